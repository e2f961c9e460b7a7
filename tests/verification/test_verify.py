"""Verifying grasps end to end: what held once holds again, and what cannot hold does not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.hands import write_with_optional_fingers
from helpers.objects import CUBE, box_model, standing
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

import drakegrasp as dg
from drakegrasp.config import Config
from drakegrasp.errors import GraspError, OffSurfaceError
from drakegrasp.frames import X_WT, invert_pose, make_pose
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.settings import load_config, override_config
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation.candidates import Pregrasp
from drakegrasp.simulation.construction import build_scene
from drakegrasp.simulation.placement import PlacedObject
from drakegrasp.simulation.sampling.rotations import R_OG0
from drakegrasp.simulation.trial import TrialRecord, run_attempt
from drakegrasp.verification import verify as verifying
from drakegrasp.verification.verify import PlacedGrasp, verify_placed

pytestmark = pytest.mark.sim

CONFIG = load_config()


@pytest.fixture(scope="module")
def cube(tmp_path_factory: pytest.TempPathFactory) -> PlacedObject:
    model = box_model(tmp_path_factory.mktemp("cube"), [CUBE] * 3, "1_cube_a")
    return PlacedObject(model=model, X_TO=standing(model))


@pytest.fixture(scope="module")
def grasp(cube: PlacedObject) -> tuple[np.ndarray, np.ndarray]:
    """Contacts of a simulated grasp that held, across two faces of the cube, from above."""
    scene = build_scene(cube.model, CONFIG.physics, load_hand(CONFIG.hand))
    pregrasp = Pregrasp(X_OG=make_pose(R_OG0, [0.0, 0.0, CUBE / 2.0 + 0.06]), spread=0.0)
    record = run_attempt(scene, cube.X_TO, pregrasp, CONFIG)
    assert record.outcome is Outcome.SUCCESS and record.closed is not None
    return record.closed.contacts.p_OQ, record.closed.contacts.nhat_Q_O


def verify(
    placed: PlacedObject,
    p: np.ndarray,
    n: np.ndarray,
    method: str = "hand",
    config: Config = CONFIG,
) -> dg.Verification:
    return verify_placed(
        PlacedGrasp(index=0, placed=placed, p_OQ=p, nhat_Q_O=n, method=method, config=config)
    )


@pytest.fixture(scope="module")
def held(cube: PlacedObject, grasp: tuple[np.ndarray, np.ndarray]) -> dg.Verification:
    return verify(cube, *grasp)


def test_a_grasp_that_held_is_found_again_and_holds(held: dg.Verification) -> None:
    assert held.success and held.outcome is Outcome.SUCCESS
    assert held.fit is not None and held.fit.residual.max() < 0.003
    assert np.rad2deg(held.fit.normal_error).max() < 15.0
    assert held.contact_error is not None and held.contact_error.max() < 0.005
    assert held.closed is not None and held.closed.touching.all()
    assert held.lifted is not None and held.lifted.touching.all()
    assert held.fit.status == 0 and held.fit.iterations > 0
    assert {"surface", "margin", "fit", "simulate"} <= set(held.seconds)
    assert held.explain().startswith("The grasp of 1_cube_a holds")


def test_forces_alone_hold_it_too(cube: PlacedObject, grasp: tuple[np.ndarray, np.ndarray]) -> None:
    found = verify(cube, *grasp, "forces")
    assert found.success and found.fit is None and found.trial is None
    assert found.forces is not None and found.forces.planned_force < 20.0
    assert 0.0 < found.smallest_friction < CONFIG.physics.friction_hand
    assert "carry it" in found.explain()


def test_the_same_grasp_gives_the_same_bits(
    held: dg.Verification, cube: PlacedObject, grasp: tuple[np.ndarray, np.ndarray]
) -> None:
    p, n = grasp
    verify(cube, p + np.array([0.0, 0.0, 0.003]), n)  # something else in between
    again = verify(cube, p, n)
    assert again.trial is not None and held.trial is not None
    assert again.closed is not None and held.closed is not None
    np.testing.assert_array_equal(again.trial.X_OG, held.trial.X_OG)
    np.testing.assert_array_equal(again.closed.p_OQ, held.closed.p_OQ)
    np.testing.assert_array_equal(again.trial.lift.X_TO, held.trial.lift.X_TO)


@pytest.mark.parametrize("yaw", [0.7, -2.9])
def test_moving_object_and_grasp_together_changes_nothing(
    held: dg.Verification, cube: PlacedObject, grasp: tuple[np.ndarray, np.ndarray], yaw: float
) -> None:
    Z = make_pose(Rotation.from_euler("z", yaw).as_matrix(), [0.2, -0.1, 0.0])
    X_TO = Z @ cube.X_TO
    moved = dg.transform_grasp(X_TO, dg.pack_grasp(*grasp))
    found = dg.verify_grasp(moved, cube, frame="workspace", X_TO=X_TO)
    assert found.outcome is held.outcome and found.tries == held.tries
    assert found.closed is not None and held.closed is not None
    assert found.fit is not None and held.fit is not None
    np.testing.assert_allclose(found.fit.X_OG, held.fit.X_OG, atol=1e-9)
    np.testing.assert_allclose(found.closed.p_OQ, held.closed.p_OQ, atol=1e-9)


def test_the_camera_frame_is_the_one_of_its_pose(
    held: dg.Verification, cube: PlacedObject, grasp: tuple[np.ndarray, np.ndarray]
) -> None:
    X_TC = make_pose(Rotation.from_euler("xyz", [2.0, 0.4, -1.0]).as_matrix(), [0.1, 0.3, 0.4])
    X_CO = invert_pose(X_TC) @ cube.X_TO
    seen = dg.transform_grasp(X_CO, dg.pack_grasp(*grasp))
    found = dg.verify_grasp(seen, cube, frame="camera", X_TC=X_TC)
    assert found.outcome is held.outcome
    np.testing.assert_allclose(found.p_OQ, held.p_OQ, atol=1e-12)


@pytest.mark.parametrize("method", ["hand", "forces"])
def test_contacts_off_the_surface_are_no_grasp(
    cube: PlacedObject, grasp: tuple[np.ndarray, np.ndarray], method: str
) -> None:
    p, n = grasp
    found = verify(cube, p + 0.03 * n, n, method)
    assert found.outcome is Outcome.OFF_SURFACE and not found.success
    assert "30.0 mm from the object's surface" in found.reason
    with pytest.raises(OffSurfaceError, match=r"on the object's surface, got: contact . is 30\.0"):
        dg.verify_grasp(dg.pack_grasp(p + 0.03 * n, n), cube, method=method)


@pytest.mark.parametrize("method", ["hand", "forces"])
def test_normals_that_point_inwards_are_no_grasp(
    cube: PlacedObject, grasp: tuple[np.ndarray, np.ndarray], method: str
) -> None:
    p, n = grasp
    found = verify(cube, p, n * [[-1.0], [-1.0], [1.0]], method)
    assert found.outcome is Outcome.OFF_SURFACE
    assert found.reason in ("normal 1 points into the object", "normal 2 points into the object")


@pytest.mark.parametrize("method", ["hand", "forces"])
def test_three_contacts_on_one_face_hold_nothing(cube: PlacedObject, method: str) -> None:
    half = CUBE / 2.0
    p = np.array([[half, -0.02, 0.0], [half, 0.02, 0.0], [half, 0.0, 0.02]])
    found = verify(cube, p, np.tile([1.0, 0.0, 0.0], (3, 1)), method)
    assert not found.success
    assert found.smallest_friction == np.inf
    assert "are not enough at any friction" in found.explain()


def test_contacts_that_no_hand_spans_are_unreachable(tmp_path: Path) -> None:
    model = box_model(tmp_path, [0.5, 0.1, 0.1], "1_beam_a")
    p = np.array([[0.25, 0.0, 0.0], [0.0, 0.05, 0.0], [-0.25, 0.0, 0.0]])
    n = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    found = verify(PlacedObject(model=model, X_TO=standing(model)), p, n)
    assert found.outcome is Outcome.UNREACHABLE
    assert "no palm pose was found" in found.reason and found.tries == 0


def test_a_finger_that_touches_elsewhere_does_not_make_the_grasp(
    held: dg.Verification, cube: PlacedObject, grasp: tuple[np.ndarray, np.ndarray]
) -> None:
    strict = override_config(CONFIG, ["verify.max_contact_error=1e-5"])
    p, n = grasp
    found = verify(cube, p, n, config=strict)
    assert found.outcome is Outcome.UNREACHABLE and held.success
    assert "closes on the object" in found.reason


def test_the_others_count_where_a_fingertip_that_is_not_required_misses(
    held: dg.Verification, tmp_path: Path
) -> None:
    """The first finger closes 2 cm from its point, the last on nothing."""
    assert held.trial is not None and held.trial.closed is not None
    closed, contacts = held.trial.closed, held.trial.closed.contacts
    p_OQ, touching = contacts.p_OQ.copy(), contacts.touching.copy()
    p_OQ[2], touching[2] = np.nan, False
    contacts = replace(contacts, p_OQ=p_OQ, touching=touching)
    trial = replace(held.trial, closed=replace(closed, contacts=contacts))
    config = load_config(hand=str(write_with_optional_fingers(tmp_path, 2)))
    near = verifying._judge(replace(held, trial=trial), config)
    assert near.success and near.contact_error is not None
    assert np.isnan(near.contact_error).tolist() == [False, False, True]
    moved = held.p_OQ + np.diag([0.02, 0.0, 0.0])
    far = verifying._judge(replace(held, trial=trial, p_OQ=moved), config)
    assert far.outcome is Outcome.UNREACHABLE
    assert far.reason.startswith("fingertip 1 closes on the object")


def test_at_little_friction_neither_method_holds(
    cube: PlacedObject, grasp: tuple[np.ndarray, np.ndarray]
) -> None:
    slippery = override_config(CONFIG, ["physics.friction_hand=0.05"])
    for method in ("hand", "forces"):
        found = verify(cube, *grasp, method, slippery)
        assert found.outcome in (Outcome.DROPPED, Outcome.SLIPPED)


def test_a_drake_error_is_a_value_and_the_next_grasp_is_untouched(
    held: dg.Verification,
    cube: PlacedObject,
    grasp: tuple[np.ndarray, np.ndarray],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    p, n = grasp
    with monkeypatch.context() as patch:
        patch.setattr("drakegrasp.simulation.trial.finger_speed", _fail)
        found = verify(cube, p, n)
    assert found.outcome is Outcome.SOLVER_ERROR and found.outcome.inconclusive
    assert "says nothing about the grasp" in found.reason and "broken" in found.reason
    again = verify(cube, p, n)
    assert again.closed is not None and held.closed is not None
    np.testing.assert_array_equal(again.closed.p_OQ, held.closed.p_OQ)


def test_without_a_verdict_on_one_try_there_is_none(
    cube: PlacedObject, grasp: tuple[np.ndarray, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A palm pose that timed out might have held."""
    outcomes = iter([Outcome.SLIPPED, Outcome.TIMEOUT, *[Outcome.DROPPED] * 3])
    monkeypatch.setattr(
        "drakegrasp.verification.verify.run_attempt",
        lambda scene, X_TO, attempt, config: TrialRecord(
            outcome=next(outcomes), X_TO=X_TO, X_OG=attempt.X_OG
        ),
    )
    found = verify(cube, *grasp)
    assert found.tries > 1
    assert found.outcome is Outcome.TIMEOUT
    assert "says nothing about the grasp" in found.explain()


