"""Verifying grasps end to end: what held once holds again, and what cannot hold does not."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import permutations
from typing import Any

import numpy as np
import pytest
from helpers.objects import CUBE, box_model, standing
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_info, threadpool_limits

import drakegrasp as dg
from drakegrasp.frames import X_WT, invert_pose, make_pose
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.settings import load_config, override_config
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation.attempt import Attempt
from drakegrasp.simulation.attempts import make_attempts
from drakegrasp.simulation.candidates import R_OG0
from drakegrasp.simulation.construction import build_scene
from drakegrasp.simulation.placement import PlacedObject
from drakegrasp.simulation.trial import TrialRecord, run_attempt
from drakegrasp.verification import verify as verifying
from drakegrasp.verification.placing import place_on_object
from drakegrasp.verification.verify import verify_placed

pytestmark = pytest.mark.sim

#: Lifts are quick.
CONFIG = load_config(
    overrides=["lift.max_speed=2", "lift.max_acceleration=10", "lift.hold_time=0.1"]
)
HAND = load_hand()
X_TC = make_pose(Rotation.from_euler("xyz", [2.0, 0.4, -1.0]).as_matrix(), [0.1, 0.3, 0.4])


@pytest.fixture(scope="module")
def cube(tmp_path_factory):
    model = box_model(tmp_path_factory.mktemp("cube"), [CUBE] * 3, "1_cube_a")
    return PlacedObject(model=model, X_TO=standing(model), config=CONFIG)


@pytest.fixture(scope="module")
def grasp(cube):
    """Contacts of a simulated grasp that held, across two faces of the cube, from above."""
    scene = build_scene(cube.model, CONFIG.physics, load_hand(CONFIG.hand))
    pregrasp = Attempt(X_OG=make_pose(R_OG0, [0.0, 0.0, CUBE / 2.0 + 0.06]), spread=0.0)
    record = run_attempt(scene, cube.X_TO, pregrasp, CONFIG)
    assert record.outcome is Outcome.SUCCESS and record.closed is not None
    return record.closed.contacts.p_OQ, record.closed.contacts.nhat_Q_O


def verify(placed, p, n, config=CONFIG):
    placed = placed if placed.config is config else replace(placed, config=config)
    (grasp,) = place_on_object(dg.pack_grasp(p, n), placed)
    return verify_placed(grasp)


def reached(verdict):
    """Return the contact points after closing, in {O} [m]."""
    return verdict.trial.closed.contacts.p_OQ


@pytest.fixture(scope="module")
def held(cube, grasp):
    return verify(cube, *grasp)


def test_a_grasp_that_held_is_found_again_and_holds(held, cube):
    assert held.matches and held.outcome is Outcome.SUCCESS
    assert held.fit is not None and held.fit.residual.max() < 0.003
    assert np.rad2deg(held.fit.normal_error).max() < 15.0
    assert held.contact_error is not None and held.contact_error.max() < 0.005
    assert held.trial.closed.contacts.touching.all() and held.trial.lift.contacts.touching.all()
    assert held.epsilon > 0.0
    assert held.explain().startswith("The grasp of 1_cube_a holds")
    assert {"surface", "fit", "simulate"} <= set(held.seconds)
    assert held.placed is cube and held.precision and held.stable and held.kept
    # The fingers were opened before they closed.
    assert np.all(held.pregrasp.closing < held.fit.closing)
    assert (X_WT @ cube.X_TO @ held.pregrasp.X_OG)[2, 3] > 0.65


@pytest.mark.parametrize("where", ["table", "camera"])
def test_moving_object_and_grasp_together_changes_nothing(held, cube, grasp, where):
    Z = make_pose(Rotation.from_euler("z", -2.9).as_matrix(), [0.2, -0.1, 0.0])
    X_TO, seen = Z @ cube.X_TO, where == "camera"
    moved = dg.transform_grasp(invert_pose(X_TC) @ X_TO if seen else X_TO, dg.pack_grasp(*grasp))
    how = {"X_TC": X_TC} if seen else {}
    placed = replace(dg.place_object(cube, X_TO=X_TO), config=CONFIG)
    found = dg.verify_grasp(moved, placed, frame=where, **how)
    assert found.outcome is held.outcome and found.num_tries == held.num_tries
    np.testing.assert_allclose(found.fit.X_OG, held.fit.X_OG, atol=1e-9)
    np.testing.assert_allclose(reached(found), reached(held), atol=1e-9)


def test_postures_are_tried_where_their_rows_put_the_object(cube):
    """Poses that differ by 4 mm are two, and equal ones are one object."""
    higher = make_pose(np.eye(3), [0.0, 0.0, 0.004]) @ cube.X_TO
    poses, palms = np.array([cube.X_TO, higher, higher]), np.tile(np.eye(4), (3, 1, 1))
    table = make_attempts(HAND, ["1_cube_a"] * 3, palms, X_TO=poses)
    (low,), (high,), (again,) = (each.stands for each in place_on_object(table, cube))
    assert low is cube and again is high
    np.testing.assert_allclose(high.X_TO, higher, atol=1e-12)


def test_contacts_in_the_air_are_tried_and_told(cube, grasp):
    """The hand closes on the cube behind them: it holds, but not the grasp that was asked for."""
    p, n = grasp
    found = verify(cube, p + 0.03 * n, n)
    np.testing.assert_allclose(found.surface_distance, 0.03, atol=1e-4)
    assert found.lifted and not found.matches
    assert found.farthest_contact == pytest.approx(0.03, abs=1e-3)
    assert "It does not match its request: fingertip" in found.explain()


def test_normals_that_point_inwards_are_tried_and_get_a_hint(cube, grasp):
    p, n = grasp
    found = verify(cube, p, -n)
    assert not found.matches and found.trial is not None
    assert found.hints == ("normals that point the other way, out of the object",)
    assert found.explain().endswith(f"This would fit much better: {found.hints[0]}.")


@pytest.mark.parametrize("given", list(permutations(range(3)))[1:])
def test_fingers_in_another_order_get_the_right_one(cube, grasp, given):
    p, n = grasp
    found = verify(cube, p[list(given)], n[list(given)])
    right = " ".join(str(given.index(finger) + 1) for finger in range(3))
    assert found.hints == (f"contacts in the order {right} of the fingers",)


def test_start_collision_names_the_links_and_what_they_are_in(cube, grasp):
    """With fingers 1 and 2 swapped the palm is upside down, below the object."""
    p, n = grasp
    found = verify(cube, p[[1, 0, 2]], n[[1, 0, 2]])
    assert found.outcome is Outcome.START_COLLISION and found.reason in found.explain()
    met = "finger1_distal, .* in the object; .* in the table"
    assert re.fullmatch(f"{found.outcome.text}: {met}", found.reason)


@pytest.mark.parametrize(
    ("meant", "given", "factor", "hint"),
    [
        ("table", {"frame": "object"}, 1.0, "the table's frame (table)"),
        ("world", {"frame": "table"}, 1.0, "the world's frame (world)"),
        ("object", {"frame": "table"}, 1.0, "the object's frame (object)"),
        ("object", {"frame": "camera", "X_TC": X_TC}, 1.0, "the object's frame (object)"),
        (X_TC, {"frame": "camera", "X_TC": invert_pose(X_TC)}, 1.0, "the inverse of X_TC"),
        ("object", {}, 1e3, "points in millimetres instead of metres"),
        ("object", {}, 1e2, "points in centimetres instead of metres"),
        ("object", {}, 1e-3, "points 1000 times as large"),
        (X_TC, {"frame": "camera", "X_TC": X_TC}, 1e3, "points in millimetres instead of metres"),
        (
            "table",
            {"frame": "object"},
            1e3,
            "the table's frame (table), with points in millimetres instead of metres",
        ),
        # Without the camera's pose nobody can know.
        (X_TC, {"frame": "object"}, 1.0, None),
    ],
)
def test_misplaced_points_are_told_first_with_where_they_would_fit(
    cube: PlacedObject,
    grasp: tuple[np.ndarray, np.ndarray],
    meant: str | np.ndarray,
    given: dict[str, Any],
    factor: float,
    hint: str | None,
) -> None:
    # Of a cube that stands upright in the middle, the frames differ by their height alone.
    X_TO = make_pose(Rotation.from_euler("z", 0.7).as_matrix(), [0.2, -0.1, 0.0]) @ cube.X_TO
    X_FO = (
        {"object": np.eye(4), "table": X_TO, "world": X_WT @ X_TO}[meant]
        if isinstance(meant, str)
        else None
    )
    X_FO = invert_pose(X_TC) @ X_TO if X_FO is None else X_FO
    numbers = dg.transform_grasp(X_FO, dg.pack_grasp(*grasp))
    numbers[:9] *= factor
    found = dg.verify_grasp(numbers, dg.place_object(cube, X_TO=X_TO), **given)
    assert found.misplaced and not found.matches
    distance = 1e3 * found.surface_distance
    text = found.explain()
    assert f"{distance.max():.1f} mm off the object" in text.split(". ")[0]
    if hint is None:
        assert found.hints == () and "They fit in no other known frame or unit" in text
    else:
        assert found.hints == (hint,)
        assert f". This would fit much better: {hint}. The grasp of" in text


def test_one_point_in_the_air_is_told(cube, grasp):
    p, n = grasp[0].copy(), grasp[1]
    p[1] += 0.012 * n[1]
    found = verify(cube, p, n)
    assert found.lifted and found.misplaced and found.hints == ()
    text = found.explain()
    assert text.startswith("1 of 3 points lies 12.0 mm off the object, so the requested grasp")
    assert "After closing, the fingertips touch" in text
    assert not any(word in text for word in ("Before closing", "In a dataset"))


def test_at_little_friction_it_does_not_hold(cube, grasp):
    found = verify(cube, *grasp, override_config(CONFIG, ["physics.friction_hand=0.05"]))
    assert found.outcome in (Outcome.DROPPED, Outcome.SLIPPED, Outcome.PARTLY_HELD)


def test_a_drake_error_is_a_value_and_the_next_grasp_is_untouched(held, cube, grasp, monkeypatch):
    p, n = grasp
    with monkeypatch.context() as patch:
        patch.setattr("drakegrasp.simulation.trial.finger_speed", _fail)
        found = verify(cube, p, n)
    assert found.outcome is Outcome.SOLVER_ERROR and found.outcome.inconclusive
    assert "says nothing about the grasp" in found.reason and "broken" in found.reason
    again = verify(cube, p, n)
    np.testing.assert_array_equal(reached(again), reached(held))


def tried(held, monkeypatch, ends, most=5, fingers=3):
    """Return the verdict where the trials of the wrist poses end in these ways, in turn."""
    (first,) = held.tries
    trials = iter([replace(first, trial=replace(first.trial, outcome=end)) for end in ends])
    monkeypatch.setattr(verifying, "fit_wrist", lambda *_, **__: [first.fit] * len(ends))
    monkeypatch.setattr(verifying, "_try", lambda *_: next(trials))
    hand = "franka" if fingers == 2 else "barrett"
    config = override_config(CONFIG, [f"verify.max_tries={most}"], hand=hand)
    monkeypatch.setattr(verifying, "start_meetings", lambda *_: {})
    return verify(held.placed, held.p_OQ[:fingers], held.nhat_Q_O[:fingers], config=config)


LOST, HITS, HELD = Outcome.SLIPPED, Outcome.START_COLLISION, Outcome.SUCCESS


@pytest.mark.parametrize(
    ("ends", "most", "tries", "by"),
    [
        ([HELD, LOST], 5, 1, 0),
        ([LOST, HELD, LOST], 5, 2, 1),
        ([HITS, LOST, HELD], 5, 3, 2),
        ([LOST, LOST, HELD], 2, 2, None),
        ([LOST, HELD], 1, 1, None),
        ([LOST, LOST], 5, 2, None),
        ([Outcome.TIMEOUT, LOST], 5, 2, None),
    ],
)
def test_first_wrist_pose_decides_and_the_others_are_an_oracle(
    held, monkeypatch, ends, most, tries, by
):
    found = tried(held, monkeypatch, ends, most)
    assert (found.outcome, found.num_tries, found.lifted_by) == (ends[0], tries, by)
    assert found.matches == (by == 0) and found.lifted_any == (by is not None)
    assert [each.trial.outcome for each in found.tries] == ends[:tries]
    if by:
        assert f"number {by + 1} of {tries} does" in found.explain()


@pytest.mark.parametrize(
    ("fingers", "ends", "left"),
    [
        (2, [HITS] * 9 + [LOST, HITS, HELD, LOST], [LOST, HELD]),
        (2, [HITS] * 3, [HITS]),
        (3, [HITS, HITS, HELD], [HITS, HITS, HELD]),
    ],
)
def test_two_contacts_leave_poses_that_collide_out(held, monkeypatch, fingers, ends, left):
    """The palm's turn about two contacts is open: the first pose that is clear is the first."""
    found = tried(held, monkeypatch, ends, fingers=fingers)
    assert [each.trial.outcome for each in found.tries] == left
    assert found.outcome is left[0]


