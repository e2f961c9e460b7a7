"""Where predicted contacts are on an object's surface, and how well their normals agree with it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh

from drakegrasp.frames import Array
from drakegrasp.objects.model import ObjectModel

#: A face may be this much farther than the nearest one and still count as next to the point [m]: a
#: prediction is as often on the wrong side of a cup's wall as beside the wall.
WALL = 0.005


@dataclass(frozen=True, kw_only=True, eq=False)
class SurfaceFit:
    """How k contacts lie on the surface that the hand meets.

    Attributes:
        distance: (k,), of the points from the surface [m].
        nearest: (k, 3), the points of the surface nearest to them, in {O} [m].
        agreement: (k,), cosine between each normal and the outward normal of a face next to its
            point, of the face where it is largest; negative where the normal points inwards.
        normals: (k, 3), outward unit normals in {O} of the faces nearest to the points.
    """

    distance: Array
    nearest: Array
    agreement: Array
    normals: Array


def fit_surface(model: ObjectModel, p_OQ: Array, nhat_Q_O: Array) -> SurfaceFit:
    """Return how contacts lie on an object's surface.

    A predicted point may be beside an edge or on the wrong side of a thin wall, so each face that
    is at most `WALL` farther than the nearest one is next to it.

    Args:
        model: The object.
        p_OQ: (k, 3), points in {O} [m].
        nhat_Q_O: (k, 3), unit normals in {O}.
    """
    # The point of each of m faces that is nearest to each contact.
    triangles = model.collision.triangles
    k, m = len(p_OQ), len(triangles)
    points = np.repeat(p_OQ, m, axis=0)
    near = trimesh.triangles.closest_point(np.tile(triangles, (k, 1, 1)), points)
    distances = np.linalg.norm(near - points, axis=1).reshape(k, m)

    # The nearest face, and the best of those next to the point.
    face = distances.argmin(axis=1)
    distance = distances[np.arange(k), face]
    cosine = nhat_Q_O @ model.collision.face_normals.T
    beside = distances <= distance[:, None] + WALL
    return SurfaceFit(
        distance=distance,
        nearest=near.reshape(k, m, 3)[np.arange(k), face],
        agreement=np.where(beside, cosine, -1.0).max(axis=1),
        normals=model.collision.face_normals[face],
    )
