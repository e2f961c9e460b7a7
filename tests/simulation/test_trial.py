"""The trial is physical: closed forms, refusals by the physics, and the same bits twice."""

from __future__ import annotations

import pickle
from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh
from helpers.objects import (
    CUBE,
    STANDOFF,
    box_model,
    drawn_attempts,
    from_above,
    model_of,
    standing,
)

from drakegrasp.frames import X_WT, make_pose, transform_points
from drakegrasp.hand.settings import load_config, override_config
from drakegrasp.objects.model import prepare_object
from drakegrasp.objects.sources import MeshSource
from drakegrasp.outcomes import Outcome, Stage
from drakegrasp.simulation import scene as stepping
from drakegrasp.simulation import trial as trial_module
from drakegrasp.simulation.attempt import Attempt
from drakegrasp.simulation.construction import build_object_scene, build_scene
from drakegrasp.simulation.contacts import ClearanceMonitor, is_inside
from drakegrasp.simulation.lift import lift_duration
from drakegrasp.simulation.scene import Scene, advance, reset_object
from drakegrasp.simulation.screen import Screening
from drakegrasp.simulation.trial import TrialRecord, run_attempt, start_meetings

pytestmark = pytest.mark.sim

GRAVITY = 9.81


@pytest.fixture(scope="module")
def held(scene, cube, config) -> TrialRecord:
    """The cube grasped across its faces."""
    return run_attempt(scene, standing(cube), from_above(cube, STANDOFF), config)


def test_it_can_be_told_which_links_meet_what_where_an_attempt_starts(scene, cube, config):
    """The palm on the cube, the fingers beside it in the air; beside the cube, all on the table."""
    X_TO, attempt = standing(cube), from_above(cube, 0.001)
    assert start_meetings(scene, X_TO, attempt) == {"object": ["base"]}
    beside = attempt.X_OG.copy()
    beside[0, 3], beside[2, 3] = 0.4, 0.0
    met = start_meetings(scene, X_TO, replace(attempt, X_OG=beside))
    assert list(met) == ["table"]
    assert {"finger1_distal", "finger3_distal"} <= set(met["table"])
    assert start_meetings(scene, X_TO, from_above(cube, 0.25)) == {}


def test_cube_grasped_across_its_faces_is_carried_by_its_fingertips_alone(held, cube, hand, config):
    assert (held.outcome, held.precision) == (Outcome.SUCCESS, True)
    p, n = held.closed.contacts.p_OQ, held.closed.contacts.nhat_Q_O
    assert np.allclose(np.abs(p[:, 1]), CUBE / 2.0, atol=1e-5)
    assert np.allclose(n, np.sign(p[:, 1])[:, None] * [0.0, 1.0, 0.0], atol=1e-3)
    assert np.allclose(np.linalg.norm(n, axis=1), 1.0)
    for contacts in (held.closed.contacts, held.lift.contacts):
        assert contacts.touching.all()
        assert (contacts.point_contacts, contacts.other_links) == (0, 0)
        push = -np.einsum("ij,ij->i", contacts.f_Q_O, contacts.nhat_Q_O)
        tangential = np.linalg.norm(contacts.f_Q_O + push[:, None] * contacts.nhat_Q_O, axis=1)
        assert np.all(push > 0.0)
        assert np.all(tangential <= 1.01 * config.physics.friction_hand * push)
    # A pad is 20 mm thick; the contact is stiff enough to stay near its surface.
    depth = held.closed.contacts.penetration
    assert np.all((depth > 0.0) & (depth < 3e-3))
    # The closing joint's torque is the moment of the tip force about it and the coupled joint; no
    # fingertip point is farther from its closing joint than 0.15 m.
    for finger, force in zip(hand.fingers, held.closed.contacts.f_Q_O, strict=True):
        assert finger.torque_limit / 0.15 < np.linalg.norm(force) < finger.torque_limit / 0.04
    total = np.linalg.norm(held.lift.contacts.f_Q_O.sum(axis=0))
    assert total == pytest.approx(cube.mass * GRAVITY, rel=0.02)

    # It rises with the palm to the target. The wrist starts where a coarse step begins.
    assert not held.lift.contacts.object_on_table
    whole = lift_duration(0.60 - CUBE - STANDOFF, config)
    whole += config.lift.release_time + config.lift.hold_time
    coarse = config.physics.coarse_steps * config.physics.time_step
    assert whole - 1e-6 < held.lift.duration < whole + coarse
    risen = held.lift.X_TO[2, 3] - held.X_TO[2, 3]
    assert risen == pytest.approx(0.60 - CUBE - STANDOFF, abs=1e-3)


