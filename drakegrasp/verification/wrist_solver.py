"""Solving the wrist problem: SciPy's SLSQP from several starts.

Input: a hand and k contacts in {O}. Output: palm poses with joints, the best first. Contacts leave
a family of palm poses open, so solutions from different starts are different palm poses for the
same grasp. The starts come from a table of postures whose nominal fingertip contacts are close to
the given contacts. Distances and angles among contacts and normals do not depend on the frame, so a
tree finds the postures in which they are similar. Only these postures are aligned with the contacts
(our own construction).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize
from scipy.spatial import KDTree

from drakegrasp.arithmetic import multiply
from drakegrasp.frames import Array, make_pose, rotation_about
from drakegrasp.hand.description import Hand
from drakegrasp.hand.kinematics import fingertip_poses
from drakegrasp.verification.wrist_problem import (
    POSE,
    Evaluation,
    WristProblem,
    evaluate,
    hand_constants,
    nearest_on_pads,
    signed_distance,
)

#: Steps of the table's angles [rad]; closing steps are longer for hands with many fingers. The unit
#: of a sliding closing joint is `Hand.closing_unit`.
SPREAD_STEP, CLOSING_STEP = np.deg2rad(11.25), np.deg2rad(8.0)
#: Minimum number of closing steps from the open hand to the limit; some fingers move only a little.
LEAST_STEPS = 5
#: Maximum number of closing postures in the table.
MAX_CLOSINGS = 5000
#: Largest angles in the table [rad]: spread fingers point sideways, and closed fingers almost make
#: a fist.
MAX_SPREAD, MAX_CLOSING = np.deg2rad(45.0), np.deg2rad(112.0)
#: Lever arm that converts angles between normals to lengths when contacts are compared [m].
LEVER = 0.02
#: Number of postures that are aligned with the contacts.
NEAREST = 96
#: Any two starts differ by more than this in some joint [rad], because contacts leave a family of
#: postures open.
DIFFERENT = np.deg2rad(14.0)


#: A start for the wrist problem: the palm pose X_OG (4, 4), and coordinates (1 + m,), see
#: `HandConstants.limits` [rad or m].
Start: TypeAlias = tuple[Array, Array]


@dataclass(frozen=True, kw_only=True, eq=False)
class Postures:
    """N postures of a hand.

    Attributes:
        coordinates: (N, 1 + m), see `HandConstants.limits` [rad or m].
        p_GP: (N, k, 3), nominal contact points in {G} [m].
        n_G: (N, k, 3), outward pad normals there, in {G}.
        units: (1 + m,), see `HandConstants.units` [rad or m].
        tree: Tree of their features, see `_features`.
    """

    coordinates: Array
    units: Array
    p_GP: Array
    n_G: Array
    tree: KDTree


@lru_cache(maxsize=4)
def make_postures(hand: Hand) -> Postures:
    """Return the table of a hand's postures."""
    # A grid of coordinates.
    constants = hand_constants(hand)
    lower, upper = constants.limits.T
    most, motors = MAX_CLOSING * constants.units, len(upper) - 1
    most[0] = MAX_SPREAD
    upper = np.minimum(upper, most)
    fewest = MAX_CLOSINGS ** (1.0 / motors) - 1.0
    step = max(CLOSING_STEP, MAX_CLOSING / fewest) * constants.units
    step[0] = SPREAD_STEP
    step[1:] = np.minimum(step[1:], (upper - lower)[1:] / min(LEAST_STEPS, fewest))
    axes = [np.arange(low, high + 1e-9, s) for low, high, s in zip(lower, upper, step, strict=True)]
    c = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 1 + motors)

    # The contacts of each posture: the points of the pads next to the pad points.
    X_GF = fingertip_poses(hand, spread=c[:, 0], closing=multiply(c[:, 1:], hand.closing_ratio.T))
    contact = signed_distance(constants.pads, constants.pad_points)
    on_pad = constants.pad_points - contact.distance[:, None] * contact.normal
    p_GP = np.einsum("nkab,kb->nka", X_GF[..., :3, :3], on_pad) + X_GF[..., :3, 3]
    n_G = np.einsum("nkab,kb->nka", X_GF[..., :3, :3], contact.normal)
    tree = KDTree(_features(p_GP, n_G))
    return Postures(coordinates=c, units=constants.units, p_GP=p_GP, n_G=n_G, tree=tree)


