"""What forces at a grasp's contacts can do within the hand's strength, without a simulation.

Input: predicted points and normals, or contacts, and the wrenches of a lift. Output: the smallest
forces within the friction cones (`ContactForces`), margins of a grasp, and a `ForceVerdict`. The
verdict states whether forces at the surface contacts that a prediction selects can support the
lift.

The forces solve a second-order cone program (M. Lobo, L. Vandenberghe, S. Boyd, H. Lebret,
"Applications of second-order cone programming", 1998, section 3.4), with Clarabel through Drake. A
fingertip touches at points with Coulomb friction. It pushes along the inward normal and along the
surface; it neither pulls nor twists. It has one point, or several points that form a patch. The
points of a patch share the finger's force in any way, so together they also resist twisting.

A prediction only selects contacts on the surface that the hand meets in the simulation, so no
choice of its numbers can make a force possible that the surface does not allow. The selected
contact is the closest point to the predicted one on a face whose normal is within `MAX_ANGLE` of
the predicted normal. At an edge, where several of these faces are equally close, it is on the face
whose normal is closest to the predicted one. A point on the wrong side of a thin wall is therefore
moved to the side that its normal names. If no such face is within `MAX_DISTANCE`, the contact is on
the closest face of all, and the prediction is off the surface by that distance or angle.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
import trimesh
from pydrake.solvers import ClarabelSolver, LinearEqualityConstraint, MathematicalProgram
from scipy.spatial import ConvexHull, QhullError

from drakegrasp.config import Config
from drakegrasp.frames import Array
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.kinematics import fingertip_forces, within_load
from drakegrasp.mesh.surfaces import winding_numbers
from drakegrasp.objects.model import ObjectModel
from drakegrasp.simulation.drive import drive_of
from drakegrasp.simulation.lift import lift_path
from drakegrasp.table import Table

#: Forces apply a wrench if their error is below this fraction of the wrench.
MAX_ERROR = 1e-7


@dataclass(frozen=True, eq=False)
class GraspContacts:
    """Contacts of k fingertips on an object, and how hard they can press.

    Attributes:
        p_OQ: (k, 3), or (k, m, 3) for m points each; contact points in {O} [m].
        nhat_Q_O: Normals out of the object in {O}, of the same shape.
        p_OOcm: (3,), centre of mass of the object in {O} [m].
        force_limit: (k,), largest total normal force of each fingertip over all its points, or one
            value for all fingertips, positive [N].
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
        """(n, 3), vectors from the centre of mass to all points, finger by finger, in {O} [m]."""
        points = np.asarray(self.p_OQ, dtype=float) - np.asarray(self.p_OOcm, dtype=float)
        return points.reshape(-1, 3)

    @property
    def axes(self) -> Array:
        """(n, 3, 3), axes of all points, see `contact_axes`."""
        return contact_axes(np.reshape(np.asarray(self.nhat_Q_O, dtype=float), (-1, 3)))


def _is_not_from_clarabel(record: logging.LogRecord) -> bool:
    """Return whether a record is not Drake's note on the solver's status, which we read instead."""
    return not record.getMessage().startswith("Clarabel returns")


logging.getLogger("drake").addFilter(_is_not_from_clarabel)


