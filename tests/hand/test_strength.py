"""How hard fingertips can be loaded: levers by hand and by differences, torques by drive."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.hands import PINCER_SDF, changed_finger, write_pincer

from drakegrasp.frames import transform_points
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.kinematics import (
    closing_levers,
    coordinate_limits,
    fingertip_forces,
    fingertip_poses,
    within_load,
)

#: Distance of the gripper's pad points from their hinges [m].
ARM = np.hypot(0.01, 0.09)


def pad_points(hand: Hand, spread: float, closing: np.ndarray) -> np.ndarray:
    """Return the pad points (k, 3) in {G} [m]."""
    X_GF = fingertip_poses(hand, spread=spread, closing=closing)
    return np.array(
        [transform_points(X, f.p_FiP[None])[0] for X, f in zip(X_GF, hand.fingers, strict=True)]
    )


def test_lever_of_a_single_hinge_is_the_distance_from_it(tmp_path):
    hand = load_hand(write_pincer(tmp_path))
    for closing in ([0.0, 0.0], [0.3, 0.9]):
        assert np.allclose(closing_levers(hand, closing), ARM)


@pytest.mark.parametrize("spread", [0.0, 0.8])
def test_lever_of_coupled_joints_is_the_speed_of_the_pad_point(spread):
    hand, h = load_hand(), 1e-6
    for closing in (np.zeros(3), np.array([0.4, 1.1, 2.2])):
        moved = pad_points(hand, spread, closing + h) - pad_points(hand, spread, closing - h)
        assert np.allclose(
            closing_levers(hand, closing), np.linalg.norm(moved, axis=1) / (2.0 * h), rtol=1e-8
        )


def test_fingers_press_with_their_motors_and_hold_what_the_others_press():
    """Motors of 2, 2 and 4 N m; finger 3 is pressed by two of 2 N m; the lever is 116 mm."""
    hand = load_hand()
    levers = closing_levers(hand, np.full(3, np.deg2rad(70.0)))
    assert np.allclose(levers, 0.116, atol=1e-3)
    assert np.allclose(fingertip_forces(hand, "torque") * levers, [2.0, 2.0, 4.0])
    assert np.allclose(fingertip_forces(hand, "worm") * levers, [6.0, 6.0, 4.0])
    assert np.array_equal(fingertip_forces(hand, "locked"), fingertip_forces(hand, "worm"))


def test_no_finger_holds_more_than_its_worm():
    hand = load_hand()
    weak = replace(hand, fingers=tuple(replace(f, holding_torque=4.5) for f in hand.fingers))
    levers = closing_levers(hand, np.full(3, np.deg2rad(70.0)))
    assert np.allclose(fingertip_forces(weak, "worm") * levers, [4.5, 4.5, 4.0])


def test_no_fingertip_of_weaker_motors_carries_more_than_the_load():
    """All by one factor: fingers stay as strong beside each other, and worms as they are."""
    hand = load_hand()
    weak = within_load(hand, 19.6)
    assert fingertip_forces(weak, "worm").max() == pytest.approx(19.6)
    before, after = (np.array([f.effort_limit for f in each.fingers]) for each in (hand, weak))
    assert np.allclose(after / before, after[0] / before[0])
    assert [f.holding_effort for f in weak.fingers] == [f.holding_effort for f in hand.fingers]
    for load in (None, 1e3):
        assert within_load(hand, load) is hand


def test_strength_at_the_ends_of_the_range_is_what_the_docs_say():
    hand = load_hand()
    ends = [closing_levers(hand, limit) for limit in coordinate_limits(hand)[1:].T]
    middle = np.array([2.0, 2.0, 4.0]) / fingertip_forces(hand, "torque")
    assert np.allclose(middle / ends[0] - 1.0, -0.10, atol=0.005)
    assert np.allclose(middle / ends[1] - 1.0, 0.19, atol=0.005)


def test_locked_finger_without_a_holding_torque_holds_what_the_others_press(tmp_path):
    hand = load_hand(write_pincer(tmp_path, fingers=changed_finger(torque_limit=3.0)))
    assert np.allclose(fingertip_forces(hand, "locked"), [3.0 / ARM, 3.0 / ARM])
    assert np.allclose(fingertip_forces(hand, "torque"), [3.0 / ARM, 1.0 / ARM])


def test_joint_without_limits_has_the_lever_of_the_open_hand(tmp_path):
    sdf = PINCER_SDF.replace("<limit><lower>0</lower><upper>1</upper></limit>", "")
    hand = load_hand(write_pincer(tmp_path, sdf=sdf))
    assert np.allclose(fingertip_forces(hand, "torque"), 1.0 / ARM)
