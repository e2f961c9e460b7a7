"""What the page shows of attempts with a mass and a camera of their own."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.datasets import TRIALS, make_dataset

from drakegrasp.dataset.quality import GRAVITY
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.frames import invert_pose, transform_points, unpack_pose
from drakegrasp.page.renders import THUMBNAIL, contact_dots, read_rows
from drakegrasp.page.snapshot import read_snapshot
from drakegrasp.vision.camera import intrinsics, project


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The boxes, each attempt with a mass and cameras of its own. Read only."""
    folder = tmp_path_factory.mktemp("drawn")
    draws = ("mass=[0.5, 1.5]", "camera_shift=0.02", "camera_turn_deg=10")
    return make_dataset(folder / "out", folder, overrides=[f"randomize.{draw}" for draw in draws])


def imbalance(out: Path) -> np.ndarray:
    """Return that of every attempt; nothing carries the weight.

    The fingertips of every success push with 12.5 N along -y of {O}.
    """
    with h5py.File(out / TRIALS) as file:
        weights = GRAVITY * file["trials/mass"][:]
        y_T = unpack_pose(file["trials/X_TO_lifted"][:])[:, :3, 1]
    rest_T = -12.5 * y_T - weights[:, None] * np.array([0.0, 0.0, 1.0])
    return np.linalg.norm(rest_T, axis=1) / weights


def test_anomaly_is_of_the_drawn_mass(drawn: Path) -> None:
    snapshot, expected = read_snapshot(drawn), imbalance(drawn)
    for i in (0, 3, 11):
        assert snapshot.table.imbalance[i] == pytest.approx(expected[i], rel=1e-6)


@pytest.mark.parametrize("camera", ["oto", "otm"])
def test_dots_are_where_the_moved_camera_sees_the_contacts(drawn: Path, camera: str) -> None:
    snapshot = read_snapshot(drawn)
    data = GraspDataset(drawn / f"grasping_{camera}.hdf5", split="test")
    trial = int(data.column("trial_id")[0])
    (row,) = read_rows(snapshot, [trial], THUMBNAIL)
    X_TC = unpack_pose(data.column(f"object_props/frame_work2cam_{camera}")[0].astype(float))
    X_CO = invert_pose(X_TC) @ unpack_pose(row["X_TO"])
    expected = project(
        intrinsics(snapshot.config.camera), transform_points(X_CO, row["closed_p_OQ"])
    )
    dots = contact_dots(snapshot, row, camera)
    assert len(dots) == 3
    np.testing.assert_allclose([[dot.u, dot.v] for dot in dots], expected, atol=0.01)