@dataclass(frozen=True, kw_only=True, eq=False)
class ContactForces:
    """Forces of k fingers on the object.

    Attributes:
        feasible: Whether the forces apply the requested wrench.
        f_Q_O: (n, 3), forces at all points, finger by finger, in {O} [N]; NaN without forces.
        normal: (k,), inward normal components [N]; inf without forces.
        shares: (k,), normal component of each finger as a fraction of its limit; inf without
            forces.
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
        """Largest fraction of a limit that a finger needs; inf if there are no forces."""
        return float(self.shares.max())


class ForceProgram:
    """The cone program of one grasp: built when first needed, solved for many wrenches.

    For a wrench w on the object, forces f_ij at point j of finger i with normal parts f_n and
    tangential parts f_t, limits N_i and the grasp map G:

        minimise t   subject to   Σ_ij G_ij f_ij = w,   |f_t| ≤ μ f_n,   Σ_j f_n,ij ≤ t N_i

    (Lobo et al., 3.4). The unknowns x are the three components of each force along the axes of its
    point. The tangential components are divided by the friction coefficient mu, so every cone is
    |tangential| <= normal. Forces are in units of the load. Torques are divided by the largest
    distance of a point from Ocm, so that all grasps have the same scale for the solver. Limits are
    in units of the largest limit.
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
        # Contacts that are not finite hold nothing; a map of zeros has the same effect.
        self._map = A if np.isfinite(A).all() else np.zeros_like(A)

        self._limit = np.broadcast_to(np.asarray(contacts.force_limit, dtype=float), (self._k,))
        self._largest = float(self._limit.max())

    def smallest(self, wrench_O: npt.ArrayLike) -> ContactForces:
        """Return the forces that apply a wrench and need the smallest fraction of the limits.

        This fraction is the largest of all fingers; the forces may be beyond the limits.

        Args:
            wrench_O: (6,), torque about Ocm and force on the object in {O} [N m, N].
        """
        target = np.asarray(wrench_O, dtype=float) / self._units
        load = float(np.linalg.norm(target))

        # Without a load no forces are needed; for an infinite load there are none.
        if load == 0.0:
            return self._forces(np.zeros(3 * self._n), target)
        if not np.isfinite(load):
            return self._forces(None, target)

        # Solve for the load's direction, and scale the solution.
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
        """Return the x (3 n,) of the solution, or None if the solver finds no solution."""
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
    """Return the forces of the wrench that needs the largest fraction of the fingers' limits.

    The needed fraction is a convex function of the wrench, so no wrench between the given ones
    needs a larger one.

    Args:
        program: Cone program of the grasp.
        wrenches_O: (n, 6), torque about Ocm and force on the object in {O} [N m, N].

    Returns:
        The forces; there are none if one of the wrenches cannot be applied.
    """
    wrenches = np.asarray(wrenches_O, dtype=float)
    return max((program.smallest(wrench) for wrench in wrenches), key=lambda forces: forces.share)


