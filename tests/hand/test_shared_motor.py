"""Fingers that another finger's motor drives: keys, limits, strength, postures, wrists."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.hands import SLIDER, slider_fingers, write_slider

from drakegrasp.errors import HandError
from drakegrasp.frames import make_pose
from drakegrasp.hand.checks import check_couplings
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.kinematics import (
    closed_positions,
    coordinate_limits,
    fingertip_forces,
    open_together,
)
from drakegrasp.simulation.posture import Posture, start_of
from drakegrasp.verification.wrist_solver import fit_wrist, make_postures

OWN, DRIVEN = slider_fingers(60.0, finger="left")
REFUSALS = {
    "no such finger": (
        [OWN, {**DRIVEN, "driven_by": {"finger": "middle"}}],
        r"fingers.1.driven_by.finger must be .* motor of its own \(left\), got 'middle'"),
    "each drives the other": (
        [{**DRIVEN, "name": "left", "driven_by": {"finger": "right"}}, DRIVEN],
        r"fingers.0.driven_by.finger must be .* \(there is none\), got 'right'"),
    "a motor of its own as well": (
        [OWN, {**DRIVEN, "force_limit": 3.0}],
        "fingers.1.force_limit must be left out with driven_by: the motor is that of finger"),
    "a rotor of its own": ([OWN, {**DRIVEN, "rotor_inertia": 1e-6}],
                           "fingers.1.rotor_inertia must be left out"),
    "it opens while the other closes": (
        [OWN, {**DRIVEN, "driven_by": {"finger": "left", "ratio": -1.0}}],
        "fingers.1.driven_by.ratio: .*greater than 0"),
}  # fmt: skip


def shared(tmp_path: Path, ratio: float = 1.0, **changes: object) -> Hand:
    fingers = slider_fingers(60.0, finger="left", ratio=ratio)
    return load_hand(write_slider(tmp_path, fingers=fingers, **changes))


@pytest.mark.parametrize("case", REFUSALS)
def test_a_finger_is_driven_by_one_motor(tmp_path: Path, case: str) -> None:
    fingers, message = REFUSALS[case]
    with pytest.raises(HandError, match=message):
        load_hand(write_slider(tmp_path, fingers=fingers))


def test_a_finger_that_turns_is_not_driven_by_one_that_slides(tmp_path: Path) -> None:
    turning = SLIDER.replace(
        'name="right_slide" type="prismatic"', 'name="right_slide" type="revolute"'
    )
    message = (
        r"fingers.1.driven_by: must be a finger whose closing joint turns, as 'right_slide', "
        "got 'left'"
    )
    with pytest.raises(HandError, match=message):
        shared(tmp_path, urdf=turning)


def test_fingers_of_one_motor_close_in_step(tmp_path: Path) -> None:
    """The model lets each slide by 40 mm: the one that closes twice as far is at its end first."""
    hand = shared(tmp_path, ratio=2.0)
    np.testing.assert_allclose(coordinate_limits(hand)[1:], [[0.0, 0.02], [0.0, 0.04]])
    np.testing.assert_allclose(closed_positions(hand), [0.02, 0.04])
    np.testing.assert_allclose(hand.closing_speed, [0.1, 0.2])
    np.testing.assert_allclose(open_together(hand, [0.015, 0.02]), [0.01, 0.02])
    np.testing.assert_allclose(open_together(hand, [0.005, 0.02]), [0.005, 0.01])


def test_one_motor_presses_with_both_fingers(tmp_path: Path) -> None:
    """120 N at a motor that moves each finger by as much are 60 N each, by 1 and 2 they are 40."""
    assert fingertip_forces(shared(tmp_path), "torque") == pytest.approx([60.0, 60.0])
    assert fingertip_forces(shared(tmp_path, ratio=2.0), "torque") == pytest.approx([40.0, 40.0])
    assert fingertip_forces(load_hand("franka"), "worm") == pytest.approx([35.0, 35.0])


@pytest.mark.parametrize(("q", "own_motors"), [((0.02, 0.02), False), ((0.02, 0.03), True)])
def test_a_posture_that_the_motor_cannot_reach_gets_motors_of_its_own(
    tmp_path: Path, q: tuple[float, float], own_motors: bool
) -> None:
    start = start_of(Posture(np.eye(4), np.array(q)), shared(tmp_path))
    assert start.own_motors == own_motors
    assert start.closing is None or np.ptp(start.closing) == 0.0


def test_a_wrist_brings_both_fingers_to_their_points(tmp_path: Path) -> None:
    """The contacts are 3 mm off the middle: the palm moves, not one of the fingers."""
    hand = shared(tmp_path)
    assert make_postures(hand).coordinates.shape[1] == 2
    p_OQ, outward = np.array([[0.0, -0.017, 0.3], [0.0, 0.023, 0.3]]), np.eye(3)[[1, 1]]
    outward[0] *= -1.0
    best = fit_wrist(hand, p_OQ, outward, make_pose(np.eye(3), [0.0, 0.0, 0.5]))[0]
    assert best.closing[0] == best.closing[1] == pytest.approx(0.02, abs=1e-3)
    assert best.residual.max() < 5e-4


def test_hand_check_asks_for_the_motor_that_the_model_shares(tmp_path: Path) -> None:
    """Its fingers mimic each other in the URDF."""
    finding = check_couplings(load_hand(write_slider(tmp_path)))
    assert not finding.ok
    assert "'right_slide' must be coupled to 'left_slide' by 1 and 0" in finding.text
    assert check_couplings(shared(tmp_path)).ok
    other = check_couplings(shared(tmp_path, ratio=2.0))
    assert not other.ok
