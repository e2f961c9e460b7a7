"""The verdict on one grasp of one object, from its contacts in {O}.

In: a `PlacedGrasp`. Out: a `Verification`. Method
`hand` finds palm poses that bring the fingertips to the points and runs a trial from each, as a
build does. Method `forces` asks whether forces at the surface's own contacts can lift the object. A
wrong prediction, a failed solver and a lost object are outcomes, not exceptions.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from drakegrasp.config import Config, with_whole_lifts
from drakegrasp.errors import OffSurfaceError
from drakegrasp.frames import Array
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.kinematics import coordinate_limits
from drakegrasp.outcomes import Outcome
from drakegrasp.runtime.blas import one_thread
from drakegrasp.runtime.timing import timed
from drakegrasp.simulation.candidates import Pregrasp
from drakegrasp.simulation.placement import PlacedObject
from drakegrasp.simulation.scene_cache import cached_scene, forget_scenes
from drakegrasp.simulation.trial import TrialRecord, run_attempt
from drakegrasp.verification.contact_surface import face_distances, points_outward
from drakegrasp.verification.forces.quality import force_margin
from drakegrasp.verification.forces.verdict import hand_contacts, judge_forces
from drakegrasp.verification.result import Verification, in_mm
from drakegrasp.verification.wrist.solver import WristFit, fit_wrist

METHODS = ("hand", "forces")

#: Decimals to which points [m] and unit normals are rounded: 0.1 mm and 0.06 degrees. This is
#: finer than any contact is known and coarser than single precision, so the same grasp given in
#: another frame becomes the same numbers, and rounding cannot change a close verdict.
POINT_DIGITS, NORMAL_DIGITS = 4, 3
#: Shares of `verify.open_margin_deg` by which the fingers are opened, in turn, until the hand is
#: clear of object and table.
MARGINS = (1.0, 0.5)
#: The reason that a person reads, by the outcome of the trial.
_REASONS = {
    Outcome.SUCCESS: "every fingertip touches it at the end of the lift, clear of the table",
    Outcome.BELOW_TABLE: "the palm would be below the table",
    Outcome.START_COLLISION: "the opened hand would be inside the object or the table",
    Outcome.MISSING_FINGERTIP: "a fingertip closes without touching the object",
    Outcome.HAND_CONTACT: "a part of the hand that is not a fingertip touches the object",
    Outcome.TABLE_CONTACT: "the closing hand or the lifted object touches the table",
    Outcome.DROPPED: "the hand loses the object during the lift",
    Outcome.SLIPPED: "a fingertip loses contact during the lift",
    Outcome.SOLVER_ERROR: "the simulation failed, which says nothing about the grasp",
    Outcome.TIMEOUT: "the limit of computing time passed, which says nothing about the grasp",
}
#: Outcomes by how far an attempt got. If a grasp's attempts fail differently, the one that got
#: furthest is reported.
_RANK = (
    Outcome.TIMEOUT,
    Outcome.SOLVER_ERROR,
    Outcome.BELOW_TABLE,
    Outcome.START_COLLISION,
    Outcome.UNREACHABLE,
    Outcome.MISSING_FINGERTIP,
    Outcome.HAND_CONTACT,
    Outcome.TABLE_CONTACT,
    Outcome.DROPPED,
    Outcome.SLIPPED,
)


@dataclass(frozen=True, kw_only=True, eq=False)
class PlacedGrasp:
    """A grasp of k contacts on an object on the table: all that its verification needs.

    Attributes:
        index: Its place among the caller's grasps.
        placed: The object on the table.
        p_OQ, nhat_Q_O: (k, 3), contact points [m] and outward unit normals in {O}.
        method: "hand" or "forces".
        config: Hand, physics, lift and limits. What ends or avoids lifts (`lift.stop_when`,
            `lift.least_chance`, `lift.least_depth_variance`) is without effect: the verdict is that
            of a whole lift.
    """

    index: int
    placed: PlacedObject
    p_OQ: Array
    nhat_Q_O: Array
    method: str
    config: Config


@one_thread
def verify_placed(grasp: PlacedGrasp) -> Verification:
    """Return whether a grasp holds its object; the contacts are rounded to 0.1 mm."""
    # Round the contacts; adding zero turns -0.0 into 0.0.
    placed, config = grasp.placed, with_whole_lifts(grasp.config)
    rules, seconds = config.verify, dict[str, float]()
    p_OQ = np.round(grasp.p_OQ, POINT_DIGITS) + 0.0
    nhat_Q_O = np.round(grasp.nhat_Q_O, NORMAL_DIGITS) + 0.0
    nhat_Q_O /= np.linalg.norm(nhat_Q_O, axis=1, keepdims=True)

    # Contacts off the surface, and normals that point inwards, are no grasp.
    with timed(seconds, "surface"):
        distance = face_distances(placed.model, p_OQ)
        outward = points_outward(placed.model, distance, nhat_Q_O)
    base = Verification(
        method=grasp.method,
        outcome=Outcome.OFF_SURFACE,
        reason="",
        placed=placed,
        config=config,
        p_OQ=p_OQ,
        nhat_Q_O=nhat_Q_O,
        surface_distance=distance.min(axis=1),
        seconds=seconds,
    )
    farthest = int(np.argmax(base.surface_distance))
    if base.surface_distance[farthest] > rules.max_surface_distance:
        return replace(
            base,
            reason=f"contact {farthest + 1} is {in_mm(base.surface_distance[farthest])} from the "
            f"object's surface, more than {in_mm(rules.max_surface_distance)}",
        )
    if not outward.all():
        finger = int(np.argmin(outward))
        return replace(base, reason=f"normal {finger + 1} points into the object")

    # What forces at the contacts alone can do, whatever the method.
    with timed(seconds, "margin"):
        contacts = hand_contacts(placed.model, p_OQ, nhat_Q_O, config)
        margin = force_margin(placed.model, placed.X_TO_simulated, contacts, config)
    base = replace(base, epsilon=margin.epsilon, smallest_friction=margin.smallest_friction)

    # The trial.
    lift = _lift_by_hand if grasp.method == "hand" else _lift_by_forces
    return lift(base, config)


def refuse_off_surface(result: Verification) -> None:
    """Raise an error if the contacts of a verified grasp are not on its object.

    Raises:
        OffSurfaceError: If so.
    """
    if result.outcome is Outcome.OFF_SURFACE:
        raise OffSurfaceError(f"contacts must be on the object's surface, got: {result.reason}")


def _lift_by_hand(base: Verification, config: Config) -> Verification:
    """Find palm poses for the contacts and try them until one holds the object."""
    # Palm poses that bring the fingertips to the contacts, the best first.
    rules, X_TO = config.verify, base.placed.X_TO_simulated
    with timed(base.seconds, "fit"):
        fits = fit_wrist(
            load_hand(config.hand),
            base.p_OQ,
            base.nhat_Q_O,
            up_O=X_TO[2, :3],
            height=float(X_TO[2, 3]),
        )
    near = [fit for fit in fits if not _misfit(fit, config)]
    if not near:
        reason = _misfit(fits[0], config)
        return replace(base, outcome=Outcome.UNREACHABLE, reason=reason, fit=fits[0])

    # A trial from each, until one holds or enough were simulated; a collision at the start is
    # geometry alone.
    results: list[Verification] = []
    simulated = 0
    for fit in near:
        with timed(base.seconds, "simulate"):
            pregrasp, trial = _try(base.placed, X_TO, fit, config)
        results.append(_judge(replace(base, fit=fit, pregrasp=pregrasp, trial=trial), config))
        if results[-1].success:
            return replace(results[-1], tries=len(results))
        simulated += trial.outcome is not Outcome.START_COLLISION
        if simulated == rules.max_tries:
            break

    # If one of them has no verdict, the grasp has none: that one might have held.
    unknown = [result for result in results if result.outcome.inconclusive]
    farthest = max(unknown or results, key=lambda result: _RANK.index(result.outcome))
    return replace(farthest, tries=len(results))


def _lift_by_forces(base: Verification, config: Config) -> Verification:
    """Ask whether forces at the surface's own contacts can lift the object, without a hand."""
    placed = base.placed
    with timed(base.seconds, "forces"):
        forces = judge_forces(placed.model, placed.X_TO_simulated, base.p_OQ, base.nhat_Q_O, config)
    outcome = Outcome.SUCCESS if forces.held else Outcome.DROPPED
    if not forces.on_surface:
        outcome = Outcome.OFF_SURFACE
    return replace(base, outcome=outcome, reason=forces.reason, forces=forces)


