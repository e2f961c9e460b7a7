"""Datasets that were built apart become one: halves by objects, by seeds, and what is refused."""

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
from helpers.assertions import arrays_of, assert_same_arrays
from helpers.builds import build
from helpers.datasets import (
    BOTH,
    BOXES,
    OTO,
    TRIALS,
    edit_manifest,
    make_dataset,
)
from helpers.meshes import write_fixed
from helpers.tiers import few

from drakegrasp.dataset.assemble import assemble
from drakegrasp.dataset.check import check_dataset
from drakegrasp.dataset.manifest import claim_directory, read_manifest, write_manifest
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.rejections import AttemptKey
from drakegrasp.errors import DataError
from drakegrasp.generation.merge import merge
from drakegrasp.generation.replay import replay_trial
from drakegrasp.hand.files import MODELS
from drakegrasp.hand.settings import load_config, override_config
from drakegrasp.objects.sources import find_meshes
from drakegrasp.outcomes import Outcome
from drakegrasp.page.catalog import read_snapshot
from drakegrasp.runtime.executor import run_here
from drakegrasp.runtime.files import seal

NAMES = list(BOXES)


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small dataset of boxes. Read only."""
    return make_dataset(tmp_path_factory.mktemp("sound"), tmp_path_factory.mktemp("meshes"))


@pytest.fixture(scope="module")
def other(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same under another seed. Read only."""
    folder = tmp_path_factory.mktemp("other")
    return make_dataset(folder / "out", folder, overrides=["seed=1"])


