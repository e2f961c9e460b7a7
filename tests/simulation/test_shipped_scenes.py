"""What Drake is given of every hand that comes with the package: the numbers of its hand file."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.objects import from_above, standing

from drakegrasp.config import Config
from drakegrasp.frames import X_WT
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.file_format import hand_names
from drakegrasp.objects.model import ObjectModel
from drakegrasp.simulation.construction import build_scene
from drakegrasp.simulation.scene import (
    Scene,
    advance,
    closing_angles,
    hand_joint_names,
    hand_positions,
    reset_attempt,
)

pytestmark = pytest.mark.sim


@pytest.fixture(scope="module", params=hand_names())
def shipped(request: pytest.FixtureRequest, cube: ObjectModel, config: Config) -> Scene:
    """The hand high above the cube, after it closed for 0.2 s from a tenth of its way."""
    hand = load_hand(request.param)
    scene, X_WO = build_scene(cube, config.physics, hand), X_WT @ standing(cube)
    start = 0.1 * hand.closing_unit
    X_WG = X_WO @ from_above(cube, 0.5).X_OG
    reset_attempt(scene, X_WO, X_WG, spread=0.0, closing=start)
    advance(scene, 0.2)
    return scene


def test_gains_are_of_joints_that_turn_or_slide(shipped: Scene) -> None:
    """A motor that is 0.1 rad/s, or 0.01 m/s, too slow gives 2 N m, or 20 N."""
    for finger in shipped.hand.fingers:
        (actuator,) = (
            a for m in shipped.motors for a in m.actuators
            if a.joint().name() == finger.closing_joint
        )  # fmt: skip
        d, p = (2000.0, 1e-4) if finger.slides else (20.0, 1e-6)
        gains = actuator.get_controller_gains()
        assert (gains.d, gains.p) == (pytest.approx(d), pytest.approx(p))


def test_fingers_close_at_their_speed(shipped: Scene) -> None:
    hand = shipped.hand
    start = 0.1 * hand.closing_unit[hand.motor_fingers]
    expected = start + 0.2 * np.asarray(hand.closing_speed)[hand.motor_fingers]
    np.testing.assert_allclose(closing_angles(shipped), expected, rtol=0.02)


def test_coupled_joints_are_where_the_hand_file_has_them(shipped: Scene) -> None:
    """And those of the preshape, to the bit."""
    q = dict(zip(hand_joint_names(shipped), hand_positions(shipped), strict=True))
    assert {joint: q[joint] for joint in shipped.hand.preshape} == dict(shipped.hand.preshape)
    for finger in shipped.hand.fingers:
        for coupling in finger.coupled:
            expected = coupling.ratio * q[finger.closing_joint] + coupling.offset
            assert q[coupling.joint] == pytest.approx(expected, abs=2e-3), coupling.joint


def test_limits_of_closing_joints_are_the_models(shipped: Scene) -> None:
    """They are what a drive gives back, and what an empty hand closes up to."""
    hand = shipped.hand
    for joint, limits in zip(shipped.closing_joints, shipped.closing_limits, strict=True):
        described = hand.joint_limits[hand.joint_names.index(joint.name())]
        assert limits == pytest.approx(described)
        assert joint.position_lower_limits()[0] == limits[0] < limits[1]