def test_palm_poses_that_collide_at_the_start_do_not_count(
    held: dg.Verification,
    cube: PlacedObject,
    grasp: tuple[np.ndarray, np.ndarray],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert held.trial is not None
    hits = replace(held.trial, outcome=Outcome.START_COLLISION, closed=None, lift=None)
    trials = [hits] * (CONFIG.verify.max_tries + 1) + [held.trial]
    monkeypatch.setattr(verifying, "fit_wrist", lambda *_, **__: [held.fit] * len(trials))
    remaining = iter(trials)
    monkeypatch.setattr(verifying, "_try", lambda *_: (held.pregrasp, next(remaining)))
    found = verify(cube, *grasp)
    assert found.success
    assert found.tries == len(trials)


def test_number_of_threads_changes_no_bit(
    cube: PlacedObject, grasp: tuple[np.ndarray, np.ndarray]
) -> None:
    """Workers have one thread for linear algebra; a caller's own process has many."""
    fits = []
    for threads in (1, 4):
        with threadpool_limits(threads):
            found = verify(cube, *grasp)
        assert found.fit is not None
        fits.append(found.fit)
    np.testing.assert_array_equal(fits[0].X_OG, fits[1].X_OG)
    np.testing.assert_array_equal(fits[0].closing, fits[1].closing)


def _fail(scene: object) -> float:
    raise RuntimeError("broken")


def test_one_grasp_is_a_vector(cube: PlacedObject) -> None:
    with pytest.raises(GraspError, match=r"verify_grasps takes many"):
        dg.verify_grasp(np.zeros((2, 18)), cube)
    with pytest.raises(GraspError, match=r"must be one of hand, forces, got 'fingers'"):
        dg.verify_grasp(np.zeros(18), cube, method="fingers")
    with pytest.raises(GraspError, match=r"a mesh or a dataset must be given"):
        dg.verify_grasp(np.zeros(18))


def test_another_hands_grasp_is_refused(cube: PlacedObject) -> None:
    with pytest.raises(GraspError, match=r"must be 18 numbers .*got an array of shape \(24,\)"):
        dg.verify_grasp(np.zeros(24), cube)


def test_results_know_what_they_were_asked(held: dg.Verification, cube: PlacedObject) -> None:
    assert held.placed is cube and held.method == "hand"
    assert repr(held).startswith("Verification(hand, held, precision, stable: ")
    assert held.pregrasp is not None and held.pregrasp.closing is not None
    assert held.fit is not None
    # The fingers were opened before they closed.
    assert np.all(held.pregrasp.closing < held.fit.closing)
    assert (X_WT @ cube.X_TO @ held.pregrasp.X_OG)[2, 3] > 0.65


# Each limit, lowered below what was found


def limited(name: str, found: float, factor: float) -> Config:
    return override_config(CONFIG, [f"verify.{name}={factor * found}"])


@pytest.mark.parametrize(
    ("name", "found", "said"),
    [
        ("max_residual", "residual", "to their points: fingertip"),
        ("max_normal_error_deg", "normal_error", "to their points and normals: pad"),
    ],
)
def test_a_fit_beyond_a_limit_is_no_way_to_make_the_grasp(
    held: dg.Verification, name: str, found: str, said: str
) -> None:
    assert held.fit is not None
    values = getattr(held.fit, found)
    finger = 1 + int(values.argmax())
    if name.endswith("deg"):
        values = np.rad2deg(values)
    assert verifying._misfit(held.fit, limited(name, values.max(), 1.01)) == ""
    assert f"{said} {finger} stays" in verifying._misfit(
        held.fit, limited(name, values.max(), 0.99)
    )


def test_contacts_beyond_the_limit_are_another_grasp(held: dg.Verification) -> None:
    assert held.contact_error is not None
    largest, finger = held.contact_error.max(), 1 + int(held.contact_error.argmax())
    near = verifying._judge(held, limited("max_contact_error", largest, 1.01))
    far = verifying._judge(held, limited("max_contact_error", largest, 0.99))
    assert near.held and near.outcome is Outcome.SUCCESS
    assert far.outcome is Outcome.UNREACHABLE
    assert far.reason.startswith(f"fingertip {finger} closes on the object")


def test_distance_from_the_surface_has_a_limit(
    cube: PlacedObject, grasp: tuple[np.ndarray, np.ndarray]
) -> None:
    """Points that are moved outwards by 1 mm."""
    p, n = grasp
    for limit, off in ((0.9e-3, True), (1.2e-3, False)):
        config = override_config(CONFIG, [f"verify.max_surface_distance={limit}"])
        found = verify(cube, p + 1e-3 * n, n, "forces", config)
        assert (found.outcome is Outcome.OFF_SURFACE) == off


def test_as_many_palm_poses_are_tried_as_may_be(
    held: dg.Verification,
    cube: PlacedObject,
    grasp: tuple[np.ndarray, np.ndarray],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """And of different failures the one that got furthest is told."""
    assert held.trial is not None
    ends = [Outcome.SLIPPED, Outcome.MISSING_FINGERTIP, Outcome.DROPPED, Outcome.SUCCESS]
    trials = [replace(held.trial, outcome=end, closed=None, lift=None) for end in ends]
    monkeypatch.setattr(verifying, "fit_wrist", lambda *_, **__: [held.fit] * len(trials))
    for most, outcome in ((3, Outcome.SLIPPED), (4, Outcome.SUCCESS)):
        remaining = iter(trials)
        monkeypatch.setattr(verifying, "_try", lambda *_, r=remaining: (held.pregrasp, next(r)))
        config = override_config(CONFIG, [f"verify.max_tries={most}"])
        found = verify(cube, *grasp, config=config)
        assert (found.outcome, found.tries) == (outcome, most)


def test_verdict_is_that_of_a_whole_lift(
    held: dg.Verification, cube: PlacedObject, grasp: tuple[np.ndarray, np.ndarray]
) -> None:
    """Whatever moves in the hand ends the lifts of the dataset's configuration at once."""
    limits = ["lift.stop_slip=1e-9", "filters.max_slip=1e-9"]
    config = override_config(CONFIG, ["lift.stop_when=lost_sample", *limits])
    found = verify(cube, *grasp, config=config)
    assert found.outcome is Outcome.SUCCESS
    assert found.trial is not None and held.trial is not None
    assert found.trial.lift.duration == held.trial.lift.duration
    assert found.config.lift.stop_when == "never"


@pytest.mark.parametrize(("collisions", "shares"), [(0, [1.0]), (1, [1.0, 0.5]), (2, [1.0, 0.5])])
def test_fingers_are_opened_until_the_hand_is_clear(
    held: dg.Verification,
    cube: PlacedObject,
    monkeypatch: pytest.MonkeyPatch,
    collisions: int,
    shares: list[float],
) -> None:
    """By the whole margin, then by half of it."""
    opened, ends = [], iter([Outcome.START_COLLISION] * collisions + [Outcome.SUCCESS])

    def run(scene: object, X_TO: np.ndarray, attempt: Pregrasp, config: Config) -> TrialRecord:
        opened.append(attempt.closing)
        return TrialRecord(outcome=next(ends), X_TO=X_TO, X_OG=attempt.X_OG)

    monkeypatch.setattr(verifying, "run_attempt", run)
    assert held.fit is not None
    config = override_config(CONFIG, ["verify.open_margin_deg=10"])
    pregrasp, trial = verifying._try(cube, cube.X_TO, held.fit, config)
    expected = [held.fit.closing - share * np.deg2rad(10.0) for share in shares]
    np.testing.assert_allclose(opened, np.maximum(expected, 0.0), atol=1e-12)
    assert trial.outcome is (Outcome.START_COLLISION if collisions == 2 else Outcome.SUCCESS)
    np.testing.assert_array_equal(pregrasp.X_OG, held.fit.X_OG)
