"""Forward kinematics, against a table and against Drake."""

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

#: The palm's surface above the base [m]; the table below is given from there.
PALM_SURFACE = 0.0793


#: Tip of the official Denavit-Hartenberg table in the distal link's frame [m].
P_FiT = np.array([0.050, 0.0095, 0.0])


#: Veres' fingertip sensor in the distal link's frame [m], and the surface's normal there.
P_FiV, N_FiV = np.array([0.0401, 0.0106, 0.0]), np.array([0.041, 0.999, 0.0])


#: Spread, proximal angle [deg], finger; T, V [m], normal at V in base axes.
TABLE = """
0 0 F1 -0.0250 -0.1521 0.0385 -0.0250 -0.1438 0.0330 0.000 0.611 0.792
0 0 F2 0.0250 -0.1521 0.0385 0.0250 -0.1438 0.0330 0.000 0.611 0.792
0 0 F3 0.0000 0.1521 0.0385 0.0000 0.1438 0.0330 0.000 -0.611 0.792
0 100 F1 -0.0250 0.0159 0.0608 -0.0250 0.0062 0.0586 0.000 0.157 -0.988
0 100 F2 0.0250 0.0159 0.0608 0.0250 0.0062 0.0586 0.000 0.157 -0.988
0 100 F3 0.0000 -0.0159 0.0608 0.0000 -0.0062 0.0586 0.000 -0.157 -0.988
90 60 F1 -0.0741 0.0000 0.0967 -0.0781 0.0000 0.0876 0.886 0.000 -0.464
90 60 F2 0.0741 0.0000 0.0967 0.0781 0.0000 0.0876 -0.886 0.000 -0.464
90 60 F3 0.0000 0.0491 0.0967 0.0000 0.0531 0.0876 0.000 -0.886 -0.464
"""


@pytest.mark.parametrize("row", TABLE.strip().splitlines())
def test_forward_kinematics_agrees_with_the_table(hand: Hand, row: str) -> None:
    spread, proximal, name, *numbers = row.split()
    T, V, n = np.array(numbers, dtype=float).reshape(3, 3)
    i = [finger.name for finger in hand.fingers].index(name)
    closing = np.full(3, np.deg2rad(float(proximal)))
    X_BFi = hand.X_BG @ fingertip_poses(hand, spread=np.deg2rad(float(spread)), closing=closing)[i]
    # The table is rounded to 0.1 mm; the brief for the model is half a millimetre.
    lift = [0.0, 0.0, PALM_SURFACE]
    assert np.linalg.norm(X_BFi[:3, :3] @ P_FiT + X_BFi[:3, 3] - lift - T) < 5e-4
    assert np.linalg.norm(X_BFi[:3, :3] @ P_FiV + X_BFi[:3, 3] - lift - V) < 5e-4
    np.testing.assert_allclose(X_BFi[:3, :3] @ N_FiV, n, atol=1e-3)


def test_many_postures_are_evaluated_as_one_by_one(hand: Hand) -> None:
    rng = np.random.default_rng(1)
    spread, closing = rng.random((4, 1)), rng.random((4, 2, 3))
    X_GF = fingertip_poses(hand, spread=spread, closing=closing)
    assert X_GF.shape == (4, 2, 3, 4, 4)
    one = fingertip_poses(hand, spread=spread[3, 0], closing=closing[3, 1])
    np.testing.assert_allclose(X_GF[3, 1], one, atol=1e-15)


def test_coordinate_limits_are_those_of_the_joints_that_stop_first(hand: Hand) -> None:
    # 48 degrees of the distal joint are 144 of the proximal one, which stops at 140.
    expected = np.deg2rad([[0, 180], [0, 140], [0, 140], [0, 140]])
    np.testing.assert_allclose(coordinate_limits(hand), expected, atol=1e-8)


def test_closing_must_be_one_angle_per_finger(hand: Hand) -> None:
    with pytest.raises(ValueError, match=r"closing must have shape \(\.\.\., 3\), got \(2,\)"):
        fingertip_poses(hand, spread=0.0, closing=[0.1, 0.2])


#: Distance of the gripper's pad points from their hinges [m].
ARM = np.hypot(0.01, 0.09)


def pad_points(hand: Hand, spread: float, closing: np.ndarray) -> np.ndarray:
    """Return the pad points (k, 3) in {G} [m]."""
    X_GF = fingertip_poses(hand, spread=spread, closing=closing)
    return np.array(
        [transform_points(X, f.p_FiP[None])[0] for X, f in zip(X_GF, hand.fingers, strict=True)]
    )


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


def test_locked_finger_without_a_holding_torque_holds_what_the_others_press(tmp_path):
    hand = load_hand(write_pincer(tmp_path, fingers=changed_finger(torque_limit=3.0)))
    assert np.allclose(fingertip_forces(hand, "locked"), [3.0 / ARM, 3.0 / ARM])
    assert np.allclose(fingertip_forces(hand, "torque"), [3.0 / ARM, 1.0 / ARM])


def test_joint_without_limits_has_the_lever_of_the_open_hand(tmp_path):
    sdf = PINCER_SDF.replace("<limit><lower>0</lower><upper>1</upper></limit>", "")
    hand = load_hand(write_pincer(tmp_path, sdf=sdf))
    assert np.allclose(fingertip_forces(hand, "torque"), 1.0 / ARM)
