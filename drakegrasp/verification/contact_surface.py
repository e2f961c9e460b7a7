"""Where predicted contacts are on an object's surface, and whether their normals point outwards."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import trimesh

from drakegrasp.frames import Array
from drakegrasp.objects.model import ObjectModel

#: A normal points out of a face if the cosine between it and the face's own is above this: 84
#: degrees.
OUTWARD = 0.1
#: A face may be this much farther than the nearest one and still count as next to the point [m]: a
#: prediction is as often on the wrong side of a cup's wall as beside the wall.
WALL = 0.005


def face_distances(model: ObjectModel, p_OQ: Array) -> Array:
    """Return the distance (k, m) [m] of points (k, 3) in {O} from each of m collision faces."""
    triangles = model.collision.triangles
    k, m = len(p_OQ), len(triangles)
    points = np.repeat(p_OQ, m, axis=0)
    near = trimesh.triangles.closest_point(np.tile(triangles, (k, 1, 1)), points)
    return np.asarray(np.linalg.norm(near - points, axis=1).reshape(k, m))


def points_outward(model: ObjectModel, distance: Array, nhat_Q_O: Array) -> npt.NDArray[np.bool_]:
    """Return (k,), whether each normal points out of a face next to its point.

    A predicted point may be beside an edge or on the wrong side of a thin wall, so any face that
    is at most `WALL` farther than the nearest one counts.

    Args:
        model: The object.
        distance: (k, m), of the points from the faces, see `face_distances` [m].
        nhat_Q_O: (k, 3), normals in {O}.
    """
    outward = nhat_Q_O @ model.collision.face_normals.T > OUTWARD
    near = distance <= distance.min(axis=1, keepdims=True) + WALL
    return np.asarray(np.any(outward & near, axis=1))
