"""What forces at a grasp's contact points can do to the object, by linear algebra alone.

In: contact points, outward normals, a friction coefficient. Out: the grasp map, and the
epsilon of Ferrari and Canny. Contacts are points with Coulomb friction: a finger pushes
along the inward normal and along the surface, it neither pulls nor twists.

A wrench here is [torque about Ocm; force], (6,), in axes of {O} [N m, N], in the order of
Drake's spatial forces.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull, QhullError

from drakegrasp.frames import Array

#: Edges of the pyramid that stands in for a friction cone, inscribed in it. With 16, epsilon
#: is about 2 % too small and changes by as much with the frame, and the hull takes 15 ms.
FRICTION_EDGES = 16
#: An epsilon below this is the rounding of an origin on the hull's surface.
ROUNDING = 1e-9


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


def characteristic_length(vertices: npt.ArrayLike, p_OOcm: npt.ArrayLike) -> float:
    """Return the largest distance of a vertex (n, 3) in {O} from the centre of mass [m].

    No contact on the surface has a longer arm, so torques divided by it are comparable with
    the forces that cause them.
    """
    arms = np.asarray(vertices, dtype=float) - np.asarray(p_OOcm, dtype=float)
    return float(np.linalg.norm(arms, axis=1).max())


def ferrari_canny(
    p_OQ: npt.ArrayLike,
    nhat_Q_O: npt.ArrayLike,
    p_OOcm: npt.ArrayLike,
    *,
    friction: float,
    length: float,
) -> float:
    """Return the epsilon of a grasp: the smallest wrench that can break it.

    The L1 version of C. Ferrari and J. Canny, "Planning optimal grasps", ICRA 1992: the
    distance of the origin from the surface of the convex hull of all contacts' friction
    cones with a unit normal force, that is, for normal forces that sum to one. Each cone is
    linearised with `FRICTION_EDGES` edges.

    Args:
        p_OQ: (k, 3), contact points in {O} [m].
        nhat_Q_O: (k, 3), normals out of the object in {O}.
        p_OOcm: (3,), the centre of mass in {O} [m].
        friction: Coulomb coefficient.
        length: What torques are divided by [m], see `characteristic_length`.

    Returns:
        Epsilon, without unit; 0 where the origin is not inside of the hull, or the hull is
        flat, or a number is not finite.
    """
    angles = 2.0 * np.pi * np.arange(FRICTION_EDGES) / FRICTION_EDGES
    pyramid = np.stack(
        [np.ones(FRICTION_EDGES), friction * np.cos(angles), friction * np.sin(angles)]
    )
    edges = contact_axes(nhat_Q_O) @ pyramid  # (k, 3, edges)
    blocks = grasp_map(p_OQ, p_OOcm).reshape(6, -1, 3)
    wrenches = np.einsum("wki,kie->kew", blocks, edges).reshape(-1, 6)
    wrenches[:, :3] /= length
    if not np.isfinite(wrenches).all():
        return 0.0
    try:
        hull = ConvexHull(wrenches)
    except QhullError:
        return 0.0  # flat or too few points: some wrench cannot be resisted at all
    # Rows are unit outward normal and offset, negative where the origin is inside.
    epsilon = -float(hull.equations[:, -1].max())
    return epsilon if epsilon > ROUNDING else 0.0
