"""Posed scenes for MuJoCo: they load where they lie, and show the grasp."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("coacd")
mujoco = pytest.importorskip("mujoco")

from drakegrasp.exchange.export import ClosedGrasp  # noqa: E402
from drakegrasp.frames import invert_pose  # noqa: E402
from drakegrasp.hand.description import load_hand  # noqa: E402
from drakegrasp.pictures.still_scene import StillScene  # noqa: E402


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


@pytest.fixture
def model(exported: Callable[[str], Path], grasps: list[ClosedGrasp]) -> Any:
    path = exported("mjcf") / grasps[0].object_name / f"{grasps[0].trial_id}.xml"
    return mujoco.MjModel.from_xml_path(str(path))


def test_motors_keep_the_fingers_where_they_are(model: Any) -> None:
    joints = model.actuator_trnid[:, 0]
    at = model.key_qpos[0][model.jnt_qposadr[joints]]
    np.testing.assert_allclose(model.key_ctrl[0], at)
    assert model.body("object").mass[0] == pytest.approx(1.0)


def test_object_touches_with_its_convex_parts(model: Any, grasps: list[ClosedGrasp]) -> None:
    # A box is one part, with its own edges.
    (part,) = np.flatnonzero(model.geom_bodyid == model.body("object").id)
    np.testing.assert_allclose(model.geom_aabb[part], [0.0, 0.0, 0.0, 0.025, 0.03, 0.05], atol=1e-7)
    np.testing.assert_allclose(model.geom_friction[part, 0], grasps[0].conditions[0])
    assert model.geom_condim[part] == 4