def find_starts(postures: Postures, p_OQ: Array, nhat_Q_O: Array, count: int) -> list[Start]:
    """Return up to `count` different starts, the best first.

    Args:
        postures: Postures of the hand.
        p_OQ: (k, 3), contact points [m].
        nhat_Q_O: (k, 3), outward unit normals.
        count: Maximum number of starts.
    """
    rows, X_OG, misfit = _nearest_postures(postures, p_OQ, nhat_Q_O)

    # Take the best starts that differ enough.
    starts: list[Start] = []
    for i in np.argsort(misfit, kind="stable"):
        c = postures.coordinates[rows[i]]
        if all(np.abs((other - c) / postures.units).max() > DIFFERENT for _, other in starts):
            starts.append((X_OG[i], c))
        if len(starts) == count:
            break
    return starts


def posture_misfit(postures: Postures, p_OQ: Array, nhat_Q_O: Array) -> float:
    """Return the smallest misfit of contacts to those of any posture: a sum of squares [m^2].

    Args:
        postures: Postures of the hand.
        p_OQ: (k, 3), contact points [m].
        nhat_Q_O: (k, 3), outward unit normals.
    """
    return float(_nearest_postures(postures, p_OQ, nhat_Q_O)[2].min())


def _nearest_postures(
    postures: Postures, p_OQ: Array, nhat_Q_O: Array
) -> tuple[npt.NDArray[np.int64], Array, Array]:
    """Return the rows of the postures with the most similar contacts, aligned, and the misfits."""
    # Pads face against the normals.
    nearest = min(NEAREST, len(postures.coordinates))
    _, rows = postures.tree.query(_features(p_OQ, -nhat_Q_O), k=np.arange(1, nearest + 1))
    X_OG, misfit = _align(postures.p_GP[rows], postures.n_G[rows], p_OQ, -nhat_Q_O)
    return rows, X_OG, misfit


def turned_starts(starts: Sequence[Start], p_OQ: Array, count: int) -> list[Start]:
    """Return starts turned about the line through two contacts, which does not move the contacts.

    Two contacts leave this turn open, and most of these palm poses would be inside the object or
    the table. Starts with the same turn are adjacent; the given starts are first.

    Args:
        starts: Starts for a hand with two fingers.
        p_OQ: (2, 3), the contact points [m].
        count: Number of turns, evenly spaced over a full turn.
    """
    centre, line = p_OQ.mean(axis=0), p_OQ[1] - p_OQ[0]
    axis = line / max(float(np.linalg.norm(line)), 1e-9)
    turned = []
    for angle in 2.0 * np.pi * np.arange(count) / count:
        R = rotation_about(axis, angle)
        X_OO = make_pose(R, centre - R @ centre)
        turned += [(X_OO @ X_OG, c) for X_OG, c in starts]
    return turned


def _features(p: Array, n: Array) -> Array:
    """Return features (..., f) [m] of contacts that do not depend on the frame of the contacts.

    Args:
        p: (..., k, 3), points [m].
        n: (..., k, 3), unit normals.
    """
    # Distances, and angles of the normals to each other and to the line between the points.
    values = [np.zeros(p.shape[:-2])]
    for i, j in combinations(range(p.shape[-2]), 2):
        d = p[..., i, :] - p[..., j, :]
        length = np.linalg.norm(d, axis=-1)
        away = d / np.maximum(length, 1e-6)[..., None]
        values += [
            length,
            LEVER * np.sum(n[..., i, :] * n[..., j, :], axis=-1),
            LEVER * np.sum(away * n[..., i, :], axis=-1),
            LEVER * np.sum(away * n[..., j, :], axis=-1),
        ]
    if p.shape[-2] >= 3:
        # Distances and angles are equal for mirror images, but the side of the triangle is not.
        across = np.cross(p[..., 1, :] - p[..., 0, :], p[..., 2, :] - p[..., 0, :])
        across /= np.maximum(np.linalg.norm(across, axis=-1), 1e-9)[..., None]
        values += [LEVER * np.sum(across * n[..., i, :], axis=-1) for i in range(p.shape[-2])]
    return np.stack(values, axis=-1)


