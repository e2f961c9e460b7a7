"""The margin of predicted contacts: what forces at them alone can do within the hand's strength.

Input: predicted points and normals, and the wrenches of a lift. Output: the epsilon of Ferrari and
Canny, and the smallest friction coefficient at which forces at the contacts support the lift.

A prediction only selects contacts on the surface that the hand meets in the simulation. The
selected contact is the closest point to the predicted one on a face whose normal is within
`MAX_ANGLE` of the predicted normal. At an edge, where several of these faces are equally close, it
is on the face whose normal is closest to the predicted one. A point on the wrong side of a thin
wall is therefore moved to the side that its normal names. If no such face is within `MAX_DISTANCE`,
the contact is on the closest face of all.

A fingertip touches at points with Coulomb friction. It pushes along the inward normal and along the
surface; it neither pulls nor twists. It has one point, or for a hand with two fingertips several
points that form a patch. The points of a patch share the finger's force in any way, so together
they also resist twisting.
"""

from __future__ import annotations

import logging

import numpy as np
import numpy.typing as npt
import trimesh
from pydrake.solvers import ClarabelSolver, MathematicalProgram
from scipy.spatial import ConvexHull, QhullError

from drakegrasp.config import Config
from drakegrasp.frames import Array
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.kinematics import fingertip_forces, within_load
from drakegrasp.objects.model import ObjectModel
from drakegrasp.simulation.drive import drive_of
from drakegrasp.simulation.lift import lift_path

#: Usual area of a fingertip's contact [m^2]: the median of 498 patches of the Barrett Hand
#: after closing, on five G3DB meshes; half of them are between 57 and 89 mm^2.
PATCH_AREA = 68e-6
#: Radius of a disc of this area [m], 4.65 mm, and its torsion radius r under even pressure, 3.1 mm.
#: A normal force f resists a torsional moment of mu f r (R. Howe, M. Cutkosky, "Practical
#: force-motion models for sliding manipulation", IJRR 15(6), 1996).
PATCH_RADIUS = float(np.sqrt(PATCH_AREA / np.pi))
TORSION_RADIUS = 2.0 / 3.0 * PATCH_RADIUS
#: Number of points on the ring of a patch.
RING_POINTS = 8
#: Hands with at least this many fingers are judged by points alone. With fewer fingers, points
#: resist no torque about the line between them, so their contacts are patches.
ENOUGH_POINTS = 3
#: A prediction is off the surface if its point is farther from the surface than this [m], about the
#: radius of a patch, or if its normal differs from the surface normal by more than this [rad].
MAX_DISTANCE, MAX_ANGLE = 0.005, np.deg2rad(45.0)
#: Distances that differ by less than this are equal [m]: predictions are rounded to 0.1 mm.
SAME_DISTANCE = 1e-4
#: A face that agrees with the normal may be farther than the closest face by at most this [m], less
#: than the wall of a cup.
MAX_DETOUR = 1e-3
#: Edges of the pyramid that approximates a friction cone from inside. With 16 edges, epsilon is
#: about 2 % too small and varies by as much with the frame; the hull takes 15 ms.
FRICTION_EDGES = 16
#: An epsilon below this is a rounding error: the origin is on the surface of the hull.
ROUNDING = 1e-9
#: Largest friction coefficient to try, and the tolerance of the smallest one.
MAX_FRICTION, FRICTION_TOLERANCE = 10.0, 1e-4
#: Forces apply a wrench if their error is below this fraction of the wrench.
MAX_ERROR = 1e-7


def _is_not_from_clarabel(record: logging.LogRecord) -> bool:
    """Return whether a record is not Drake's note on the solver's status, which we read instead."""
    return not record.getMessage().startswith("Clarabel returns")


logging.getLogger("drake").addFilter(_is_not_from_clarabel)


