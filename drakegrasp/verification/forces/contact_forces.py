"""The smallest forces within the friction cones of a grasp's contacts that hold the object.

In: a grasp, and the wrench that its contacts must apply to the object. Out: `ContactForces`. The
problem is a second-order cone program (M. Lobo, L. Vandenberghe, S. Boyd, H. Lebret,
"Applications of second-order cone programming", 1998, section 3.4), solved by Clarabel through
Drake. If no forces apply the wrench, the result says so; nothing is raised.

A fingertip touches at points with Coulomb friction, which it pushes along the inward normal and
along the surface; it neither pulls nor twists. It has one point, or several that make a patch: they
share the finger's force in any way, so that together they resist twisting, too.
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


@dataclass(frozen=True, eq=False)
class GraspContacts:
    """Contacts of k fingertips on an object, and how hard they can press.

    Attributes:
        p_OQ: (k, 3), or (k, m, 3) for m points each; contact points in {O} [m].
        nhat_Q_O: Likewise, normals out of the object in {O}.
        p_OOcm: (3,), centre of mass of the object in {O} [m].
        force_limit: (k,), largest normal force of each fingertip, of all its points together, or
            one for all, positive [N].
    """

    p_OQ: npt.ArrayLike
    nhat_Q_O: npt.ArrayLike
    p_OOcm: npt.ArrayLike
    force_limit: npt.ArrayLike = 1.0

    @property
    def fingers(self) -> int:
        """Number of fingertips."""
        return len(np.asarray(self.p_OQ))

    @property
    def p_OcmQ(self) -> Array:
        """(n, 3), arms of all points about the centre of mass, finger by finger, in {O} [m]."""
        points = np.asarray(self.p_OQ, dtype=float) - np.asarray(self.p_OOcm, dtype=float)
        return points.reshape(-1, 3)

    @property
    def axes(self) -> Array:
        """(n, 3, 3), axes of all points, see `contact_axes`."""
        return contact_axes(np.reshape(np.asarray(self.nhat_Q_O, dtype=float), (-1, 3)))


def _is_not_from_clarabel(record: logging.LogRecord) -> bool:
    """Return whether a log record is not Drake's note on the solver's status, which we read."""
    return not record.getMessage().startswith("Clarabel returns")


logging.getLogger("drake").addFilter(_is_not_from_clarabel)


@dataclass(frozen=True, kw_only=True, eq=False)
class ContactForces:
    """Forces of k fingers on the object.

    Attributes:
        feasible: Whether they apply the wrench that was asked for.
        f_Q_O: (n, 3), at all points, finger by finger, in {O} [N]; NaN if there are none.
        normal: (k,), inward normal components [N]; inf if there are none.
        shares: (k,), of its limit that each of them takes; inf if there are none.
    """

    feasible: bool
    f_Q_O: Array
    normal: Array
    shares: Array

    @property
    def largest_normal(self) -> float:
        """Largest inward normal component [N]; inf if there are no forces."""
        return float(self.normal.max())

    @property
    def share(self) -> float:
        """Largest share of its limit that a contact takes; inf if there are no forces."""
        return float(self.shares.max())


class ForceProgram:
    """The cone program of one grasp: built when first needed, solved for many wrenches.

    For a wrench w on the object, forces f_ij at point j of finger i with normal parts f_n and
    tangential parts f_t, limits N_i and the grasp map G:

        minimise t   subject to   Σ_ij G_ij f_ij = w,   |f_t| ≤ μ f_n,   Σ_j f_n,ij ≤ t N_i

    (Lobo et al., 3.4). The unknowns x are the three components of each force along the axes of its
    point, the tangential ones divided by the friction coefficient mu. So every cone is
    |tangential| <= normal. Forces are in units of the load, and torques are divided by the largest
    distance of a point from Ocm, so that all grasps look alike to the solver. Limits are in units
    of the largest one.
    """

    def __init__(self, contacts: GraspContacts, friction: float) -> None:
        """Compute the map from the unknowns to the wrench, for a Coulomb coefficient."""
        # Units of torque and force.
        p_OcmQ = contacts.p_OcmQ
        self._k, self._n = contacts.fingers, len(p_OcmQ)
        arm = float(np.linalg.norm(p_OcmQ, axis=1).max())
        self._units = np.repeat([arm or 1.0, 1.0], 3)

        # Forces of the unknowns, (n, 3, 3); the wrench is A @ x.
        self._force = contacts.axes * [1.0, friction, friction]
        blocks = grasp_map(p_OcmQ).reshape(6, self._n, 3)
        A = np.einsum("wni,nij->wnj", blocks, self._force).reshape(6, -1) / self._units[:, None]
        # Contacts that are not finite hold nothing; a map of zeros says the same.
        self._map = A if np.isfinite(A).all() else np.zeros_like(A)

        self._limit = np.broadcast_to(np.asarray(contacts.force_limit, dtype=float), (self._k,))
        self._largest = float(self._limit.max())

    def smallest(self, wrench_O: npt.ArrayLike) -> ContactForces:
        """Return the forces that apply a wrench and take the smallest share of the limits.

        The share is the largest of the contacts'; the forces may be beyond the limits.

        Args:
            wrench_O: (6,), torque about Ocm and force on the object in {O} [N m, N].
        """
        target = np.asarray(wrench_O, dtype=float) / self._units
        load = float(np.linalg.norm(target))

        # Without a load no forces are needed; for an infinite one there are none.
        if load == 0.0:
            return self._forces(np.zeros(3 * self._n), target)
        if not np.isfinite(load):
            return self._forces(None, target)

        # Solve for the load's direction, and scale.
        program, wrench = self._smallest
        wrench.UpdateCoefficients(self._with_t(self._map), target / load)
        x = self._solve(program)
        forces = self._forces(None if x is None else load * x, target)
        return forces if forces.feasible else self._forces(None, target)

    @cached_property
    def _smallest(self) -> tuple[MathematicalProgram, LinearEqualityConstraint]:
        """Minimise t subject to map @ x = wrench, x in the cones, normal forces <= t limits."""
        program = MathematicalProgram()
        x, t = program.NewContinuousVariables(3 * self._n, "x"), program.NewContinuousVariables(1)
        for point in x.reshape(-1, 3):
            program.AddLorentzConeConstraint(np.eye(3), np.zeros(3), point)
        equality = program.AddLinearEqualityConstraint(
            self._with_t(self._map), np.zeros(6), np.append(x, t)
        )
        # The points of a finger share its limit.
        sums = -np.kron(np.eye(self._k), np.ones(self._n // self._k))
        select = np.column_stack([sums, self._limit / self._largest])
        program.AddLinearConstraint(
            select, np.zeros(self._k), np.full(self._k, np.inf), np.append(x[::3], t)
        )
        program.AddLinearCost(t[0])
        return program, equality.evaluator()

    def _solve(self, program: MathematicalProgram) -> Array | None:
        """Return the x (3 n,) of the solution, or None if the solver finds none."""
        result = ClarabelSolver().Solve(program)
        return np.asarray(result.get_x_val()[: 3 * self._n]) if result.is_success() else None

    @staticmethod
    def _with_t(A: Array) -> Array:
        """Return A with a column of zeros, for t."""
        return np.hstack([A, np.zeros((len(A), 1))])

    def _forces(self, x: Array | None, target: Array) -> ContactForces:
        """Return the forces of x (3 n,), and whether they apply the target wrench (6,)."""
        if x is None:
            return ContactForces(
                feasible=False,
                f_Q_O=np.full((self._n, 3), np.nan),
                normal=np.full(self._k, np.inf),
                shares=np.full(self._k, np.inf),
            )
        error = float(np.linalg.norm(self._map @ x - target))
        points = x.reshape(-1, 3)
        normal = points[:, 0].reshape(self._k, -1).sum(axis=1)
        return ContactForces(
            feasible=error <= MAX_ERROR * float(np.linalg.norm(target)),
            f_Q_O=np.einsum("nij,nj->ni", self._force, points),
            normal=normal,
            shares=normal / self._limit,
        )


def hardest_forces(program: ForceProgram, wrenches_O: npt.ArrayLike) -> ContactForces:
    """Return the forces of the wrench that takes the largest share of the fingers' limits.

    The share that a wrench needs is a convex function of the wrench, so no wrench in between needs
    more.

    Args:
        program: Of the grasp.
        wrenches_O: (n, 6), torque about Ocm and force on the object in {O} [N m, N].

    Returns:
        The forces; if one of the wrenches cannot be applied, there are none.
    """
    wrenches = np.asarray(wrenches_O, dtype=float)
    return max((program.smallest(wrench) for wrench in wrenches), key=lambda forces: forces.share)


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


def grasp_map(p_OcmQ: Array) -> Array:
    """Return the grasp map G (6, 3k): wrench = G @ f for forces f (3k,), contact by contact.

    The block of a contact with the arm p is G_i = [[p]×; 1], with [p]× f = p × f.

    Args:
        p_OcmQ: (k, 3), arms of the contacts about the centre of mass [m].
    """
    # Column j of a block is the moment of the unit force along axis j.
    with np.errstate(invalid="ignore"):
        moments = np.cross(p_OcmQ[:, None, :], np.eye(3)).transpose(2, 0, 1).reshape(3, -1)
    return np.vstack([moments, np.tile(np.eye(3), len(p_OcmQ))])
