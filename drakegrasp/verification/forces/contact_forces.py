"""Forces at contact points that hold an object, within friction, as small as possible.

In: a grasp, and the wrench that its contacts must give the object. Out: `ContactForces`.
The programme is convex, a second-order cone programme (M. Lobo, L. Vandenberghe, S. Boyd,
H. Lebret, "Applications of second-order cone programming", 1998, section 3.4), solved by
Clarabel within Drake. A wrench that cannot be given is a value, never an exception.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from pydrake.solvers import ClarabelSolver, LinearEqualityConstraint, MathematicalProgram

from drakegrasp.frames import Array

#: Largest error of a wrench that still counts as given, as a share of it.
MAX_ERROR = 1e-7


def _is_for_people(record: logging.LogRecord) -> bool:
    # Drake announces on standard error what its solver's result says anyway.
    return not record.getMessage().startswith("Clarabel returns")


logging.getLogger("drake").addFilter(_is_for_people)


@dataclass(frozen=True, kw_only=True, eq=False)
class ContactForces:
    """Forces of k fingers on the object.

    Attributes:
        feasible: Whether they give the wrench that was asked for.
        f_Q_O: (k, 3), in {O} [N]; NaN where there are none.
        largest_normal: Largest inward normal component [N]; inf where there are none.
    """

    feasible: bool
    f_Q_O: Array
    largest_normal: float


class ForceProgram:
    """The programmes of one grasp: each is built when first needed, solved for many wrenches.

    Unknown are the components of each force in the axes of its contact, tangential ones as
    shares of the friction coefficient, so that every cone is |tangential| <= normal. Forces
    are counted in units of the load and torques as forces at the farthest contact: to the
    solver all grasps are of one size.
    """

    def __init__(
        self,
        p_OQ: npt.ArrayLike,
        nhat_Q_O: npt.ArrayLike,
        p_OOcm: npt.ArrayLike,
        friction: float,
    ) -> None:
        """Take in the grasp.

        Args:
            p_OQ: (k, 3), contact points in {O} [m].
            nhat_Q_O: (k, 3), normals out of the object in {O}.
            p_OOcm: (3,), centre of mass in {O} [m].
            friction: Coulomb coefficient, zero or more.
        """
        p_OcmQ = np.asarray(p_OQ, dtype=float) - np.asarray(p_OOcm, dtype=float)
        self._k = len(p_OcmQ)
        arm = float(np.linalg.norm(p_OcmQ, axis=1).max())
        self._units = np.repeat([arm or 1.0, 1.0], 3)  # of torque and force, in forces
        self._axes = contact_axes(nhat_Q_O) * [1.0, friction, friction]
        blocks = grasp_map(p_OcmQ, np.zeros(3)).reshape(6, self._k, 3)
        A = np.einsum("wki,kij->wkj", blocks, self._axes).reshape(6, -1) / self._units[:, None]
        # Contacts that are not finite hold nothing, and neither does a map of zeros.
        self._map = A if np.isfinite(A).all() else np.zeros_like(A)

    def smallest(self, wrench_O: npt.ArrayLike) -> ContactForces:
        """Return the forces that give a wrench with the smallest largest normal force.

        Args:
            wrench_O: (6,), torque about Ocm and force on the object in {O} [N m, N].
        """
        target = np.asarray(wrench_O, dtype=float) / self._units
        load = float(np.linalg.norm(target))
        if load == 0.0:
            return self._forces(np.zeros(3 * self._k), target)
        if not np.isfinite(load):
            return self._forces(None, target)
        program, wrench = self._smallest
        wrench.UpdateCoefficients(_widen(self._map, 1), target / load)
        found = self._solve(program)
        forces = self._forces(None if found is None else load * found, target)
        return forces if forces.feasible else self._forces(None, target)

    def closest(self, wrench_O: npt.ArrayLike, force_limit: float) -> ContactForces:
        """Return the forces within a limit that give the wrench closest to one.

        A torque that is missing counts as much as that force at the farthest contact.

        Args:
            wrench_O: (6,), torque about Ocm and force on the object in {O} [N m, N].
            force_limit: Of each normal force [N], positive.
        """
        target = np.asarray(wrench_O, dtype=float) / self._units
        if not np.isfinite(target).all():
            return self._forces(None, target)
        program, wish = self._closest
        wish.UpdateCoefficients(_widen(self._map, 6), target / force_limit)
        found = self._solve(program)
        return self._forces(None if found is None else force_limit * found, target)

    @cached_property
    def _smallest(self) -> tuple[MathematicalProgram, LinearEqualityConstraint]:
        """Minimise t with map @ x = wrench, x in the cones and every normal force <= t."""
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
        """Minimise |r|^2 with map @ x + r = wrench, x in the cones and normal forces <= 1."""
        program, x = self._in_cones()
        r = program.NewContinuousVariables(6, "r")
        equality = program.AddLinearEqualityConstraint(
            _widen(self._map, 6), np.zeros(6), np.append(x, r)
        )
        program.AddBoundingBoxConstraint(0.0, 1.0, x[::3])
        program.AddQuadraticCost(2.0 * np.eye(6), np.zeros(6), r, is_convex=True)
        return program, equality.evaluator()

    def _in_cones(self) -> tuple[MathematicalProgram, np.ndarray]:
        program = MathematicalProgram()
        x = program.NewContinuousVariables(3 * self._k, "x")
        for contact in x.reshape(-1, 3):
            program.AddLorentzConeConstraint(np.eye(3), np.zeros(3), contact)
        return program, x

    def _solve(self, program: MathematicalProgram) -> Array | None:
        result = ClarabelSolver().Solve(program)
        if not result.is_success():
            return None
        return np.asarray(result.get_x_val()[: 3 * self._k])

    def _forces(self, x: Array | None, target: Array) -> ContactForces:
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
    """Return A with more columns: of zeros for one, of the identity for as many as it has rows."""
    extra = np.zeros((len(A), 1)) if columns == 1 else np.eye(len(A))
    return np.hstack([A, extra])


def smallest_forces(
    p_OQ: npt.ArrayLike,
    nhat_Q_O: npt.ArrayLike,
    p_OOcm: npt.ArrayLike,
    wrench_O: npt.ArrayLike,
    friction: float,
) -> ContactForces:
    """Return the forces that give one wrench, see `ForceProgram`."""
    return ForceProgram(p_OQ, nhat_Q_O, p_OOcm, friction).smallest(wrench_O)


def largest_normal_force(program: ForceProgram, wrenches_O: npt.ArrayLike) -> float:
    """Return the largest normal force [N] that any of the wrenches (n, 6) takes at least.

    The smallest largest force is a convex function of the wrench, so it is no larger for any
    wrench in between. It is inf where one of them cannot be given.
    """
    wrenches = np.asarray(wrenches_O, dtype=float)
    return max(program.smallest(wrench).largest_normal for wrench in wrenches)


def contact_axes(nhat_Q_O: npt.ArrayLike) -> Array:
    """Return axes at each contact, (k, 3, 3): as columns, the inward normal and two tangents.

    Args:
        nhat_Q_O: (k, 3), normals out of the object in {O}, of any length; the axes of one
            without direction are NaN.
    """
    normals = np.asarray(nhat_Q_O, dtype=float)
    with np.errstate(invalid="ignore"):
        inward = -normals / np.linalg.norm(normals, axis=1, keepdims=True)
    # The axis of {O} that is farthest from the normal is never parallel to it.
    first = np.cross(inward, np.eye(3)[np.argmin(np.abs(inward), axis=1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([inward, first, np.cross(inward, first)], axis=2)


def grasp_map(p_OQ: npt.ArrayLike, p_OOcm: npt.ArrayLike) -> Array:
    """Return G (6, 3k) with wrench = G @ f for the forces f (3k,) on the object, point by point.

    Args:
        p_OQ: (k, 3), contact points in {O} [m].
        p_OOcm: (3,), the centre of mass in {O} [m].
    """
    arms = np.asarray(p_OQ, dtype=float) - np.asarray(p_OOcm, dtype=float)
    # Column j of a block is the moment of the unit force along axis j.
    with np.errstate(invalid="ignore"):
        moments = np.cross(arms[:, None, :], np.eye(3)).transpose(2, 0, 1).reshape(3, -1)
    return np.vstack([moments, np.tile(np.eye(3), len(arms))])