def _align(p_GP: Array, n_G: Array, p_OQ: Array, n_O: Array) -> tuple[Array, Array]:
    """Return the palm poses that bring N sets of contacts closest to the given ones.

    It is the method of Kabsch (1976), on the points and on points `LEVER` along the normals. With
    the centred sets A and B as rows and AᵀB = U Σ Vᵀ, the sum Σ_i |R a_i + p − b_i|² is smallest
    for

        R = V diag(1, 1, det(U Vᵀ)) Uᵀ,   p = mean(b) − R mean(a).

    Args:
        p_GP: (N, k, 3), points of the postures in {G} [m].
        n_G: (N, k, 3), normals of the pads in {G}.
        p_OQ: (k, 3), points to meet in {O} [m].
        n_O: (k, 3), normals that the pads should have in {O}.

    Returns:
        Poses X_OG (N, 4, 4), and the sums of squared distances (N,) [m^2].
    """
    # Rotations between the centred sets, without mirror images.
    A = np.concatenate([p_GP, p_GP + LEVER * n_G], axis=-2)
    B = np.concatenate([p_OQ, p_OQ + LEVER * n_O], axis=-2)
    centre_A, centre_B = A.mean(axis=-2, keepdims=True), B.mean(axis=-2)
    U, _, Vt = np.linalg.svd(np.swapaxes(A - centre_A, -1, -2) @ (B - centre_B))
    mirrored = np.linalg.det(U @ Vt) < 0.0
    V = np.swapaxes(Vt, -1, -2)
    V[mirrored, :, 2] *= -1.0
    R = V @ np.swapaxes(U, -1, -2)

    # Translations, and the remaining distances.
    p = centre_B - np.einsum("nab,nb->na", R, centre_A[:, 0])
    misfit = np.sum((A @ np.swapaxes(R, -1, -2) + p[:, None] - B) ** 2, axis=(-1, -2))
    X = np.tile(np.eye(4), (len(R), 1, 1))
    X[:, :3, :3], X[:, :3, 3] = R, p
    return X, misfit


#: Number of starts, and so of solutions.
STARTS = 5
#: Number of tried rotations of the palm about the line through two contacts, which do not determine
#: this rotation.
TURNS = 36
#: Unit of the objective [m^2]: residuals of a few millimetres give values of order one.
UNIT = 0.005**2
#: Unit of the clearance over the table [m].
CLEARANCE_UNIT = 0.01
#: Fraction of the identity in the scaling matrix; it keeps steps short along directions that the
#: contacts hardly determine.
DAMPING = 3e-4
#: SLSQP stops after this many iterations, or when the scaled objective changes by less than this.
MAX_ITERATIONS, TOLERANCE = 50, 1e-3
#: Steps of Newton's method that bring each pad onto its point.
REFINEMENTS = 3
#: A closing position is refined only if it changes the distance by more than this [m per
#: `Hand.closing_unit`]: closing cannot bring a pad closer that slides along its point.
MIN_SLOPE = 0.01


@dataclass(frozen=True, kw_only=True, eq=False)
class WristFit:
    """A solution of the wrist problem for k fingers.

    Attributes:
        X_OG: (4, 4), palm pose.
        spread: Angle of the spread joints [rad].
        closing: (k,), closing positions at which the pads meet the points [rad or m].
        objective: Sum of squared residuals at the end of SLSQP, before each finger was moved onto
            its point [m^2].
        residual: (k,), distance of each predicted point from its fingertip's surface [m].
        normal_error: (k,), angle between each pad's inward normal and the predicted normal [rad].
    """

    X_OG: Array
    spread: float
    closing: Array
    objective: float
    residual: Array
    normal_error: Array


def fit_wrist(hand: Hand, p_OQ: Array, nhat_Q_O: Array, X_TO: Array) -> list[WristFit]:
    """Return the solutions from all starts, the one with the smallest objective first.

    Args:
        hand: A hand with k fingers.
        p_OQ: (k, 3), contact points [m].
        nhat_Q_O: (k, 3), outward unit normals.
        X_TO: (4, 4), pose of the object on the table, under which the hand cannot be.
    """
    constants, fits = hand_constants(hand), []
    starts = find_starts(make_postures(hand), p_OQ, nhat_Q_O, STARTS)
    if hand.num_fingers == 2:
        starts = turned_starts(starts[:1], p_OQ, TURNS)
    for X_OS, posture in starts:
        problem = WristProblem(
            constants=constants,
            p_OQ=p_OQ,
            nhat_Q_O=nhat_Q_O,
            up_O=X_TO[2, :3],
            height=float(X_TO[2, 3]),
            X_OS=X_OS,
            posture=posture,
        )
        fits.append(solve(problem))
    return sorted(fits, key=lambda fit: fit.objective)


def solve(problem: WristProblem) -> WristFit:
    """Return SLSQP's solution from the problem's start, with each finger moved onto its point."""
    # Minimise the sum of squares.
    scaled = _ScaledProblem(problem)
    result = minimize(
        scaled.objective,
        np.zeros(POSE + len(problem.posture)),
        jac=True,
        method="SLSQP",
        constraints=[
            {"type": "ineq", "fun": scaled.constraints, "jac": scaled.constraint_jacobian}
        ],
        options={"maxiter": MAX_ITERATIONS, "ftol": TOLERANCE},
    )
    solution = scaled.at(result.x)

    # Refine the fingers at the palm pose of the solution.
    problem = replace(problem, X_OS=solution.X_OG)
    refined, c = _refine(problem, scaled.x(result.x)[POSE:])
    p_FiQ = refined.p_FiQ

    facing = -np.sum(refined.pad_normals_O * problem.nhat_Q_O, axis=1)
    return WristFit(
        X_OG=solution.X_OG,
        spread=float(c[0]),
        closing=problem.constants.closing_ratio @ c[1:],
        objective=float(solution.residuals @ solution.residuals),
        residual=np.linalg.norm(nearest_on_pads(problem.constants.pads, p_FiQ) - p_FiQ, axis=1),
        normal_error=np.arccos(np.clip(facing, -1.0, 1.0)),
    )


