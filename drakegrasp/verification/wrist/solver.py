"""Solving the wrist problem: SciPy's SLSQP from several starts.

In: a hand and k contacts in {O}. Out: palm poses with joints, the best first. Contacts leave a
family of palm poses open, so solutions from different starts are different ways to make the same
grasp.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize

from drakegrasp.frames import Array
from drakegrasp.hand.description import Hand
from drakegrasp.verification.wrist.hand_constants import hand_constants
from drakegrasp.verification.wrist.initial_guesses import (
    find_starts,
    make_postures,
    turned_starts,
)
from drakegrasp.verification.wrist.pads import nearest_on_pads
from drakegrasp.verification.wrist.problem import POSE, Evaluation, WristProblem, evaluate

#: Number of starts, and so of solutions.
STARTS = 5
#: Two contacts leave the palm's turn about their line open: number of turns that are tried.
TURNS = 36
#: Unit of the objective [m^2]: residuals of a few millimetres give values of order one.
UNIT = 0.005**2
#: Unit of the clearance over the table [m].
CLEARANCE_UNIT = 0.01
#: Share of the identity in the scaling matrix; it keeps steps short along directions that the
#: contacts hardly determine.
DAMPING = 3e-4
#: SLSQP stops after so many iterations, or when the scaled objective changes by less than this.
MAX_ITERATIONS, TOLERANCE = 50, 1e-3
#: Steps of Newton's method that bring each pad onto its point.
REFINEMENTS = 3
#: A closing position is refined only if the distance changes with it by more than this [m per
#: `Hand.closing_unit`]: a pad that slides along its point cannot be brought nearer by closing.
MIN_SLOPE = 0.01


@dataclass(frozen=True, kw_only=True, eq=False)
class WristFit:
    """A solution of the wrist problem for k fingers.

    Attributes:
        X_OG: (4, 4), palm pose.
        spread: Angle of the spread joints [rad].
        closing: (k,), closing positions at which the pads meet the points [rad or m].
        objective: Sum of squared residuals where SLSQP ended, before each finger was brought onto
            its point [m^2].
        residual: (k,), distance of each predicted point from its fingertip's surface [m].
        normal_error: (k,), angle between each pad's inward and the predicted normal [rad].
        status: SLSQP's exit mode; 0 is success.
        message: SLSQP's text for it.
        iterations, evaluations: Numbers of SLSQP's iterations and of evaluations of the problem.
    """

    X_OG: Array
    spread: float
    closing: Array
    objective: float
    residual: Array
    normal_error: Array
    status: int
    message: str
    iterations: int
    evaluations: int


def fit_wrist(
    hand: Hand, p_OQ: Array, nhat_Q_O: Array, *, up_O: Array, height: float
) -> list[WristFit]:
    """Return the solutions from all starts, the one with the smallest objective first.

    Args:
        hand: Of k fingers.
        p_OQ: (k, 3), contact points [m].
        nhat_Q_O: (k, 3), outward unit normals.
        up_O: (3,), the table's upward normal in {O}.
        height: Height of the origin of {O} above the table [m].
    """
    constants, fits = hand_constants(hand), []
    starts = find_starts(make_postures(hand), p_OQ, nhat_Q_O, STARTS)
    if hand.num_fingers == 2:
        starts = turned_starts(starts[:1], p_OQ, TURNS)
    for start in starts:
        problem = WristProblem(
            constants=constants,
            p_OQ=p_OQ,
            nhat_Q_O=nhat_Q_O,
            up_O=up_O,
            height=height,
            X_OS=start.X_OG,
            posture=start.coordinates,
        )
        fits.append(solve(problem))
    return sorted(fits, key=lambda fit: fit.objective)


def solve(problem: WristProblem) -> WristFit:
    """Return SLSQP's solution from the problem's start, with each finger brought onto its point."""
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
    evaluations = scaled.evaluations

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
        status=int(result.status),
        message=str(result.message),
        iterations=int(result.nit),
        evaluations=evaluations,
    )


def _refine(problem: WristProblem, coordinates: Array) -> tuple[Evaluation, Array]:
    """Close or open each finger until its pad meets its point; the palm does not move.

    Newton's method on the distance φ_i of each finger from its point, by its own closing position:
    c_i ← c_i − φ_i / (∂φ_i/∂c_i), within the limits, as long as Σ |φ_i| falls. Fingers that share a
    motor take the mean of their steps.

    Args:
        problem: With its start at the palm's pose.
        coordinates: (1 + m,), of the start, see `HandConstants.limits` [rad or m].

    Returns:
        The problem at the refined coordinates, and these.
    """
    lower, upper = problem.constants.limits.T
    pose, own = np.zeros(POSE), np.arange(len(problem.p_OQ))
    motor = problem.constants.motor_of
    c = np.clip(coordinates, lower, upper)
    best = evaluate(problem, np.concatenate([pose, c]))
    for _ in range(REFINEMENTS):
        # A step of each closing angle, within the limits.
        distance = best.contact.distance
        slope = best.jacobian[own, POSE + 1 + motor]
        moves = np.abs(slope) * problem.constants.units[1 + motor] > MIN_SLOPE
        step = np.where(moves, distance / np.where(moves, slope, 1.0), 0.0)
        step = np.bincount(motor, step) / np.bincount(motor)
        trial = np.clip(c - np.concatenate([[0.0], step]), lower, upper)

        # Stop when it brings the fingers no nearer.
        after = evaluate(problem, np.concatenate([pose, trial]))
        if not np.abs(after.contact.distance).sum() < np.abs(distance).sum():
            break
        best, c = after, trial
    return best, c


class _ScaledProblem:
    """The problem in scaled unknowns y with x = x_S + S y, as SLSQP needs it.

    S is an inverse square root of the Gauss-Newton matrix H at the start x_S: with the residuals'
    Jacobian J there, n unknowns, the unit U (`UNIT`) and λ (`DAMPING`),

        H₀ = 2 Jᵀ J / U,   H = H₀ + λ tr(H₀)/n · 1 = L Lᵀ (Cholesky),   S = L⁻ᵀ,   Sᵀ H S = 1.

    SLSQP's first step assumes an identity Hessian, so in y it is the Gauss-Newton step. The last
    evaluation is kept, because SLSQP asks for objective and constraints at the same point.
    """

    def __init__(self, problem: WristProblem) -> None:
        self._problem = problem
        self._start = np.concatenate([np.zeros(POSE), problem.posture])
        self._last = evaluate(problem, self._start)
        self.evaluations = 1
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
            self.evaluations += 1
        return self._last

    def objective(self, y: Array) -> tuple[float, Array]:
        """Return the sum of squares, in units of `UNIT`, and its gradient (n,) by y."""
        e = self.at(y)
        slope = 2.0 * (e.residuals @ e.jacobian) @ self._S / UNIT
        return float(e.residuals @ e.residuals) / UNIT, slope

    def constraints(self, y: Array) -> Array:
        """Return what must not be negative: distances to the joints' limits and to the table."""
        c, (lower, upper) = self.x(y)[POSE:], self._problem.constants.limits.T
        return np.concatenate([c - lower, upper - c, self.at(y).clearance / CLEARANCE_UNIT])

    def constraint_jacobian(self, y: Array) -> Array:
        """Return the derivative of `constraints` by y."""
        joints = self._S[POSE:]
        over_table = self.at(y).clearance_jacobian @ self._S / CLEARANCE_UNIT
        return np.concatenate([joints, -joints, over_table])
