"""The verdict on grasps of objects, each given by its contacts in {O} or by a posture.

Input: `PlacedGrasp`s. Output: a `Verification` for each, in the caller's order. A posture is tried
as given. For contacts, palm poses are found that bring the fingertips to the points, and a trial is
run from the best pose, as in a build. If that does not hold, the others are also tried. Every row
with contacts is tried, even if the numbers look wrong, and faults are judged afterwards from the
measurements. A wrong prediction, a failed solver and a lost object are outcomes, not exceptions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import groupby, islice
from typing import Any, TypeAlias

import numpy as np

from drakegrasp.config import Config
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
from drakegrasp.simulation.placement import PlacedObject, run_trial
from drakegrasp.simulation.posture import start_of
from drakegrasp.simulation.scene_cache import cached_scene, run_cached
from drakegrasp.simulation.trial import TrialRecord, start_meetings
from drakegrasp.verification.hints import fit_surface
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
    p_OQ, nhat_Q_O = grasp.in_object_frame()
    verdict = Verification(
        grasp=grasp,
        outcome=Outcome.INVALID,
        reason=grasp.invalid,
        p_OQ=p_OQ,
        nhat_Q_O=nhat_Q_O,
        surface_distance=np.full(len(p_OQ), np.nan),
    )
    if grasp.invalid:
        return verdict
    return _of_posture(verdict) if grasp.postures else _of_contacts(verdict)


def rounded(p_OQ: Array, nhat_Q_O: Array) -> tuple[Array, Array]:
    """Return points and unit normals (k, 3), rounded."""
    # Adding zero turns -0.0 into 0.0.
    normals = np.round(nhat_Q_O, NORMAL_DIGITS) + 0.0
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.round(p_OQ, POINT_DIGITS) + 0.0, normals / length


@one_thread
def first_fit(grasp: PlacedGrasp) -> WristFit:
    """Return the wrist pose by which valid contacts are judged."""
    hand, contacts = load_hand(grasp.config.hand_source), rounded(*grasp.in_object_frame())
    return fit_wrist(hand, *contacts, grasp.placed.X_TO_simulated)[0]


def _of_contacts(verdict: Verification) -> Verification:
    """Try palm poses for the contacts until one holds the object or enough were tried."""
    grasp, seconds = verdict.grasp, verdict.seconds
    p_OQ, nhat_Q_O = rounded(verdict.p_OQ, verdict.nhat_Q_O)
    with timed(seconds, "surface"):
        surface = fit_surface(grasp.placed.model, p_OQ, nhat_Q_O)
    with timed(seconds, "fit"):
        hand = load_hand(grasp.config.hand_source)
        poses = fit_wrist(hand, p_OQ, nhat_Q_O, grasp.placed.X_TO_simulated)

    # Two contacts leave the palm's turn about their line open, and most of these poses are inside
    # the object or the table: the first clear pose counts as the first pose, unless all collide.
    pass_collisions = len(p_OQ) == 2
    tries, passed = list[PoseTrial](), list[PoseTrial]()
    for fit in poses:
        if len(tries) == grasp.config.verify.max_tries:
            break
        with timed(seconds, "simulate"):
            tried = _try(grasp, p_OQ, nhat_Q_O, fit)
        collides = pass_collisions and tried.trial.outcome is Outcome.START_COLLISION
        (passed if collides else tries).append(tried)
        if tried.lifted:
            break
    return _judged(
        replace(
            verdict,
            p_OQ=p_OQ,
            nhat_Q_O=nhat_Q_O,
            surface_distance=surface.distance,
            tries=tuple(tries or passed[:1]),
        )
    )


def _try(grasp: PlacedGrasp, p_OQ: Array, nhat_Q_O: Array, fit: WristFit) -> PoseTrial:
    """Run the trial of a wrist pose, and measure the errors of its contacts."""
    pregrasp, trial = _run(grasp.placed, fit, grasp.config)

    # Distances and angles for the fingertips that touch; a contact whose patches face each other
    # has no normal.
    contact_error, normal_error = np.full((2, len(p_OQ)), np.nan)
    if trial.closed is not None:
        closed = trial.closed.contacts
        contact_error = np.linalg.norm(closed.p_OQ - p_OQ, axis=1)
        cosine = np.sum(closed.nhat_Q_O * nhat_Q_O, axis=1)
        normal_error = np.arccos(np.clip(cosine, -1.0, 1.0))
    views = grasp.placed.around is None  # the cameras of a build see one object
    return PoseTrial(
        fit=fit,
        pregrasp=pregrasp,
        trial=trial,
        contact_error=contact_error,
        normal_error=normal_error,
        removal=judge_sample(grasp.placed.model, trial, grasp.config, views=views),
    )


def _run(placed: PlacedObject, fit: WristFit, config: Config) -> tuple[Attempt, TrialRecord]:
    """Open the fingers of a fit until the hand is clear, and run the trial from there.

    Returns:
        The start of the trial, and its record.
    """
    hand = load_hand(config.hand_source)
    least = coordinate_limits(hand)[1:, 0]
    for share in MARGINS:
        margin = share * np.deg2rad(config.verify.open_margin_deg) * hand.closing_unit
        closing = np.maximum(fit.closing - margin, least)
        pregrasp = Attempt(X_OG=fit.X_OG, spread=fit.spread, closing=closing)
        at = placed.X_TO_simulated
        trial = run_cached(placed.model, at, pregrasp, config, placed.around_simulated)
        if trial.outcome is not Outcome.START_COLLISION:
            break
    return pregrasp, trial


def _of_posture(verdict: Verification) -> Verification:
    """Try a posture in each of its resting poses and preshapes; return the best verdict."""
    # Try each of them.
    grasp, tried = verdict.grasp, list[tuple[Verification, str]]()
    views = grasp.placed.around is None  # the cameras of a build see one object
    hand, nothing = load_hand(grasp.config.hand_source), np.full(len(verdict.p_OQ), np.nan)
    for stand, (placed, given) in enumerate(zip(grasp.stands, grasp.postures, strict=True)):
        for shape in grasp.preshapes:
            posture = replace(given, preshape=shape or None)
            start = start_of(posture, hand)
            with timed(verdict.seconds, "simulate"):
                trial = run_trial(placed, posture, grasp.config)
            one = PoseTrial(
                fit=None,
                pregrasp=start,
                trial=_of_all_fingers(trial, start.unused, hand.num_fingers),
                contact_error=nothing,
                normal_error=nothing,
                removal=judge_sample(placed.model, trial, grasp.config, views=views),
            )
            found = replace(verdict, stand=stand, tries=(one,))
            tried.append((_judged(found), shape))

    # The best, and the reason with what the posture left open.
    best, shape = max(
        tried, key=lambda f: (f[0].lifted, f[0].stable, f[0].precision, f[0].outcome.stage)
    )
    notes, poses = list[str](), len(grasp.stands)
    if not grasp.named:
        notes.append(
            f"the best of {poses} resting poses, as none is named: {best.stand}"
            if poses > 1
            else "in the one resting pose that is known, as none is named"
        )
    if len(grasp.preshapes) > 1:
        notes.append(f"the best of {len(grasp.preshapes)} preshapes: {shape}")
    return replace(best, reason=f"{best.reason} ({'; '.join(notes)})") if notes else best


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


def _judged(verdict: Verification) -> Verification:
    """Return the verdict of the first trial, which decides."""
    trial, start, placed = verdict.tries[0].trial, verdict.tries[0].pregrasp, verdict.placed
    message = trial.message
    if trial.outcome is Outcome.START_COLLISION:
        about = verdict.config.physics, verdict.config.hand_source, start.preshape
        scene = cached_scene(placed.model, *about, placed.around_simulated)
        met = start_meetings(scene, placed.X_TO_simulated, start)
        message = "; ".join(f"{', '.join(links)} in the {other}" for other, links in met.items())
    reason = trial.outcome.text + (f": {message}" if message else "")
    return replace(verdict, outcome=trial.outcome, reason=reason)


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
    explained: bool = True,
) -> list[Verification]:
    """Return the results of grasps in the caller's order.

    Args:
        grasps: Grasps with indices 0 to n - 1, in any order; grasps of one object are adjacent.
        execute: Runs the verifications.
        report: Is called with the numbers of finished grasps and of those that match.
        on_result: Is called with each result in the caller's order, once all earlier ones exist.
        together: Largest number of grasps of one object in a task. They are sent to a worker with
            one copy of the meshes, and share what the worker computes from the meshes.
        explained: Whether the tasks also compute the margins and hints, which a result otherwise
            computes when it is asked for them.
    """
    by_index = {grasp.index: grasp for grasp in grasps}
    results: dict[int, Verification] = {}
    delivered = holding = 0
    report(0, len(grasps), holding=holding)
    for finished in execute(
        partial(_verify_together, explained=explained), _tasks(grasps, together)
    ):
        # Workers return what they found, without the meshes.
        for index, found in finished:
            results[index] = Verification(grasp=by_index[index], **found)
            holding += results[index].matches

        # Deliver these results, and later results that were waiting for them.
        while delivered in results:
            on_result(delivered, results[delivered])
            delivered += 1
        report(len(results), len(grasps), holding=holding)
    return [results[i] for i in range(len(grasps))]


def _tasks(grasps: Sequence[PlacedGrasp], together: int) -> Iterator[list[PlacedGrasp]]:
    """Yield grasps of one object, up to `together` at a time."""
    for _, same in groupby(grasps, key=lambda grasp: grasp.placed.model.name):
        while chunk := list(islice(same, together)):
            yield chunk


def _verify_together(
    grasps: Sequence[PlacedGrasp], *, explained: bool
) -> list[tuple[int, dict[str, Any]]]:
    """Return what was found of the grasps of a task, each with its index."""
    results = [verify_placed(grasp) for grasp in grasps]
    return [(r.grasp.index, (r.explained() if explained else r).findings()) for r in results]
