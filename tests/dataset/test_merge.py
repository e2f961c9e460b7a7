"""One dataset of several."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from helpers.datasets import BOXES, TRIALS, make_dataset

from drakegrasp.dataset.assemble import assemble
from drakegrasp.dataset.checks.run import check_dataset
from drakegrasp.dataset.manifest import read_manifest, write_manifest
from drakegrasp.dataset.merge import merge
from drakegrasp.dataset.paths import DATA_FILES, FILE_NAME
from drakegrasp.dataset.shards import read_shard, write_shard
from drakegrasp.errors import DataError

NAMES = list(BOXES)
IDENTITY = ("object", "resting", "candidate", "standoff_index", "child")


def half(sound: Path, out: Path, names: Sequence[str]) -> Path:
    """Return a dataset of some of the objects, as it would have been built of these alone."""
    shutil.copytree(sound, out)
    manifest = read_manifest(out)
    kept = tuple(entry for entry in manifest.objects if entry.name in names)
    write_manifest(replace(manifest, objects=kept), out)
    assemble(out)
    return out


@pytest.fixture(scope="module")
def halves(sound: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two datasets of the objects, the last ones first. Read only."""
    folder = tmp_path_factory.mktemp("halves")
    return [half(sound, folder / str(i), NAMES[2 - 2 * i : 4 - 2 * i]) for i in range(2)]


