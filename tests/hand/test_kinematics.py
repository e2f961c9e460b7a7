"""Forward kinematics, against a table and against Drake, of every hand of the package."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.hands import PINCER_SDF, changed_finger, drake_fingertip_poses, write_pincer

from drakegrasp.frames import Array, transform_points
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.file_format import hand_names
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


#: Centres of the round tips in the fingertip links [m]; SimLab's URDF.
ALLEGRO_TIPS = np.array([[0.0, 0.0, 0.0267], [0.0, 0.0, 0.0267], [0.0, 0.0, 0.0423]])
#: Closing angle [rad]; centres of the tips of index, middle and thumb in {G} [mm]. Computed from
#: SimLab's joint table (joint frames of allegro_hand_ros @296ef6b, identical in dex-urdf and
#: Menagerie), with the synergies of the hand file.
ALLEGRO = """
0.0  -31.2 -122.1  1.8   24.0 -124.9  1.8  -14.3 84.7 120.6
0.2  -30.1 -109.4 38.5   24.0 -112.1 38.5  -11.6 64.2 119.0
0.5  -26.6  -69.1 77.1   24.0  -71.6 77.1   -6.4 35.5 108.2
0.8  -22.1  -17.9 86.6   24.0  -20.3 86.6   -0.3 12.2  88.6
"""
#: Closing position [m]; y of the pads' centres in the hand's frame, z 103.4 mm [mm]; franka_ros
#: @c11f000 and franka_description @b299b39.
FRANKA = ((0.0, 40.0), (0.01, 30.0), (0.02, 20.0), (0.03, 10.0), (0.035, 5.0), (0.04, 0.0))
#: Points of the tips in the fingertip links [m]; closing angle [rad], and where they are in {G}
#: [mm], from the joint table of dex-urdf @93505db and LEAP_Hand_Sim @150bc3d.
LEAP_TIPS = np.array([[0.0, -0.038, 0.0145], [0.0, -0.038, 0.0145], [0.0, -0.050, -0.0145]])
LEAP = """
0.0  -23.1 -128.7 -0.3   22.3 -128.6 -0.3   2.3 86.7 112.9
0.2  -23.1 -113.7 40.4   22.3 -113.6 40.4   2.4 65.0 113.7
0.5  -23.1  -66.9 81.7   22.3  -66.8 81.7   1.4 33.5 105.7
"""


def points(X_GF: Array, p_FP: Array) -> Array:
    return np.asarray(np.einsum("kab,kb->ka", X_GF[:, :3, :3], p_FP) + X_GF[:, :3, 3])


@pytest.mark.parametrize(
    ("name", "p_FP", "row"),
    [("allegro", ALLEGRO_TIPS, row) for row in ALLEGRO.strip().splitlines()]
    + [("leap", LEAP_TIPS, row) for row in LEAP.strip().splitlines()],
)
def test_a_hand_is_where_its_joint_table_puts_it(name: str, p_FP: Array, row: str) -> None:
    closing, *numbers = map(float, row.split())
    X_GF = fingertip_poses(load_hand(name), spread=0.0, closing=[closing] * 3)
    np.testing.assert_allclose(1e3 * points(X_GF, p_FP), np.reshape(numbers, (3, 3)), atol=0.1)


@pytest.mark.parametrize(("closing", "y"), FRANKA)
def test_franka_is_where_its_figures_put_it(closing: float, y: float) -> None:
    hand = load_hand("franka")
    X_GF = fingertip_poses(hand, spread=0.0, closing=[closing, closing])
    p_GP = points(X_GF, np.array([finger.p_FiP for finger in hand.fingers]))
    p_BP = p_GP @ hand.X_BG[:3, :3].T + hand.X_BG[:3, 3]
    np.testing.assert_allclose(1e3 * p_BP, [[0.0, y, 103.4], [0.0, -y, 103.4]], atol=0.01)


@pytest.mark.parametrize("name", hand_names())
def test_kinematics_agrees_with_drake(name: str) -> None:
    hand, rng = load_hand(name), np.random.default_rng(1)
    lower, upper = coordinate_limits(hand).T
    for spread, *closing in rng.uniform(lower, upper, (5, 1 + hand.num_fingers)):
        np.testing.assert_allclose(
            fingertip_poses(hand, spread=spread, closing=closing),
            drake_fingertip_poses(hand, spread, np.array(closing)),
            atol=1e-12,
        )