#: The stand-off, what else differs, and how the attempt ends: at its start, closed, or lifted.
ENDS = {
    "ray misses": (STANDOFF, {"ray_hits": False}, [], Outcome.RAY_MISS),
    "below the table": (
        STANDOFF,
        {"X_OG": make_pose(np.eye(3), [0, 0, -CUBE])},
        [],
        Outcome.BELOW_TABLE,
    ),
    "palm on the object": (0.001, {}, [], Outcome.START_COLLISION),
    "in the air": (0.25, {}, ["screen.mode=off"], Outcome.MISSING_FINGERTIP),
    # Its fingertips are as long as the cube is high; how deep they come is another rule.
    "on the table": (0.041, {}, ["close.scrape_depth=null"], Outcome.TABLE_CONTACT),
    # The palm's target is where it is already.
    "not lifted": (STANDOFF, {}, ["lift.p_TG=[0, 0, 0.13]"], Outcome.TABLE_CONTACT),
    "out of time": (STANDOFF, {}, ["attempt_seconds=1e-6"], Outcome.TIMEOUT),
    # The lift itself is already faster than this limit.
    "exploded": (STANDOFF, {}, ["physics.max_speed=0.05"], Outcome.SOLVER_ERROR),
}


@pytest.mark.parametrize("case", ENDS)
def test_attempt_ends_where_it_is_decided(scene, cube, config, case):
    standoff, changes, settings, outcome = ENDS[case]
    attempt, rules = (
        replace(from_above(cube, standoff), **changes),
        override_config(config, settings),
    )
    record = run_attempt(scene, standing(cube), attempt, rules)
    assert record.outcome is outcome
    assert (record.closed is not None) == (outcome.stage >= Stage.CLOSED)
    assert (record.lift is not None) == (case == "not lifted")
    if record.closed is not None:
        contacts = (record.lift or record.closed).contacts
        assert contacts.touching.all() == (case != "in the air")
        assert np.isnan(contacts.p_OQ).any() == (case == "in the air")
        assert contacts.hand_on_table == (case == "on the table")
        assert contacts.object_on_table == (case == "not lifted")
    assert ("speed" in record.message) == (case == "exploded")


@pytest.mark.parametrize(
    "error",
    [RuntimeError("broken\nlong story"), SystemExit("abort"), MemoryError(), OSError("no file")],
)
def test_error_within_drake_is_an_outcome_and_one_of_the_machine_is_not(
    scene, cube, config, monkeypatch, error
):
    def fail(*_):
        raise error

    monkeypatch.setattr(stepping, "advance", fail)
    if isinstance(error, MemoryError | OSError):
        with pytest.raises(type(error)):
            run_attempt(scene, standing(cube), from_above(cube, STANDOFF), config)
        return
    record = run_attempt(scene, standing(cube), from_above(cube, STANDOFF), config)
    assert record.outcome is Outcome.SOLVER_ERROR
    assert record.message == str(error).splitlines()[0]
    assert record.outcome.stage is Stage.PLACED


@pytest.mark.parametrize("mode", ["on", "off"])
def test_hand_wholly_inside_of_an_object_collides(tmp_path, config, hand, mode):
    """No surfaces cross there: only the inside test can see it, that of the screen or the scene."""
    block = box_model(tmp_path, [0.6, 0.6, 0.6])
    attempt = replace(from_above(block, 0.0), X_OG=make_pose(np.eye(3), [0.0, 0.0, 0.0]))
    rules = override_config(config, [f"screen.mode={mode}"])
    scene = build_scene(block, config.physics, hand)
    assert run_attempt(scene, standing(block), attempt, rules).outcome is Outcome.START_COLLISION


