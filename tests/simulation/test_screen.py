"""What geometry says of attempts: certain losers only, the same in any company."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
import trimesh
from helpers.hands import write_pincer
from helpers.objects import (
    STANDOFF,
    box_model,
    drawn_attempts,
    from_above,
    model_of,
    standing,
)

from drakegrasp.config import ScreenConfig, load_config
from drakegrasp.frames import make_pose
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.finger_sweep import hand_paths
from drakegrasp.objects.model import ObjectModel
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation import screen
from drakegrasp.simulation.candidates import Attempt
from drakegrasp.simulation.construction import build_scene
from drakegrasp.simulation.screen import Prediction, predict
from drakegrasp.simulation.trial import run_attempt

OFF = load_config(overrides=["screen.mode=off"])


def ask(cube: ObjectModel, hand: Hand, attempt, **margins: float) -> Prediction | None:
    (found,) = predict(cube, hand, standing(cube), [attempt], ScreenConfig(**margins))
    return found


def test_good_grasp_is_simulated_from_just_before_it_touches(cube, hand, config, scene):
    attempt = from_above(cube, STANDOFF)
    found = ask(cube, hand, attempt)
    assert found.outcome is None
    assert found.clear
    record = run_attempt(scene, standing(cube), attempt, config)
    slow = run_attempt(scene, standing(cube), attempt, OFF)
    assert record.outcome is slow.outcome is Outcome.SUCCESS
    assert record.time_close < 0.5 * slow.time_close
    # The same end: joints to a tenth of a degree, contacts to a fraction of a millimetre.
    assert np.allclose(record.q_closed, slow.q_closed, atol=2e-3)
    assert np.allclose(record.closed.p_OQ, slow.closed.p_OQ, atol=5e-4)
    closed = record.q_closed[[1, 4, 6]]
    assert np.all(found.closing < closed)
    assert np.all(closed < found.closing + np.deg2rad(8.0))
    assert np.all(closed < found.last)


def test_attempt_in_the_air_is_screened(cube, hand, config, scene):
    attempt = from_above(cube, 0.25)
    assert ask(cube, hand, attempt).outcome is Outcome.SCREENED
    record = run_attempt(scene, standing(cube), attempt, config)
    assert record.outcome is Outcome.SCREENED
    assert record.closed is None
    assert run_attempt(scene, standing(cube), attempt, OFF).outcome is Outcome.MISSING_FINGERTIP


def test_open_hand_deep_in_the_object_or_the_table_is_a_collision(cube, hand, config, scene):
    into_object = from_above(cube, -0.01)
    assert ask(cube, hand, into_object).outcome is Outcome.START_COLLISION
    X_TG = make_pose(np.diag([1.0, -1.0, -1.0]), [0.3, 0.0, 0.02])
    into_table = replace(into_object, X_OG=np.linalg.inv(standing(cube)) @ X_TG)
    assert ask(cube, hand, into_table).outcome is Outcome.START_COLLISION
    for attempt in (into_object, into_table):
        record = run_attempt(scene, standing(cube), attempt, OFF)
        assert record.outcome is Outcome.START_COLLISION


def test_object_under_one_finger_only_is_screened(cube, hand):
    """The palm beside the cube: one fingertip may meet it, the others close on nothing."""
    attempt = from_above(cube, STANDOFF)
    aside = replace(attempt, X_OG=make_pose(np.eye(3), [0.0, 0.12, 0.0]) @ attempt.X_OG)
    assert ask(cube, hand, aside).outcome in (Outcome.SCREENED, Outcome.START_COLLISION)


def test_fingertip_that_meets_the_object_beside_its_pad_is_screened(cube, hand):
    """The cube is between the ends of the fingertips: their first 5 mm do not come to it."""
    base = {"pad_region": ((-1.0, 0.0, 0.0, -0.005),), "pad_point": (0.0, 0.009, 0.0)}
    backs = tuple(replace(finger, **base) for finger in hand.fingers)
    assert ask(cube, hand, from_above(cube, STANDOFF)).outcome is None
    found = ask(cube, replace(hand, fingers=backs), from_above(cube, STANDOFF))
    assert found.outcome is Outcome.SCREENED


def test_wide_margins_screen_nothing_that_could_touch(cube, hand):
    attempt = from_above(cube, 0.11)
    assert ask(cube, hand, attempt, reach_margin=0.2, block_margin=1.0).outcome is None


def test_it_is_not_asked_where_it_has_nothing_to_say(cube, hand):
    attempt = from_above(cube, STANDOFF)
    assert ask(cube, hand, replace(attempt, ray_hits=False)) is None
    closed = replace(attempt, closing=np.full(hand.num_fingers, 0.3))
    assert ask(cube, hand, closed) is None


def test_attempt_that_says_where_its_fingers_start_is_never_screened(cube, config, scene):
    """Verification opens the fingers by itself and wants to know what happens."""
    attempt = replace(from_above(cube, 0.25), closing=np.zeros(3))
    record = run_attempt(scene, standing(cube), attempt, config)
    assert record.outcome is Outcome.MISSING_FINGERTIP
    assert np.array_equal(
        record.q_closed, run_attempt(scene, standing(cube), attempt, OFF).q_closed
    )


def test_prediction_depends_on_the_attempt_alone(cube, hand, config):
    drawn, made, together = drawn_attempts(cube, standing(cube), config, 0), [], []
    while sum(found is not None and found.outcome is None for found in together) < 3:
        assert len(made) < 2000, "three of the attempts must be simulated"
        made += islice(drawn, 100)
        together = predict(cube, hand, standing(cube), made, config.screen)
    for row, attempt in enumerate(made):
        alone = ask(cube, hand, attempt)
        found = together[row]
        assert (alone is None) == (found is None)
        if found is not None:
            assert alone.outcome is found.outcome
            assert alone.clear == found.clear
            assert np.array_equal(alone.closing, found.closing)
            assert np.array_equal(alone.last, found.last)


def test_given_prediction_changes_no_bit(cube, hand, config, scene):
    attempt = from_above(cube, STANDOFF)
    alone = run_attempt(scene, standing(cube), attempt, config)
    given = run_attempt(scene, standing(cube), attempt, config, ask(cube, hand, attempt))
    assert np.array_equal(alone.q_lifted, given.q_lifted)
    assert np.array_equal(alone.closed.f_Q_O, given.closed.f_Q_O)


@pytest.mark.sim
def test_nothing_that_is_screened_would_have_been_lifted(tmp_path, hand, config):
    model = box_model(tmp_path, [0.05, 0.07, 0.15], name="1_box_tall")
    X_TO = standing(model)
    scene = build_scene(model, config.physics, hand)

    # Take attempts from the draw until ten of either kind are lost.
    losers: dict[Outcome, list[Attempt]] = {Outcome.START_COLLISION: [], Outcome.SCREENED: []}
    for attempt in drawn_attempts(model, X_TO, config, 1):
        (found,) = predict(model, hand, X_TO, [attempt], config.screen)
        above = (X_TO @ attempt.X_OG)[2, 3] > 0.0
        if above and found is not None and found.outcome is not None:
            losers[found.outcome].append(attempt)
        if min(map(len, losers.values())) >= 10:
            break
    lost = [attempt for attempts in losers.values() for attempt in attempts[:10]]
    assert len(lost) == 20
    outcomes = {run_attempt(scene, X_TO, attempt, OFF).outcome for attempt in lost}
    assert outcomes <= {Outcome.START_COLLISION, Outcome.MISSING_FINGERTIP}


def test_another_hand_is_screened_too(tmp_path, cube):
    pincer = load_hand(write_pincer(tmp_path))
    above = replace(from_above(cube, 0.03), X_OG=make_pose(np.diag([1.0, -1.0, -1.0]), [0, 0, 0.4]))
    assert ask(cube, pincer, above).outcome is Outcome.SCREENED


@pytest.mark.parametrize("key", ["start_margin", "reach_margin", "block_margin", "clearance"])
def test_margins_are_lengths(key):
    with pytest.raises(Exception, match=rf"screen\.{key}: must be greater than 0"):
        load_config(overrides=[f"screen.{key}=-0.001"])


@pytest.mark.parametrize(("text", "mode"), [("on", "on"), ("off", "off"), ("false", "off")])
def test_mode_is_a_word_that_yaml_takes_for_a_truth_value(text, mode):
    assert load_config(overrides=[f"screen.mode={text}"]).screen.mode == mode


def crate(folder, length: float) -> ObjectModel:
    """Return an open crate of a metre with walls of 2 mm, far thinner than a cell of its grid."""
    outer = trimesh.creation.box([1.0, length, 0.5])
    inner = trimesh.creation.box([0.996, length - 0.004, 0.5])
    inner.apply_translation([0.0, 0.0, 0.002])
    return model_of(trimesh.boolean.difference([outer, inner], engine="manifold"), folder)


def test_wall_between_the_points_of_a_coarse_grid_is_met(tmp_path, hand):
    """Wherever it lies in its cell: fingers around its rim meet it, and never start within it."""
    for length in 0.8 + 0.0017 * np.arange(6):
        model = crate(tmp_path, length)
        assert model.field.spacing > 3 * 0.002
        wall = length / 2.0 - 0.001
        attempt = from_above(model, STANDOFF)
        attempt.X_OG[:3, 3] += [0.0, wall, 0.0]
        (found,) = predict(model, hand, standing(model), [attempt], ScreenConfig())
        assert found.outcome is None
        tips = [tip_distance(hand, i, q, attempt, wall) for i, q in enumerate(found.closing)]
        assert min(tips) > 0.0


def tip_distance(hand: Hand, finger: int, angle: float, attempt, wall: float) -> float:
    """Return how far a fingertip is in front of a wall across y that is 2 mm thick [m]."""
    path = hand_paths(hand, attempt.spread).fingers[finger]
    points = path.points[np.searchsorted(path.angles, angle), : path.tip]
    y = points @ attempt.X_OG[1, :3] + attempt.X_OG[1, 3]
    return float(np.abs(y - wall).min()) - 0.001


def test_grid_that_is_fine_enough_leaves_the_margins(cube, tmp_path):
    margins = ScreenConfig()
    assert screen._widened(margins, cube.field) == margins
    wide = screen._widened(margins, crate(tmp_path, 0.8).field)
    assert wide.reach_margin > margins.reach_margin + 0.002
    more = wide.reach_margin - margins.reach_margin
    assert wide.clearance == pytest.approx(margins.clearance + more)


def test_no_field_is_made_where_nobody_asks(cube, hand):
    """Verification's attempts say where they begin, and a field takes longer than a close."""
    model = replace(cube)
    started = replace(from_above(cube, STANDOFF), closing=np.zeros(3))
    assert predict(model, hand, standing(model), [started], ScreenConfig()) == [None]
    off = ScreenConfig(mode="off")
    assert predict(model, hand, standing(model), [from_above(cube, STANDOFF)], off) == [None]
    assert "field" not in vars(model)
