"""Subdivision: a closed surface comes in; the same surface without long edges goes out.

A face of a rigid hydroelastic surface gives one contact polygon, and a polygon has one point of
force. A base of two triangles therefore carries at two points and tips over; one of many small
faces carries nearly up to its rim.
"""

from __future__ import annotations

import numpy as np

from drakegrasp.arithmetic import dot
from drakegrasp.frames import Array
from drakegrasp.mesh.components import edge_ids
from drakegrasp.mesh.surfaces import Faces, Solid, half_edges

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
        faces = _split(vertices, faces, midpoint[ids].reshape(-1, 3))
    return None


def _split(vertices: Array, faces: Faces, midpoints: Faces) -> Faces:
    """Return faces (k, 3), each split at the midpoints of its edges.

    Args:
        vertices: (n, 3) [m], midpoints among them.
        faces: (m, 3).
        midpoints: (m, 3), the vertex amid the edge that leaves each corner, or -1.
    """
    # Turn each face so that a lone midpoint is on its first edge, and a lone whole edge is its
    # last.
    split = midpoints >= 0
    number = split.sum(axis=1)
    turn = np.where(number == 1, split.argmax(axis=1), 0)
    turn = np.where(number == 2, (split.argmin(axis=1) + 1) % 3, turn)
    order = (np.arange(3) + turn[:, None]) % 3
    a, b, c = np.take_along_axis(faces, order, axis=1).T
    d, e, f = np.take_along_axis(midpoints, order, axis=1).T  # amid ab, bc, ca

    # Two midpoints leave a quadrilateral a d e c, which its shorter diagonal halves.
    ae, dc = vertices[e] - vertices[a], vertices[c] - vertices[d]
    shorter = (number == 2) & (dot(ae, ae) <= dot(dc, dc))
    other = (number == 2) & ~shorter
    parts = [
        (number == 0, [(a, b, c)]),
        (number == 1, [(a, d, c), (d, b, c)]),
        (shorter, [(d, b, e), (a, d, e), (a, e, c)]),
        (other, [(d, b, e), (a, d, c), (d, e, c)]),
        (number == 3, [(a, d, f), (d, b, e), (f, e, c), (d, e, f)]),
    ]
    return np.vstack(
        [np.column_stack(corners)[chosen] for chosen, pieces in parts for corners in pieces]
    )