@pytest.mark.parametrize("name", ["54_candlestick_final", "60_comb_final", "65_coffeemaker_final"])
def test_points_inside_of_a_real_mesh_with_needles_are_found(name, g3db, config):
    """Drake's point distance gives up on such meshes; the inside test agrees with rays."""
    source = MeshSource(name=name, class_name="thing", path=g3db / f"{name}.obj", scale=0.01)
    model = prepare_object(source)
    scene = build_object_scene(model, config.physics)
    reset_object(scene, X_WT @ standing(model))
    rng = np.random.default_rng(0)
    p_OP = rng.uniform(-1.0, 1.0, (400, 3)) * model.half_extents
    p_WP = transform_points(X_WT @ standing(model), p_OP)
    found = np.array([is_inside(scene.model, scene.pose(scene.object), p[None]) for p in p_WP])
    by_rays = model.collision.contains(p_OP)
    assert 0 < found.sum() < len(found)
    assert np.mean(found == by_rays) > 0.99


def test_hand_inside_of_a_ring_does_not_collide(tmp_path, config, hand):
    """The object's surface counts, not its convex hull."""
    ring = model_of(
        trimesh.creation.annulus(r_min=0.28, r_max=0.30, height=0.04, sections=64), tmp_path
    )
    X_OG = make_pose(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, 0.15])
    attempt = Attempt(X_OG=X_OG, spread=0.0)
    scene = build_scene(ring, config.physics, hand)
    everything = override_config(config, ["screen.mode=off"])
    record = run_attempt(scene, standing(ring), attempt, everything)
    assert record.outcome is Outcome.MISSING_FINGERTIP
    assert run_attempt(scene, standing(ring), attempt, config).outcome is Outcome.SCREENED


def test_same_attempt_gives_the_same_bits_whatever_ran_before(scene, cube, config, hand, held):
    run_attempt(scene, standing(cube), from_above(cube, 0.05, spread=0.3), config)
    again = run_attempt(scene, standing(cube), from_above(cube, STANDOFF), config)
    fresh = run_attempt(
        build_scene(cube, config.physics, hand), standing(cube), from_above(cube, STANDOFF), config
    )
    assert pickle.dumps(again) == pickle.dumps(fresh) == pickle.dumps(held)


@pytest.mark.parametrize("distance", [0.02, 0.5])
def test_lift_keeps_its_speed_and_acceleration_limits(config, distance):
    """It is the fastest that does, along its curve of least jerk: of a short way, or a long one."""
    T, s = lift_duration(distance, config), np.linspace(0.0, 1.0, 10_001)
    speed = distance / T * 30.0 * s**2 * (1.0 - s) ** 2
    acceleration = distance / T**2 * 60.0 * s * (1.0 - s) * (1.0 - 2.0 * s)
    limits = config.lift.max_speed, config.lift.max_acceleration
    shares = [np.abs(x).max() / most for x, most in zip((speed, acceleration), limits, strict=True)]
    assert max(shares) == pytest.approx(1.0, rel=1e-6)


@pytest.mark.parametrize("place", [(0.0, 0.0), (-0.7, 0.7)])
def test_a_block_sinks_into_the_table_alike_everywhere(tmp_path, place):
    """On a soft table of modulus E, a base A is where E d A / 0.05 m carries the weight."""
    model = box_model(tmp_path, [0.08, 0.08, 0.04])
    physics = load_config(overrides=["physics.table_modulus=1e5"]).physics
    scene = build_object_scene(model, physics)
    X_WO = X_WT @ standing(model)
    X_WO[:2, 3] += place
    reset_object(scene, X_WO)
    scene.simulator.Initialize()
    advance(scene, 1.0)
    depth = X_WO[2, 3] - scene.pose(scene.object)[2, 3]
    assert depth == pytest.approx(model.mass * GRAVITY * 0.05 / (1e5 * 0.08**2), rel=0.02)


