"""The files of DexGraspBench: a hand, objects and grasps that its loader reads."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
import yaml

pytest.importorskip("coacd")
mujoco = pytest.importorskip("mujoco")

from drakegrasp.exchange.dexgraspbench import APART, grasp_dictionary  # noqa: E402
from drakegrasp.exchange.export import ClosedGrasp  # noqa: E402
from drakegrasp.frames import Array, multiply  # noqa: E402
from drakegrasp.hand.description import load_hand  # noqa: E402
from drakegrasp.hand.kinematics import fingertip_poses  # noqa: E402
from drakegrasp.mjcf import make_hand_model  # noqa: E402
from drakegrasp.pictures.still_scene import StillScene  # noqa: E402


def pose_of(vector: Array) -> Array:
    """Return the pose (4, 4) of a position and a quaternion w, x, y, z, as other tools read it."""
    X = trimesh.transformations.quaternion_matrix(vector[3:])
    X[:3, 3] = vector[:3]
    return X


@pytest.fixture(scope="module")
def folder(exported: Callable[[str], Path]) -> Path:
    return exported("dexgraspbench")


@pytest.fixture(scope="module")
def settings(folder: Path) -> dict[str, Any]:
    return yaml.safe_load((folder / "config/hand/drakegrasp_barrett.yaml").read_text())


def content_of(folder: Path, grasp: ClosedGrasp) -> dict[str, Any]:
    data = folder / "output/export_drakegrasp_barrett/graspdata"
    path = data / grasp.object_name / f"{grasp.trial_id}.npy"
    return np.load(path, allow_pickle=True).item()


def test_fingers_open_and_press_by_equal_steps(folder: Path, grasps: list[ClosedGrasp]) -> None:
    hand, content = load_hand(), content_of(folder, grasps[0])
    start, closed, squeezed = (
        dict(zip(content["joint_names"], content[f"{name}_qpos"][7:], strict=True))
        for name in ("pregrasp", "grasp", "squeeze")
    )
    for finger in hand.fingers:
        for joint, ratio in (
            (finger.closing_joint, 1.0),
            *((c.joint, c.ratio) for c in finger.coupled),
        ):
            assert squeezed[joint] - closed[joint] == pytest.approx(APART * ratio)
            assert start[joint] == pytest.approx(max(closed[joint] - APART * ratio, 0.0), abs=1e-9)
    for joint in hand.spread.joints:
        assert start[joint] == closed[joint] == squeezed[joint]


def test_fingers_that_slide_have_lengths(grasps: list[ClosedGrasp]) -> None:
    hand, q = load_hand("franka"), np.array([0.03, 0.03])
    grasp = replace(grasps[0], q=q, spread=0.0)
    joints = tuple(joint.name for joint in make_hand_model(hand).joints)
    content = grasp_dictionary(hand, StillScene(hand), joints, grasp)
    assert content["joint_units"] == ["m", "m"]
    moved = content["squeeze_qpos"][7:] - content["grasp_qpos"][7:]
    assert np.abs(moved) == pytest.approx([0.1 * APART] * 2)


def test_hand_is_one_model_with_fingertips_where_drake_has_them(
    folder: Path, settings: dict[str, Any]
) -> None:
    """As the benchmark has it: the world of the MJCF is the palm link."""
    hand = load_hand()
    model = mujoco.MjModel.from_xml_path(str(folder / settings["xml_path"]))
    data = mujoco.MjData(model)
    closing = 0.3 * hand.closing_unit
    c = np.concatenate([[0.2], closing])
    for name, gain, offset in zip(
        hand.joint_names, hand.joint_gain, hand.joint_offset, strict=True
    ):
        data.qpos[model.joint(name).qposadr[0]] = gain @ c + offset
    mujoco.mj_kinematics(model, data)
    expected = fingertip_poses(hand, spread=0.2, closing=closing)
    for link, X_GF in zip(hand.fingertip_links, expected, strict=True):
        p_WF = multiply(hand.X_BG, X_GF)[:3, 3]
        np.testing.assert_allclose(data.body(link).xpos, p_WF, atol=1e-6)


def test_motors_have_the_gains_of_the_benchmark(folder: Path, settings: dict[str, Any]) -> None:
    model = mujoco.MjModel.from_xml_path(str(folder / settings["xml_path"]))
    assert model.nu == 5
    # The benchmark's MuJoCo does not know the attribute by which newer ones write a position.
    assert "input=" not in (folder / settings["xml_path"]).read_text()
    assert set(model.actuator_gainprm[:, 0]) == {5.0}
    assert (np.abs(model.actuator_forcerange) == 3.0).all()


def test_motors_of_fingers_that_slide_work_in_metres() -> None:
    """A metre is ten radians, as in `description.SLIDE`; a force of 1 N then is 0.1 N m."""
    model = make_hand_model(load_hand("franka")).compile()
    np.testing.assert_allclose(model.dof_damping, [5.0, 5.0])
    np.testing.assert_allclose(model.dof_armature, [0.02, 0.02])
    np.testing.assert_allclose(model.actuator_gainprm[:, 0], 500.0)
    np.testing.assert_allclose(model.actuator_biasprm[:, 1], -500.0)
    np.testing.assert_allclose(model.actuator_forcerange, [[-30.0, 30.0]])


def test_hand_has_the_friction_of_mujocos_defaults() -> None:
    """A coefficient of 1, and that which is asked for."""
    hand = load_hand("franka")
    for model, friction in ((make_hand_model(hand), 1.0), (make_hand_model(hand, 0.6), 0.6)):
        assert set(model.compile().geom_friction[:, 0]) == {friction}


def test_settings_name_links_of_the_model(folder: Path, settings: dict[str, Any]) -> None:
    model = mujoco.MjModel.from_xml_path(str(folder / settings["xml_path"]))
    bodies = {model.body(i).name for i in range(model.nbody)}
    assert set(settings["valid_body_name"]) <= bodies
    assert settings["tip_body_name"] == list(load_hand().fingertip_links)


def test_objects_have_their_volume(folder: Path, grasps: list[ClosedGrasp]) -> None:
    """From it the benchmark has the density that makes every object as heavy."""
    for grasp in grasps:
        path = content_of(folder, grasp)["obj_path"]
        info = json.loads((folder / path / "info/simplified.json").read_text())
        parts = [trimesh.load_mesh(p) for p in (folder / path / "urdf/meshes").glob("*.obj")]
        assert all(part.is_volume for part in parts)
        assert info["mass"] == pytest.approx(sum(part.volume for part in parts))
        # The boxes of the dataset lie on the table with their centre as origin.
        lowest = min((part.vertices @ grasp.X_TO[2, :3]).min() for part in parts)
        assert lowest == pytest.approx(-grasp.X_TO[2, 3], abs=1e-3)
