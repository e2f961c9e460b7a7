"""What geometry says of attempts: certain losers only, the same in any company."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from helpers.hands import slider_fingers, write_slider
from helpers.objects import STANDOFF, box_model, drawn_attempts, from_above, model_of, standing

from drakegrasp.config import ScreenConfig
from drakegrasp.frames import make_pose
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.finger_sweep import hand_paths
from drakegrasp.hand.settings import load_config, override_config
from drakegrasp.objects.model import ObjectModel
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation import screen as stage
from drakegrasp.simulation.attempt import Attempt
from drakegrasp.simulation.construction import build_scene
from drakegrasp.simulation.screen import Screening, screen
from drakegrasp.simulation.trial import run_attempt

OFF = load_config(overrides=["screen.mode=off"])


def ask(cube: ObjectModel, hand: Hand, attempt, **margins: float) -> Screening | None:
    (found,) = screen(cube, hand, standing(cube), [attempt], ScreenConfig(**margins))
    return found


def test_good_grasp_is_simulated_from_just_before_it_touches(cube, hand, config, scene):
    attempt = from_above(cube, STANDOFF)
    found = ask(cube, hand, attempt)
    assert found.outcome is None
    assert found.clear
    record = run_attempt(scene, standing(cube), attempt, config)
    slow = run_attempt(scene, standing(cube), attempt, OFF)
    assert record.outcome is slow.outcome is Outcome.SUCCESS
    assert record.closed.duration < 0.5 * slow.closed.duration
    # The same end: joints to a tenth of a degree, contacts to a fraction of a millimetre.
    assert np.allclose(record.closed.q, slow.closed.q, atol=2e-3)
    assert np.allclose(record.closed.contacts.p_OQ, slow.closed.contacts.p_OQ, atol=5e-4)
    closed = record.closed.q[[1, 4, 6]]
    assert np.all(found.closing < closed)
    assert np.all(closed < found.closing + np.deg2rad(8.0))
    assert np.all(closed < found.last)


#: The middle of the table, the palm just above it and its fingers in it.
INTO_TABLE = make_pose(np.diag([1.0, -1.0, -1.0]), [0.3, 0.0, 0.02])


@pytest.mark.parametrize(
    ("standoff", "X_TG", "outcome", "drakes"),
    [
        (0.25, None, Outcome.SCREENED, Outcome.MISSING_FINGERTIP),
        (-0.01, None, Outcome.START_COLLISION, Outcome.START_COLLISION),
        (0.0, INTO_TABLE, Outcome.START_COLLISION, Outcome.START_COLLISION),
    ],
    ids=["in the air", "in the object", "in the table"],
)
def test_what_is_certainly_lost_is_not_simulated(
    cube, hand, config, scene, standoff, X_TG, outcome, drakes
):
    attempt = from_above(cube, standoff)
    if X_TG is not None:
        attempt = replace(attempt, X_OG=np.linalg.inv(standing(cube)) @ X_TG)
    assert ask(cube, hand, attempt).outcome is outcome
    record = run_attempt(scene, standing(cube), attempt, config)
    assert (record.outcome, record.closed) == (outcome, None)
    assert run_attempt(scene, standing(cube), attempt, OFF).outcome is drakes


def test_it_is_not_asked_where_it_has_nothing_to_say(cube, hand):
    attempt = from_above(cube, STANDOFF)
    assert ask(cube, hand, replace(attempt, ray_hits=False)) is None
    closed = replace(attempt, closing=np.full(hand.num_fingers, 0.3))
    assert ask(cube, hand, closed) is None


def test_screening_depends_on_the_attempt_alone(cube, hand, config):
    """The poses of the object differ, and the higher one blocks no finger at the table."""
    drawn, made, together = drawn_attempts(cube, standing(cube), config), [], []
    lifted = make_pose(np.eye(3), [0.0, 0.0, 0.02]) @ standing(cube)
    while sum(found is not None and found.outcome is None for found in together) < 3:
        assert len(made) < 2000, "three of the attempts must be simulated"
        made += islice(drawn, 100)
        X_TO = np.array([(standing(cube), lifted)[row % 2] for row in range(len(made))])
        together = screen(cube, hand, X_TO, made, config.screen)
    for row, attempt in enumerate(made):
        (alone,) = screen(cube, hand, X_TO[row], [attempt], config.screen)
        found = together[row]
        assert (alone is None) == (found is None)
        if found is not None:
            assert alone.outcome is found.outcome
            assert alone.clear == found.clear
            assert np.array_equal(alone.closing, found.closing)
            assert np.array_equal(alone.last, found.last)


@pytest.mark.sim
def test_nothing_that_is_screened_would_have_been_lifted(tmp_path, hand, config):
    model = box_model(tmp_path, [0.05, 0.07, 0.15], name="1_box_tall")
    X_TO = standing(model)
    scene = build_scene(model, config.physics, hand)

    # Take attempts from the draw until ten of either kind are lost.
    losers: dict[Outcome, list[Attempt]] = {Outcome.START_COLLISION: [], Outcome.SCREENED: []}
    for attempt in drawn_attempts(model, X_TO, override_config(config, ["seed=1"])):
        (found,) = screen(model, hand, X_TO, [attempt], config.screen)
        above = (X_TO @ attempt.X_OG)[2, 3] > 0.0
        if above and found is not None and found.outcome is not None:
            losers[found.outcome].append(attempt)
        if min(map(len, losers.values())) >= 10:
            break
    lost = [attempt for attempts in losers.values() for attempt in attempts[:10]]
    assert len(lost) == 20
    outcomes = {run_attempt(scene, X_TO, attempt, OFF).outcome for attempt in lost}
    assert outcomes <= {Outcome.START_COLLISION, Outcome.MISSING_FINGERTIP}


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
        (found,) = screen(model, hand, standing(model), [attempt], ScreenConfig())
        assert found.outcome is None
        tips = [tip_distance(hand, i, q, attempt, wall) for i, q in enumerate(found.closing)]
        assert min(tips) > 0.0


def tip_distance(hand: Hand, finger: int, angle: float, attempt, wall: float) -> float:
    """Return how far a fingertip is in front of a wall across y that is 2 mm thick [m]."""
    path = hand_paths(hand, attempt.spread).fingers[finger]
    points = path.points[np.searchsorted(path.angles, angle), : path.tip]
    y = points @ attempt.X_OG[1, :3] + attempt.X_OG[1, 3]
    return float(np.abs(y - wall).min()) - 0.001


def test_fingers_start_before_they_may_cross_in_an_attempt(cube, hand):
    """In the air, with margins so wide that it is simulated: they start well before their ends."""
    attempt = from_above(cube, 0.25)
    found = ask(cube, hand, attempt, reach_margin=1.0, block_margin=1.0, clearance=1e-4)
    assert found.outcome is None
    assert max(found.closing) < 0.9 * min(path.angles[-1] for path in hand_paths(hand, 0.0).fingers)


def lowest(hand: Hand) -> float:
    """Return how far the open hand reaches below its palm, which looks down [m]."""
    paths = hand_paths(hand, 0.0)
    opened = [paths.still, *(path.points[0] for path in paths.fingers)]
    return float(np.concatenate(opened)[:, 2].max())


@pytest.mark.parametrize(
    ("margins", "outcome", "clear"),
    [
        (-1.5, Outcome.START_COLLISION, False),
        (-0.5, Outcome.SCREENED, False),
        (0.5, Outcome.SCREENED, False),
        (1.5, Outcome.SCREENED, True),
    ],
)
def test_open_hand_is_certain_beyond_the_margin_only(
    cube, hand, config, scene, margins, outcome, clear
):
    """Open fingers over the table beside the cube, so many margins above it: Drake agrees."""
    margin = ScreenConfig().start_margin
    height = lowest(hand) + margins * margin
    X_TG = make_pose(np.diag([1.0, -1.0, -1.0]), [0.4, 0.0, height])
    attempt = replace(from_above(cube, STANDOFF), X_OG=np.linalg.inv(standing(cube)) @ X_TG)
    found = ask(cube, hand, attempt)
    assert (found.outcome, found.clear) == (outcome, clear)
    hits = margins < 0.0
    drakes = run_attempt(scene, standing(cube), attempt, config).outcome
    assert drakes is (Outcome.START_COLLISION if hits else Outcome.SCREENED)


@pytest.mark.parametrize(("margins", "clear"), [(0.5, False), (1.5, True)])
def test_open_hand_near_the_object_is_not_clear(cube, hand, margins, clear):
    """Over the cube's top, so many margins from its faces in closed form."""
    paths = hand_paths(hand, 0.0)
    opened = np.concatenate([paths.still, *(path.points[0] for path in paths.fingers)])

    def distance(standoff: float) -> float:
        X_OG = from_above(cube, standoff).X_OG
        outside = np.abs(opened @ X_OG[:3, :3].T + X_OG[:3, 3]) - cube.half_extents
        return float(np.linalg.norm(np.maximum(outside, 0.0), axis=1).min())

    wanted = margins * ScreenConfig().start_margin
    standoff = min(np.linspace(0.0, 0.1, 1001), key=lambda s: abs(distance(s) - wanted))
    assert distance(standoff) == pytest.approx(wanted, abs=2e-4)
    found = ask(cube, hand, from_above(cube, standoff), reach_margin=0.2, block_margin=1.0)
    assert (found.outcome, found.clear) == (None, clear)


