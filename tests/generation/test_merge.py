"""Datasets that were built apart become one: halves by objects, and what is refused."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import pytest
from helpers import datasets
from helpers.assertions import assert_same_arrays
from helpers.datasets import BOTH, BOXES, TRIALS, edit_manifest, make_dataset

from drakegrasp.dataset.assemble import assemble
from drakegrasp.dataset.check import check_dataset
from drakegrasp.dataset.manifest import read_manifest, write_manifest
from drakegrasp.dataset.rejections import AttemptKey
from drakegrasp.errors import DataError
from drakegrasp.generation.merge import merge
from drakegrasp.hand.file_format import MODELS
from drakegrasp.hand.settings import override_config
from drakegrasp.page.snapshot import read_snapshot
from drakegrasp.runtime.files import seal

NAMES = list(BOXES)


def half(whole: Path, out: Path, places: slice) -> Path:
    """Return a dataset of some of the objects of another."""
    shutil.copytree(whole, out)
    manifest = read_manifest(out)
    write_manifest(replace(manifest, objects=manifest.objects[places]), out)
    assemble(out)
    return out


def files_of(out: Path) -> dict[str, bytes]:
    return {str(p.relative_to(out)): p.read_bytes() for p in out.rglob("*") if p.is_file()}


def test_halves_by_objects_are_the_whole(sound: Path, tmp_path: Path) -> None:
    first = half(sound, tmp_path / "first", slice(0, 2))
    second = half(sound, tmp_path / "second", slice(2, 3))
    before = files_of(first), files_of(second)
    merge(tmp_path / "into", [first, second])
    for name in (*BOTH, TRIALS):
        assert_same_arrays(tmp_path / "into" / name, sound / name)
    assert (tmp_path / "into/manifest.json").read_bytes() == (sound / "manifest.json").read_bytes()
    assert check_dataset(tmp_path / "into") == []
    # Those that it is made of are as before, and share its shards.
    assert (files_of(first), files_of(second)) == before
    assert {path.stat().st_nlink for path in (tmp_path / "into/shards").rglob("*.h5")} == {2}


def test_where_files_cannot_be_linked_they_are_copied(
    sound: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_link(*_: object) -> None:
        raise OSError("another file system")

    monkeypatch.setattr(os, "link", no_link)
    merge(tmp_path / "into", [sound])
    assert files_of(tmp_path / "into").keys() <= files_of(sound).keys()
    assert check_dataset(tmp_path / "into") == []


def test_a_hand_counts_by_its_files_and_not_by_their_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    outs = []
    for number in range(2):
        own = dict([*BOXES.items()][number : number + 1])
        monkeypatch.setattr(datasets, "BOXES", own)
        folder = shutil.copytree(MODELS, tmp_path / f"hands{number}")
        changed = (f"hand={folder / 'barrett_hand.yaml'}",)
        meshes = tmp_path / f"meshes{number}"
        outs.append(make_dataset(tmp_path / f"{number}", meshes, overrides=changed))
    merge(tmp_path / "into", outs)
    assert check_dataset(tmp_path / "into") == []


def test_rejections_stay_and_are_inspected(sound: Path, out: Path, tmp_path: Path) -> None:
    key = AttemptKey(NAMES[0], 0, 0)
    assemble(out, rejected=[key])
    merge(tmp_path / "into", [sound, out])
    assert read_manifest(tmp_path / "into").rejected == (key,)
    assert check_dataset(tmp_path / "into") == []
    state = read_snapshot(tmp_path / "into")
    place = state.find(key)
    assert place is not None
    assert state.table.lifted[place]


# What is refused


def changed(edit: Callable[[dict], object]) -> Callable[[Path], None]:
    """Return what gives a dataset, and its files, another manifest."""

    def change(out: Path) -> None:
        edit_manifest(out, edit)
        sign(out)

    return change


def built_with(override: str) -> Callable[[Path], None]:
    def change(out: Path) -> None:
        manifest = read_manifest(out)
        config = override_config(manifest.config, [override])
        write_manifest(replace(manifest, config=config), out)
        sign(out)

    return change


def sign(out: Path) -> None:
    """Let the files of a dataset be of its manifest."""
    for name in (*BOTH, TRIALS):
        with h5py.File(out / name, "r+") as file:
            file.attrs["signature"] = read_manifest(out).signature()


def a_shard(out: Path) -> Path:
    return next((out / "shards" / NAMES[1]).iterdir())


def with_another_shard(out: Path) -> None:
    with h5py.File(a_shard(out), "r+") as file:
        file["trials/time_close"][0] += 1e-6
    seal(a_shard(out))
    assemble(out)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            built_with("physics.friction_hand=0.5"),
            "differs in physics.friction_hand (0.71 there, 0.5 here)",
        ),
        (built_with("filters.max_slip=0.004"), "differs in filters.max_slip"),
        (built_with("seed=1"), "differs in seed"),
        (changed(lambda m: m["versions"].update(drake="1.0")), "must be of drake "),
        (changed(lambda m: m["versions"].update(hand="0")), "must be of hand "),
        (changed(lambda m: m["objects"][1].update(mass=0.5)), "got others in mass"),
        (with_another_shard, f"shards/{NAMES[1]}/"),
        (lambda out: a_shard(out).unlink(), "must be a complete shard, got none"),
        (lambda out: (out / TRIALS).unlink(), "must be a complete dataset"),
    ],
)
def test_what_differs_is_named_and_refused(
    change: Callable[[Path], None], said: str, sound: Path, out: Path
) -> None:
    change(out)
    before = files_of(out)
    with pytest.raises(DataError) as caught:
        merge(out.parent / "into", [sound, out])
    assert said in str(caught.value)
    assert str(out) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert files_of(out) == before
    # Nothing is left of the merged dataset.
    assert not [path for path in out.parent.iterdir() if "into" in path.name]


def test_a_directory_in_use_is_refused(sound: Path, out: Path) -> None:
    with pytest.raises(DataError, match="must be a new or empty directory"):
        merge(out, [sound])