def test_table_friction_stops_a_sliding_block(tmp_path):
    """A block of speed v slides v^2 / (2 mu g) before it stops.

    The table is stiff: at 1 ms the distance is two tenths short, at 0.2 ms less than one.
    """
    model = box_model(tmp_path, [0.08, 0.08, 0.04])
    physics = load_config(
        overrides=["physics.friction_table=0.5", "physics.time_step=0.0002"]
    ).physics
    slid = {}
    for start, x in ((0.5, 0.0), (0.5, 0.3), (1.0, 0.0)):
        scene = build_object_scene(model, physics)
        X_WO = X_WT @ standing(model)
        X_WO[0, 3] += x
        reset_object(scene, X_WO)
        scene.simulator.Initialize()
        advance(scene, 0.1)
        velocity = np.zeros(6)
        velocity[3] = start
        scene.plant.SetVelocities(scene.context, velocity)
        before = scene.pose(scene.object)[0, 3]
        advance(scene, 0.3)
        assert np.abs(scene.plant.GetVelocities(scene.context)).max() < 1e-3
        slid[start, x] = scene.pose(scene.object)[0, 3] - before
        assert slid[start, x] == pytest.approx(start**2 / (2.0 * 0.5 * GRAVITY), rel=0.1)
    # No border of the table's parts is where objects stand.
    assert slid[0.5, 0.3] == pytest.approx(slid[0.5, 0.0], rel=1e-3)


@pytest.mark.nightly
@pytest.mark.slow
def test_smaller_step_gives_the_same_verdicts(tmp_path, config, hand):
    """At the default of 8 ms 95 % of what is simulated ends as at 1 ms."""
    model = box_model(tmp_path, [0.05, 0.07, 0.15], name="1_box_tall")
    X_TO, coarse = standing(model), override_config(config, ["screen.mode=off"])
    fine = override_config(coarse, ["physics.time_step=0.001", "physics.coarse_steps=1"])
    scenes = [build_scene(model, rule.physics, hand) for rule in (coarse, fine)]

    # Take attempts from the draw until there are 20 to compare, and three successes among them.
    same: list[bool] = []
    successes = 0
    for attempt in drawn_attempts(model, X_TO, config):
        record = run_attempt(scenes[0], X_TO, attempt, coarse)
        if record.closed is not None:
            truth = run_attempt(scenes[1], X_TO, attempt, fine).outcome
            same.append(record.outcome is truth)
            successes += truth is Outcome.SUCCESS
        if len(same) >= 20 and successes >= 3:
            break
    assert len(same) >= 20
    assert successes >= 3
    assert np.mean(same) >= 0.95


# Each verdict of a trial, by the one contact that decides it


def test_hand_whose_other_link_is_on_the_object_does_not_lift(scene, cube, config, monkeypatch):
    """Which part of a patch is a link's: test_contacts.py."""
    read = trial_module.read_contacts
    monkeypatch.setattr(trial_module, "read_contacts", lambda s: replace(read(s), other_links=1))
    record = run_attempt(scene, standing(cube), from_above(cube, STANDOFF), config)
    assert record.closed.contacts.touching.all()
    assert (record.outcome, record.lift) == (Outcome.HAND_CONTACT, None)


def test_slip_and_turn_are_how_the_object_lags_behind_the_palm(cube, config, hand):
    """The palm keeps its orientation; the object creeps where fingers can be pushed open."""
    torque = override_config(config, ["lift.drive=torque", "lift.release_time=0.5"])
    scene = build_scene(cube, config.physics, hand)
    record = run_attempt(scene, standing(cube), from_above(cube, STANDOFF), torque)
    p_TG = (standing(cube) @ from_above(cube, STANDOFF).X_OG)[:3, 3]
    carried = standing(cube)[:3, 3] + np.array(config.lift.p_TG) - p_TG
    slip = np.linalg.norm(record.lift.X_TO[:3, 3] - carried)
    turned = standing(cube)[:3, :3].T @ record.lift.X_TO[:3, :3]
    turn = np.arccos((np.trace(turned) - 1.0) / 2.0)
    assert slip > 1e-3 and turn > 1e-3
    assert record.lift.slip == pytest.approx(slip, abs=1e-4)
    assert record.lift.turn == pytest.approx(turn, abs=1e-3)
    assert np.allclose((record.lift.X_TO @ record.lift.X_OG)[:3, 3], config.lift.p_TG, atol=1e-4)


