"""Lifts end as they would with fine steps throughout, and no later than their end is known."""

from __future__ import annotations

import pickle
from collections import Counter

import numpy as np
import pytest
from helpers.objects import CUBE, STANDOFF, from_above, standing
from pydrake.math import RigidTransform

from drakegrasp.frames import X_WT, make_pose, rotation_about
from drakegrasp.hand.settings import load_config, override_config
from drakegrasp.objects.model import ObjectModel
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation import lift as lifting
from drakegrasp.simulation import scene as stepping
from drakegrasp.simulation.construction import build_scene
from drakegrasp.simulation.contacts import read_contacts
from drakegrasp.simulation.lift import lift_duration
from drakegrasp.simulation.scene import (
    Scene,
    advance,
    hand_positions,
    move_wrist,
    palm_pose,
    release,
    reset_attempt,
    transfer_state,
)
from drakegrasp.simulation.trial import TrialRecord, run_attempt

pytestmark = pytest.mark.sim


def close(scene: Scene, cube: ObjectModel) -> None:
    X_WO = X_WT @ standing(cube)
    reset_attempt(scene, X_WO, X_WO @ from_above(cube, STANDOFF).X_OG, spread=0.0)
    advance(scene, 2.4)


@pytest.fixture
def simulated(monkeypatch) -> Counter:
    """The time that was simulated with each step [s]."""
    seconds, simulate = Counter(), stepping.advance

    def count(stage: Scene, duration: float) -> None:
        seconds[stage.physics.time_step] += duration
        simulate(stage, duration)

    monkeypatch.setattr(stepping, "advance", count)
    return seconds


def test_lift_with_coarse_steps_ends_as_one_without(
    scene, cube, config, hand, simulated, monkeypatch
):
    # A cube that is pinched creeps a little all the time: here that counts as rest.
    config = override_config(config, ["close.stop_speed=0.1"])
    monkeypatch.setattr(lifting, "COARSE_SHIFT", 2e-3)
    monkeypatch.setattr(lifting, "COARSE_ANGLE", np.deg2rad(2.0))
    attempt = from_above(cube, STANDOFF)
    by_coarse = run_attempt(scene, standing(cube), attempt, config)
    long = config.physics.coarse_steps * config.physics.time_step
    assert simulated[long] > 0.4 * by_coarse.lift.duration
    fine = override_config(config, ["physics.coarse_steps=1"])
    throughout = build_scene(cube, fine.physics, hand)
    assert throughout.coarse_scene is None
    by_fine = run_attempt(throughout, standing(cube), attempt, fine)
    assert by_coarse.outcome is by_fine.outcome is Outcome.SUCCESS
    # The wrist starts where a step of the longest kind begins.
    assert by_coarse.lift.duration == pytest.approx(by_fine.lift.duration, abs=long)
    assert np.allclose(by_coarse.lift.X_TO[:3, 3], by_fine.lift.X_TO[:3, 3], atol=1e-3)
    assert np.allclose(by_coarse.lift.X_TO[:3, :3], by_fine.lift.X_TO[:3, :3], atol=0.02)
    assert np.allclose(by_coarse.lift.contacts.f_Q_O, by_fine.lift.contacts.f_Q_O, atol=1.0)