def _refine(problem: WristProblem, coordinates: Array) -> tuple[Evaluation, Array]:
    """Close or open each finger until its pad meets its point; the palm does not move.

    It is Newton's method on the distance φ_i of each finger from its point, as a function of the
    finger's closing position: c_i ← c_i − φ_i / (∂φ_i/∂c_i), within the limits, as long as Σ |φ_i|
    decreases. Fingers that share a motor take the mean of their steps.

    Args:
        problem: The problem, whose start is at the palm's pose.
        coordinates: (1 + m,), coordinates of the start, see `HandConstants.limits` [rad or m].

    Returns:
        The problem evaluated at the refined coordinates, and these coordinates.
    """
    lower, upper = problem.constants.limits.T
    pose, own = np.zeros(POSE), np.arange(len(problem.p_OQ))
    motor = problem.constants.motor_of
    c = np.clip(coordinates, lower, upper)
    best = evaluate(problem, np.concatenate([pose, c]))
    for _ in range(REFINEMENTS):
        # A step of each closing position, within the limits.
        distance = best.contact.distance
        slope = best.jacobian[own, POSE + 1 + motor]
        moves = np.abs(slope) * problem.constants.units[1 + motor] > MIN_SLOPE
        step = np.where(moves, distance / np.where(moves, slope, 1.0), 0.0)
        step = np.bincount(motor, step) / np.bincount(motor)
        trial = np.clip(c - np.concatenate([[0.0], step]), lower, upper)

        # Stop if it does not bring the fingers closer.
        after = evaluate(problem, np.concatenate([pose, trial]))
        if not np.abs(after.contact.distance).sum() < np.abs(distance).sum():
            break
        best, c = after, trial
    return best, c


class _ScaledProblem:
    """The problem in scaled unknowns y with x = x_S + S y, as SLSQP needs it.

    S is an inverse square root of the Gauss-Newton matrix H at the start x_S. With the residuals'
    Jacobian J there, n unknowns, the unit U (`UNIT`) and λ (`DAMPING`),

        H₀ = 2 Jᵀ J / U,   H = H₀ + λ tr(H₀)/n · 1 = L Lᵀ (Cholesky),   S = L⁻ᵀ,   Sᵀ H S = 1.

    SLSQP's first step assumes an identity Hessian, so in y it is the Gauss-Newton step. The last
    evaluation is cached, because SLSQP requests objective and constraints at the same point.
    """

    def __init__(self, problem: WristProblem) -> None:
        self._problem = problem
        self._start = np.concatenate([np.zeros(POSE), problem.posture])
        self._last = evaluate(problem, self._start)
        J = self._last.jacobian
        H = 2.0 * J.T @ J / UNIT
        H += DAMPING * np.trace(H) / len(H) * np.eye(len(H))
        self._S = np.linalg.inv(np.linalg.cholesky(H)).T
        self._y = np.zeros(len(H))

    def x(self, y: Array) -> Array:
        """Return the unknowns x (n,) of scaled unknowns y (n,)."""
        return self._start + self._S @ y

    def at(self, y: Array) -> Evaluation:
        """Return the evaluation of the problem at y (n,)."""
        if not np.array_equal(y, self._y):
            self._y, self._last = y.copy(), evaluate(self._problem, self.x(y))
        return self._last

    def objective(self, y: Array) -> tuple[float, Array]:
        """Return the sum of squares in units of `UNIT`, and its gradient (n,) in y."""
        e = self.at(y)
        slope = 2.0 * (e.residuals @ e.jacobian) @ self._S / UNIT
        return float(e.residuals @ e.residuals) / UNIT, slope

    def constraints(self, y: Array) -> Array:
        """Return the distances to the joints' limits and to the table, all at least 0."""
        c, (lower, upper) = self.x(y)[POSE:], self._problem.constants.limits.T
        return np.concatenate([c - lower, upper - c, self.at(y).clearance / CLEARANCE_UNIT])

    def constraint_jacobian(self, y: Array) -> Array:
        """Return the derivative of `constraints` with respect to y."""
        joints = self._S[POSE:]
        over_table = self.at(y).clearance_jacobian @ self._S / CLEARANCE_UNIT
        return np.concatenate([joints, -joints, over_table])
