"""Verifying one grasp on one object: from contacts in {O} to a verdict.

In: an object on the table and k contact points with normals. Out: a `Verification`. Method
`hand` finds palm poses that bring the fingertips there and tries them in the simulator, as
`trial` tries any attempt. Method `forces` lifts the object by forces at the contacts alone.
Failures of prediction, solver and physics are values here.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt
import trimesh

from drakegrasp.config import Config
from drakegrasp.frames import Array
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.kinematics import coordinate_limits
from drakegrasp.objects.model import ObjectModel
from drakegrasp.outcomes import Outcome
from drakegrasp.runtime.timing import timed
from drakegrasp.simulation.candidates import Attempt
from drakegrasp.simulation.placement import PlacedObject, rest_pose
from drakegrasp.simulation.scene_cache import forget_scenes, scene_of
from drakegrasp.simulation.trial import TrialRecord, run_attempt
from drakegrasp.verification.forces.lift import LiftEnd, lift_by_forces
from drakegrasp.verification.forces.quality import force_margin
from drakegrasp.verification.result import Verification
from drakegrasp.verification.wrist.solver import WristFit, fit_wrist

Method = Literal["hand", "forces"]
METHODS: tuple[str, ...] = get_args(Method)

#: Digits of metres and of unit normals that count: 0.1 mm and 0.06 degrees, finer than any
#: contact is known, coarser than single precision. So the same grasp in another frame is the
#: same numbers, and a verdict on the edge does not hang on rounding.
POINT_DIGITS, NORMAL_DIGITS = 4, 3
#: Shares of `verify.open_margin_deg` that are tried until the opened hand is clear.
MARGINS = (1.0, 0.5)
#: Why a trial ended as it did, for a person.
_REASONS = {
    Outcome.SUCCESS: "every fingertip holds it at the end of the lift",
    Outcome.BELOW_TABLE: "the palm would be below the table",
    Outcome.START_COLLISION: "the opened hand would be in the object or the table",
    Outcome.MISSING_FINGERTIP: "a fingertip closes without meeting the object",
    Outcome.HAND_CONTACT: "another part of the hand meets the object when it closes",
    Outcome.TABLE_CONTACT: "the closing hand or the lifted object touches the table",
    Outcome.DROPPED: "the object is lost during the lift",
    Outcome.SLIPPED: "a fingertip loses the object during the lift",
    Outcome.SOLVER_ERROR: "the simulator failed, which says nothing about the grasp",
    Outcome.TIMEOUT: "the wall-clock limit passed, which says nothing about the grasp",
}
#: The verdict on a lift by forces.
_ENDS = {
    LiftEnd.HELD: Outcome.SUCCESS,
    LiftEnd.INFEASIBLE: Outcome.DROPPED,
    LiftEnd.OVER_LIMIT: Outcome.DROPPED,
    LiftEnd.STRAYED: Outcome.SLIPPED,
    LiftEnd.ERROR: Outcome.SOLVER_ERROR,
    LiftEnd.TIMEOUT: Outcome.TIMEOUT,
}
#: What a failed grasp is called when several wrist poses failed differently: the last that
#: applies, as that one came farthest.
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


#: Least cosine between a normal that points out of a face and the face's own: 84 degrees.
OUTWARD = 0.1
#: How much farther than the nearest face another may be to count as well [m]: a prediction is
#: as often on the wrong side of a cup's wall as it is beside it.
WALL = 0.005


def verify_contacts(
    placed: PlacedObject, p_OQ: Array, nhat_Q_O: Array, *, method: str, config: Config
) -> Verification:
    """Return whether a grasp holds an object, given its contacts in {O}.

    Args:
        placed: The object on the table.
        p_OQ: (k, 3), contact points [m]; 0.1 mm count.
        nhat_Q_O: (k, 3), outward unit normals.
        method: "hand" or "forces".
        config: Hand, physics, lift and limits.
    """
    rules, seconds = config.verify, dict[str, float]()
    # Adding zero takes the sign of a negative zero away.
    p_OQ, nhat_Q_O = np.round(p_OQ, POINT_DIGITS) + 0.0, np.round(nhat_Q_O, NORMAL_DIGITS) + 0.0
    nhat_Q_O /= np.linalg.norm(nhat_Q_O, axis=1, keepdims=True)
    with timed(seconds, "surface"):
        distance = face_distances(placed.model, p_OQ)
        outward = points_outward(placed.model, distance, nhat_Q_O)
    base = Verification(
        method=method,
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
            reason=f"contact {farthest + 1} is {_mm(base.surface_distance[farthest])} from the "
            f"object's surface, more than {_mm(rules.max_surface_distance)}",
        )
    if not outward.all():
        finger = int(np.argmin(outward))
        return replace(base, reason=f"normal {finger + 1} points into the object")
    with timed(seconds, "margin"):
        margin = force_margin(placed.model, rest_pose(placed.X_TO), p_OQ, nhat_Q_O, config)
    base = replace(base, epsilon=margin.epsilon, smallest_friction=margin.smallest_friction)
    by = _by_hand if method == "hand" else _by_forces
    return by(base, config)


def _by_hand(base: Verification, config: Config) -> Verification:
    rules, X_TO = config.verify, rest_pose(base.placed.X_TO)
    with timed(base.seconds, "fit"):
        fits = fit_wrist(
            load_hand(config.hand),
            base.p_OQ,
            base.nhat_Q_O,
            up_O=X_TO[2, :3],
            height=float(X_TO[2, 3]),
        )
    near = [fit for fit in fits if not _misfit(fit, config)][: rules.max_tries]
    if not near:
        reason = _misfit(fits[0], config)
        return replace(base, outcome=Outcome.UNREACHABLE, reason=reason, fit=fits[0])
    results: list[Verification] = []
    for tries, fit in enumerate(near, start=1):
        with timed(base.seconds, "simulate"):
            attempt, trial = _try(base.placed, X_TO, fit, config)
        results.append(_judge(replace(base, fit=fit, attempt=attempt, trial=trial), config))
        if results[-1].success:
            return replace(results[-1], tries=tries)
    # As long as one of them has no verdict, the grasp has none.
    unknown = [result for result in results if result.outcome.says_nothing]
    farthest = max(unknown or results, key=lambda result: _RANK.index(result.outcome))
    return replace(farthest, tries=len(near))


def _by_forces(base: Verification, config: Config) -> Verification:
    limit = load_hand(config.hand).fingertip_force_limit
    with timed(base.seconds, "simulate"):
        scene = scene_of(base.placed.model, config.physics, None)
        lift = lift_by_forces(
            scene,
            rest_pose(base.placed.X_TO),
            base.p_OQ,
            base.nhat_Q_O,
            force_limit=limit,
            config=config,
        )
    if _ENDS[lift.end].says_nothing:
        forget_scenes()
    moved = f"{_mm(lift.position_error)} and {np.rad2deg(lift.angle_error):.1f}°"
    reasons = {
        LiftEnd.HELD: f"forces of at most {lift.applied_force:.1f} N carry it, and it arrives "
        f"within {moved}",
        LiftEnd.INFEASIBLE: "no forces within the friction cones carry it",
        LiftEnd.OVER_LIMIT: f"it takes a normal force of {lift.planned_force:.1f} N, more than a "
        f"fingertip's {limit:g} N",
        LiftEnd.STRAYED: f"under the forces it strays from its path, by {moved}",
        LiftEnd.ERROR: f"{_REASONS[Outcome.SOLVER_ERROR]}: {lift.message}",
        LiftEnd.TIMEOUT: _REASONS[Outcome.TIMEOUT],
    }
    return replace(base, outcome=_ENDS[lift.end], reason=reasons[lift.end], lift=lift)


def _misfit(fit: WristFit, config: Config) -> str:
    """Return why a palm pose is not one of the grasp, or nothing if it is."""
    rules, finger = config.verify, int(np.argmax(fit.residual))
    if fit.residual[finger] > rules.max_residual:
        return (
            f"no pose of the palm was found that brings fingertip {finger + 1} nearer to its "
            f"point than {_mm(fit.residual[finger])} with the others at theirs"
        )
    finger = int(np.argmax(fit.normal_error))
    angle = np.rad2deg(fit.normal_error[finger])
    if angle > rules.max_normal_error_deg:
        return (
            f"no pose of the palm was found that turns pad {finger + 1} nearer to its normal "
            f"than {angle:.0f}° with all fingertips at their points"
        )
    return ""


def _try(
    placed: PlacedObject, X_TO: Array, fit: WristFit, config: Config
) -> tuple[Attempt, TrialRecord]:
    """Open the fingers of a fit until the hand is clear, and run the trial from there."""
    scene = scene_of(placed.model, config.physics, config.hand)
    least = coordinate_limits(load_hand(config.hand))[1:, 0]
    for share in MARGINS:
        margin = share * np.deg2rad(config.verify.open_margin_deg)
        attempt = Attempt(
            candidate=0,
            standoff_index=0,
            standoff=0.0,
            spread=fit.spread,
            X_OG=fit.X_OG,
            ray_hits=True,
            seed=0,
            closing=np.maximum(fit.closing - margin, least),
        )
        trial = run_attempt(scene, X_TO, attempt, config)
        if trial.outcome is not Outcome.START_COLLISION:
            break
    if trial.outcome.says_nothing:
        forget_scenes()
    return attempt, trial


def _judge(result: Verification, config: Config) -> Verification:
    """Return a tried grasp with its verdict."""
    trial = result.trial
    assert trial is not None
    outcome, reason, error = trial.outcome, _REASONS[trial.outcome], None
    if trial.message:
        reason = f"{reason}: {trial.message}"
    if trial.closed is not None and trial.closed.touching.all():
        error = np.linalg.norm(trial.closed.p_OQ - result.p_OQ, axis=1)
        finger = int(np.argmax(error))
        if error[finger] > config.verify.max_contact_error:
            outcome = Outcome.UNREACHABLE
            reason = (
                f"the closing fingertip {finger + 1} meets the object {_mm(error[finger])} from "
                f"its point, more than {_mm(config.verify.max_contact_error)}"
            )
    return replace(result, outcome=outcome, reason=reason, contact_error=error)


def _mm(length: float) -> str:
    return f"{1e3 * length:.1f} mm"


def face_distances(model: ObjectModel, p_OQ: Array) -> Array:
    """Return the distance (k, m) [m] of points (k, 3) in {O} from each of m collision faces."""
    triangles = model.collision.triangles
    k, m = len(p_OQ), len(triangles)
    points = np.repeat(p_OQ, m, axis=0)
    near = trimesh.triangles.closest_point(np.tile(triangles, (k, 1, 1)), points)
    return np.asarray(np.linalg.norm(near - points, axis=1).reshape(k, m))


def points_outward(model: ObjectModel, distance: Array, nhat_Q_O: Array) -> npt.NDArray[np.bool_]:
    """Return for each of k normals whether it points out of a face next to its point.

    A predicted point may be beside an edge or on the wrong side of a thin wall, so every
    face that is not `WALL` farther than the nearest one is asked.

    Args:
        model: The object.
        distance: (k, m), of the points from the faces, see `face_distances` [m].
        nhat_Q_O: (k, 3), normals in {O}.
    """
    outward = nhat_Q_O @ model.collision.face_normals.T > OUTWARD
    near = distance <= distance.min(axis=1, keepdims=True) + WALL
    return np.asarray(np.any(outward & near, axis=1))
