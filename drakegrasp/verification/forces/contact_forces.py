"""The smallest forces within the friction cones of a grasp's contacts that hold the object.

In: a grasp, and the wrench that its contacts must apply to the object. Out: `ContactForces`. The
problem is a second-order cone program (M. Lobo, L. Vandenberghe, S. Boyd, H. Lebret,
"Applications of second-order cone programming", 1998, section 3.4), solved by Clarabel through
Drake. If no forces apply the wrench, the result says so; nothing is raised.

A contact is a point with Coulomb friction, or a patch, which also resists twisting about its
normal. The tangential force f_t and the torsional moment m of a patch with the normal force f_n are
within the ellipsoid |f_t|^2 + (m / r)^2 <= (mu f_n)^2 (R. Howe, M. Cutkosky, "Practical
force-motion models for sliding manipulation", IJRR 15(6), 1996), with the torsion radius r of a
disc under even pressure, 2/3 of its radius.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from pydrake.solvers import ClarabelSolver, LinearEqualityConstraint, MathematicalProgram

from drakegrasp.config import Config
from drakegrasp.frames import Array
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.strength import fingertip_forces
from drakegrasp.objects.model import ObjectModel
from drakegrasp.simulation.drive import drive_of

#: Forces count as applying a wrench if their error is below this share of it.
MAX_ERROR = 1e-7
#: Usual area of a fingertip's contact [m^2]: the median of 498 patches of the Barrett Hand
#: after closing, on five G3DB meshes; half of them are between 57 and 89 mm^2.
PATCH_AREA = 68e-6
#: Hands with so many fingers hold an object by points alone. With fewer, points resist no torque
#: about the line between them, and patches do.
ENOUGH_POINTS = 3


@dataclass(frozen=True, eq=False)
class GraspContacts:
    """Contacts of k fingertips on an object, and how hard they can press.

    Attributes:
        p_OQ: (k, 3), contact points in {O} [m].
        nhat_Q_O: (k, 3), normals out of the object in {O}.
        p_OOcm: (3,), centre of mass of the object in {O} [m].
        force_limit: (k,), largest normal force of each contact, or one for all, positive [N].
        torsion_radius: Of the contacts' patches [m]; 0 for points.
    """

    p_OQ: npt.ArrayLike
    nhat_Q_O: npt.ArrayLike
    p_OOcm: npt.ArrayLike
    force_limit: npt.ArrayLike = 1.0
    torsion_radius: float = 0.0

    @property
    def p_OcmQ(self) -> Array:
        """(k, 3), arms of the contacts about the centre of mass, in {O} [m]."""
        return np.asarray(self.p_OQ, dtype=float) - np.asarray(self.p_OOcm, dtype=float)


def hand_contacts(
    model: ObjectModel, p_OQ: npt.ArrayLike, nhat_Q_O: npt.ArrayLike, config: Config
) -> GraspContacts:
    """Return contacts that the fingertips of the configuration's hand make on an object.

    Args:
        model: The object.
        p_OQ: (k, 3), contact points in {O} [m].
        nhat_Q_O: (k, 3), normals out of the object in {O}.
        config: The hand and its drive.
    """
    hand = load_hand(config.hand)
    return GraspContacts(
        p_OQ,
        nhat_Q_O,
        model.p_OOcm,
        force_limit=fingertip_forces(hand, drive_of(hand, config.lift)),
        torsion_radius=patch_torsion_radius(hand.num_fingers),
    )


def patch_torsion_radius(fingers: int) -> float:
    """Return the torsion radius [m] of the contacts of a hand: 0 for points.

    A disc of the area A under even pressure resists a torsional moment of 2/3 R μ f_n, so

        r = 2/3 R,   R = √(A / π),   A = `PATCH_AREA`.

    Args:
        fingers: Number of fingertips of the hand.
    """
    return 0.0 if fingers >= ENOUGH_POINTS else float(2.0 / 3.0 * np.sqrt(PATCH_AREA / np.pi))


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
        tau_Q_O: (k, 3), torsional moments about the normals, in {O} [N m]; zero for points, NaN if
            there are none.
        normal: (k,), inward normal components [N]; inf if there are none.
        shares: (k,), of its limit that each of them takes; inf if there are none.
    """

    feasible: bool
    f_Q_O: Array
    tau_Q_O: Array
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
    """The cone programs of one grasp: built when first needed, solved for many wrenches.

    For a wrench w on the object, contact forces f_i with normal parts f_n, tangential parts f_t and
    torsional moments m_i about the inward normals n_i, limits N_i and the grasp map G:

        smallest:  minimise t        subject to  Σ_i (G_i f_i + [m_i n_i; 0]) = w
        closest:   minimise |r|²     subject to  Σ_i (G_i f_i + [m_i n_i; 0]) + r = w
        both:      √(|f_t|² + (m_i / radius)²) ≤ μ f_n,   f_n ≤ t N_i  (closest: t = 1)

    (Lobo et al., 3.4; Howe and Cutkosky). For points m_i = 0.

    The unknowns x are m per contact: the three components of its force along the axes of the
    contact, the tangential ones divided by the friction coefficient mu, and for a patch its
    torsional moment, divided by mu and the torsion radius. So every cone is
    |tangential, torsional| <= normal. Forces are in units of the load, and torques are divided by
    the largest distance of a contact from Ocm, so that all grasps look alike to the solver. Limits
    are in units of the largest one.
    """

    def __init__(self, contacts: GraspContacts, friction: float) -> None:
        """Compute the map from the unknowns to the wrench, for a Coulomb coefficient."""
        # Units of torque and force.
        p_OcmQ, radius = contacts.p_OcmQ, contacts.torsion_radius
        self._k = len(p_OcmQ)
        arm = float(np.linalg.norm(p_OcmQ, axis=1).max())
        self._units = np.repeat([arm or 1.0, 1.0], 3)

        # Forces and moments of the unknowns, (k, 3, m) each.
        axes, self._m = contact_axes(contacts.nhat_Q_O), 4 if radius > 0.0 else 3
        self._force = np.zeros((self._k, 3, self._m))
        self._force[:, :, :3] = axes * [1.0, friction, friction]
        self._moment = np.zeros_like(self._force)
        self._moment[:, :, 3:] = friction * radius * axes[:, :, :1]

        # The wrench is A @ x.
        blocks = grasp_map(p_OcmQ).reshape(6, self._k, 3)
        A = np.einsum("wki,kij->wkj", blocks, self._force)
        A[:3] += self._moment.transpose(1, 0, 2)
        A = A.reshape(6, -1) / self._units[:, None]
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
            return self._forces(np.zeros(self._m * self._k), target)
        if not np.isfinite(load):
            return self._forces(None, target)

        # Solve for the load's direction, and scale.
        program, wrench = self._smallest
        wrench.UpdateCoefficients(_widen(self._map, 1), target / load)
        x = self._solve(program)
        forces = self._forces(None if x is None else load * x, target)
        return forces if forces.feasible else self._forces(None, target)

    def closest(self, wrench_O: npt.ArrayLike) -> ContactForces:
        """Return the forces within the limits whose wrench is closest to a given one.

        A missing torque counts as much as the force that causes it at the farthest contact.

        Args:
            wrench_O: (6,), torque about Ocm and force on the object in {O} [N m, N].
        """
        target = np.asarray(wrench_O, dtype=float) / self._units
        if not np.isfinite(target).all():
            return self._forces(None, target)
        program, wish = self._closest
        wish.UpdateCoefficients(_widen(self._map, 6), target / self._largest)
        x = self._solve(program)
        return self._forces(None if x is None else self._largest * x, target)

    @cached_property
    def _smallest(self) -> tuple[MathematicalProgram, LinearEqualityConstraint]:
        """Minimise t subject to map @ x = wrench, x in the cones, normal forces <= t limits."""
        program, x = self._in_cones()
        t = program.NewContinuousVariables(1, "t")
        equality = program.AddLinearEqualityConstraint(
            _widen(self._map, 1), np.zeros(6), np.append(x, t)
        )
        select = np.column_stack([-np.eye(self._k), self._limit / self._largest])
        program.AddLinearConstraint(
            select, np.zeros(self._k), np.full(self._k, np.inf), np.append(x[:: self._m], t)
        )
        program.AddLinearCost(t[0])
        return program, equality.evaluator()

    @cached_property
    def _closest(self) -> tuple[MathematicalProgram, LinearEqualityConstraint]:
        """Minimise |r|^2 subject to map @ x + r = wrench, x in the cones, forces <= limits."""
        program, x = self._in_cones()
        r = program.NewContinuousVariables(6, "r")
        equality = program.AddLinearEqualityConstraint(
            _widen(self._map, 6), np.zeros(6), np.append(x, r)
        )
        program.AddBoundingBoxConstraint(
            np.zeros(self._k), self._limit / self._largest, x[:: self._m]
        )
        program.AddQuadraticCost(2.0 * np.eye(6), np.zeros(6), r, is_convex=True)
        return program, equality.evaluator()

    def _in_cones(self) -> tuple[MathematicalProgram, np.ndarray]:
        """Return a program with the unknowns x (m k,) in their friction cones."""
        program = MathematicalProgram()
        x = program.NewContinuousVariables(self._m * self._k, "x")
        for contact in x.reshape(-1, self._m):
            program.AddLorentzConeConstraint(np.eye(self._m), np.zeros(self._m), contact)
        return program, x

    def _solve(self, program: MathematicalProgram) -> Array | None:
        """Return the x (m k,) of the solution, or None if the solver finds none."""
        result = ClarabelSolver().Solve(program)
        if not result.is_success():
            return None
        return np.asarray(result.get_x_val()[: self._m * self._k])

    def _forces(self, x: Array | None, target: Array) -> ContactForces:
        """Return the forces of x (m k,), and whether they apply the target wrench (6,)."""
        if x is None:
            nothing = np.full((self._k, 3), np.nan)
            return ContactForces(
                feasible=False,
                f_Q_O=nothing,
                tau_Q_O=nothing,
                normal=np.full(self._k, np.inf),
                shares=np.full(self._k, np.inf),
            )
        error = float(np.linalg.norm(self._map @ x - target))
        contacts = x.reshape(-1, self._m)
        return ContactForces(
            feasible=error <= MAX_ERROR * float(np.linalg.norm(target)),
            f_Q_O=np.einsum("kij,kj->ki", self._force, contacts),
            tau_Q_O=np.einsum("kij,kj->ki", self._moment, contacts),
            normal=contacts[:, 0],
            shares=contacts[:, 0] / self._limit,
        )


def _widen(A: Array, columns: int) -> Array:
    """Return A with a column of zeros, or with an identity of as many columns as A has rows."""
    extra = np.zeros((len(A), 1)) if columns == 1 else np.eye(len(A))
    return np.hstack([A, extra])


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