@pytest.fixture(scope="module")
def seeds(sound: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """The same objects under two seeds. Read only."""
    folder = tmp_path_factory.mktemp("seeds")
    return [sound, make_dataset(folder / "seed", folder / "meshes", "seed=7")]


def rows(out: Path, name: str, group: str) -> dict[Any, list[Any]]:
    """Return the columns of a table by the identity of the attempts, but for numbers of rows."""
    with h5py.File(out / TRIALS) as file:
        objects = file["objects/name"].asstr()[()]
        keys = [file["trials"][key][()] for key in IDENTITY]
    identities = list(zip(objects[keys[0]], *keys[1:], strict=True))
    with h5py.File(out / name) as file:
        columns: dict[str, Any] = {}
        file[group].visititems(
            lambda key, item: columns.update({key: item[()]}) if hasattr(item, "dtype") else None
        )
        ids = columns.pop("trial_id")
    columns.pop("object", None)
    return {identities[i]: [columns[key][k] for key in sorted(columns)] for k, i in enumerate(ids)}


def test_halves_equal_the_whole_but_for_order(
    sound: Path, halves: list[Path], tmp_path: Path
) -> None:
    merge(tmp_path / "into", halves)
    tables = [(TRIALS, "trials")]
    tables += [(name, split) for name in DATA_FILES.values() for split in ("train", "test")]
    for name, group in tables:
        merged, whole = rows(tmp_path / "into", name, group), rows(sound, name, group)
        assert merged.keys() == whole.keys()
        assert merged
        for key, values in whole.items():
            for a, b in zip(merged[key], values, strict=True):
                np.testing.assert_array_equal(a, b)


def test_a_merged_dataset_is_sound(halves: list[Path], seeds: list[Path], tmp_path: Path) -> None:
    for number, outs in enumerate((halves, seeds)):
        merge(tmp_path / f"into{number}", outs)
        assert [str(v) for v in check_dataset(tmp_path / f"into{number}")] == []


def test_sources_stay_as_they_are(halves: list[Path], seeds: list[Path], tmp_path: Path) -> None:
    def content() -> dict[Path, bytes]:
        files = (path for out in (*halves, *seeds) for path in out.rglob("*"))
        return {path: path.read_bytes() for path in files if path.is_file()}

    before = content()
    merge(tmp_path / "into", [*halves, *seeds])
    assert content() == before


def test_what_two_datasets_hold_is_taken_once(
    sound: Path, halves: list[Path], tmp_path: Path
) -> None:
    merge(tmp_path / "into", [*halves, sound])
    assert rows(tmp_path / "into", TRIALS, "trials").keys() == rows(sound, TRIALS, "trials").keys()


def test_the_dataset_with_more_attempts_of_an_object_counts(sound: Path, tmp_path: Path) -> None:
    short = half(sound, tmp_path / "short", NAMES)
    manifest = read_manifest(short)
    write_manifest(
        replace(manifest, objects=tuple(replace(e, tried=2) for e in manifest.objects)), short
    )
    merge(tmp_path / "into", [short, sound])
    assert rows(tmp_path / "into", TRIALS, "trials").keys() == rows(sound, TRIALS, "trials").keys()


def test_an_object_under_two_seeds_has_two_names_and_one_group(
    seeds: list[Path], tmp_path: Path
) -> None:
    merge(tmp_path / "into", seeds)
    entries = read_manifest(tmp_path / "into").objects
    expected = [(name, None, name) for name in NAMES]
    expected += [(f"{name} seed 7", 7, name) for name in NAMES]
    assert [(entry.name, entry.seed, entry.group) for entry in entries] == expected


def test_an_object_of_another_seed_keeps_its_name_if_it_is_the_only_one(
    sound: Path, seeds: list[Path], tmp_path: Path
) -> None:
    parts = [half(seeds[i], tmp_path / str(i), NAMES[i : i + 1]) for i in range(2)]
    merge(tmp_path / "into", parts)
    entries = read_manifest(tmp_path / "into").objects
    assert [(e.name, e.seed, e.group) for e in entries] == [
        (NAMES[0], None, None),
        (NAMES[1], 7, None),
    ]


def test_merging_again_takes_nothing_twice(seeds: list[Path], tmp_path: Path) -> None:
    merge(tmp_path / "once", seeds)
    merge(tmp_path / "again", [tmp_path / "once", seeds[1]])
    for name in (FILE_NAME, TRIALS):
        assert (tmp_path / "again" / name).read_bytes() == (tmp_path / "once" / name).read_bytes()


def test_rejections_go_with_their_objects(seeds: list[Path], tmp_path: Path) -> None:
    other = half(seeds[1], tmp_path / "other", NAMES)
    assemble(other, rejected=[0])
    merge(tmp_path / "into", [seeds[0], other])
    (key,) = read_manifest(tmp_path / "into").rejected
    assert (key.object, key.candidate) == (f"{NAMES[0]} seed 7", 0)


def edit_manifest(out: Path, edit: Callable[[dict[str, Any]], None]) -> None:
    tree = json.loads((out / FILE_NAME).read_text())
    edit(tree)
    (out / FILE_NAME).write_text(json.dumps(tree))


def other_filters(out: Path) -> None:
    assemble(out, overrides=["filters.outlier_sigma=3"])


def other_drake(out: Path) -> None:
    edit_manifest(out, lambda tree: tree["versions"].update(drake="0.1"))


def other_mesh(out: Path) -> None:
    edit_manifest(out, lambda tree: tree["objects"][0].update(mesh_sha256="00"))


def other_results(out: Path) -> None:
    path = next((out / "shards" / NAMES[0]).glob("*.h5"))
    shard = read_shard(path)
    trials = {**shard.trials, "slip": shard.trials["slip"] + 1e-3}
    write_shard(out, replace(shard, trials=trials))


def no_results(out: Path) -> None:
    next((out / "shards" / NAMES[0]).glob("*.h5")).unlink()


def older_schema(out: Path) -> None:
    edit_manifest(out, lambda tree: tree.update(schema_version=3))


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (other_filters, r"differs in filters.outlier_sigma \(4.0 there, 3.0 here\)"),
        (other_drake, r"differs in drake \([0-9.]+ there, 0.1 here\)"),
        (other_mesh, f"{NAMES[0]} must be of the same mesh"),
        (other_results, "must equal .* of the same attempts"),
        (no_results, f"must be complete, got no results of {NAMES[0]}"),
        (older_schema, "schema must be 4 for anything but reading, got 3"),
    ],
)
def test_datasets_that_do_not_go_together_are_refused(
    sound: Path, tmp_path: Path, spoil: Callable[[Path], None], told: str
) -> None:
    other = half(sound, tmp_path / "other", NAMES)
    spoil(other)
    with pytest.raises(DataError, match=told) as error:
        merge(tmp_path / "into", [sound, other])
    assert "\n" not in str(error.value)
    assert not (tmp_path / "into").exists()


def test_a_directory_with_files_is_refused(sound: Path, halves: list[Path]) -> None:
    with pytest.raises(DataError, match="must be a new or empty directory"):
        merge(halves[0], [sound])


def test_nothing_is_left_of_a_merge_that_fails(
    halves: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise RuntimeError

    monkeypatch.setattr("drakegrasp.dataset.merge.assemble_locked", fail)
    before = sorted(tmp_path.iterdir())
    with pytest.raises(RuntimeError):
        merge(tmp_path / "into", halves)
    assert sorted(tmp_path.iterdir()) == before


def test_files_are_copied_where_they_cannot_be_linked(
    halves: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    merge(tmp_path / "linked", halves)

    def refuse(*_: object) -> None:
        raise OSError

    monkeypatch.setattr("os.link", refuse)
    merge(tmp_path / "copied", halves)
    name = TRIALS
    assert (tmp_path / "copied" / name).read_bytes() == (tmp_path / "linked" / name).read_bytes()