def screening(outcome: Outcome | None, *, clear: bool, last: float = 2.0) -> Screening:
    return Screening(outcome=outcome, clear=clear, closing=np.zeros(3), last=np.full(3, last))


@pytest.mark.parametrize(
    ("standoff", "said", "clear", "outcome"),
    [
        # Where geometry is certain, nobody asks Drake.
        (STANDOFF, Outcome.START_COLLISION, False, Outcome.START_COLLISION),
        (0.001, Outcome.SCREENED, True, Outcome.SCREENED),
        # Near a collision Drake says whether it is one, and that comes first.
        (0.001, Outcome.SCREENED, False, Outcome.START_COLLISION),
        (STANDOFF, Outcome.SCREENED, False, Outcome.SCREENED),
        (0.001, None, False, Outcome.START_COLLISION),
        (STANDOFF, None, False, Outcome.TIMEOUT),
        (STANDOFF, None, True, Outcome.TIMEOUT),
    ],
)
def test_screening_decides_where_it_is_certain(scene, cube, standoff, said, clear, outcome):
    """What is simulated times out at once."""
    hurried = load_config(overrides=["attempt_seconds=1e-6"])
    known = screening(said, clear=clear)
    record = run_attempt(scene, standing(cube), from_above(cube, standoff), hurried, known)
    assert record.outcome is outcome


def test_closing_ends_where_a_fingertip_has_passed_the_object(scene, cube, config, hand):
    """In the air: at the first look two degrees beyond the last angle at which it could touch."""
    last = 0.4
    known = screening(None, clear=True, last=last)
    record = run_attempt(scene, standing(cube), from_above(cube, 0.3), config, known)
    assert record.outcome is Outcome.MISSING_FINGERTIP
    end = last + np.deg2rad(2.0)
    look = config.close.check_period * max(hand.closing_speed)
    closed = record.closed.q[[1, 4, 6]]
    assert end < closed.max() < end + 1.1 * look


def test_time_of_closing_that_was_skipped_counts(scene, cube, config, hand):
    """A finger that starts half closed has as much less time for the rest."""
    short = override_config(config, ["close.max_time=0.5", "close.stop_speed=1e-9"])
    for start, rest in ((0.0, 0.5), (0.2, 0.5 - 0.2 / min(hand.closing_speed))):
        known = replace(screening(None, clear=True), closing=np.full(3, start))
        record = run_attempt(scene, standing(cube), from_above(cube, 0.3), short, known)
        step = config.physics.time_step
        assert record.closed.duration == pytest.approx(rest, abs=step)


@pytest.mark.parametrize(("speed", "looks"), [(2.0, 1), (0.5, 5)])
def test_closing_ends_at_the_first_look_at_which_the_fingers_stand(
    scene, cube, config, speed, looks
):
    """In the air they close at about 1 rad/s until time is up."""
    patient = override_config(config, [f"close.stop_speed={speed}", "close.max_time=0.5"])
    known = screening(None, clear=True)
    record = run_attempt(scene, standing(cube), from_above(cube, 0.3), patient, known)
    assert record.closed.duration == pytest.approx(looks * config.close.check_period, abs=8e-3)