def _misfit(fit: WristFit, config: Config) -> str:
    """Return why a palm pose does not make the grasp; empty if it does."""
    rules, finger = config.verify, int(np.argmax(fit.residual))
    if fit.residual[finger] > rules.max_residual:
        return (
            "no palm pose was found that brings all fingertips to their points: fingertip "
            f"{finger + 1} stays {in_mm(fit.residual[finger])} away"
        )
    finger = int(np.argmax(fit.normal_error))
    angle = np.rad2deg(fit.normal_error[finger])
    if angle > rules.max_normal_error_deg:
        return (
            "no palm pose was found that brings all fingertips to their points and normals: pad "
            f"{finger + 1} stays {angle:.0f}° from its normal"
        )
    return ""


def _try(
    placed: PlacedObject, X_TO: Array, fit: WristFit, config: Config
) -> tuple[Pregrasp, TrialRecord]:
    """Open the fingers of a fit until the hand is clear, and run the trial from there.

    Returns:
        What the trial started from, and what happened.
    """
    scene = cached_scene(placed.model, config.physics, config.hand)
    hand = load_hand(config.hand)
    least = coordinate_limits(hand)[1:, 0]
    for share in MARGINS:
        margin = share * np.deg2rad(config.verify.open_margin_deg) * hand.closing_unit
        closing = np.maximum(fit.closing - margin, least)
        pregrasp = Pregrasp(X_OG=fit.X_OG, spread=fit.spread, closing=closing)
        trial = run_attempt(scene, X_TO, pregrasp, config)
        if trial.outcome is not Outcome.START_COLLISION:
            break

    # A scene in which Drake failed is never used again.
    if trial.outcome.inconclusive:
        forget_scenes()
    return pregrasp, trial


def _judge(result: Verification, config: Config) -> Verification:
    """Return the result of a trial with its outcome and reason."""
    # The verdict of the trial.
    trial = result.trial
    assert trial is not None
    outcome, reason, error = trial.outcome, _REASONS[trial.outcome], None
    if trial.message:
        reason = f"{reason}: {trial.message}"

    # A hand that closes on other points has not tried the predicted grasp. Fingertips that need
    # not touch, and do not, have no point.
    required = load_hand(config.hand).required
    closed = result.closed
    if closed is not None and closed.touching[required].all():
        error = np.linalg.norm(closed.p_OQ - result.p_OQ, axis=1)
        finger = int(np.argmax(np.nan_to_num(error)))
        if error[finger] > config.verify.max_contact_error:
            outcome = Outcome.UNREACHABLE
            reason = (
                f"fingertip {finger + 1} closes on the object {in_mm(error[finger])} from its "
                f"point, more than {in_mm(config.verify.max_contact_error)}"
            )
    return replace(result, outcome=outcome, reason=reason, contact_error=error)
