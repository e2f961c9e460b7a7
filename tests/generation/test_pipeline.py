"""The main job, end to end: meshes in, files out; again, elsewhere, and after damage."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import trimesh
from helpers.assertions import assert_same_dataset
from helpers.builds import build
from helpers.tiers import few

from drakegrasp.api.building import build_dataset
from drakegrasp.config import Config
from drakegrasp.dataset.assemble import assemble
from drakegrasp.dataset.check import check_dataset
from drakegrasp.dataset.manifest import read_manifest, write_manifest
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.shards import trial_columns
from drakegrasp.dataset.statistics import count_funnel
from drakegrasp.errors import DataError
from drakegrasp.filters import Removal
from drakegrasp.generation.prepare import prepare_one
from drakegrasp.generation.replay import replay_trial
from drakegrasp.generation.work_unit import run_unit
from drakegrasp.hand.settings import load_config, override_config
from drakegrasp.objects.sources import find_meshes
from drakegrasp.outcomes import Outcome

pytestmark = [pytest.mark.sim, pytest.mark.slow]


def _nothing_runs(function: Callable, items: Iterable) -> Iterator:
    """Run tasks that only read."""
    pending = list(items)
    assert not pending or function not in (run_unit, prepare_one), "nothing may be done again"
    return (function(item) for item in pending)


#: One attempt at an object, far from it: there is nothing to lift.
FAR = ("candidates.max=1", "candidates.method=normals", "candidates.standoffs=[0.2]")


@pytest.fixture
def out(small_dataset: Path, tmp_path: Path) -> Path:
    """A copy of the small dataset."""
    return Path(shutil.copytree(small_dataset, tmp_path / "copy"))


@pytest.fixture
def meshes(small_meshes: Path, tmp_path: Path) -> Path:
    """A copy of its meshes."""
    return Path(shutil.copytree(small_meshes, tmp_path / "meshes"))


def test_every_attempt_has_a_row_and_every_success_a_look(small_dataset: Path) -> None:
    funnel = count_funnel(small_dataset)
    assert np.all(funnel.candidates == 16)
    with h5py.File(small_dataset / "trials.hdf5") as file:
        keys = ("object", "candidate", "standoff_index")
        rows = list(zip(*(file[f"trials/{key}"][:].tolist() for key in keys), strict=True))
        outcomes, ids = file["trials/outcome"][:], file["successes/trial_id"][:]
        kept = ids[file["successes/removal"][:] == Removal.KEPT]
    assert rows == list(product(range(3), range(16), range(3)))
    assert ids.tolist() == np.flatnonzero(outcomes == Outcome.SUCCESS).tolist()
    with h5py.File(small_dataset / "grasping_otm.hdf5") as file:
        sampled = np.concatenate([file[split]["trial_id"][:] for split in file])
    assert sorted(sampled.tolist()) == kept.tolist() != []


def test_dataset_keeps_every_invariant(small_dataset: Path) -> None:
    assert check_dataset(small_dataset) == []


@pytest.mark.cluster
@pytest.mark.parametrize("workers", few([1, 2], 1))
def test_number_of_workers_changes_nothing(
    small_meshes: Path, small_dataset: Path, small_config: Config, tmp_path: Path, workers: int
) -> None:
    """One of three objects is left for the workers to prepare, and two of its units to try."""
    out, ignore = tmp_path / "out", shutil.ignore_patterns("11_box_slim.*")
    for name in ("objects", "shards"):
        shutil.copytree(small_dataset / name, out / name, ignore=ignore)
    for shard in out.glob("shards/11_box_slim/000000[48]*.h5"):
        shard.unlink()
    report = build_dataset(small_meshes, out, config=small_config, workers=workers, show=False)
    assert report.simulated == 2
    assert_same_dataset(small_dataset, out)


def test_second_build_simulates_nothing_and_opens_each_shard_once(
    small_meshes: Path, out: Path, small_config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = {p: p.stat().st_mtime_ns for p in out.glob("*.hdf5")}
    opened, reader = Counter[Path](), Path.open

    def count(path: Path, *given: Any, **named: Any) -> Any:
        opened[path] += 1
        return reader(path, *given, **named)

    monkeypatch.setattr(Path, "open", count)
    report = build(small_meshes, out, small_config, _nothing_runs)
    assert (report.simulated, report.reused) == (0, 12)
    files = [*out.glob("shards/*/*.h5"), *out.glob("objects/*.h5")]
    assert {path: n for path, n in opened.items() if path.suffix == ".h5"} == Counter(files)
    assert {p: p.stat().st_mtime_ns for p in out.glob("*.hdf5")} == before


def test_object_keeps_to_what_is_said_of_it(meshes: Path, out: Path, small_config: Config) -> None:
    """A changed entry of objects.yaml prepares and simulates that object again, and no other."""
    said = "objects: {11_box_slim: {density: 600, friction: 0.9}}\n"
    (meshes / "objects.yaml").write_text(said)
    report = build(meshes, out, small_config)
    assert (report.simulated, report.reused) == (4, 8)
    assert check_dataset(out) == []

    # The manifest and /objects have it, and the lift is simulated with it.
    entry = read_manifest(out).objects[1]
    assert (entry.name, entry.friction) == ("11_box_slim", 0.9)
    assert entry.mass == pytest.approx(600.0 * 0.065 * 0.05 * 0.14, rel=1e-6)
    with h5py.File(out / "trials.hdf5") as file:
        assert file["objects/mass"][1] == entry.mass
        assert np.isnan(file["objects/friction"][0]) and file["objects/friction"][1] == 0.9
        lifted = np.flatnonzero(
            (file["trials/object"][()] == 1) & np.isfinite(file["trials/slip"][()])
        )
    assert replay_trial(out, int(lifted[0])).same
    second = build(meshes, out, small_config, _nothing_runs)
    assert second.reused == 12


def test_changed_class_is_in_the_files_without_a_simulation(
    meshes: Path, out: Path, small_config: Config
) -> None:
    (meshes / "objects.yaml").write_text("objects: {11_box_slim: {class: carton}}\n")
    report = build(meshes, out, small_config)
    assert (report.simulated, report.reused, report.assembled) == (0, 12, True)
    assert check_dataset(out) == []
    with h5py.File(out / "trials.hdf5") as file:
        assert file["objects/class_name"].asstr()[1] == "carton"
    second = build(meshes, out, small_config, _nothing_runs)
    assert not second.assembled

    # A group does not even need the object to be prepared.
    said = "objects: {11_box_slim: {class: carton, group: box}}\n"
    (meshes / "objects.yaml").write_text(said)
    second = build(meshes, out, small_config, _nothing_runs)
    assert second.assembled and read_manifest(out).objects[1].group == "box"


def test_build_keeps_what_an_inspection_rejected(
    meshes: Path, out: Path, small_config: Config
) -> None:
    """But not of a mesh that has changed since: its grasps are other ones."""
    assemble(out, rejected=[GraspDataset(out / "grasping_oto.hdf5", split="test")[0].trial_id])
    (out / "trials.hdf5").unlink()
    report = build(meshes, out, small_config, _nothing_runs)
    assert report.assembly.removed[Removal.REJECTED] == 1

    # No mesh is simulated again here: only its entry counts.
    manifest = read_manifest(out)
    changed = [replace(entry, mesh_sha256="0" * 64) for entry in manifest.objects]
    write_manifest(replace(manifest, objects=tuple(changed)), out)
    build(meshes, out, small_config)
    assert read_manifest(out).rejected == ()


def test_other_configuration_is_refused_and_nothing_changes(
    small_meshes: Path, out: Path, small_config: Config
) -> None:
    before = sorted((p, p.stat().st_mtime_ns) for p in out.rglob("*") if p.is_file())
    with pytest.raises(DataError, match=r"differs in seed \(0 there, 1 here\); choose another"):
        build(small_meshes, out, override_config(small_config, ["seed=1"]), _nothing_runs)
    assert sorted((p, p.stat().st_mtime_ns) for p in out.rglob("*") if p.is_file()) == before


def test_refused_meshes_are_listed_and_the_others_go_on(tmp_path: Path) -> None:
    """Names may have blanks and letters of any alphabet."""
    meshes, name = tmp_path / "Möbel und Töpfe", "1_чашка большая_a"
    meshes.mkdir()
    trimesh.creation.box([0.06, 0.06, 0.09]).export(meshes / f"{name}.obj")
    trimesh.creation.box([5.0, 5.0, 5.0]).export(meshes / "2_house_a.obj")
    (meshes / "3_text_a.obj").write_text("no mesh at all\n")
    out = tmp_path / "Daten ü"
    config = load_config(overrides=FAR)
    report = build(meshes, out, config)
    assert (count_funnel(out).names, count_funnel(out).classes) == ((name,), ("чашка большая",))
    assert [entry.name for entry in report.refused] == ["2_house_a", "3_text_a"]
    assert "--units" in report.refused[0].reason
    # Each has its name beside the reason, once.
    assert not any("2_house_a" in e.reason or "3_text_a" in e.reason for e in report.refused)
    assert check_dataset(out) == []
    again = build(meshes, out, config, _nothing_runs)
    assert again.refused == report.refused


@pytest.mark.parametrize("stage", ["success", "start_collision", "missing_fingertip"])
def test_replay_gives_the_same_bits(small_dataset: Path, stage: str) -> None:
    with h5py.File(small_dataset / "trials.hdf5") as file:
        outcome = file["trials/outcome"][:]
    (rows,) = np.nonzero(outcome == Outcome[stage.upper()])
    again = replay_trial(small_dataset, int(rows[-1]))
    assert again.same, again.differences
    assert again.found is Outcome[stage.upper()]


def test_replay_says_what_differs(out: Path) -> None:
    """In every column, but for those that say which attempt it is."""
    names = {f.name for f in trial_columns()} - {"candidate", "standoff_index"}
    with h5py.File(out / "trials.hdf5", "r+") as file:
        number = int(np.flatnonzero(file["trials/outcome"][:] == Outcome.SUCCESS)[0])
        names &= set(file["trials"])
        for name in names:
            values = file["trials"][name]
            row = values[number]
            # Of what a trial has no value of, a value is the difference.
            values[number] = ~row if row.dtype.kind == "b" else np.nan_to_num(row) + 1
    again = replay_trial(out, number)
    assert not again.same
    assert set(again.differences) == names
    assert again.differences["spread"] == again.differences["outcome"] == pytest.approx(1.0)
    with pytest.raises(DataError, match="trial must be 0 to 143, got 144"):
        replay_trial(out, 144)


def test_repeats_come_with_the_samples_and_change_none(
    small_meshes: Path, small_config: Config, small_dataset: Path, tmp_path: Path
) -> None:
    """Of one object, whose attempts do not depend on the others."""
    config = override_config(small_config, ["robustness.repeats=2"])
    build([find_meshes(small_meshes)[1]], tmp_path / "out", config)
    with (
        h5py.File(tmp_path / "out" / "trials.hdf5", "r") as file,
        h5py.File(small_dataset / "trials.hdf5", "r") as plain,
    ):
        tried, repeated = file["trials/robust_tried"][:], file["trials/robust_kept"][:]
        kept = file["successes/trial_id"][:][file["successes/removal"][:] == Removal.KEPT]
        own = plain["trials/object"][:] == 1
        assert file["objects/name"][0] == plain["objects/name"][1]
        assert np.array_equal(file["trials/outcome"][:], plain["trials/outcome"][:][own])
        assert not [name for name in plain["trials"] if name.startswith("robust")]
        assert np.array_equal(file["trials/slip"][:], plain["trials/slip"][:][own], equal_nan=True)
        lifted = np.isfinite(file["trials/time_lift"][:])
    # Samples by the default filters are repeated, since the filters of a dataset may change.
    assert {*tried[kept].tolist()} == {0, 2}
    assert not tried[~lifted].any()
    assert (repeated <= tried).all()
    assert (repeated[kept] == 2).any()
    assert check_dataset(tmp_path / "out") == []
