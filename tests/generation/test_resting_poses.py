"""A build of two samplers that take turns at several resting poses."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from unittest.mock import Mock

import h5py
import numpy as np
import pytest
from cross_check import cross_check
from helpers.builds import build
from helpers.meshes import write_fixed

from drakegrasp.config import Config
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.frames import unpack_pose
from drakegrasp.hand.settings import load_config
from drakegrasp.objects.sources import MeshSource, find_meshes
from drakegrasp.outcomes import Outcome
from drakegrasp.verification.placing import dataset_config, place_on_rows

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
    return made_once("resting poses", lambda out: build(sources, out, config))


def trials(out: Path) -> dict[str, np.ndarray]:
    with h5py.File(out / "trials.hdf5") as file:
        return {name: values[:] for name, values in file["trials"].items()}


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
    placed = place_on_rows(grasps, data, config=dataset_config(data))
    assert sorted(each.index for each in placed) == list(range(len(grasps)))
    assert len(np.unique(rows["resting"][tried])) > 1
    for each in placed:
        X_TO = unpack_pose(rows["X_TO"][tried[each.index]])
        np.testing.assert_array_equal(each.placed.X_TO, X_TO)


def test_lifts_are_tried_elsewhere_as_they_lay(
    dataset: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mujoco_baseline = pytest.importorskip("mujoco_baseline")
    peer = Mock()
    peer.run.return_value = mujoco_baseline.PeerTrial(outcome=Outcome.MOVED)
    monkeypatch.setattr(mujoco_baseline, "MujocoBaseline", lambda *_: peer)
    lifts = cross_check(dataset, 12)["lifts"]
    columns = trials(dataset)
    ids = [lift["trial_id"] for lift in lifts]
    assert len(np.unique(columns["resting"][ids])) > 1
    # Each lift is run where it was placed.
    assert [name for name, *_ in peer.mock_calls] == len(ids) * ["place", "run"]
    stood = [call.args[0] for call in peer.place.call_args_list]
    np.testing.assert_array_equal(stood, [unpack_pose(columns["X_TO"][i]) for i in ids])