@pytest.mark.parametrize("back", [False, True])
def test_another_diagram_goes_on_where_one_stopped(scene, cube, config, back):
    """The wrist follows its curve across the change, with the steps of the new diagram."""
    close(scene, cube)
    release(scene)
    target = X_WT[:3, 3] + config.lift.p_TG
    motion = move_wrist(scene, target, 1.0)
    coarse = scene.coarse_scene()
    long = coarse.physics.time_step
    when = 125 * long
    advance(scene, when - 1e-6 - scene.time)
    before, after = scene, coarse
    transfer_state(after, before, when, motion)
    if back:
        advance(coarse, 2 * long - 1e-6)
        before, after, when = coarse, scene, when + 2 * long
        transfer_state(after, before, when, motion)
    assert after.time == pytest.approx(when, abs=1e-12)
    assert np.array_equal(palm_pose(after), palm_pose(before))
    assert np.array_equal(after.pose(after.object), before.pose(before.object))
    assert np.array_equal(hand_positions(after), hand_positions(before))
    hand = scene.hand
    spread = [after.plant.GetJointByName(n, after.instance) for n in hand.spread.joints]
    assert spread
    assert all(joint.is_locked(after.context) for joint in spread)
    step = after.physics.time_step
    for k in range(1, 6):
        advance(after, when + k * step - 1e-6 - after.time)
        s = (after.time - motion.begin) / motion.duration
        risen = s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
        meant = motion.p_start + risen * (motion.p_end - motion.p_start)
        assert np.allclose(palm_pose(after)[:3, 3], meant, atol=5e-4)
    # The object goes with the hand: what holds it carries its weight and speeds it up.
    way = motion.p_end - motion.p_start
    acceleration = way[2] * 60.0 * s * (1.0 - s) * (1.0 - 2.0 * s) / motion.duration**2
    contacts = read_contacts(after)
    force = contacts.f_Q_O.sum(axis=0) @ after.pose(after.object)[2, :3]
    assert contacts.touching.all()
    assert force == pytest.approx(cube.mass * (9.81 + acceleration), rel=0.1)


def test_lift_ends_when_the_object_is_lost(cube, config, hand):
    slippery = override_config(config, ["physics.friction_hand=0.05"])
    scene = build_scene(cube, slippery.physics, hand)
    record = run_attempt(scene, standing(cube), from_above(cube, STANDOFF), slippery)
    assert record.outcome is Outcome.DROPPED
    whole = lift_duration(0.60 - CUBE - STANDOFF, slippery) + slippery.lift.hold_time
    assert record.lift.duration < 0.7 * whole


@pytest.fixture(scope="module")
def sliding(scene, cube):
    """Lifts of a cube by fingers that it pushes open: it slides by 22 mm and turns by 8 degrees."""

    def run(*overrides: str) -> TrialRecord:
        rules = load_config(overrides=["lift.drive=torque", *overrides])
        return run_attempt(scene, standing(cube), from_above(cube, STANDOFF), rules)

    return run


LOST_SAMPLE = "lift.stop_when=lost_sample"


def same_bits(one: TrialRecord, other: TrialRecord) -> bool:
    return pickle.dumps(one) == pickle.dumps(other)


@pytest.mark.parametrize("limits", [[], ["lift.stop_slip=1", "lift.stop_turn_deg=4"]])
def test_lift_ends_when_its_sample_is_lost(sliding, limits):
    """By 10 mm or by an angle; the object, still held, is measured as it is then."""
    whole, ended = sliding(), sliding(LOST_SAMPLE, *limits, "filters.max_turn_deg=4")
    assert (whole.outcome, ended.outcome) == (Outcome.SUCCESS, Outcome.MOVED)
    assert ended.lift.duration < 0.5 * whole.lift.duration
    assert ended.lift.slip < 0.6 * whole.lift.slip
    assert (ended.lift.slip > 0.010) or limits
    assert ended.lift.contacts.touching.all()
    assert same_bits(ended.closed.contacts, whole.closed.contacts)
    X_GO = np.linalg.inv(ended.lift.X_OG) @ ended.X_OG
    assert np.linalg.norm(X_GO[:3, 3]) > 0.9 * ended.lift.slip


def test_verdict_at_the_end_of_a_whole_lift_goes_first(sliding):
    """Here there are two checks: before the wrist moves, and at the end."""
    whole = sliding("lift.check_period=9")
    assert whole.outcome is Outcome.SUCCESS
    assert 1e-6 < whole.lift.slip_released < 0.010 < whole.lift.slip
    assert 1e-6 < whole.lift.turn_released < whole.lift.turn
    assert same_bits(sliding("lift.check_period=9", LOST_SAMPLE), whole)


