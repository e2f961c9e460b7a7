"""Whether predicted contacts are on an object: how far from its surface, and on which side."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import trimesh

from drakegrasp.frames import Array
from drakegrasp.object_model import ObjectModel

#: Least cosine between a normal that points out of a face and the face's own: 84 degrees.
OUTWARD = 0.1


def face_distances(model: ObjectModel, p_OQ: Array) -> Array:
    """Return the distance (k, m) [m] of points (k, 3) in {O} from each of m collision faces."""
    triangles = model.collision.triangles
    k, m = len(p_OQ), len(triangles)
    points = np.repeat(p_OQ, m, axis=0)
    near = trimesh.triangles.closest_point(np.tile(triangles, (k, 1, 1)), points)
    return np.asarray(np.linalg.norm(near - points, axis=1).reshape(k, m))


def points_outward(
    model: ObjectModel, distance: Array, nhat_Q_O: Array, within: float
) -> npt.NDArray[np.bool_]:
    """Return for each of k normals whether it points out of a face near its point.

    A predicted point may be beside an edge or on the wrong side of a thin wall, so every
    face near it is asked.

    Args:
        model: The object.
        distance: (k, m), of the points from the faces, see `face_distances` [m].
        nhat_Q_O: (k, 3), normals in {O}.
        within: What near is [m].
    """
    outward = nhat_Q_O @ model.collision.face_normals.T > OUTWARD
    return np.asarray(np.any(outward & (distance <= within), axis=1))
