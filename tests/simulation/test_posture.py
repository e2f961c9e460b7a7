"""A posture starts the trial that it says: by the hand's own motors, or with one for each joint."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
from helpers.assertions import refused
from helpers.hands import write_with_preshapes
from helpers.objects import STANDOFF, from_above, standing

from drakegrasp.errors import GraspError
from drakegrasp.frames import X_WT, make_pose, rotation_about
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.kinematics import joint_positions
from drakegrasp.hand.settings import load_config
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation.attempts import make_posture
from drakegrasp.simulation.drive import disengage, engage
from drakegrasp.simulation.placement import PlacedObject, run_trial
from drakegrasp.simulation.posture import OPENED, Posture, opened, start_of
from drakegrasp.simulation.scene import closing_angles, command_joints, joint_limits, reset_attempt
from drakegrasp.simulation.trial import TrialRecord, run_attempt

#: A pose that no frame has.
X = make_pose(rotation_about([0.0, 0.6, 0.8], 0.7), [0.1, -0.2, 0.3])


def posture_of(hand, spread: float, closing: list[float], **other: np.ndarray) -> Posture:
    named = joint_positions(hand, spread, closing)
    return Posture(X, np.array([named[name] for name in hand.joint_order]), **other)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"q_squeeze": ["a"] * 8}, "squeeze joints must be numbers .*, got text"),
        ({"X_FG": np.zeros((4, 4))}, "the palm's pose must have 0 0 0 1"),
        ({"frame": "mesh"}, "X_OM must be given with the frame mesh"),
        ({"frame": "table"}, "X_TO must be given with the frame table, got None"),
        ({"frame": "camera", "X_TO": X}, "X_TC must be given with the frame camera, and only"),
        ({"joints": ["finger1_spread_joint"] * 8}, "joints must be named once each"),
    ],
)
def test_what_is_no_posture_is_refused_in_a_line(options, words):
    arguments = {"X_FG": X, "q_grasp": np.zeros(8), **options}
    with pytest.raises(GraspError, match=words):
        make_posture(load_hand(), **arguments)


# The rule of the two ways


def test_posture_of_the_couplings_is_an_attempt_of_spread_and_closing():
    hand = load_hand()
    start = start_of(posture_of(hand, 0.2, [1.0, 0.1, 0.9]), hand)
    assert (start.path, start.spread) == (None, pytest.approx(0.2))
    np.testing.assert_allclose(start.closing, [1.0 - OPENED, 0.0, 0.9 - OPENED])


@pytest.mark.parametrize(("off_deg", "own"), [(0.9, False), (1.1, True)])
@pytest.mark.parametrize("joint", ["finger1_distal_joint", "finger2_spread_joint"])
@pytest.mark.parametrize("stage", ["q_grasp", "q_pregrasp", "q_squeeze"])
def test_joint_off_its_coupling_by_more_than_a_degree_has_a_motor(joint, off_deg, own, stage):
    hand = load_hand()
    good = posture_of(hand, 0.2, [1.0, 1.0, 1.0]).q_grasp
    q = {name: good.copy() for name in ("q_grasp", "q_pregrasp", "q_squeeze")}
    q[stage][hand.joint_order.index(joint)] += np.deg2rad(off_deg)
    start = start_of(Posture(X, **q), hand)
    assert start.own_motors == own


@pytest.mark.parametrize(
    ("joint", "own", "pregrasp"),
    [("thumb_roll_joint", False, None), ("ring_mcp_joint", True, np.full(16, 0.3))],
)
def test_joint_that_no_motor_moves_is_locked_where_the_grasp_has_it(joint, own, pregrasp):
    """Of the preshape where the hand file's motors close, or without a motor of its own."""
    hand = load_hand("allegro")
    at = hand.joint_order.index(joint)
    grasp = np.full(16, 0.6) if own else posture_of(hand, 0.0, [0.5, 0.5, 0.5]).q_grasp
    grasp[at] += 0.1
    start = start_of(Posture(X, grasp, pregrasp), hand)
    assert start.own_motors == own
    assert start.path[0, at] == grasp[at]


def test_joints_beyond_their_limits_are_brought_within():
    hand = load_hand("allegro")
    _, grasp, _ = start_of(Posture(X, np.full(16, 3.0)), hand).path
    upper = dict(zip(hand.joint_names, hand.joint_limits[:, 1], strict=True))
    np.testing.assert_array_equal(grasp, [upper[name] for name in hand.joint_order])
    assert (opened(grasp, hand) <= grasp).all()


# The trial


@pytest.fixture(scope="module")
def held(scene, cube, config) -> TrialRecord:
    return run_attempt(scene, standing(cube), from_above(cube, STANDOFF), config)


@pytest.fixture(scope="module")
def given(scene, held) -> Posture:
    hand = scene.hand
    named = joint_positions(hand, 0.0, np.zeros(3))
    start = np.array([named[name] for name in hand.joint_order])
    return Posture(held.X_OG, held.closed.q, start)


