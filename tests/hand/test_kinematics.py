"""Forward kinematics, against a table and against Drake."""

from __future__ import annotations

import numpy as np
import pytest

from drakegrasp.hand.description import Hand
from drakegrasp.hand.kinematics import coordinate_limits, fingertip_poses

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
0 60 F1 -0.0250 -0.0491 0.0967 -0.0250 -0.0531 0.0876 0.000 0.886 -0.464
0 60 F2 0.0250 -0.0491 0.0967 0.0250 -0.0531 0.0876 0.000 0.886 -0.464
0 60 F3 0.0000 0.0491 0.0967 0.0000 0.0531 0.0876 0.000 -0.886 -0.464
0 100 F1 -0.0250 0.0159 0.0608 -0.0250 0.0062 0.0586 0.000 0.157 -0.988
0 100 F2 0.0250 0.0159 0.0608 0.0250 0.0062 0.0586 0.000 0.157 -0.988
0 100 F3 0.0000 -0.0159 0.0608 0.0000 -0.0062 0.0586 0.000 -0.157 -0.988
90 0 F1 -0.1771 0.0000 0.0385 -0.1688 0.0000 0.0330 0.611 0.000 0.792
90 0 F2 0.1771 0.0000 0.0385 0.1688 0.0000 0.0330 -0.611 0.000 0.792
90 0 F3 0.0000 0.1521 0.0385 0.0000 0.1438 0.0330 0.000 -0.611 0.792
90 60 F1 -0.0741 0.0000 0.0967 -0.0781 0.0000 0.0876 0.886 0.000 -0.464
90 60 F2 0.0741 0.0000 0.0967 0.0781 0.0000 0.0876 -0.886 0.000 -0.464
90 60 F3 0.0000 0.0491 0.0967 0.0000 0.0531 0.0876 0.000 -0.886 -0.464
90 100 F1 -0.0091 0.0000 0.0608 -0.0188 0.0000 0.0586 0.157 0.000 -0.988
90 100 F2 0.0091 0.0000 0.0608 0.0188 0.0000 0.0586 -0.157 0.000 -0.988
90 100 F3 0.0000 -0.0159 0.0608 0.0000 -0.0062 0.0586 0.000 -0.157 -0.988
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
