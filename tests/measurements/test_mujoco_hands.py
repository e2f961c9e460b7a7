"""Hands of all kinds in MuJoCo: fingers that slide, a preshape, couplings with offsets."""

from __future__ import annotations

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco")
pytest.importorskip("coacd")

from mujoco_baseline import MujocoBaseline  # noqa: E402

from drakegrasp.frames import invert_pose, make_pose  # noqa: E402
from drakegrasp.hand.description import load_hand  # noqa: E402
from drakegrasp.hand.kinematics import fingertip_poses, joint_positions  # noqa: E402
from drakegrasp.hand.settings import load_config  # noqa: E402
from drakegrasp.hand_setup import trial_grasps  # noqa: E402

pytestmark = [pytest.mark.sim, pytest.mark.slow]


@pytest.mark.parametrize("name", ["allegro", "franka"])
def test_fingertips_are_where_drake_has_them(name: str) -> None:
    hand, config = load_hand(name), load_config(hand=name)
    model, X_TO, *_ = next(trial_grasps(hand, "box"))
    peer = MujocoBaseline(model, X_TO, config)

    # Its fingertips are where Drake's are, in the posture in which all fingers have closed a bit.
    m, d = peer._model, peer._data
    closing = 0.3 * hand.closing_unit
    for joint, position in joint_positions(hand, 0.0, closing).items():
        if joint not in hand.preshape:
            d.qpos[m.joint(joint).qposadr[0]] = position
    mujoco.mj_kinematics(m, d)

    def pose(body: str):
        found = d.body(body)
        return make_pose(found.xmat.reshape(3, 3), found.xpos)

    X_GW = invert_pose(pose(hand.palm_link) @ hand.X_BG)
    X_GF = np.array([X_GW @ pose(link) for link in hand.fingertip_links])
    expected = fingertip_poses(hand, spread=0.0, closing=closing)
    np.testing.assert_allclose(X_GF, expected, atol=1e-6)
