"""The verdict on grasps of objects, each given by its contacts in {O} or by a posture.

Input: `PlacedGrasp`s. Output: a `Verification` for each, in the caller's order. A posture is tried
as given. For contacts, method `hand` finds palm poses that bring the fingertips to the points, and
runs a trial from the best pose, as a build does. If that does not hold, it also tries the others.
Method `forces` computes whether forces at points of the surface can lift the object. Every row
with contacts is tried, even if the numbers look wrong, and faults are judged afterwards from the
measurements. A wrong prediction, a failed solver and a lost object are outcomes, not exceptions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import groupby, islice
from typing import Any, TypeAlias, cast

import numpy as np

from drakegrasp.config import Config, with_whole_lifts
from drakegrasp.frames import Array
from drakegrasp.generation.attempts import judge_sample
from drakegrasp.grasp import for_all_fingers
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.kinematics import coordinate_limits
from drakegrasp.outcomes import Outcome
from drakegrasp.runtime.environment import one_thread, timed
from drakegrasp.runtime.executor import Executor
from drakegrasp.runtime.progress import Report
from drakegrasp.simulation.attempt import Attempt
from drakegrasp.simulation.contacts import Contacts
from drakegrasp.simulation.placement import PlacedObject
from drakegrasp.simulation.posture import run_trial, start_of
from drakegrasp.simulation.scene_cache import cached_scene, forget_scenes
from drakegrasp.simulation.trial import TrialRecord, run_attempt, start_meetings
from drakegrasp.verification.forces import force_margin, hand_contacts, judge_forces
from drakegrasp.verification.hints import find_hints, find_posture_hints, fit_surface
from drakegrasp.verification.placing import PlacedGrasp
from drakegrasp.verification.result import PoseTrial, Verification
from drakegrasp.verification.wrist_solver import WristFit, fit_wrist

#: Decimals to which points [m] and unit normals are rounded: 0.1 mm and 0.06 degrees. This is
#: finer than any contact is known, and coarser than single precision. So the same grasp in another
#: frame becomes the same numbers, and rounding errors cannot change a close verdict.
POINT_DIGITS, NORMAL_DIGITS = 4, 3
#: Fractions of `verify.open_margin_deg` by which the fingers are opened, in turn, until the hand is
#: clear of object and table.
MARGINS = (1.0, 0.5)


@one_thread
def verify_placed(grasp: PlacedGrasp) -> Verification:
    """Return whether a grasp holds its object; the contacts are rounded to 0.1 mm."""
    p_OQ, nhat_Q_O = grasp.contacts()
    normalised, ranks = grasp.attempt.normalised, grasp.attempt.rank
    stated = grasp.attempt.confidence
    base = Verification(
        method=grasp.method,
        outcome=Outcome.INVALID,
        reason=grasp.invalid,
        placed=grasp.placed,
        config=with_whole_lifts(grasp.config),
        p_OQ=p_OQ,
        nhat_Q_O=nhat_Q_O,
        surface_distance=np.full(len(p_OQ), np.nan),
        normalised=normalised is not None and bool(normalised[0]),
        confidence=np.nan if stated is None else float(stated[0]),
        rank=-1 if stated is None or ranks is None else int(ranks[0]),
    )
    if grasp.invalid:
        return base
    if grasp.method == "posture":
        return _best_stand(base, grasp)

    # Measure how the contacts lie on the surface, and what forces at the contacts alone can do.
    model, (points, normals) = base.placed.model, _rounded(p_OQ, nhat_Q_O)
    with timed(base.seconds, "surface"):
        fit = fit_surface(model, points, normals)
        if grasp.snap_points:
            points, _ = _rounded(fit.nearest, normals)
    with timed(base.seconds, "margin"):
        contacts = hand_contacts(model, points, normals, base.config)
        X_TO = base.placed.X_TO_simulated
        epsilon, smallest_friction = force_margin(model, X_TO, contacts, base.config)
    base = replace(
        base,
        p_OQ=points,
        nhat_Q_O=normals,
        surface_distance=fit.distance,
        snapped=grasp.snap_points,
        epsilon=epsilon,
        smallest_friction=smallest_friction,
    )

    # Run the trial. If it fails or the points are far away, look for faults in the numbers.
    result = _lift_by_hand(base) if grasp.method == "hand" else _lift_by_forces(base)
    if (result.success and not result.misplaced) or result.outcome.inconclusive:
        return result
    with timed(base.seconds, "hints"):
        hints = find_hints(grasp, p_OQ, normals, fits=result.success)
    return replace(result, hints=hints)


@one_thread
def first_fit(grasp: PlacedGrasp) -> WristFit:
    """Return the wrist pose by which a valid grasp is judged."""
    return _fits(grasp.placed, *_rounded(*grasp.contacts()), grasp.config)[0]


def _fits(placed: PlacedObject, p_OQ: Array, nhat_Q_O: Array, config: Config) -> list[WristFit]:
    X_TO = placed.X_TO_simulated
    return fit_wrist(
        load_hand(config.hand_source), p_OQ, nhat_Q_O, up_O=X_TO[2, :3], height=float(X_TO[2, 3])
    )


def _rounded(p_OQ: Array, nhat_Q_O: Array) -> tuple[Array, Array]:
    """Return points and unit normals (k, 3), rounded."""
    # Adding zero turns -0.0 into 0.0.
    normals = np.round(nhat_Q_O, NORMAL_DIGITS) + 0.0
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.round(p_OQ, POINT_DIGITS) + 0.0, normals / length


def _lift_by_hand(base: Verification) -> Verification:
    """Find palm poses for the contacts, and try them until one holds the object."""
    # The palm poses bring the fingertips to the contacts; the best is first.
    hand = load_hand(base.config.hand_source)
    with timed(base.seconds, "fit"):
        fits = _fits(base.placed, base.p_OQ, base.nhat_Q_O, base.config)
    with timed(base.seconds, "simulate"):
        # Two contacts leave the palm's turn about their line open, and most of these poses are
        # inside the object or the table: the first clear pose counts as the first pose.
        tries = _try_poses(base, fits, pass_collisions=hand.num_fingers == 2)

    return _judged(base, tries)


def _best_stand(base: Verification, grasp: PlacedGrasp) -> Verification:
    """Try a posture in each of its resting poses and preshapes; return the best verdict."""
    shapes = grasp.attempt.shapes(0, load_hand(base.config.hand_source))
    found = [
        (_try_posture(replace(base, placed=placed, stand=k), grasp, shape), shape)
        for k, placed in enumerate(grasp.stands)
        for shape in shapes
    ]
    best, shape = max(
        found, key=lambda f: (f[0].held, f[0].stable, f[0].precision, f[0].outcome.stage)
    )
    told, poses = list[str](), len(grasp.stands)
    if not grasp.attempt.names_pose(0):
        told.append("in the one resting pose that is known, as none is named")
        if poses > 1:
            told = [f"the best of {poses} resting poses, as none is named: {best.stand}"]
    if len(shapes) > 1:
        told.append(f"the best of {len(shapes)} preshapes: {shape}")
    return replace(best, reason=f"{best.reason} ({'; '.join(told)})") if told else best


def _try_posture(base: Verification, grasp: PlacedGrasp, preshape: str) -> Verification:
    """Try a posture in a preshape; an empty name means no preshape."""
    posture = replace(grasp.posture(base.placed), preshape=preshape or None)
    with timed(base.seconds, "simulate"):
        trial = run_trial(base.placed, posture, base.config)
    start = start_of(posture, load_hand(base.config.hand_source))
    nothing = np.full(len(base.p_OQ), np.nan)
    tried = PoseTrial(
        fit=None,
        pregrasp=start,
        trial=_of_all_fingers(trial, start.unused, len(base.p_OQ)),
        contact_error=nothing,
        normal_error=nothing,
        removal=judge_sample(base.placed.model, trial, base.config),
    )
    result = _judged(base, (tried,))
    if result.held or result.outcome.inconclusive:
        return result

    # If it fails, look for faults in the numbers.
    with timed(base.seconds, "hints"):
        hints, distance = find_posture_hints(grasp, base.placed, posture)
    return replace(result, hints=hints, fingertip_distance=distance)


def _of_all_fingers(trial: TrialRecord, unused: int, fingers: int) -> TrialRecord:
    """Return a trial with contacts of all fingers; fingers that a preshape leaves out have none."""
    fills = {**dict.fromkeys(("p_OQ", "nhat_Q_O"), np.nan), "touching": False}
    fills |= dict.fromkeys(("f_Q_O", "area", "penetration"), 0.0)

    def filled(contacts: Contacts) -> Contacts:
        values: dict[str, Any] = {
            name: for_all_fingers(getattr(contacts, name), unused, fingers, fill)
            for name, fill in fills.items()
        }
        return replace(contacts, **values)

    closed, lifted = trial.closed, trial.lift
    return replace(
        trial,
        closed=closed and replace(closed, contacts=filled(closed.contacts)),
        lift=lifted and replace(lifted, contacts=filled(lifted.contacts)),
    )


def _judged(base: Verification, tries: tuple[PoseTrial, ...]) -> Verification:
    """Return the verdict of the first trial, which decides."""
    trial = tries[0].trial
    placed, start, message = base.placed, tries[0].pregrasp, trial.message
    if trial.outcome is Outcome.START_COLLISION:
        about = base.config.physics, base.config.hand_source, start.preshape
        met = start_meetings(cached_scene(placed.model, *about), placed.X_TO_simulated, start)
        message = "; ".join(f"{', '.join(links)} in the {other}" for other, links in met.items())
    reason = trial.outcome.text + (f": {message}" if message else "")
    return replace(base, outcome=trial.outcome, reason=reason, tries=tries)


def _try_poses(
    base: Verification, fits: Iterable[WristFit], *, pass_collisions: bool
) -> tuple[PoseTrial, ...]:
    """Return the trials of wrist poses until one holds or enough were tried; at least one.

    Args:
        base: The verification so far, with the requested contacts.
        fits: The wrist poses.
        pass_collisions: Whether poses that collide at the start do not count, unless all do.
    """
    tries, passed = list[PoseTrial](), list[PoseTrial]()
    for fit in fits:
        tried = _try(base, fit)
        collides = pass_collisions and tried.trial.outcome is Outcome.START_COLLISION
        (passed if collides else tries).append(tried)
        if tried.held or len(tries) == base.config.verify.max_tries:
            break
    return tuple(tries or passed[:1])


def _try(base: Verification, fit: WristFit) -> PoseTrial:
    """Run the trial of a wrist pose, and measure the errors of its contacts."""
    model = base.placed.model
    pregrasp, trial = _run(base.placed, base.placed.X_TO_simulated, fit, base.config)

    # Distances and angles for the fingertips that touch; a contact whose patches face each other
    # has no normal.
    contact_error, normal_error = np.full((2, len(base.p_OQ)), np.nan)
    if trial.closed is not None:
        closed = trial.closed.contacts
        contact_error = np.linalg.norm(closed.p_OQ - base.p_OQ, axis=1)
        cosine = np.sum(closed.nhat_Q_O * base.nhat_Q_O, axis=1)
        normal_error = np.arccos(np.clip(cosine, -1.0, 1.0))
    return PoseTrial(
        fit=fit,
        pregrasp=pregrasp,
        trial=trial,
        contact_error=contact_error,
        normal_error=normal_error,
        removal=judge_sample(model, trial, base.config),
    )


def _run(
    placed: PlacedObject, X_TO: Array, fit: WristFit, config: Config
) -> tuple[Attempt, TrialRecord]:
    """Open the fingers of a fit until the hand is clear, and run the trial from there.

    Returns:
        The start of the trial, and its record.
    """
    scene = cached_scene(placed.model, config.physics, config.hand_source)
    hand = load_hand(config.hand_source)
    least = coordinate_limits(hand)[1:, 0]
    for share in MARGINS:
        margin = share * np.deg2rad(config.verify.open_margin_deg) * hand.closing_unit
        closing = np.maximum(fit.closing - margin, least)
        pregrasp = Attempt(X_OG=fit.X_OG, spread=fit.spread, closing=closing)
        trial = run_attempt(scene, X_TO, pregrasp, config)
        if trial.outcome is not Outcome.START_COLLISION:
            break

    # A scene in which Drake failed is never used again.
    if trial.outcome.inconclusive:
        forget_scenes()
    return pregrasp, trial


def _lift_by_forces(base: Verification) -> Verification:
    """Compute whether forces at points of the surface can lift the object, without a hand."""
    placed = base.placed
    with timed(base.seconds, "forces"):
        forces = judge_forces(
            placed.model, placed.X_TO_simulated, base.p_OQ, base.nhat_Q_O, base.config
        )
    outcome = Outcome.SUCCESS if forces.held else Outcome.DROPPED
    if not forces.on_surface:
        outcome = Outcome.OFF_SURFACE
    return replace(base, outcome=outcome, reason=forces.reason, forces=forces)


#: Receives results as they are computed: called with a grasp's index and its result.
ResultCallback: TypeAlias = Callable[[int, Verification], None]


def ignore_result(index: int, result: Verification) -> None:
    """Do nothing with a result; the default `ResultCallback`."""


def verify_batch(
    grasps: Sequence[PlacedGrasp],
    execute: Executor,
    report: Report,
    on_result: ResultCallback = ignore_result,
    *,
    together: int = 1,
) -> list[Verification]:
    """Return the results of grasps in the caller's order.

    Args:
        grasps: Grasps with indices 0 to n - 1, in any order; grasps of one object are adjacent.
        execute: Runs the verifications.
        report: Is called with the numbers of finished and of successful grasps.
        on_result: Is called with each result in the caller's order, once all earlier ones exist.
        together: Largest number of grasps of one object in a task. They are sent to a worker with
            one copy of the meshes, and share what the worker computes from the meshes.
    """
    objects = {g.index: g.stands for g in grasps}
    results: dict[int, Verification] = {}
    delivered = holding = 0
    report(0, len(grasps), holding=holding)
    for verdicts in execute(_verify_together, _tasks(grasps, together)):
        for index, result in verdicts:
            results[index] = replace(result, placed=objects[index][result.stand])
            holding += result.success

        # Deliver these results, and later results that were waiting for them.
        while delivered in results:
            on_result(delivered, results[delivered])
            delivered += 1
        report(len(results), len(grasps), holding=holding)
    return [results[i] for i in range(len(grasps))]


def _tasks(grasps: Sequence[PlacedGrasp], together: int) -> Iterator[list[PlacedGrasp]]:
    """Yield the grasps in lists of at most `together`, each list for one object."""
    for _, same in groupby(grasps, key=lambda grasp: id(grasp.placed)):
        # `itertools.batched` is newer than Python 3.11.
        while task := list(islice(same, together)):
            yield task


def _verify_together(grasps: Sequence[PlacedGrasp]) -> list[tuple[int, Verification]]:
    """Return the indices of grasps with their results, without the object: the caller has it."""
    nothing = cast(PlacedObject, None)
    return [(g.index, replace(verify_placed(g), placed=nothing)) for g in grasps]