def test_long_steps_are_for_what_stands_still_in_the_hand(cube, config, hand, simulated):
    """Where fingers can be pushed open the cube creeps at each look, and all steps are fine."""
    long = config.physics.coarse_steps * config.physics.time_step
    shares = {}
    scene = build_scene(cube, config.physics, hand)
    for drive in ("worm", "torque"):
        simulated.clear()
        drawn = override_config(config, [f"lift.drive={drive}"])
        record = run_attempt(scene, standing(cube), from_above(cube, STANDOFF), drawn)
        shares[drive] = simulated[long] / record.lift.duration
    assert shares["worm"] > 0.7
    assert shares["torque"] < 0.3


@pytest.mark.parametrize(
    ("shift", "angle_deg", "closed", "touching", "at_rest", "certain"),
    [
        # What stands still may take long steps; a fingertip that is on it is not lost.
        (0.0, 0.0, 0.0, "all", True, False),
        (0.9e-4, 0.09, 0.9e-3, "all", True, False),
        # A little motion of any kind needs fine steps.
        (1.1e-4, 0.0, 0.0, "all", False, False),
        (0.0, 0.11, 0.0, "all", False, False),
        (0.0, 0.0, 1.1e-3, "all", False, False),
        # Much motion with nothing that touches: lost for good, but not on a slow finger's account.
        (6e-4, 0.0, 0.0, "none", False, True),
        (0.0, 0.6, 0.0, "none", False, True),
        (6e-4, 0.0, 0.0, "palm", False, False),
        (0.0, 0.0, 1.1e-3, "none", False, False),
        # What stands still has slipped where a fingertip is off it, unless the table holds it.
        (0.0, 0.0, 0.0, "off", True, True),
        (0.0, 0.0, 0.0, "off on table", True, False),
    ],
)
def test_monitor_judges_what_moved_since_the_last_look(
    scene, cube, monkeypatch, shift, angle_deg, closed, touching, at_rest, certain
):
    """A look takes 0.1 s; fingers stand below 0.01 rad/s. Nothing is simulated."""
    close(scene, cube)
    X_GO, angles = lifting._object_in_hand(scene), lifting.closing_angles(scene)
    monitor = lifting._Monitor(scene)
    turn = make_pose(rotation_about([0.0, 1.0, 0.0], np.deg2rad(angle_deg)), [0.0, shift, 0.0])
    monkeypatch.setattr(lifting, "_object_in_hand", lambda _: X_GO @ turn)
    monkeypatch.setattr(lifting, "closing_angles", lambda _: angles + np.eye(3)[1] * closed)
    tips = {body.index() for body in scene.fingertips}
    palm = scene.plant.GetBodyByName(scene.hand.palm_link).index()
    table = scene.table.index()
    on_object = {
        "all": tips,
        "none": {table},
        "palm": {palm},
        "off": {palm},
        "off on table": {table},
    }[touching]
    monkeypatch.setattr(lifting, "bodies_on_object", lambda _: on_object)
    monkeypatch.setattr(lifting, "_has_lost_tip", lambda _: "off" in touching)
    assert monitor.update(scene, 0.1, 0.01) is certain
    assert monitor.at_rest is at_rest


@pytest.mark.parametrize(("away", "lost"), [(0.0, False), (2.5e-3, False), (4e-3, True)])
def test_fingertip_is_lost_beyond_a_few_millimetres(scene, cube, monkeypatch, away, lost):
    """The object is moved away from the two fingers on one side, by that and how deep it was."""
    close(scene, cube)
    depth = float(read_contacts(scene).penetration.max())
    X_WO = X_WT @ standing(cube) @ make_pose(np.eye(3), [0.0, 0.0, 0.0])
    sides = read_contacts(scene).p_OQ[:, 1]
    alone = int(np.argmax(np.sign(sides) != np.sign(sides.sum())))
    X_WO[1, 3] -= np.sign(sides[alone]) * ((away + depth) if away else 0.0)
    release(scene)
    scene.plant.SetFreeBodyPose(scene.context, scene.object, RigidTransform(X_WO))
    assert lifting._has_lost_tip(scene) is lost
