"""The check as a whole: what passes, what is missing, damaged or of another layout."""

from __future__ import annotations

import gc
import shutil
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import h5py
import numpy as np
import pytest
from helpers.datasets import (
    CERTIFIED,
    OTM,
    OTO,
    TRIALS,
    change,
    edit_file,
    found,
    must_find,
    must_find_without_shards,
    set_at,
)

from drakegrasp.dataset.assembly import pack
from drakegrasp.dataset.checks import rows, run, samples
from drakegrasp.dataset.checks.run import check_dataset
from drakegrasp.dataset.manifest import read_manifest, write_manifest
from drakegrasp.dataset.paths import model_path, plan_path
from drakegrasp.dataset.shards import read_shard, write_shard
from drakegrasp.errors import DataError
from drakegrasp.hand.settings import load_config
from drakegrasp.objects.model import ObjectModel, load_object, save_object
from drakegrasp.runtime.executor import processes

T, R = TypeVar("T"), TypeVar("R")


def test_a_sound_dataset_passes(sound: Path) -> None:
    assert check_dataset(sound) == []
    with h5py.File(sound / OTO) as file:
        assert {s: len(file[s]["grasps"]) for s in file} == {"train": 2, "valid": 1, "test": 6}


@pytest.mark.parametrize("name", [OTO, OTM, TRIALS])
def test_a_sound_file_passes_alone(sound: Path, tmp_path: Path, name: str) -> None:
    shutil.copy(sound / name, tmp_path / "renamed.h5")
    assert check_dataset(tmp_path / "renamed.h5") == []


def test_progress_ends_at_the_total(sound: Path) -> None:
    seen: list[tuple[int, int]] = []
    check_dataset(sound, progress=lambda done, total, **_: seen.append((done, total)))
    assert seen[-1][0] == seen[-1][1] == 36 + 2 * 9 + 12
    assert [done for done, _ in seen] == sorted(done for done, _ in seen)


