"""The hands that come with the package, against published figures and against Drake."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.hands import drake_fingertip_poses

from drakegrasp.frames import Array
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.file_format import hand_names
from drakegrasp.hand.kinematics import coordinate_limits, fingertip_poses

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
#: Number of fingers and of numbers in a grasp.
FINGERS = {
    "allegro": (3, 18), "allegro_four": (4, 24), "barrett": (3, 18), "franka": (2, 12),
    "leap": (3, 18),
}  # fmt: skip
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


def test_these_hands_come_with_the_package() -> None:
    assert hand_names() == list(FINGERS)
    for name, (fingers, numbers) in FINGERS.items():
        hand = load_hand(name)
        assert (hand.name, hand.num_fingers) == (name, fingers)
        assert 6 * hand.num_fingers == numbers
        assert hand.payload is not None
    assert load_hand("barrett").rated_load == 19.62


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


@pytest.mark.parametrize("name", FINGERS)
def test_kinematics_agrees_with_drake(name: str) -> None:
    hand, rng = load_hand(name), np.random.default_rng(1)
    lower, upper = coordinate_limits(hand).T
    for spread, *closing in rng.uniform(lower, upper, (5, 1 + hand.num_fingers)):
        np.testing.assert_allclose(
            fingertip_poses(hand, spread=spread, closing=closing),
            drake_fingertip_poses(hand, spread, np.array(closing)),
            atol=1e-12,
        )


def test_limits_are_those_of_all_joints_that_a_finger_moves() -> None:
    """The second joint starts at 0.2 rad and ends first, at 1.709 rad."""
    limits = coordinate_limits(load_hand("allegro"))
    np.testing.assert_allclose(limits[:2], [[0.0, 0.0], [-0.196, 1.509]], atol=1e-12)
    np.testing.assert_array_equal(coordinate_limits(load_hand("franka"))[1:], [[0.0, 0.04]] * 2)
