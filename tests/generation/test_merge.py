"""Datasets that were built apart become one: halves by objects, and what is refused."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers import datasets
from helpers.assertions import assert_same_arrays
from helpers.builds import build
from helpers.datasets import (
    BOTH,
    BOXES,
    TRIALS,
    edit_manifest,
    make_dataset,
)
from helpers.meshes import write_fixed

from drakegrasp.dataset.assemble import assemble
from drakegrasp.dataset.check import check_dataset
from drakegrasp.dataset.manifest import read_manifest, write_manifest
from drakegrasp.dataset.rejections import AttemptKey
from drakegrasp.errors import DataError
from drakegrasp.generation.merge import merge
from drakegrasp.generation.replay import replay_trial
from drakegrasp.hand.file_format import MODELS
from drakegrasp.hand.settings import load_config, override_config
from drakegrasp.objects.sources import find_meshes
from drakegrasp.outcomes import Outcome
from drakegrasp.page.snapshot import read_snapshot
from drakegrasp.runtime.executor import run_here
from drakegrasp.runtime.files import seal

NAMES = list(BOXES)


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small dataset of boxes. Read only."""
    return make_dataset(tmp_path_factory.mktemp("sound"), tmp_path_factory.mktemp("meshes"))


@pytest.fixture
def copy(sound: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(sound, tmp_path / "copy"))


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


def test_the_same_again_is_taken_once(sound: Path, copy: Path, tmp_path: Path) -> None:
    merge(tmp_path / "once", [sound, copy])
    assert_same_arrays(tmp_path / "once" / TRIALS, sound / TRIALS)


def test_rejections_stay_and_are_inspected(sound: Path, copy: Path, tmp_path: Path) -> None:
    key = AttemptKey(NAMES[0], 0, 0)
    assemble(copy, rejected=[key])
    merge(tmp_path / "into", [sound, copy])
    assert read_manifest(tmp_path / "into").rejected == (key,)
    assert check_dataset(tmp_path / "into") == []
    state = read_snapshot(tmp_path / "into")
    place = state.find(key)
    assert place is not None
    assert state.table.held[place]


# What is refused


def with_manifest(edit: Callable[[dict], object]) -> Callable[[Path, Path], list[Path]]:
    """Return two datasets, the second with another manifest, of which its files are."""

    def spoil(sound: Path, copy: Path) -> list[Path]:
        edit_manifest(copy, edit)
        return [sound, signed(copy)]

    return spoil


def signed(out: Path) -> Path:
    """Return a dataset whose files are now said to be of its manifest."""
    for name in (*BOTH, TRIALS):
        with h5py.File(out / name, "r+") as file:
            file.attrs["signature"] = read_manifest(out).signature()
    return out


def built_with(override: str) -> Callable[[Path, Path], list[Path]]:
    def say(sound: Path, copy: Path) -> list[Path]:
        manifest = read_manifest(copy)
        config = override_config(manifest.config, [override])
        write_manifest(replace(manifest, config=config), copy)
        return [sound, signed(copy)]

    return say


def with_another_shard(sound: Path, copy: Path) -> list[Path]:
    path = next((copy / "shards" / NAMES[1]).iterdir())
    with h5py.File(path, "r+") as file:
        file["trials/time_close"][0] += 1e-6
    seal(path)
    assemble(copy)
    return [sound, copy]


def without_a_shard(sound: Path, copy: Path) -> list[Path]:
    next((copy / "shards" / NAMES[1]).iterdir()).unlink()
    return [sound, copy]


def not_assembled(sound: Path, copy: Path) -> list[Path]:
    (copy / TRIALS).unlink()
    return [sound, copy]


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (
            built_with("physics.friction_hand=0.5"),
            "differs in physics.friction_hand (0.71 there, 0.5 here)",
        ),
        (built_with("camera.fov_y_deg=40.0"), "differs in camera.fov_y_deg"),
        (built_with("candidates.max=99"), "differs in candidates.max"),
        (built_with("filters.max_slip=0.004"), "differs in filters.max_slip"),
        (with_manifest(lambda m: m["versions"].update(drake="1.0")), "must be of drake "),
        (with_manifest(lambda m: m["versions"].update(hand="0")), "must be of hand "),
        (with_manifest(lambda m: m["versions"].update(drakegrasp="0.1")), "be of drakegrasp "),
        (with_manifest(lambda m: m["objects"][1].update(mass=0.5)), "got others in mass"),
        (with_another_shard, f"shards/{NAMES[1]}/"),
        (without_a_shard, "must be a complete shard, got none"),
        (not_assembled, "must be a complete dataset"),
        (built_with("seed=1"), "differs in seed"),
    ],
)
def test_what_differs_is_named_and_refused(
    make: Callable[[Path, Path], list[Path]], said: str, sound: Path, copy: Path
) -> None:
    outs = make(sound, copy)
    before = files_of(outs[1])
    with pytest.raises(DataError) as caught:
        merge(copy.parent / "into", outs)
    assert said in str(caught.value)
    assert str(outs[1]) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert files_of(outs[1]) == before
    # Nothing is left of the merged dataset.
    assert not [path for path in copy.parent.iterdir() if "into" in path.name]


def test_a_directory_in_use_is_refused(sound: Path, copy: Path) -> None:
    with pytest.raises(DataError, match="must be a new or empty directory"):
        merge(copy, [sound])


@pytest.mark.nightly
@pytest.mark.sim
@pytest.mark.slow
def test_merged_builds_replay_bit_equal(tmp_path: Path) -> None:
    """Everything is drawn: palm poses, resting poses and conditions."""
    write_fixed(tmp_path / "meshes", "8_wineglass_flute", "10_box_tall")
    sources = find_meshes(tmp_path / "meshes")
    drawn = [
        *("candidates.max=8", "unit_candidates=4", "candidates.method=[normals, rotations]"),
        *("objects.resting_poses=2", "filters.outlier_sigma=0", "filters.require=held"),
        "physics.friction_hand=1.5",
    ]
    outs = [tmp_path / "first", tmp_path / "second"]
    for out, own in zip(outs, (sources[:1], sources[1:]), strict=True):
        build(own, out, load_config("randomized", overrides=drawn), run_here, show=False)
    build(
        sources,
        tmp_path / "whole",
        load_config("randomized", overrides=drawn),
        run_here,
        show=False,
    )

    # Halves by objects are the whole, may be built on, and replay.
    merge(tmp_path / "halves", outs[:2])
    assert_same_arrays(tmp_path / "halves" / TRIALS, tmp_path / "whole" / TRIALS)
    report = build(
        sources,
        tmp_path / "halves",
        load_config("randomized", overrides=drawn),
        run_here,
        show=False,
    )
    assert (report.simulated, report.assembled) == (0, False)
    with h5py.File(tmp_path / "halves" / TRIALS) as file:
        owner, outcome = (file["trials"][key][:] for key in ("object", "outcome"))
    for number in range(2):
        lifted = np.flatnonzero((owner == number) & (outcome == Outcome.SUCCESS))
        for row in (*np.flatnonzero(owner == number)[:2], *lifted[:1]):
            again = replay_trial(tmp_path / "halves", int(row))
            assert again.same, (number, row, again.differences)