@pytest.fixture(scope="module")
def uncoupled(given, scene) -> Posture:
    """The held posture with its fingertips bent by 6 degrees more, and its first links by less."""
    q, order = given.q_grasp.copy(), scene.hand.joint_order
    for finger in scene.hand.fingers:
        q[order.index(finger.coupled[0].joint)] += 0.1
        q[order.index(finger.closing_joint)] -= 0.04
    return Posture(given.X_OG, q, q - (q - given.q_pregrasp) * 0.3)


@pytest.mark.sim
def test_closed_hand_given_back_is_the_same_trial(scene, cube, config, held, given):
    start = start_of(given, scene.hand)
    again = run_attempt(scene, standing(cube), start, config)
    assert held.outcome is Outcome.SUCCESS
    assert pickle.dumps(again) == pickle.dumps(held)


@pytest.mark.sim
@pytest.mark.parametrize("drive", ["worm", "torque", "locked"])
def test_joints_with_motors_of_their_own_hold_the_cube(scene, cube, config, held, uncoupled, drive):
    start = start_of(uncoupled, scene.hand)
    assert start.own_motors
    rules = config.model_copy(update={"lift": config.lift.model_copy(update={"drive": drive})})
    record = run_attempt(scene, standing(cube), start, rules)
    assert record.outcome is Outcome.SUCCESS
    assert record.stable
    # They stop on the object near the grasp, and the fingertips are still off their coupling.
    off = record.closed.q - uncoupled.q_grasp
    assert np.abs(off).max() < 0.15
    assert not np.allclose(record.closed.q, held.closed.q, atol=0.02)

    # The same bits again, and none of it is left in the scene of the hand's own motors.
    assert pickle.dumps(run_attempt(scene, standing(cube), start, rules)) == pickle.dumps(record)
    usual = run_attempt(scene, standing(cube), from_above(cube, STANDOFF), config)
    assert pickle.dumps(usual) == pickle.dumps(held)


@pytest.mark.sim
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_worm_of_a_joint_holds_against_the_way_of_its_motor(scene, cube, given, sign):
    own, X_WO = scene.own_motors(), X_WT @ standing(cube)
    half = (given.q_pregrasp + given.q_grasp) / 2.0
    reset_attempt(own, X_WO, X_WO @ given.X_OG, spread=0.0, q=half)
    angles = closing_angles(own)
    command_joints(own, [0.0], [angles + 0.2 * sign])
    engage(own, "worm")
    try:
        for joint, angle, limits in zip(
            own.closing_joints, angles, own.closing_limits, strict=True
        ):
            held = (angle, limits[1]) if sign > 0.0 else (limits[0], angle)
            assert joint_limits(joint) == pytest.approx(held)
    finally:
        disengage(own)
    assert [joint_limits(joint) for joint in own.closing_joints] == list(own.closing_limits)


@pytest.mark.sim
def test_public_trial_closes_the_fingers_of_the_preshape(cube, given, tmp_path):
    """The second finger stays open."""
    path = write_with_preshapes(tmp_path, pair="F1 F3")
    placed = PlacedObject(model=cube, X_TO=standing(cube), config=load_config(hand=str(path)))
    q, order = given.q_grasp.copy(), load_hand(path).joint_order
    q[[order.index(name) for name in ("finger2_proximal_joint", "finger2_distal_joint")]] = 0.0
    trial = run_trial(placed, replace(given, q_grasp=q, preshape="pair"))
    assert trial.closed.contacts.touching.tolist() == [True, True]


def test_a_palm_pose_alone_closes_from_the_open_hand(tmp_path):
    """As an attempt of a sampler does: at the hand's first spread, in the preshape it names."""
    hand = load_hand(write_with_preshapes(tmp_path, pair="F1 F3"))
    hand = replace(hand, spreads_deg=(10.0, 20.0))
    start = start_of(make_posture(hand, X), hand)
    assert (start.closing, start.path, start.preshape, start.unused) == (None, None, None, 0)
    shaped = replace(hand.preshapes[0], spreads_deg=hand.spreads_deg)
    hand = replace(hand, preshapes=(shaped,))
    start = start_of(make_posture(hand, X, preshape="pair"), hand)
    assert (start.preshape, start.unused) == (0, hand.unused_in(0)) and start.unused
    assert start.spread == pytest.approx(np.deg2rad(10.0))
    np.testing.assert_array_equal(start.X_OG, X)
    assert "q_squeeze must be given together with q_grasp" in refused(
        make_posture, hand, X, q_squeeze=np.zeros(8)
    )


def test_a_preshape_that_the_hand_lacks_is_refused(tmp_path):
    shaped = load_hand(write_with_preshapes(tmp_path, pair="F1 F3"))
    q = np.zeros(8)
    assert "preshape must be left out for the hand barrett, got 'pair'" in refused(
        make_posture, load_hand(), X, q, preshape="pair"
    )
    assert "preshape must be one of pair for the hand shaped, got 'all'" in refused(
        start_of, Posture(X, q, preshape="all"), shaped
    )