def contact_axes(nhat_Q_O: npt.ArrayLike) -> Array:
    """Return axes (k, 3, 3) at each contact, as columns: the inward normal and two tangents.

    Args:
        nhat_Q_O: (k, 3), normals out of the object in {O}, of any length; the axes of a zero normal
            are NaN.
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


#: Edges of the pyramid that approximates a friction cone from inside. With 16 edges, epsilon is
#: about 2 % too small and varies by as much with the frame; the hull takes 15 ms.
FRICTION_EDGES = 16
#: An epsilon below this is a rounding error: the origin is on the surface of the hull.
ROUNDING = 1e-9
#: Largest friction coefficient to try, and the tolerance of the smallest one.
MAX_FRICTION, FRICTION_TOLERANCE = 10.0, 1e-4


def characteristic_length(vertices: npt.ArrayLike, p_OOcm: npt.ArrayLike) -> float:
    """Return the largest distance of a surface from the centre of mass [m].

    No contact has a longer arm, so torques divided by this length are comparable with the forces
    that cause them.

    Args:
        vertices: (n, 3), vertices of the surface in {O} [m].
        p_OOcm: (3,), the centre of mass in {O} [m].
    """
    arms = np.asarray(vertices, dtype=float) - np.asarray(p_OOcm, dtype=float)
    return float(np.linalg.norm(arms, axis=1).max())


def ferrari_canny(contacts: GraspContacts, *, friction: float, length: float) -> float:
    """Return the epsilon of a grasp: the smallest wrench that can break it.

    This is the L1 version of C. Ferrari and J. Canny, "Planning optimal grasps", ICRA 1992: the
    distance of the origin from the surface of the convex hull of all contacts' friction cones, for
    normal forces that sum to one. Each cone is approximated by a pyramid with `FRICTION_EDGES`
    edges. Edge e of point i, with the inward normal n_i, the tangents t, the arm p_i and the length
    L, has the wrench

        w_ie = [p_i × f_ie / L; f_ie],   f_ie = n_i + μ (cos(α_e) t_i1 + sin(α_e) t_i2).

    If the origin is inside the hull, ε = min over |u| = 1 of max over i, e of u·w_ie.

    Args:
        contacts: Contacts of the grasp.
        friction: Coulomb coefficient.
        length: Length by which torques are divided [m], see `characteristic_length`.

    Returns:
        Epsilon, without unit; 0 if the origin is not inside the hull, the hull is flat, or a
        number is not finite.
    """
    # Wrenches of the edges of all cones, for a normal force of one.
    angles = 2.0 * np.pi * np.arange(FRICTION_EDGES) / FRICTION_EDGES
    edges = np.stack(
        [np.ones(FRICTION_EDGES), friction * np.cos(angles), friction * np.sin(angles)]
    )
    forces = contacts.axes @ edges  # (n, 3, edges)
    blocks = grasp_map(contacts.p_OcmQ).reshape(6, -1, 3)
    wrenches = np.einsum("wni,nie->new", blocks, forces).reshape(-1, 6)
    wrenches[:, :3] /= length
    if not np.isfinite(wrenches).all():
        return 0.0

    # Compute the distance of the origin from the hull of these wrenches.
    try:
        hull = ConvexHull(wrenches)
    except QhullError:
        return 0.0  # flat, or too few points: some wrench cannot be resisted at all
    # A row is a unit outward normal and an offset, which is negative if the origin is inside.
    epsilon = -float(hull.equations[:, -1].max())
    return epsilon if epsilon > ROUNDING else 0.0


def force_margin(
    model: ObjectModel,
    X_TO: npt.ArrayLike,
    p_OQ: npt.ArrayLike,
    nhat_Q_O: npt.ArrayLike,
    config: Config,
) -> tuple[float, float]:
    """Return the margin by which forces at the contacts of a grasp hold the object in its lift.

    The contacts are those on the surface that a prediction selects, modelled as points, or as
    patches for a hand with two fingertips.

    Args:
        model: The object.
        X_TO: (4, 4), resting pose of the object.
        p_OQ: (k, 3), predicted points in {O} [m].
        nhat_Q_O: (k, 3), predicted unit normals out of the object in {O}.
        config: The hand, its drive, friction and lift.

    Returns:
        Two numbers. The first is the epsilon of Ferrari and Canny at the configured friction, with
        torques divided by the largest distance of the object's surface from its centre of mass; it
        is 0 without force closure. The second is the smallest coefficient at which forces within
        the limits of the hand's fingertips support the lift; it is inf if no coefficient suffices.
    """
    found = surface_contacts(model, p_OQ, nhat_Q_O)
    contacts = _grasp(model, found, config, patches=len(found.p_OQ) < ENOUGH_POINTS)
    epsilon = ferrari_canny(
        contacts,
        friction=model.own_physics(config.physics).friction_hand,
        length=characteristic_length(model.visual_vertices, model.p_OOcm),
    )
    return epsilon, smallest_friction(contacts, lift_path(X_TO, config).wrenches(model))


def smallest_friction(contacts: GraspContacts, wrenches_O: npt.ArrayLike) -> float:
    """Return the smallest friction coefficient at which all wrenches can be applied.

    With t(w, μ) the fraction of the limits that a wrench needs (`ForceProgram`), it is

        μ* = min {μ : max over w of t(w, μ) ≤ 1}.

    The needed force never grows with friction, so bisection finds the coefficient.

    Args:
        contacts: Contacts of the grasp.
        wrenches_O: (n, 6), each torque about Ocm and force on the object in {O} [N m, N].

    Returns:
        The coefficient, rounded up by at most `FRICTION_TOLERANCE`; inf if `MAX_FRICTION` does not
        suffice.
    """

    def holds(friction: float) -> bool:
        program = ForceProgram(contacts, friction)
        return all(program.smallest(wrench).share <= 1.0 for wrench in np.asarray(wrenches_O))

    low, high = 0.0, MAX_FRICTION
    if not holds(high):
        return float("inf")
    while high - low > FRICTION_TOLERANCE:
        middle = (low + high) / 2.0
        low, high = (low, middle) if holds(middle) else (middle, high)
    return high


#: Usual area of a fingertip's contact [m^2]: the median of 498 patches of the Barrett Hand
#: after closing, on five G3DB meshes; half of them are between 57 and 89 mm^2.
PATCH_AREA = 68e-6
#: Radius of a disc of this area [m], 4.65 mm, and its torsion radius r under even pressure, 3.1 mm.
#: A normal force f resists a torsional moment of mu f r (R. Howe, M. Cutkosky, "Practical
#: force-motion models for sliding manipulation", IJRR 15(6), 1996).
PATCH_RADIUS = float(np.sqrt(PATCH_AREA / np.pi))
TORSION_RADIUS = 2.0 / 3.0 * PATCH_RADIUS
#: A prediction is off the surface if its point is farther from the surface than this [m], about the
#: radius of a patch, or if its normal differs from the surface normal by more than this [rad].
MAX_DISTANCE, MAX_ANGLE = 0.005, np.deg2rad(45.0)
#: Distances that differ by less than this are equal [m]: predictions are rounded to 0.1 mm.
SAME_DISTANCE = 1e-4
#: A face that agrees with the normal may be farther than the closest face by at most this [m], less
#: than the wall of a cup.
MAX_DETOUR = 1e-3
#: Number of points on the ring of a patch.
RING_POINTS = 8


def surface_feet(triangles: Array, points: Array) -> Array:
    """Return the closest point (n, m, 3) on each of m triangles to each of n points."""
    n, m = len(points), len(triangles)
    near = trimesh.triangles.closest_point(
        np.tile(triangles, (n, 1, 1)), np.repeat(points, m, axis=0)
    )
    return np.asarray(near).reshape(n, m, 3)


def surface_contacts(model: ObjectModel, p_OQ: npt.ArrayLike, nhat_Q_O: npt.ArrayLike) -> Table:
    """Return the contacts that predicted points (k, 3) [m] and outward unit normals (k, 3) select.

    Args:
        model: The object.
        p_OQ: Predicted points in {O}.
        nhat_Q_O: Predicted normals in {O}.

    Returns:
        A table of k rows. `p_OQ` (k, 3) are points of the surface in {O} [m], and `nhat_Q_O` (k, 3)
        outward normals of the faces there. `distance` (k,) is the distance of the predicted points
        from them [m], `inside` (k,) whether the predicted points are inside the object, and `angle`
        (k,) the angle between the predicted normals and these [rad]. `off_surface` (k,) states
        whether a prediction is off the surface, by its distance or its angle.
    """
    points, normals = np.asarray(p_OQ, dtype=float), np.asarray(nhat_Q_O, dtype=float)

    # Choose the closest face among those that agree with the normal, or else among all. No
    # fingertip can be beyond a wall, so a face that is much farther than the closest one is not
    # chosen.
    feet = surface_feet(model.collision.triangles, points)
    distance = np.linalg.norm(feet - points[:, None], axis=2)
    cosine = normals @ model.collision.face_normals.T
    near_enough = distance <= distance.min(axis=1, keepdims=True) + MAX_DETOUR
    agreeing = np.where((cosine >= np.cos(MAX_ANGLE)) & near_enough, distance, np.inf)
    found = agreeing.min(axis=1) <= MAX_DISTANCE
    chosen = _nearest(np.where(found[:, None], agreeing, distance), cosine)

    # The selected point of that face, and the distance and angle of the prediction from it.
    near = feet[np.arange(len(points)), chosen]
    own = np.asarray(model.collision.face_normals[chosen])
    winding = winding_numbers(
        points, model.collision_vertices, model.collision_faces.astype(np.int64)
    )
    away = np.linalg.norm(points - near, axis=1)
    angle = np.arccos(np.clip(np.einsum("ij,ij->i", own, normals), -1.0, 1.0))
    return Table(
        p_OQ=near,
        nhat_Q_O=own,
        distance=away,
        inside=winding > 0.5,
        angle=angle,
        off_surface=~((away <= MAX_DISTANCE) & (angle <= MAX_ANGLE)),
    )


def patch_points(model: ObjectModel, contacts: Table) -> tuple[Array, Array]:
    """Return points (k, m, 3) [m] of the patches around k contacts, and normals (k, m, 3) there.

    A patch consists of the contact and `RING_POINTS` points in a ring around it; each point has the
    normal of the face on which it lies. The ring consists of the surface points that are closest to
    a circle with the radius `TORSION_RADIUS` in the contact's tangent plane. Of equally close
    faces, the one that is most parallel to the contact's face is used. So a patch ends at an edge
    of 90 degrees or more, and bends around a blunter edge.

    Args:
        model: The object.
        contacts: Contacts on the surface of the object.
    """
    # A circle about each contact.
    angles = 2.0 * np.pi * np.arange(RING_POINTS) / RING_POINTS
    ring = np.column_stack([np.zeros(RING_POINTS), np.cos(angles), np.sin(angles)])
    axes = contact_axes(contacts.nhat_Q_O)
    circles = contacts.p_OQ[:, None] + TORSION_RADIUS * ring @ axes.transpose(0, 2, 1)

    # A point of the circle is at most a radius from the surface, so at most two from the contact.
    triangles, face_normals = model.collision.triangles, model.collision.face_normals
    arms = surface_feet(triangles, contacts.p_OQ) - contacts.p_OQ[:, None]
    near = np.linalg.norm(arms, axis=2) <= 2.0 * TORSION_RADIUS + SAME_DISTANCE
    points, normals = [], []
    for i, circle in enumerate(circles):
        cosine = face_normals @ contacts.nhat_Q_O[i]
        faces = np.flatnonzero(near[i])
        feet = surface_feet(triangles[faces], circle)
        distance = np.linalg.norm(feet - circle[:, None], axis=2)
        chosen = _nearest(distance, np.broadcast_to(cosine[faces], distance.shape))
        points.append(np.vstack([contacts.p_OQ[i], feet[np.arange(RING_POINTS), chosen]]))
        normals.append(np.vstack([contacts.nhat_Q_O[i], face_normals[faces[chosen]]]))
    return np.array(points), np.array(normals)


def _nearest(distance: Array, cosine: Array) -> npt.NDArray[np.int64]:
    """Return the index (n,) of the closest face (n, m); of equally close ones the most parallel."""
    near = distance <= distance.min(axis=1, keepdims=True) + SAME_DISTANCE
    return np.argmax(np.where(near, cosine, -np.inf), axis=1)


#: Hands with at least this many fingers are judged by points alone. With fewer fingers, points
#: resist no torque about the line between them, so patches decide.
ENOUGH_POINTS = 3


@dataclass(frozen=True, kw_only=True, eq=False)
class ForceVerdict:
    """What forces can do at the contacts that a prediction selects.

    Attributes:
        contacts: Contacts on the surface, see `surface_contacts`.
        points: Forces at one point of each contact, for the harder of the lift's two wrenches.
        patches: Forces at the patches around the contacts, for the harder of the two wrenches.
    """

    contacts: Table
    points: ContactForces
    patches: ContactForces

    @property
    def deciding(self) -> ContactForces:
        """The forces that decide: at points, or at patches for a hand with two fingertips."""
        return self.points if len(self.contacts.p_OQ) >= ENOUGH_POINTS else self.patches

    @property
    def on_surface(self) -> bool:
        """Whether the surface is near every predicted contact, in position and normal."""
        return not self.contacts.off_surface.any()

    @property
    def held(self) -> bool:
        """Whether the contacts are on the surface, and forces at them support the object."""
        return self.on_surface and self.planned_share <= 1.0

    @property
    def planned_force(self) -> float:
        """Normal force [N] of the finger that needs the largest fraction of its limit, or inf."""
        return float(self.deciding.normal[np.argmax(self.deciding.shares)])

    @property
    def planned_share(self) -> float:
        """The smallest fraction of a limit that suffices; above 1 the fingers are too weak."""
        return self.deciding.share

    @property
    def reason(self) -> str:
        """Why the grasp holds or fails, in one sentence without a full stop."""
        # The prediction may be too far off to select a contact.
        found, shares = self.contacts, self.deciding.shares
        off = int(np.argmax(found.distance))
        if found.distance[off] > MAX_DISTANCE:
            side = "inside" if found.inside[off] else "outside"
            return (
                f"contact {off + 1} is {1e3 * found.distance[off]:.1f} mm {side} the object's "
                f"surface, more than {1e3 * MAX_DISTANCE:.0f} mm"
            )
        off = int(np.argmax(found.angle))
        if found.angle[off] > MAX_ANGLE:
            return (
                f"normal {off + 1} is {np.rad2deg(found.angle[off]):.0f}° off the surface's own, "
                f"more than {np.rad2deg(MAX_ANGLE):.0f}°"
            )

        # The surface there may be unable to support the load.
        if not np.isfinite(self.planned_share):
            return f"no forces within the surface's friction cones carry it{self._other()}"
        if self.planned_share > 1.0:
            limit = self.planned_force / shares.max()
            return (
                f"it takes a normal force of {self.planned_force:.1f} N, more than the "
                f"{limit:.1f} N that the fingertip carries{self._other()}"
            )
        return (
            f"normal forces of at most {self.deciding.largest_normal:.1f} N carry it: "
            f"{_percent(self.points)} of a fingertip's strength at points, "
            f"{_percent(self.patches)} at patches"
        )

    def _other(self) -> str:
        """Return what patches could do if points decide and fail."""
        if self.deciding is self.patches:
            return ""
        if not np.isfinite(self.patches.share):
            return ", nor do patches"
        return f"; at patches it takes {_percent(self.patches)} of a fingertip's strength"


def judge_forces(
    model: ObjectModel,
    X_TO: npt.ArrayLike,
    p_OQ: npt.ArrayLike,
    nhat_Q_O: npt.ArrayLike,
    config: Config,
) -> ForceVerdict:
    """Return whether forces at the contacts that a prediction selects support the object's lift.

    The object moves along `simulation.lift.lift_path`. The friction is the object's own, or
    `physics.friction_hand`.

    Args:
        model: The object.
        X_TO: (4, 4), resting pose of the object.
        p_OQ: (k, 3), predicted points in {O} [m].
        nhat_Q_O: (k, 3), predicted unit normals out of the object in {O}.
        config: The hand, its drive, friction and lift.
    """
    contacts = surface_contacts(model, p_OQ, nhat_Q_O)
    friction = model.own_physics(config.physics).friction_hand
    wrenches = lift_path(X_TO, config).wrenches(model)
    return ForceVerdict(
        contacts=contacts,
        points=hardest_forces(
            ForceProgram(_grasp(model, contacts, config, patches=False), friction), wrenches
        ),
        patches=hardest_forces(
            ForceProgram(_grasp(model, contacts, config, patches=True), friction), wrenches
        ),
    )


def _grasp(model: ObjectModel, contacts: Table, config: Config, *, patches: bool) -> GraspContacts:
    """Return contacts as points or patches, with the limits of the hand's fingertips."""
    hand = within_load(load_hand(config.hand_source), config.physics.finger_load)
    p_OQ, nhat_Q_O = contacts.p_OQ, contacts.nhat_Q_O
    if patches:
        p_OQ, nhat_Q_O = patch_points(model, contacts)
    return GraspContacts(
        p_OQ,
        nhat_Q_O,
        model.p_OOcm,
        force_limit=fingertip_forces(hand, drive_of(hand, config.lift)),
    )


def _percent(forces: ContactForces) -> str:
    """Return the largest fraction of a fingertip's limit as text."""
    return f"{100.0 * forces.share:.0f} %" if np.isfinite(forces.share) else "more than all"