def test_wrist_poses_are_fitted_by_one_thread(cube, grasp, monkeypatch):
    """Else bits depend on their number; protocols of MuJoCo ask for one pose alone."""
    fit_wrist, threads = verifying.fit_wrist, list[int]()

    def fit(*given, **named):
        blas = [each for each in threadpool_info() if each["user_api"] == "blas"]
        threads.extend(each["num_threads"] for each in blas)
        return fit_wrist(*given, **named)

    monkeypatch.setattr(verifying, "fit_wrist", fit)
    (asked,) = place_on_object(dg.pack_grasp(*grasp), cube)
    with threadpool_limits(2):
        verifying.first_fit(asked)
        verify_placed(asked)
    assert len(threads) >= 2 and set(threads) == {1}


def _fail(scene):
    raise RuntimeError("broken")


def test_verdict_is_that_of_a_whole_lift(held, cube, grasp):
    """Whatever moves in the hand ends the lifts of the dataset's configuration at once."""
    limits = ["lift.stop_slip=1e-9", "filters.max_slip=1e-9"]
    config = override_config(CONFIG, ["lift.stop_when=lost_sample", *limits])
    found = verify(cube, *grasp, config=config)
    assert found.outcome is Outcome.SUCCESS
    assert found.trial.lift.duration == held.trial.lift.duration
    assert found.config.lift.stop_when == "never"