@pytest.mark.parametrize("name", ["start_margin", "reach_margin", "block_margin", "clearance"])
def test_coarse_grid_widens_each_margin(cube, name):
    margins, blur = ScreenConfig(), stage.COVERED + 0.004
    coarse = SimpleNamespace(blur=blur)
    assert stage.extra_margin(coarse) == pytest.approx(0.004)
    wide = stage._widened(margins, coarse)
    assert getattr(wide, name) == pytest.approx(getattr(margins, name) + 0.004)
    assert stage.extra_margin(SimpleNamespace(blur=0.5 * stage.COVERED)) == 0.0


def test_one_finger_that_is_not_required_screens_nothing(cube, hand):
    """The last finger closes on nothing: the attempt is lost only where it must touch."""
    attempt = from_above(cube, STANDOFF)
    nowhere = {"pad_region": ((-1.0, 0.0, 0.0, -0.005),), "pad_point": (0.0, 0.009, 0.0)}
    *others, last = hand.fingers
    for required, outcome in ((True, Outcome.SCREENED), (False, None)):
        finger = replace(last, required=required, **nowhere)
        found = ask(cube, replace(hand, fingers=(*others, finger)), attempt)
        assert found.outcome is outcome


def test_fingers_of_one_motor_start_together(tmp_path):
    """One jaw would meet a box that is off the middle later than the other; it starts with it."""
    model = box_model(tmp_path, [0.03] * 3)
    X_OG = make_pose(np.diag([1.0, -1.0, -1.0]), [0.0, 0.008, 0.09])
    above = replace(from_above(model, STANDOFF), X_OG=X_OG)
    own, shared = (
        ask(model, load_hand(write_slider(tmp_path, fingers=slider_fingers(20.0, **by))), above)
        for by in ({}, {"finger": "left", "ratio": 1.0})
    )
    assert own.outcome is shared.outcome is None
    assert np.ptp(own.closing) > 0.01
    np.testing.assert_allclose(shared.closing, own.closing.min())
