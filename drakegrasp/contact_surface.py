"""Whether predicted contacts are on an object: how far from its surface, and on which side."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import trimesh

from drakegrasp.frames import Array
from drakegrasp.object_model import ObjectModel

#: Least cosine between a normal that points out of a face and the face's own: 84 degrees.
OUTWARD = 0.1
#: How much farther than the nearest face another may be to count as well [m]: a prediction is
#: as often on the wrong side of a cup's wall as it is beside it.
WALL = 0.005


def face_distances(model: ObjectModel, p_OQ: Array) -> Array:
    """Return the distance (k, m) [m] of points (k, 3) in {O} from each of m collision faces."""
    triangles = model.collision.triangles
    k, m = len(p_OQ), len(triangles)
    points = np.repeat(p_OQ, m, axis=0)
    near = trimesh.triangles.closest_point(np.tile(triangles, (k, 1, 1)), points)
    return np.asarray(np.linalg.norm(near - points, axis=1).reshape(k, m))


def points_outward(model: ObjectModel, distance: Array, nhat_Q_O: Array) -> npt.NDArray[np.bool_]:
    """Return for each of k normals whether it points out of a face next to its point.

    A predicted point may be beside an edge or on the wrong side of a thin wall, so every
    face that is not `WALL` farther than the nearest one is asked.

    Args:
        model: The object.
        distance: (k, m), of the points from the faces, see `face_distances` [m].
        nhat_Q_O: (k, 3), normals in {O}.
    """
    outward = nhat_Q_O @ model.collision.face_normals.T > OUTWARD
    near = distance <= distance.min(axis=1, keepdims=True) + WALL
    return np.asarray(np.any(outward & near, axis=1))
