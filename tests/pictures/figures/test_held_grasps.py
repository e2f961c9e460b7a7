"""Held grasps as arrays, and the approaches of one object."""

from __future__ import annotations

import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.datasets import SLIP, TRIALS, edit_file

from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.errors import DataError
from drakegrasp.frames import unpack_pose
from drakegrasp.pictures.figures.held_grasps import read_approaches, read_held


def test_every_success_is_read_once(sound: Path) -> None:
    held = read_held(sound)
    assert held.trial_ids.tolist() == [0, 3, 11, 12, 15, 23, 24, 27, 35]
    assert [int(group.sum()) for group in held.groups.values()] == [9, 9, 9]
    np.testing.assert_allclose(held.quantities["slip in the hand [mm]"], 1e3 * SLIP)
    np.testing.assert_allclose(held.quantities["turn in the hand [°]"], 1.0)
    np.testing.assert_allclose(held.quantities["largest fingertip force after the lift [N]"], 12.5)
    np.testing.assert_allclose(held.quantities["largest penetration after the lift [mm]"], 0.125)


def test_a_file_without_successes_has_none(sound: Path, tmp_path: Path) -> None:
    shutil.copy(sound / TRIALS, tmp_path)
    edit_file(tmp_path / TRIALS, lambda f: f["trials/outcome"].write_direct(np.full(36, 9, "u1")))
    held = read_held(tmp_path)
    assert len(held.trial_ids) == 0
    assert all(len(values) == 0 for values in held.quantities.values())


def test_what_is_no_dataset_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"trials\.hdf5: must be the trials"):
        read_held(tmp_path)


def test_approaches_are_of_one_object(sound: Path, tmp_path: Path) -> None:
    config = read_manifest(sound).config
    found = read_approaches(sound, "2_box_b", config)
    assert found.attempts == 12
    assert found.groups.tolist() == [2, 2, 2]  # stable
    # All palms are tilted by 0.25 rad; the one attempt whose ray misses, row 7, approached nothing.
    np.testing.assert_allclose(found.successes[:, 2], np.cos(0.25), atol=1e-9)
    with h5py.File(sound / TRIALS, "r") as file:
        rows = [1, 2, 4, 5, 6, 8, 9, 10]
        X_TO, X_OG = (unpack_pose(file[f"trials/{name}"][12:24][rows]) for name in ("X_TO", "X_OG"))
    np.testing.assert_allclose(found.directions, -(X_TO @ X_OG)[:, :3, 2], atol=1e-9)
    with h5py.File(sound / TRIALS, "r") as file:
        standoffs = np.array(config.candidates.standoffs)
        rows = file["trials/standoff_index"][12:24][[0, 3, 11]]
    lengths = np.linalg.norm(found.rays[:, 1] - found.rays[:, 0], axis=1)
    np.testing.assert_allclose(lengths, standoffs[rows])