@pytest.mark.nightly
def test_two_processes_find_what_one_does(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Small tasks, with faults in the first and the last rows, in an object and in a shard."""
    (out / "shards/2_box_b/0000002-0000004.h5").unlink()
    model_path(out, "1_box_a").write_bytes(b"")
    edit_file(out / TRIALS, lambda f: f["trials/candidate"].__setitem__(slice(None), 99))
    edit_file(out / TRIALS, lambda f: f["trials/object"].__setitem__(35, 9))
    for name in (OTO, OTM):
        edit_file(out / name, lambda f: f["test/grasps"].__setitem__((5, 0), np.nan))
    expected = check_dataset(out)
    kinds = [(v.file, v.group) for v in expected]
    assert kinds.count((TRIALS, "/trials")) == 22  # 20 candidates, the number of more, an object
    assert {(OTO, "/test"), (OTM, "/test"), ("objects/1_box_a.npz", "")} <= set(kinds)

    for module in (run, pack):
        monkeypatch.setattr(module, "TASK_ROWS", 7)
    monkeypatch.setattr(samples, "TASK_ROWS", 1)
    small = check_dataset(out)
    assert sorted(map(str, small)) == sorted(map(str, expected))
    assert check_dataset(out, execute=backwards) == small
    with processes(2) as execute:
        assert check_dataset(out, execute=execute) == small


def backwards(function: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
    """Run as workers may: the last item is done first."""
    return map(function, reversed(list(items)))


def test_file_that_is_replaced_meanwhile_is_one_error(out: Path) -> None:
    def replacing(function: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
        for item in items:
            shutil.copy(out / OTO, out / "copy")
            (out / "copy").replace(out / OTO)
            yield function(item)

    with pytest.raises(DataError, match=r"_oto.hdf5: must stay while it is checked, got another"):
        check_dataset(out, execute=replacing)


def test_meshes_and_files_are_let_go_with_each_task(
    sound: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without the collector of cycles."""
    alive: list[weakref.ref[ObjectModel]] = []

    def load(path: Path) -> ObjectModel:
        model = load_object(path)
        alive.append(weakref.ref(model))
        return model

    monkeypatch.setattr(rows, "load_object", load)
    gc.collect()
    gc.disable()
    try:
        assert check_dataset(sound) == []
    finally:
        gc.enable()
    assert alive
    assert not any(model() for model in alive)


def test_files_of_other_shards_are_found(out: Path) -> None:
    """A shard that is whole, and not the one that the files were made from."""
    header = next(read_manifest(out).headers())
    shard = read_shard(header.path(out), header)
    slip = np.array(shard.trials["slip"])
    slip[np.isfinite(slip)] += 1e-3
    write_shard(out, replace(shard, trials={**shard.trials, "slip": slip}))
    what = "attribute shards must be that of the shards that are there"
    must_find(out, *((name, "", None, what) for name in (OTO, OTM, TRIALS)))


@pytest.mark.parametrize("packing", [{"compression": "gzip", "compression_opts": 9}, {}])
def test_images_that_are_packed_otherwise_are_compared_by_value(
    out: Path, packing: dict[str, object]
) -> None:
    with h5py.File(out / OTO, "r+") as file:
        values, attributes = file["train/images"][:], dict(file["train/images"].attrs)
        del file["train/images"]
        file.create_dataset("train/images", data=values, **packing).attrs.update(attributes)
    must_find(out)
    change(out, OTO, "train/images", 1, set_at(0, 0, 0, to=0.25))
    must_find(out, (OTO, "/train", 1, "images must be what the shard holds"))


def test_trials_without_sound_objects_are_not_compared(out: Path) -> None:
    def spoil(file: h5py.File) -> None:
        del file["objects/valid"]
        file["trials/object"][...] = 99

    edit_file(out / TRIALS, spoil)
    must_find(out, (TRIALS, "/objects/valid", None, "the dataset must be there"))


def test_file_with_a_link_hides_no_other_fault(out: Path) -> None:
    edit_file(out / OTM, lambda f: f.__setitem__("link", h5py.SoftLink("/train")))
    change(out, OTO, "train/images", 0, set_at(0, 0, 0, to=2.0))
    must_find(
        out,
        (OTM, "", None, "the file must hold its own values"),
        (OTO, "/train", 0, "images must be what the shard holds"),
    )


def test_object_file_that_cannot_be_read_is_found(
    out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(out: Path, name: str, expected: str) -> None:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(run, "refuse_changed_model", fail)
    what = "an object's file must be as it was written"
    names = [entry.name for entry in read_manifest(out).objects]
    must_find(out, *((f"objects/{name}.npz", "", None, what) for name in names))


def test_any_path_of_a_dataset_may_have_faults(out: Path, tmp_path: Path) -> None:
    odd = Path(shutil.copytree(out, tmp_path / "a: b, got c" / "out"))
    model_path(odd, "1_box_a").unlink()
    plan_path(odd, "2_box_b").write_bytes(b"")
    places = {v.file: v.got for v in check_dataset(odd)}
    assert {"objects/1_box_a.npz", "objects/2_box_b.plan.h5"} <= set(places)
    assert "a: b" not in places["objects/2_box_b.plan.h5"]


def test_each_file_of_an_object_is_checked(out: Path) -> None:
    """Shards that are damaged or of another unit, meshes, and a flipped bit in a plan."""
    damaged, other = ("shards/1_box_a/0000000-0000002.h5", "shards/2_box_b/0000000-0000002.h5")
    edit_file(out / damaged, lambda f: f["trials/slip"].__setitem__(0, 0.5))
    shard = read_shard(out / other)
    write_shard(out, replace(shard, header=replace(shard.header, mesh_sha256="0")))
    content = bytearray(plan_path(out, "2_box_b").read_bytes())
    content[-100] ^= 1
    plan_path(out, "2_box_b").write_bytes(content)
    model_path(out, "3_brick").unlink()
    box = load_object(model_path(out, "1_box_a"))
    save_object(replace(box, mesh_sha256="0"), model_path(out, "1_box_a"))

    written, whole = "an object's file must be as it was written", "the shard must be there, whole"
    violations = {(v.file, v.what): v.got for v in check_dataset(out)}
    assert violations.keys() == {
        *((path, f"{whole} and of its work unit") for path in (damaged, other)),
        ("objects/2_box_b.plan.h5", written),
        ("objects/3_brick.npz", "the object must be readable"),
        ("objects/3_brick.npz", written),
        ("objects/1_box_a.npz", written),
        ("objects/1_box_a.npz", "mesh_sha256 must be that of manifest.json"),
    }
    assert "damaged or cut off" in violations[damaged, f"{whole} and of its work unit"]


def test_files_are_of_the_manifests_configuration(out: Path) -> None:
    manifest = read_manifest(out)
    files = (OTO, OTM, TRIALS)
    overrides = ["camera.size=32", "unit_candidates=2", "split.valid_fraction=0.34", *CERTIFIED]
    other = load_config(overrides=overrides)
    write_manifest(replace(manifest, config=other), out)
    what = "attribute config must be that of manifest.json"
    must_find(out, *((name, "", None, what) for name in files))
    other = load_config(overrides=[*overrides, "seed=1"])
    write_manifest(replace(manifest, config=other), out)
    hits = {h for h in found(out) if not h[0].startswith("shards")}
    assert {h[0] for h in hits} == set(files)
    assert all(h[3].startswith("attribute config must be that of manifest.json") for h in hits)


def test_a_truncated_file_is_found_and_the_others_are_still_checked(out: Path) -> None:
    content = (out / OTM).read_bytes()
    (out / OTM).write_bytes(content[: len(content) // 2])
    change(out, OTO, "train/images", 0, set_at(0, 0, 0, to=2.0))
    must_find(
        out,
        (OTM, "", None, "the file must be there and readable"),
        (OTO, "/train", 0, "images must be what the shard holds"),
    )
    with pytest.raises(DataError, match="cannot be read"):
        check_dataset(out / OTM)


def damage(path: Path, column: str) -> None:
    """Overwrite the first bytes of a column's first chunk."""
    with h5py.File(path) as file:
        offset = file[column].id.get_chunk_info(0).byte_offset
    with open(path, "r+b") as raw:
        raw.seek(offset)
        raw.write(b"\xff" * 64)


@pytest.mark.parametrize("column", ["images", "object_props/work2mass"])
def test_rows_that_cannot_be_read_are_found(out: Path, column: str) -> None:
    """Also those of a column that both data files have; they are compared with nothing."""
    damage(out / OTO, f"train/{column}")
    must_find(out, (OTO, "/train", None, "rows 0 to 1 must be readable"))


def test_samples_are_not_compared_with_trials_that_cannot_be_read(out: Path) -> None:
    damage(out / TRIALS, "trials/slip")
    must_find_without_shards(out, (TRIALS, "/trials", None, "rows 0 to 35 must be readable"))


def test_what_is_no_dataset_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"without manifest\.json"):
        check_dataset(tmp_path)
    with pytest.raises(DataError, match="must be the directory"):
        check_dataset(tmp_path / "missing.hdf5")
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["x"] = [1, 2]
    with pytest.raises(DataError, match="another HDF5 file"):
        check_dataset(tmp_path / "other.h5")


def test_a_broken_invariant_is_listed_for_twenty_rows_and_then_counted(out: Path) -> None:
    with h5py.File(out / TRIALS, "r+") as file:
        file["trials/spread"][...] = np.nan
    violations = check_dataset(out / TRIALS)
    assert len(violations) == 21
    assert violations[0].row == 0
    assert str(violations[0]).startswith("trials.hdf5 /trials row 0: spread must be finite, got")
    assert str(violations[-1]).endswith("got 16 more rows that break it")


def retype(file: h5py.File) -> None:
    values, attrs = file["valid/masks"][:], dict(file["valid/masks"].attrs)
    del file["valid/masks"]
    file["valid/masks"] = values.astype(np.int32)
    file["valid/masks"].attrs.update(attrs)


LAYOUT_CASES: Mapping[str, tuple[str, Callable[[h5py.File], Any], str, str]] = {
    "extra group": (OTO, lambda f: f.create_group("more"), "", "groups must be those of"),
    "no group": (OTO, lambda f: f.pop("valid"), "/valid", "the group must be there"),
    "extra dataset": (
        OTO,
        lambda f: f.create_dataset("valid/object_props/x", data=[0]),
        "/valid",
        "datasets must be those of the schema",
    ),
    "no dataset": (OTM, lambda f: f.pop("valid/masks"), "/valid/masks", "the dataset must be"),
    "rows": (OTO, lambda f: f["valid/masks"].resize(2, 0), "/valid/masks", "shape must be (1, 32"),
    "type": (OTO, retype, "/valid/masks", "type must be uint8"),
    "unit": (
        OTO,
        lambda f: f["valid/grasps"].attrs.update(unit="mm"),
        "/valid/grasps",
        "attribute unit must be 'm, -'",
    ),
    "frame": (
        TRIALS,
        lambda f: f["trials/slip"].attrs.update(frame="W"),
        "/trials/slip",
        "attribute frame must be 'G'",
    ),
    "meaning": (
        TRIALS,
        lambda f: f["trials/slip"].attrs.pop("meaning"),
        "/trials/slip",
        "attribute meaning must be there",
    ),
    "schema": (OTO, lambda f: f.attrs.update(schema_version=0), "", "attribute schema_version"),
    "K": (OTO, lambda f: f.attrs.update(K=np.eye(3)), "", "attribute K must be"),
    "far": (OTO, lambda f: f.attrs.update(far=1.0), "", "attribute far must be 0.75"),
    "near": (OTO, lambda f: f.attrs.pop("near"), "", "attribute near must be a positive"),
    "seed": (TRIALS, lambda f: f.attrs.update(seed=5), "", "attribute seed must be 0"),
    "hash": (TRIALS, lambda f: f.attrs.update(config_hash="0"), "", "attribute config_hash must"),
    "config": (OTO, lambda f: f.attrs.update(config="{"), "", "attribute config must be a conf"),
    "versions": (OTO, lambda f: f.attrs.update(versions="1"), "", "attribute versions must be a"),
    "convention": (
        OTO,
        lambda f: f.attrs.pop("convention_depth"),
        "",
        "attribute convention_depth must be there",
    ),
    "camera": (OTO, lambda f: f.attrs.update(camera="otm"), "", "attribute camera must be oto"),
}


#: What a file by itself does not show: a file of another version is refused.
OF_DATASET = ("schema", "camera")


@pytest.mark.parametrize("case", LAYOUT_CASES)
def test_a_wrong_layout_or_attribute_is_found(out: Path, case: str) -> None:
    name, edit, group, what = LAYOUT_CASES[case]
    edit_file(out / name, edit)
    must_find(out if case in OF_DATASET else out / name, (name, group, None, what))