def test_limit_is_of_the_threads_own_computing_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the clocks on the wall say meanwhile."""
    clocks = dict.fromkeys(("time", "monotonic", "perf_counter", "process_time"), 1e9)
    others = {name: lambda value=value: value for name, value in clocks.items()}
    monkeypatch.setattr(stepping, "time", SimpleNamespace(thread_time=lambda: 5.0, **others))
    limits = stepping.start_limits(load_config(overrides=["attempt_seconds=3"]))
    assert limits.deadline == pytest.approx(8.0)


# The least height of the hand above the table: by Drake's own poses after every step, and the
# corners of its own hulls

#: Stand-offs at which the tips pass 1 mm below the table's top and end above it, and 1 mm above.
SCRAPES, PASSES = 0.042, 0.044


@pytest.fixture
def noted(scene: Scene) -> Iterator[list[tuple[float, float]]]:
    """A list that gets the time [s] and the hand's least height [m] after each step.

    With worms the lift would take the place of the recorder.
    """
    inspector, seen = scene.scene_graph.model_inspector(), list[tuple[float, float]]()
    hulls = [
        (body, inspector.GetPoseInFrame(geometry), inspector.GetConvexHull(geometry))
        for body in scene.links
        for geometry in scene.plant.GetCollisionGeometriesForBody(body)
    ]

    def note(root: Any) -> None:
        context, lowest = scene.plant.GetMyContextFromRoot(root), np.inf
        for body, X_BS, hull in hulls:
            if hull is not None:  # boxes and cylinders are parts of the palm, above the fingertips
                X_WS = scene.plant.EvalBodyPoseInWorld(context, body) @ X_BS
                corners = [X_WS @ hull.vertex(i) for i in range(hull.num_vertices())]
                lowest = min(lowest, np.array(corners)[:, 2].min())
        seen.append((root.get_time(), lowest - X_WT[2, 3]))

    scene.simulator.set_monitor(note)
    yield seen
    scene.simulator.clear_monitor()


@pytest.mark.parametrize("standoff", [SCRAPES, PASSES])
def test_clearance_is_the_least_of_all_steps(scene, cube, config, noted, standoff) -> None:
    # The whole way from the open hand.
    rules = override_config(config, ["screen.mode=off", "lift.drive=torque"])
    record = run_attempt(scene, standing(cube), from_above(cube, standoff), rules)
    closing = [height for time, height in noted if time <= record.closed.duration]
    assert record.closed.clearance == pytest.approx(min(closing), abs=1e-4)
    # What geometry skips counts.
    quick = run_attempt(scene, standing(cube), from_above(cube, standoff), config)
    assert quick.closed.clearance == pytest.approx(min(closing), abs=1e-4)


def test_lift_begins_where_closing_ended(scene, cube, config, noted, monkeypatch) -> None:
    looks = list[float]()

    class Noted(ClearanceMonitor):
        def look(self, scene: Scene) -> None:
            looks.append(scene.time)
            super().look(scene)

    monkeypatch.setattr("drakegrasp.simulation.lift.ClearanceMonitor", Noted)
    rules = override_config(config, ["lift.drive=torque"])
    record = run_attempt(scene, standing(cube), from_above(cube, PASSES), rules)
    assert looks[0] == pytest.approx(record.closed.duration)
    lifting = [height for time, height in noted if time >= record.closed.duration - 1e-9]
    assert record.lift.clearance == pytest.approx(min(lifting), abs=1e-4)
    assert record.lift.clearance > record.closed.clearance + 1e-3


def test_hand_that_scrapes_the_table_on_its_way_is_refused(scene, cube, config) -> None:
    """It ends clear of the table, so that only the way says so; measuring changes nothing."""
    attempt = from_above(cube, SCRAPES)
    record = run_attempt(scene, standing(cube), attempt, config)
    assert record.closed.contacts.touching.all()
    assert not record.closed.contacts.hand_on_table
    assert record.closed.clearance < -config.close.scrape_depth
    assert (record.outcome, record.lift) == (Outcome.TABLE_CONTACT, None)

    before = override_config(config, ["close.scrape_depth=null"])
    lifted = run_attempt(scene, standing(cube), attempt, before)
    assert lifted.outcome is Outcome.SUCCESS
    assert np.isnan(lifted.closed.clearance)
    deeper = override_config(config, ["close.scrape_depth=0.002"])
    allowed = run_attempt(scene, standing(cube), attempt, deeper)
    for stage in ("closed", "lift"):
        one, other = (getattr(r, stage).contacts for r in (allowed, lifted))
        assert pickle.dumps(one) == pickle.dumps(other)