@pytest.mark.parametrize(("collisions", "shares"), [(0, [1.0]), (1, [1.0, 0.5]), (2, [1.0, 0.5])])
def test_fingers_are_opened_until_the_hand_is_clear(held, cube, monkeypatch, collisions, shares):
    """By the whole margin, then by half of it."""
    opened, ends = [], iter([Outcome.START_COLLISION] * collisions + [Outcome.SUCCESS])

    def run(model, X_TO, attempt, config, around):
        opened.append(attempt.closing)
        return TrialRecord(outcome=next(ends), X_TO=X_TO, X_OG=attempt.X_OG)

    monkeypatch.setattr(verifying, "run_cached", run)
    config = override_config(CONFIG, ["verify.open_margin_deg=10"])
    pregrasp, trial = verifying._run(cube, held.fit, config)
    expected = [held.fit.closing - share * np.deg2rad(10.0) for share in shares]
    np.testing.assert_allclose(opened, np.maximum(expected, 0.0), atol=1e-12)
    assert trial.outcome is (Outcome.START_COLLISION if collisions == 2 else Outcome.SUCCESS)
    np.testing.assert_array_equal(pregrasp.X_OG, held.fit.X_OG)


def test_settings_of_the_lift_are_those_of_the_trial(held, cube, grasp):
    """The target is held for longer, and no worm keeps the fingers from being pushed open."""
    hold = CONFIG.lift.hold_time + 0.24
    config = override_config(CONFIG, [f"lift.hold_time={hold}", "lift.drive=torque"])
    found = verify(cube, *grasp, config=config)
    longer = found.trial.lift.duration - held.trial.lift.duration
    assert longer == pytest.approx(0.24, abs=1e-3)
    assert found.trial.lift.slip > 3.0 * held.trial.lift.slip