def force_margin(
    model: ObjectModel, X_TO: Array, p_OQ: Array, nhat_Q_O: Array, config: Config
) -> tuple[float, float]:
    """Return the margin by which forces at the contacts of a grasp hold the object in its lift.

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
    # The contacts, and how hard the fingertips can press.
    points, normals = surface_contacts(model, p_OQ, nhat_Q_O)
    points, normals = points[:, None], normals[:, None]
    if len(points) < ENOUGH_POINTS:
        points, normals = patch_points(model, points[:, 0], normals[:, 0])
    hand = within_load(load_hand(config.hand_source), config.physics.finger_load)
    limits = fingertip_forces(hand, drive_of(hand, config.lift))

    arms = points - model.p_OOcm
    length = float(np.linalg.norm(model.visual_vertices - model.p_OOcm, axis=1).max())
    friction = model.own_physics(config.physics).friction_hand
    epsilon = ferrari_canny(arms, normals, friction=friction, length=length)
    wrenches = lift_path(X_TO, config).wrenches(model)
    return epsilon, smallest_friction(arms, normals, limits, wrenches)


def surface_feet(triangles: Array, points: Array) -> Array:
    """Return the closest point (n, m, 3) on each of m triangles to each of n points."""
    n, m = len(points), len(triangles)
    near = trimesh.triangles.closest_point(
        np.tile(triangles, (n, 1, 1)), np.repeat(points, m, axis=0)
    )
    return np.asarray(near).reshape(n, m, 3)


def surface_contacts(model: ObjectModel, p_OQ: Array, nhat_Q_O: Array) -> tuple[Array, Array]:
    """Return the contacts that predicted points (k, 3) [m] and outward unit normals (k, 3) select.

    Returns:
        Points of the surface (k, 3) in {O} [m], and outward normals (k, 3) of the faces there.
    """
    # Choose the closest face among those that agree with the normal, or else among all. No
    # fingertip can be beyond a wall, so a face that is much farther than the closest one is not
    # chosen.
    feet = surface_feet(model.collision.triangles, p_OQ)
    distance = np.linalg.norm(feet - p_OQ[:, None], axis=2)
    cosine = nhat_Q_O @ model.collision.face_normals.T
    near_enough = distance <= distance.min(axis=1, keepdims=True) + MAX_DETOUR
    agreeing = np.where((cosine >= np.cos(MAX_ANGLE)) & near_enough, distance, np.inf)
    found = agreeing.min(axis=1) <= MAX_DISTANCE
    chosen = _nearest(np.where(found[:, None], agreeing, distance), cosine)
    return feet[np.arange(len(p_OQ)), chosen], np.asarray(model.collision.face_normals[chosen])


def patch_points(model: ObjectModel, p_OQ: Array, nhat_Q_O: Array) -> tuple[Array, Array]:
    """Return points (k, m, 3) [m] of the patches around k contacts, and normals (k, m, 3) there.

    A patch consists of the contact and `RING_POINTS` points in a ring around it; each point has the
    normal of the face on which it lies. The ring consists of the surface points that are closest to
    a circle with the radius `TORSION_RADIUS` in the contact's tangent plane. Of equally close
    faces, the one that is most parallel to the contact's face is used. So a patch ends at an edge
    of 90 degrees or more, and bends around a blunter edge.

    Args:
        model: The object.
        p_OQ: (k, 3), contacts on its surface in {O} [m].
        nhat_Q_O: (k, 3), outward normals of the faces there.
    """
    # A circle about each contact.
    angles = 2.0 * np.pi * np.arange(RING_POINTS) / RING_POINTS
    ring = np.column_stack([np.zeros(RING_POINTS), np.cos(angles), np.sin(angles)])
    circles = p_OQ[:, None] + TORSION_RADIUS * ring @ contact_axes(nhat_Q_O).transpose(0, 2, 1)

    # A point of the circle is at most a radius from the surface, so at most two from the contact.
    triangles, face_normals = model.collision.triangles, model.collision.face_normals
    arms = surface_feet(triangles, p_OQ) - p_OQ[:, None]
    near = np.linalg.norm(arms, axis=2) <= 2.0 * TORSION_RADIUS + SAME_DISTANCE
    points, normals = [], []
    for i, circle in enumerate(circles):
        faces = np.flatnonzero(near[i])
        cosine = face_normals @ nhat_Q_O[i]
        feet = surface_feet(triangles[faces], circle)
        distance = np.linalg.norm(feet - circle[:, None], axis=2)
        chosen = _nearest(distance, np.broadcast_to(cosine[faces], distance.shape))
        points.append(np.vstack([p_OQ[i], feet[np.arange(RING_POINTS), chosen]]))
        normals.append(np.vstack([nhat_Q_O[i], face_normals[faces[chosen]]]))
    return np.array(points), np.array(normals)


def _nearest(distance: Array, cosine: Array) -> npt.NDArray[np.int64]:
    """Return the index (n,) of the closest face (n, m); of equally close ones the most parallel."""
    near = distance <= distance.min(axis=1, keepdims=True) + SAME_DISTANCE
    return np.argmax(np.where(near, cosine, -np.inf), axis=1)


def contact_axes(nhat_Q_O: Array) -> Array:
    """Return axes (n, 3, 3) at each contact, as columns: the inward normal and two tangents.

    Args:
        nhat_Q_O: (n, 3), normals out of the object in {O}.
    """
    inward = -nhat_Q_O / np.linalg.norm(nhat_Q_O, axis=1, keepdims=True)
    # The axis of {O} with the smallest component along the normal is never parallel to it.
    first = np.cross(inward, np.eye(3)[np.argmin(np.abs(inward), axis=1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([inward, first, np.cross(inward, first)], axis=2)


def grasp_map(p_OcmQ: Array) -> Array:
    """Return the blocks G_i = [[p_i]×; 1], (6, n, 3), with wrench = Σ_i G_i f_i, [p]× f = p × f.

    Args:
        p_OcmQ: (n, 3), arms of the contacts about the centre of mass [m].
    """
    # Column j of a block is the moment of the unit force along axis j.
    moments = np.cross(p_OcmQ[:, None, :], np.eye(3)).transpose(2, 0, 1)
    return np.concatenate([moments, np.tile(np.eye(3)[:, None], (1, len(p_OcmQ), 1))])


def ferrari_canny(p_OcmQ: Array, nhat_Q_O: Array, *, friction: float, length: float) -> float:
    """Return the epsilon of a grasp: the smallest wrench that can break it.

    This is the L1 version of C. Ferrari and J. Canny, "Planning optimal grasps", ICRA 1992: the
    distance of the origin from the surface of the convex hull of all contacts' friction cones, for
    normal forces that sum to one. Each cone is approximated by a pyramid with `FRICTION_EDGES`
    edges. Edge e of point i, with the inward normal n_i, the tangents t, the arm p_i and the length
    L, has the wrench

        w_ie = [p_i × f_ie / L; f_ie],   f_ie = n_i + μ (cos(α_e) t_i1 + sin(α_e) t_i2).

    If the origin is inside the hull, ε = min over |u| = 1 of max over i, e of u·w_ie.

    Args:
        p_OcmQ: (k, m, 3), arms of the points of k fingertips about the centre of mass in {O} [m].
        nhat_Q_O: (k, m, 3), outward normals there.
        friction: Coulomb coefficient.
        length: Length by which torques are divided [m].

    Returns:
        Epsilon, without unit; 0 if the origin is not inside the hull, or the hull is flat.
    """
    # Wrenches of the edges of all cones, for a normal force of one.
    angles = 2.0 * np.pi * np.arange(FRICTION_EDGES) / FRICTION_EDGES
    edges = np.stack(
        [np.ones(FRICTION_EDGES), friction * np.cos(angles), friction * np.sin(angles)]
    )
    forces = contact_axes(nhat_Q_O.reshape(-1, 3)) @ edges  # (n, 3, edges)
    blocks = grasp_map(p_OcmQ.reshape(-1, 3))
    wrenches = np.einsum("wni,nie->new", blocks, forces).reshape(-1, 6)
    wrenches[:, :3] /= length

    # Compute the distance of the origin from the hull of these wrenches.
    try:
        hull = ConvexHull(wrenches)
    except QhullError:
        return 0.0  # flat, or too few points: some wrench cannot be resisted at all
    # A row is a unit outward normal and an offset, which is negative if the origin is inside.
    epsilon = -float(hull.equations[:, -1].max())
    return epsilon if epsilon > ROUNDING else 0.0


def smallest_friction(
    p_OcmQ: Array, nhat_Q_O: Array, limits: npt.ArrayLike, wrenches_O: Array
) -> float:
    """Return the smallest friction coefficient at which all wrenches can be applied.

    With t(w, μ) the fraction of the limits that a wrench needs (`needed_share`), it is

        μ* = min {μ : max over w of t(w, μ) ≤ 1}.

    The needed force never grows with friction, so bisection finds the coefficient.

    Args:
        p_OcmQ: See `needed_share`, like `nhat_Q_O` and `limits`.
        nhat_Q_O: See `needed_share`.
        limits: See `needed_share`.
        wrenches_O: (n, 6), each torque about Ocm and force on the object in {O} [N m, N].

    Returns:
        The coefficient, rounded up by at most `FRICTION_TOLERANCE`; inf if `MAX_FRICTION` does not
        suffice.
    """

    def holds(friction: float) -> bool:
        given = p_OcmQ, nhat_Q_O, limits, friction
        return all(needed_share(*given, wrench) <= 1.0 for wrench in wrenches_O)

    low, high = 0.0, MAX_FRICTION
    if not holds(high):
        return float("inf")
    while high - low > FRICTION_TOLERANCE:
        middle = (low + high) / 2.0
        low, high = (low, middle) if holds(middle) else (middle, high)
    return high


def needed_share(
    p_OcmQ: Array, nhat_Q_O: Array, limits: npt.ArrayLike, friction: float, wrench_O: Array
) -> float:
    """Return the smallest fraction of the fingertips' limits with which forces apply a wrench.

    For a wrench w on the object, forces f_ij at point j of finger i with normal parts f_n and
    tangential parts f_t, limits N_i and the grasp map G, it is the t of

        minimise t   subject to   Σ_ij G_ij f_ij = w,   |f_t| ≤ μ f_n,   Σ_j f_n,ij ≤ t N_i

    (M. Lobo, L. Vandenberghe, S. Boyd, H. Lebret, "Applications of second-order cone programming",
    1998, section 3.4), solved with Clarabel through Drake. The unknowns x are the three components
    of each force along the axes of its point. The tangential components are divided by μ, so every
    cone is |tangential| <= normal. Forces are in units of the load. Torques are divided by the
    largest distance of a point from Ocm, so that all grasps have the same scale for the solver.
    Limits are in units of the largest limit.

    Args:
        p_OcmQ: (k, m, 3), arms of the points of k fingertips about the centre of mass in {O} [m].
        nhat_Q_O: (k, m, 3), outward normals there.
        limits: (k,), or one value: largest total normal force of each fingertip [N].
        friction: Coulomb coefficient μ.
        wrench_O: (6,), torque about Ocm and force on the object in {O} [N m, N].

    Returns:
        The fraction, which is above 1 if the fingertips are too weak; inf if no forces apply it.
    """
    # The map from the unknowns to the wrench, in units of torque and force.
    (k, m, _), arms = p_OcmQ.shape, p_OcmQ.reshape(-1, 3)
    n, limit = k * m, np.broadcast_to(np.asarray(limits, dtype=float), (k,))
    units = np.repeat([float(np.linalg.norm(arms, axis=1).max()) or 1.0, 1.0], 3)
    forces = contact_axes(nhat_Q_O.reshape(-1, 3)) * [1.0, friction, friction]
    A = np.einsum("wni,nij->wnj", grasp_map(arms), forces).reshape(6, -1) / units[:, None]
    target = wrench_O / units
    load = float(np.linalg.norm(target))

    # The points of a finger share its limit.
    program = MathematicalProgram()
    x, t = program.NewContinuousVariables(3 * n, "x"), program.NewContinuousVariables(1)
    for point in x.reshape(-1, 3):
        program.AddLorentzConeConstraint(np.eye(3), np.zeros(3), point)
    with_t = np.hstack([A, np.zeros((6, 1))])
    program.AddLinearEqualityConstraint(with_t, target / load, np.append(x, t))
    sums = -np.kron(np.eye(k), np.ones(m))
    select = np.column_stack([sums, limit / limit.max()])
    program.AddLinearConstraint(select, np.zeros(k), np.full(k, np.inf), np.append(x[::3], t))
    program.AddLinearCost(t[0])
    result = ClarabelSolver().Solve(program)
    if not result.is_success():
        return float("inf")

    found = load * np.asarray(result.get_x_val()[: 3 * n])
    if np.linalg.norm(A @ found - target) > MAX_ERROR * load:
        return float("inf")
    return float((found[::3].reshape(k, m).sum(axis=1) / limit).max())
