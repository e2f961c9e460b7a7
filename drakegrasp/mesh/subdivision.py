"""Subdivision: a closed surface comes in; the same surface without long edges goes out.

A face of a rigid hydroelastic surface gives one contact polygon, and a polygon has one point of
force. A base of two triangles therefore carries at two points and tips over; one of many small
faces carries nearly up to its rim.
"""

from __future__ import annotations

import numpy as np

from drakegrasp.arithmetic import dot
from drakegrasp.mesh.components import edge_ids
from drakegrasp.mesh.surfaces import Solid, half_edges, split_faces

#: An edge that is longer than the limit by rounding is not split.
TOLERANCE = 1e-9


def subdivide(solid: Solid, max_edge: float, max_faces: int) -> Solid:
    """Return the same surface with no edge longer than `max_edge` [m].

    All edges that are too long are split at their midpoints, in both of their faces, until there
    is none: so no vertex lies within another face's edge, and a closed surface stays closed. The
    old vertices come first, in their order.

    Where that gives more than `max_faces` faces, the limit is raised by steps of a quarter until
    it does not; a surface that has more already stays as it is.
    """
    while True:
        finer = _split_long_edges(solid, max_edge, max(max_faces, len(solid.faces)))
        if finer is not None:
            return finer
        max_edge *= 1.25


def _split_long_edges(solid: Solid, max_edge: float, max_faces: int) -> Solid | None:
    """Return the surface without longer edges, or None if that takes more than `max_faces`."""
    vertices, faces = solid.vertices, solid.faces
    limit = (max_edge * (1.0 + TOLERANCE)) ** 2
    while len(faces) <= max_faces:
        # The ends of each edge, of one of its two half-edges, and which edges are too long.
        ids, counts = edge_ids(faces)
        ends = np.empty((len(counts), 2), dtype=np.int64)
        ends[ids] = np.sort(half_edges(faces), axis=1)
        along = vertices[ends[:, 1]] - vertices[ends[:, 0]]
        long = dot(along, along) > limit
        if not long.any():
            return Solid(vertices=vertices, faces=faces, notes=solid.notes)

        # A vertex in the middle of each, for the faces on both sides.
        midpoint = np.full(len(counts), -1, dtype=np.int64)
        midpoint[long] = len(vertices) + np.arange(int(long.sum()))
        new = (vertices[ends[long, 0]] + vertices[ends[long, 1]]) / 2.0
        vertices = np.vstack((vertices, new))
        faces = split_faces(vertices, faces, midpoint[ids].reshape(-1, 3))
    return None