@pytest.fixture(scope="module")
def merged(sound: Path, other: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Both in one. Read only."""
    into = tmp_path_factory.mktemp("merged") / "into"
    merge(into, [sound, other])
    return into


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


def rows_of(out: Path, name: str) -> dict[str, np.ndarray]:
    """Return the rows of /trials of an object, by column, without what only a dataset knows."""
    columns = arrays_of(out / TRIALS)
    number = columns["objects/name"].tolist().index(name.encode())
    rows = columns["trials/object"] == number
    own = {key: column[rows] for key, column in columns.items() if key.startswith("trials/")}
    return {k: v for k, v in own.items() if k not in ("trials/trial_id", "trials/object")}


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


def test_a_dataset_of_one_object_is_sound(sound: Path, tmp_path: Path) -> None:
    assert check_dataset(half(sound, tmp_path / "one", slice(2, 3))) == []


def test_where_files_cannot_be_linked_they_are_copied(
    sound: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_link(*_: object) -> None:
        raise OSError("another file system")

    monkeypatch.setattr(os, "link", no_link)
    merge(tmp_path / "into", [sound])
    assert files_of(tmp_path / "into").keys() <= files_of(sound).keys()
    assert check_dataset(tmp_path / "into") == []


def test_halves_by_seeds_keep_everything(sound: Path, other: Path, merged: Path) -> None:
    assert check_dataset(merged) == []
    manifest = read_manifest(merged)
    assert [entry.name for entry in manifest.objects] == NAMES + [f"{n}-seed-1" for n in NAMES]
    assert [manifest.config_of(entry.name).seed for entry in manifest.objects] == 3 * [0] + 3 * [1]
    for source, suffix in ((sound, ""), (other, "-seed-1")):
        for name in NAMES:
            theirs, ours = rows_of(source, name), rows_of(merged, name + suffix)
            for key, values in theirs.items():
                assert np.array_equal(values, ours[key], equal_nan=values.dtype.kind == "f"), (
                    name,
                    key,
                )


def test_a_hand_counts_by_its_files_and_not_by_their_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(datasets, "BOXES", dict([*BOXES.items()][:1]))
    outs = []
    for seed in "01":
        folder = shutil.copytree(MODELS, tmp_path / f"hands{seed}")
        changed = (f"seed={seed}", f"hand={folder / 'barrett_hand.yaml'}")
        outs.append(make_dataset(tmp_path / seed, tmp_path / "meshes", overrides=changed))
    merge(tmp_path / "into", outs)
    assert check_dataset(tmp_path / "into") == []


@pytest.mark.parametrize("rule", few(["class", "object"], 1))
def test_a_mesh_under_two_seeds_is_in_one_split(rule: str, merged: Path, tmp_path: Path) -> None:
    """By class as usual, where a class has two objects; and by object."""
    into = merged
    if rule == "object":
        into, split = tmp_path / "into", f"split.by={rule}"
        merge(
            into,
            [
                make_dataset(
                    tmp_path / seed, tmp_path / "meshes", overrides=[f"seed={seed}", split]
                )
                for seed in "01"
            ],
        )
        assert check_dataset(into) == []
    home = {
        name.removesuffix("-seed-1"): set[str]()
        for name in (entry.name for entry in read_manifest(into).objects)
    }
    for part in ("train", "valid", "test"):
        data = GraspDataset(into / OTO, split=part)
        for name in data.column("object_props/object_name"):
            home[name.removesuffix("-seed-1")].add("test" if part == "test" else "other")
    assert {len(parts) for parts in home.values()} == {1}
    assert {"test"} in home.values()
    assert {"other"} in home.values()


def test_the_same_again_is_taken_once_and_merged_datasets_are_merged(
    sound: Path, other: Path, merged: Path, copy: Path, tmp_path: Path
) -> None:
    merge(tmp_path / "once", [sound, copy])
    assert_same_arrays(tmp_path / "once" / TRIALS, sound / TRIALS)
    merge(tmp_path / "again", [merged, other, copy])
    assert_same_arrays(tmp_path / "again" / TRIALS, merged / TRIALS)


def test_of_an_object_that_was_tried_for_longer_all_is_taken(
    sound: Path, copy: Path, tmp_path: Path
) -> None:
    manifest = read_manifest(copy)
    shorter = tuple(replace(entry, tried=2) for entry in manifest.objects)
    write_manifest(replace(manifest, objects=shorter), copy)
    assemble(copy)
    merge(tmp_path / "into", [copy, sound])
    assert_same_arrays(tmp_path / "into" / TRIALS, sound / TRIALS)


def test_rejections_stay_and_are_inspected(sound: Path, other: Path, tmp_path: Path) -> None:
    """Of a removed success, the image is in the shard, which has the hash of its own seed."""
    second = Path(shutil.copytree(other, tmp_path / "second"))
    assemble(second, rejected=[AttemptKey(NAMES[0], 0, 0)])
    merge(tmp_path / "into", [sound, second])
    key = AttemptKey(f"{NAMES[0]}-seed-1", 0, 0)
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


def under_another_seed(edit: Callable[[dict], object]) -> Callable[[Path, Path], list[Path]]:
    """Return two datasets, the second of another seed and with another manifest."""

    def spoil(sound: Path, copy: Path) -> list[Path]:
        other = make_dataset(copy.parent / "b", copy.parent / "meshes", overrides=["seed=1"])
        return with_manifest(edit)(sound, other)

    return spoil


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
        (under_another_seed(lambda m: m["objects"][1].update(mesh_sha256="0")), "mesh_sha256"),
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


def test_several_seeds_are_not_built_on(sound: Path, merged: Path) -> None:
    with pytest.raises(DataError, match="must be of one seed to be built on"):
        claim_directory(merged, read_manifest(sound).config)


@pytest.mark.nightly
@pytest.mark.sim
@pytest.mark.slow
def test_merged_builds_replay_bit_equal(tmp_path: Path) -> None:
    """Everything is drawn: palm poses, resting poses and conditions of each seed."""
    write_fixed(tmp_path / "meshes", "8_wineglass_flute", "10_box_tall")
    sources = find_meshes(tmp_path / "meshes")
    drawn = [
        *("candidates.max=8", "unit_candidates=4", "candidates.method=[normals, rotations]"),
        *("objects.resting_poses=2", "filters.outlier_sigma=0", "filters.require=held"),
        "physics.friction_hand=1.5",
    ]
    outs = [tmp_path / "first", tmp_path / "second", tmp_path / "other"]
    for out, seed, own in ((0, 0, sources[:1]), (1, 0, sources[1:]), (2, 9, sources)):
        config = load_config("randomized", overrides=drawn, seed=seed)
        build(own, outs[out], config, run_here, show=False)
    build(
        sources,
        tmp_path / "whole",
        load_config("randomized", overrides=drawn),
        run_here,
        show=False,
    )

    # Halves by objects are the whole, and may be built on.
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

    # Both seeds replay.
    merge(tmp_path / "into", outs)
    assert check_dataset(tmp_path / "into") == []
    with h5py.File(tmp_path / "into" / TRIALS) as file:
        owner, outcome = (file["trials"][key][:] for key in ("object", "outcome"))
    assert len(np.unique(owner)) == 4
    for number in range(4):
        lifted = np.flatnonzero((owner == number) & (outcome == Outcome.SUCCESS))
        for row in (*np.flatnonzero(owner == number)[:2], *lifted[:1]):
            again = replay_trial(tmp_path / "into", int(row))
            assert again.same, (number, row, again.differences)
