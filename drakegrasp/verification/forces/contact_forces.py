"""The smallest forces within the friction cones of a grasp's contacts that hold the object.

In: a grasp, and the wrench that its contacts must apply to the object. Out: `ContactForces`. The
problem is a second-order cone program (M. Lobo, L. Vandenberghe, S. Boyd, H. Lebret,
"Applications of second-order cone programming", 1998, section 3.4), solved by Clarabel through
Drake. If no forces apply the wrench, the result says so; nothing is raised.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from pydrake.solvers import ClarabelSolver, LinearEqualityConstraint, MathematicalProgram

from drakegrasp.frames import Array

#: Forces count as applying a wrench if their error is below this share of it.
MAX_ERROR = 1e-7


def _is_not_from_clarabel(record: logging.LogRecord) -> bool:
    """Return whether a log record is not Drake's note on the solver's status, which we read."""
    return not record.getMessage().startswith("Clarabel returns")


logging.getLogger("drake").addFilter(_is_not_from_clarabel)


@dataclass(frozen=True, kw_only=True, eq=False)
class ContactForces:
    """Forces of k fingers on the object.

    Attributes:
        feasible: Whether they apply the wrench that was asked for.
        f_Q_O: (k, 3), in {O} [N]; NaN if there are none.
        largest_normal: Largest inward normal component [N]; inf if there are none.
    """

    feasible: bool
    f_Q_O: Array
    largest_normal: float


class ForceProgram:
    """The cone programs of one grasp: built when first needed, solved for many wrenches.

    The unknowns x are the components of each force along the axes of its contact, the tangential
    ones divided by the friction coefficient, so that every cone is |tangential| <= normal. Forces
    are in units of the load, and torques are divided by the largest distance of a contact from
    Ocm, so that all grasps look alike to the solver.
    """

    def __init__(
        self,
        p_OQ: npt.ArrayLike,
        nhat_Q_O: npt.ArrayLike,
        p_OOcm: npt.ArrayLike,
        friction: float,
    ) -> None:
        """Compute the map from the unknowns to the wrench.

        Args:
            p_OQ: (k, 3), contact points in {O} [m].
            nhat_Q_O: (k, 3), normals out of the object in {O}.
            p_OOcm: (3,), centre of mass in {O} [m].
            friction: Coulomb coefficient, zero or more.
        """
        # Units of torque and force.
        p_OcmQ = np.asarray(p_OQ, dtype=float) - np.asarray(p_OOcm, dtype=float)
        self._k = len(p_OcmQ)
        arm = float(np.linalg.norm(p_OcmQ, axis=1).max())
        self._units = np.repeat([arm or 1.0, 1.0], 3)

        # The wrench is A @ x.
        self._axes = contact_axes(nhat_Q_O) * [1.0, friction, friction]
        blocks = grasp_map(p_OcmQ, np.zeros(3)).reshape(6, self._k, 3)
        A = np.einsum("wki,kij->wkj", blocks, self._axes).reshape(6, -1) / self._units[:, None]
        # Contacts that are not finite hold nothing; a map of zeros says the same.
        self._map = A if np.isfinite(A).all() else np.zeros_like(A)

    def smallest(self, wrench_O: npt.ArrayLike) -> ContactForces:
        """Return the forces that apply a wrench with the smallest possible largest normal force.

        Args:
            wrench_O: (6,), torque about Ocm and force on the object in {O} [N m, N].
        """
        target = np.asarray(wrench_O, dtype=float) / self._units
        load = float(np.linalg.norm(target))

        # Without a load no forces are needed; for an infinite one there are none.
        if load == 0.0:
            return self._forces(np.zeros(3 * self._k), target)
        if not np.isfinite(load):
            return self._forces(None, target)

        # Solve for the load's direction, and scale.
        program, wrench = self._smallest
        wrench.UpdateCoefficients(_widen(self._map, 1), target / load)
        x = self._solve(program)
        forces = self._forces(None if x is None else load * x, target)
        return forces if forces.feasible else self._forces(None, target)

    def closest(self, wrench_O: npt.ArrayLike, force_limit: float) -> ContactForces:
        """Return the forces within a limit whose wrench is closest to a given one.

        A missing torque counts as much as the force that causes it at the farthest contact.

        Args:
            wrench_O: (6,), torque about Ocm and force on the object in {O} [N m, N].
            force_limit: Largest normal force of a contact [N], positive.
        """
        target = np.asarray(wrench_O, dtype=float) / self._units
        if not np.isfinite(target).all():
            return self._forces(None, target)
        program, wish = self._closest
        wish.UpdateCoefficients(_widen(self._map, 6), target / force_limit)
        x = self._solve(program)
        return self._forces(None if x is None else force_limit * x, target)

    @cached_property
    def _smallest(self) -> tuple[MathematicalProgram, LinearEqualityConstraint]:
        """Minimise t subject to map @ x = wrench, x in the cones, every normal force <= t."""
        program, x = self._in_cones()
        t = program.NewContinuousVariables(1, "t")
        equality = program.AddLinearEqualityConstraint(
            _widen(self._map, 1), np.zeros(6), np.append(x, t)
        )
        select = np.column_stack([-np.eye(self._k), np.ones(self._k)])
        program.AddLinearConstraint(
            select, np.zeros(self._k), np.full(self._k, np.inf), np.append(x[::3], t)
        )
        program.AddLinearCost(t[0])
        return program, equality.evaluator()

    @cached_property
    def _closest(self) -> tuple[MathematicalProgram, LinearEqualityConstraint]:
        """Minimise |r|^2 subject to map @ x + r = wrench, x in the cones, normal forces <= 1."""
        program, x = self._in_cones()
        r = program.NewContinuousVariables(6, "r")
        equality = program.AddLinearEqualityConstraint(
            _widen(self._map, 6), np.zeros(6), np.append(x, r)
        )
        program.AddBoundingBoxConstraint(0.0, 1.0, x[::3])
        program.AddQuadraticCost(2.0 * np.eye(6), np.zeros(6), r, is_convex=True)
        return program, equality.evaluator()

    def _in_cones(self) -> tuple[MathematicalProgram, np.ndarray]:
        """Return a program with the unknowns x (3k,) in their friction cones."""
        program = MathematicalProgram()
        x = program.NewContinuousVariables(3 * self._k, "x")
        for contact in x.reshape(-1, 3):
            program.AddLorentzConeConstraint(np.eye(3), np.zeros(3), contact)
        return program, x

    def _solve(self, program: MathematicalProgram) -> Array | None:
        """Return the x (3k,) of the solution, or None if the solver finds none."""
        result = ClarabelSolver().Solve(program)
        if not result.is_success():
            return None
        return np.asarray(result.get_x_val()[: 3 * self._k])

    def _forces(self, x: Array | None, target: Array) -> ContactForces:
        """Return the forces of x (3k,), and whether they apply the target wrench (6,)."""
        if x is None:
            return ContactForces(
                feasible=False, f_Q_O=np.full((self._k, 3), np.nan), largest_normal=np.inf
            )
        error = float(np.linalg.norm(self._map @ x - target))
        return ContactForces(
            feasible=error <= MAX_ERROR * float(np.linalg.norm(target)),
            f_Q_O=np.einsum("kij,kj->ki", self._axes, x.reshape(-1, 3)),
            largest_normal=float(x[::3].max()),
        )


def _widen(A: Array, columns: int) -> Array:
    """Return A with a column of zeros, or with an identity of as many columns as A has rows."""
    extra = np.zeros((len(A), 1)) if columns == 1 else np.eye(len(A))
    return np.hstack([A, extra])


def smallest_forces(
    p_OQ: npt.ArrayLike,
    nhat_Q_O: npt.ArrayLike,
    p_OOcm: npt.ArrayLike,
    wrench_O: npt.ArrayLike,
    friction: float,
) -> ContactForces:
    """Return the forces that apply one wrench; arguments as for `ForceProgram`."""
    return ForceProgram(p_OQ, nhat_Q_O, p_OOcm, friction).smallest(wrench_O)


def largest_normal_force(program: ForceProgram, wrenches_O: npt.ArrayLike) -> float:
    """Return the smallest limit of normal forces [N] at which every one of the wrenches is applied.

    The largest normal force that a wrench needs is a convex function of the wrench, so no wrench
    in between needs more.

    Args:
        program: Of the grasp.
        wrenches_O: (n, 6), torque about Ocm and force on the object in {O} [N m, N].

    Returns:
        The force [N]; inf if one of the wrenches cannot be applied.
    """
    wrenches = np.asarray(wrenches_O, dtype=float)
    return max(program.smallest(wrench).largest_normal for wrench in wrenches)


def contact_axes(nhat_Q_O: npt.ArrayLike) -> Array:
    """Return axes (k, 3, 3) at each contact, as columns: the inward normal and two tangents.

    Args:
        nhat_Q_O: (k, 3), normals out of the object in {O}, of any length; a zero normal has axes
            of NaN.
    """
    normals = np.asarray(nhat_Q_O, dtype=float)
    with np.errstate(invalid="ignore"):
        inward = -normals / np.linalg.norm(normals, axis=1, keepdims=True)
    # The axis of {O} with the smallest component along the normal is never parallel to it.
    first = np.cross(inward, np.eye(3)[np.argmin(np.abs(inward), axis=1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([inward, first, np.cross(inward, first)], axis=2)


def grasp_map(p_OQ: npt.ArrayLike, p_OOcm: npt.ArrayLike) -> Array:
    """Return the grasp map G (6, 3k): wrench = G @ f for forces f (3k,), contact by contact.

    Args:
        p_OQ: (k, 3), contact points in {O} [m].
        p_OOcm: (3,), the centre of mass in {O} [m].
    """
    arms = np.asarray(p_OQ, dtype=float) - np.asarray(p_OOcm, dtype=float)
    # Column j of a block is the moment of the unit force along axis j.
    with np.errstate(invalid="ignore"):
        moments = np.cross(arms[:, None, :], np.eye(3)).transpose(2, 0, 1).reshape(3, -1)
    return np.vstack([moments, np.tile(np.eye(3), len(arms))])
