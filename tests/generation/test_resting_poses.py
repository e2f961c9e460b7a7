"""A build of two samplers that take turns at several resting poses."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from cross_check import cross_check
from helpers.assertions import assert_same_arrays, assert_same_dataset
from helpers.builds import build
from helpers.meshes import write_fixed

from drakegrasp.config import Config
from drakegrasp.dataset.assemble import assemble
from drakegrasp.dataset.check import check_dataset
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.trials import Trials
from drakegrasp.filters import Removal
from drakegrasp.frames import unpack_pose
from drakegrasp.hand.settings import load_config, override_config
from drakegrasp.objects.sources import MeshSource, find_meshes
from drakegrasp.outcomes import Outcome
from drakegrasp.pictures.approaches import read_approaches
from drakegrasp.runtime.executor import run_here
from drakegrasp.verification.placing import contacts_on_rows, dataset_config

pytestmark = [pytest.mark.sim, pytest.mark.slow]


@pytest.fixture(scope="module")
def config() -> Config:
    return load_config(
        overrides=[
            *("candidates.max=16", "unit_candidates=8", "candidates.method=[normals, rotations]"),
            *("objects.resting_poses=3", "filters.outlier_sigma=0", "split.by=object"),
            "objects.mass=0.2",
            *("physics.friction_hand=1.5", "lift.max_speed=2", "lift.max_acceleration=20"),
            *("lift.hold_time=0.1", "camera.size=32"),
        ]
    )


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> list[MeshSource]:
    folder = tmp_path_factory.mktemp("meshes")
    write_fixed(folder, "8_wineglass_flute")
    shutil.copy(folder / "8_wineglass_flute.obj", folder / "9_wineglass_twin.obj")
    return find_meshes(folder)


@pytest.fixture(scope="module")
def dataset(
    sources: list[MeshSource],
    config: Config,
    made_once: Callable[[str, Callable[[Path], object]], Path],
) -> Path:
    """The dataset. Read only."""
    return made_once("resting poses", lambda out: build(sources, out, config, run_here, show=False))


def trials(out: Path) -> dict[str, np.ndarray]:
    with h5py.File(out / "trials.hdf5") as file:
        return {name: values[:] for name, values in file["trials"].items()}


def samples(out: Path) -> np.ndarray:
    """Return the rows of the samples."""
    with h5py.File(out / "trials.hdf5") as file:
        removal, ids = file["successes/removal"][:], file["successes/trial_id"][:]
    return np.asarray(ids[removal == Removal.KEPT])


def test_check_finds_nothing(dataset: Path) -> None:
    assert [str(v) for v in check_dataset(dataset)] == []


def test_samplers_and_resting_poses_take_turns(dataset: Path) -> None:
    columns = trials(dataset)
    first = columns["standoff_index"] == 0
    manifest = json.loads((dataset / "manifest.json").read_text())
    for i, entry in enumerate(manifest["objects"]):
        own = first & (columns["object"] == i)
        poses = len(entry["resting"])
        assert poses > 1
        turns = np.arange(own.sum())
        np.testing.assert_array_equal(columns["resting"][own], turns % poses)
        np.testing.assert_array_equal(columns["source"][own], 1 - turns // poses % 2)
        for k, resting in enumerate(entry["resting"]):
            rows = columns["X_TO"][(columns["object"] == i) & (columns["resting"] == k)]
            assert np.all(rows == resting["X_TO"])


def test_samples_are_verified_as_they_lay(dataset: Path) -> None:
    """Grasps of all rows, those of other resting poses too, are put on the table as tried."""
    data, rows = GraspDataset(dataset / "grasping_oto.hdf5"), trials(dataset)
    tried, grasps = data.column("trial_id"), data.column("grasps")
    placed = contacts_on_rows(grasps, data, config=dataset_config(data))
    assert sorted(each.index for each in placed) == list(range(len(grasps)))
    assert len(np.unique(rows["resting"][tried])) > 1
    for each in placed:
        X_TO = unpack_pose(rows["X_TO"][tried[each.index]])
        np.testing.assert_array_equal(each.placed.X_TO, X_TO)


def test_lifts_are_tried_elsewhere_as_they_lay(
    dataset: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mujoco_baseline = pytest.importorskip("mujoco_baseline")
    stood: list[np.ndarray] = []

    class Peer:
        """Says where the object stood when a lift was tried."""

        def __init__(self, *_: object) -> None:
            pass

        def place(self, X_TO: np.ndarray) -> None:
            self.X_TO = X_TO

        def run(self, _: object) -> object:
            stood.append(self.X_TO)
            return mujoco_baseline.PeerTrial(outcome=Outcome.MOVED)

    monkeypatch.setattr(mujoco_baseline, "MujocoBaseline", Peer)
    lifts = cross_check(dataset, 12)["lifts"]
    columns = trials(dataset)
    ids = [lift["trial_id"] for lift in lifts]
    assert len(np.unique(columns["resting"][ids])) > 1
    np.testing.assert_array_equal(stood, [unpack_pose(columns["X_TO"][i]) for i in ids])


def test_pictures_are_of_one_resting_pose(dataset: Path) -> None:
    columns, name = trials(dataset), "8_wineglass_flute"
    own = (columns["object"] == 0) & (Trials(dataset)["removal"] == Removal.KEPT)
    counts = np.bincount(columns["resting"][own])
    assert 0 < counts.max() < counts.sum()
    shown = read_approaches(dataset, name, read_manifest(dataset).config_of(name))
    assert len(shown.samples) == counts.max()
    assert shown.elsewhere == counts.sum() - counts.max()
    pose = (columns["object"] == 0) & (columns["resting"] == counts.argmax())
    assert shown.attempts == np.count_nonzero(pose)


@pytest.mark.nightly
def test_more_palm_poses_extend_a_dataset(
    dataset: Path, sources: list[MeshSource], config: Config, tmp_path: Path
) -> None:
    """Eight and then sixteen give what sixteen give at once; only the last unit is run."""
    fewer = override_config(config, ["candidates.max=8"])
    build(sources[:1], tmp_path, fewer, run_here, show=False)
    report = build(sources[:1], tmp_path, config, run_here, show=False)
    assert (report.simulated, report.reused) == (1, 1)
    shards = sorted(tmp_path.glob("shards/*/*.h5"))
    assert len(shards) == 2
    for shard in shards:
        assert_same_arrays(shard, dataset / shard.relative_to(tmp_path))


def test_target_is_met_and_extended(
    dataset: Path, sources: list[MeshSource], config: Config, tmp_path: Path
) -> None:
    # All units are done; the target says which of them belong to the dataset.
    out = tmp_path / "out"
    shutil.copytree(dataset, out)
    few = override_config(config, ["samples=2"])
    build(sources, out, few, run_here, show=False)
    assert [str(v) for v in check_dataset(out)] == []
    with h5py.File(out / "trials.hdf5") as file:
        before = {row.tobytes() for row in file["trials/X_OG"][:]}
    assert len(before) < len(trials(dataset)["outcome"])

    # More than there can be: all palm poses are tried.
    most = override_config(config, ["samples=1000", "samples_patience=1000"])
    assert build(sources, out, most, run_here, show=False).simulated == 0
    columns = trials(out)
    for name, values in trials(dataset).items():
        np.testing.assert_array_equal(columns[name], values)
    assert before <= {row.tobytes() for row in columns["X_OG"]}


def test_assembling_again_gives_the_same(dataset: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(dataset, copy)
    assemble(copy)
    assert_same_dataset(copy, dataset)
