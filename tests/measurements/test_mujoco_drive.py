"""Drives of the fingers in MuJoCo, pushed by a torque in place of contacts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.objects import CUBE, box_model

pytest.importorskip("mujoco")
pytest.importorskip("coacd")

import mujoco
from mujoco_drive import FingerDrive
from mujoco_scene import build_mujoco_scene

from drakegrasp.hand.description import load_hand
from drakegrasp.hand.file_format import Drive
from drakegrasp.hand.settings import load_config

pytestmark = pytest.mark.sim

#: Angle at which the drive engages, and what counts as none [rad].
ANGLE, STILL = 0.5, np.deg2rad(0.01)


class Rig:
    """The hand far from any object, with its first finger in the middle of its range."""

    def __init__(self, model: mujoco.MjModel, drive: Drive) -> None:
        hand = load_hand()
        self.model, self.data = model, mujoco.MjData(model)
        self.drive = FingerDrive(model, hand, drive)
        self.joint = self.data.joint(hand.fingers[0].closing_joint)
        self.data.joint("wrist_z").qpos[0] = 2.0
        for finger in hand.fingers:
            self.data.joint(finger.closing_joint).qpos[0] = ANGLE
            self.data.joint(finger.coupled[0].joint).qpos[0] = ANGLE * finger.coupled[0].ratio
        mujoco.mj_forward(model, self.data)
        self.data.ctrl[:] = hand.closing_speed
        self.drive.disengage()
        self.drive.engage(self.data)

    def push(self, torque: float, seconds: float = 0.3) -> float:
        """Push the first finger open with a torque [N m]; return its angle afterwards [rad]."""
        self.joint.qfrc_applied[0] = -torque
        for _ in range(round(seconds / self.model.opt.timestep)):
            mujoco.mj_step(self.model, self.data)
            self.drive.update(self.data)
        return float(self.joint.qpos[0])


@pytest.fixture
def model(tmp_path: Path) -> mujoco.MjModel:
    cube = box_model(tmp_path, [CUBE, CUBE, CUBE])
    return build_mujoco_scene(cube, load_hand(), load_config()).model


def test_worm_carries_what_the_motor_cannot_and_keeps_what_the_finger_closed(
    model: mujoco.MjModel,
) -> None:
    rig = Rig(model, "worm")
    assert rig.push(3.0) == pytest.approx(ANGLE, abs=STILL)
    assert rig.drive.loads(rig.data)[0] == pytest.approx(3.0, abs=0.02)
    closed = rig.push(0.0)
    assert closed > ANGLE + 0.1
    assert rig.push(8.0) > closed - STILL
    assert Rig(model, "torque").push(3.0) < ANGLE - 0.1


def test_locked_finger_neither_opens_nor_closes(model: mujoco.MjModel) -> None:
    rig = Rig(model, "locked")
    assert rig.push(0.0) == pytest.approx(ANGLE, abs=STILL)
    assert rig.push(8.0) == pytest.approx(ANGLE, abs=np.deg2rad(0.02))


def test_worm_yields_to_its_strength_and_holds_again(model: mujoco.MjModel) -> None:
    """It opens against its holding torque of 10 N m, so 10.2 N m push it open slowly."""
    rig = Rig(model, "worm")
    opened = rig.push(10.2, seconds=0.05)
    assert ANGLE - 0.3 < opened < ANGLE - 0.02
    stands = rig.push(8.0)
    assert stands < ANGLE
    assert rig.push(9.0) == pytest.approx(stands, abs=STILL)


def test_disengaged_finger_has_the_limits_of_its_files(model: mujoco.MjModel) -> None:
    limits, torques = model.jnt_range.copy(), model.actuator_forcerange.copy()
    rig = Rig(model, "worm")
    rig.push(10.2)
    rig.drive.disengage()
    np.testing.assert_array_equal(model.jnt_range, limits)
    np.testing.assert_array_equal(model.actuator_forcerange, torques)
