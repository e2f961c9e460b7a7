"""The format of DexGraspBench: a file per grasp, from which the posture comes back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from drakegrasp.exchange.closed_grasps import ClosedGrasp
from drakegrasp.exchange.dexgraspbench import SQUEEZE, grasp_dictionary
from drakegrasp.frames import Array
from drakegrasp.hand.description import load_hand
from drakegrasp.visualization.still_scene import StillScene


def pose_of(vector: Array) -> Array:
    """Return the pose (4, 4) of a position and a quaternion w, x, y, z, as other tools read it."""
    X = trimesh.transformations.quaternion_matrix(vector[3:])
    X[:3, 3] = vector[:3]
    return X


@pytest.fixture(scope="module")
def folder(exported: Callable[[str], Path]) -> Path:
    return exported("dexgraspbench")


def test_poses_and_joints_come_back(folder: Path, grasps: list[ClosedGrasp]) -> None:
    hand = load_hand()
    assert len(list(folder.rglob("*.npy"))) == len(grasps)
    for grasp in grasps:
        path = folder / "grasps" / grasp.object_name / f"{grasp.trial_id}.npy"
        content = np.load(path, allow_pickle=True).item()
        assert pose_of(content["obj_pose"]) == pytest.approx(grasp.X_TO, abs=1e-9)
        for key in ("pregrasp_qpos", "grasp_qpos", "squeeze_qpos"):
            X_TG = pose_of(content[key][:7]) @ hand.X_BG
            assert pytest.approx(grasp.X_TG, abs=1e-9) == X_TG
        assert (content["grasp_qpos"][7:] == grasp.q).all()
        assert content["joint_names"] == list(StillScene(hand).joints)
        assert set(content["joint_units"]) == {"rad"}


def test_fingers_begin_open_and_squeeze_further(folder: Path, grasps: list[ClosedGrasp]) -> None:
    hand, grasp = load_hand(), grasps[0]
    path = folder / "grasps" / grasp.object_name / f"{grasp.trial_id}.npy"
    content = np.load(path, allow_pickle=True).item()
    spread = np.isin(content["joint_names"], hand.spread.joints)
    start, closed, squeezed = (
        content[f"{name}_qpos"][7:] for name in ("pregrasp", "grasp", "squeeze")
    )
    assert start == pytest.approx(np.where(spread, grasp.spread, 0.0))
    assert (squeezed[spread] == closed[spread]).all()
    assert squeezed[~spread] == pytest.approx((1.0 + SQUEEZE) * closed[~spread])


def test_fingers_that_slide_have_lengths(grasps: list[ClosedGrasp]) -> None:
    hand = load_hand("franka")
    q = np.array([0.01, 0.02])
    content = grasp_dictionary(hand, StillScene(hand), replace(grasps[0], q=q, spread=0.0))
    assert content["joint_units"] == ["m", "m"]
    assert len(content["joint_names"]) == 2
    start, closed, squeezed = (
        content[f"{name}_qpos"][7:] for name in ("pregrasp", "grasp", "squeeze")
    )
    assert start == pytest.approx([0.0, 0.0])
    assert (closed == q).all()
    assert squeezed == pytest.approx((1.0 + SQUEEZE) * q)


def test_meshes_are_the_objects(folder: Path, grasps: list[ClosedGrasp]) -> None:
    for name in {grasp.object_name for grasp in grasps}:
        mesh = trimesh.load_mesh(folder / "objects" / name / "mesh.obj")
        assert mesh.is_watertight
        # The boxes of the dataset stand on the table with their centre as origin.
        height = next(grasp.X_TO[2, 3] for grasp in grasps if grasp.object_name == name)
        assert mesh.bounds[0][2] == pytest.approx(-height)
