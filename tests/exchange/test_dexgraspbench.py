"""What MuJoCo loads: the hand, objects and grasps of DexGraspBench, and posed scenes."""

from __future__ import annotations

import json
import shutil
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
from drakegrasp.frames import invert_pose, multiply  # noqa: E402
from drakegrasp.hand.description import load_hand  # noqa: E402
from drakegrasp.hand.kinematics import fingertip_poses  # noqa: E402
from drakegrasp.mjcf import make_hand_model  # noqa: E402
from drakegrasp.pictures.still_scene import StillScene  # noqa: E402


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


def test_model_has_the_links_of_the_settings_and_the_gains_of_the_benchmark(
    folder: Path, settings: dict[str, Any]
) -> None:
    model = mujoco.MjModel.from_xml_path(str(folder / settings["xml_path"]))
    bodies = {model.body(i).name for i in range(model.nbody)}
    assert set(settings["valid_body_name"]) <= bodies
    assert settings["tip_body_name"] == list(load_hand().fingertip_links)
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


# Posed scenes for MuJoCo


def test_each_scene_has_object_and_links_where_they_were(
    exported: Callable[[str], Path], grasps: list[ClosedGrasp], tmp_path: Path
) -> None:
    """Also from another folder: meshes are found beside the scenes."""
    folder = tmp_path / "moved & renamed"
    shutil.copytree(exported("mjcf"), folder)
    assert len(list(folder.glob("*/*.xml"))) == len(grasps)
    hand = load_hand()
    posed = StillScene(hand)
    for grasp in grasps:
        path = folder / grasp.object_name / f"{grasp.trial_id}.xml"
        model = mujoco.MjModel.from_xml_path(str(path))
        data = mujoco.MjData(model)
        mujoco.mj_resetDataKeyframe(model, data, model.key("grasp").id)
        mujoco.mj_kinematics(model, data)

        np.testing.assert_allclose(data.body("object").xpos, grasp.X_TO[:3, 3], atol=1e-6)
        posed.pose(grasp.X_TG, grasp.q)
        X_TP = posed.link_pose(hand.palm_link)
        np.testing.assert_allclose(X_TP, grasp.X_TG @ invert_pose(hand.X_BG), atol=1e-9)
        for link in hand.link_chains:
            found = data.body(f"hand/{link}")
            np.testing.assert_allclose(found.xpos, posed.link_pose(link)[:3, 3], atol=1e-6)


def test_motors_keep_the_fingers_and_the_object_touches_with_its_convex_parts(
    exported: Callable[[str], Path], grasps: list[ClosedGrasp]
) -> None:
    path = exported("mjcf") / grasps[0].object_name / f"{grasps[0].trial_id}.xml"
    model = mujoco.MjModel.from_xml_path(str(path))
    at = model.key_qpos[0][model.jnt_qposadr[model.actuator_trnid[:, 0]]]
    np.testing.assert_allclose(model.key_ctrl[0], at)
    assert model.body("object").mass[0] == pytest.approx(1.0)

    # A box is one part, with its own edges.
    (part,) = np.flatnonzero(model.geom_bodyid == model.body("object").id)
    np.testing.assert_allclose(model.geom_aabb[part], [0.0, 0.0, 0.0, 0.025, 0.03, 0.05], atol=1e-7)
    np.testing.assert_allclose(model.geom_friction[part, 0], grasps[0].conditions[0])
    assert model.geom_condim[part] == 4
