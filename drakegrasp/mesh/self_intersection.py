"""Self-intersection: a surface of triangles comes in, the faces that pass through others go out.

Winding numbers tell how much volume a surface encloses twice; here each pair of faces counts, be
the volume ever so small.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import dot, norm
from drakegrasp.frames import Array
from drakegrasp.mesh.surfaces import Faces, diagonal, pair_blocks, unit_normals

#: An edge passes through a face if its ends are farther than this on both sides, and it farther
#: than this from the face's edges, as a fraction of the diagonal. Surfaces that only touch do
#: not, though their vertices are rounded.
DEPTH = 2e-6
#: Pairs of faces that are looked at together.
PAIRS = 1_000_000

Mask = npt.NDArray[np.bool_]


def crossing_faces(vertices: Array, faces: Faces) -> Faces:
    """Return the faces (k,) that pass through another face, in their order.

    Faces with a common edge do not count, as they cannot cross unless they are folded flat. An edge
    that passes exactly through another face's edge is not seen; that of a neighbour is. The same
    bits everywhere: nothing but sums, products and roots.

    Args:
        vertices: (n, 3) [m].
        faces: (m, 3).
    """
    # Sweep along the longest axis: boxes that overlap there come in runs.
    low, high = vertices[faces].min(axis=1), vertices[faces].max(axis=1)
    axis = int(np.argmax(np.ptp(vertices, axis=0)))
    order = np.argsort(low[:, axis], kind="stable")
    ends = np.searchsorted(low[order, axis], high[order, axis], side="right")
    counts = ends - np.arange(len(faces)) - 1

    # Test the pairs of many runs at a time.
    crosses = np.zeros(len(faces), dtype=bool)
    depth = DEPTH * diagonal(vertices)
    for i, j in pair_blocks(counts, PAIRS):
        first, second = order[i], order[i + 1 + j]
        overlap = ((low[first] <= high[second]) & (low[second] <= high[first])).all(axis=1)
        first, second = first[overlap], second[overlap]
        crossing = _cross(vertices, faces[first], faces[second], depth)
        crosses[first[crossing]] = crosses[second[crossing]] = True
    return np.flatnonzero(crosses)


def _cross(vertices: Array, first: Faces, second: Faces, depth: float) -> Mask:
    """Return which pairs (k,) of faces (k, 3) and (k, 3) pass through each other."""
    crossing = np.zeros(len(first), dtype=bool)
    shared = (first[:, :, None] == second[:, None, :]).any(axis=2)
    # Only an edge without a common vertex can pass through the other face.
    apart = np.flatnonzero(shared.sum(axis=1) < 2)
    for mine, other in ((first, second), (second, first)):
        shared = (mine[:, :, None] == other[:, None, :]).any(axis=2)
        for corner in range(3):
            p, q = mine[:, corner], mine[:, (corner + 1) % 3]
            free = apart[~(shared[apart, corner] | shared[apart, (corner + 1) % 3])]
            hit = _pass(vertices[p[free]], vertices[q[free]], vertices[other[free]], depth)
            crossing[free[hit]] = True
    return crossing


def _pass(p: Array, q: Array, triangles: Array, depth: float) -> Mask:
    """Return which segments p (k, 3) to q (k, 3) pass through their triangle (k, 3, 3)."""
    # The ends lie on different sides of its plane ...
    a, b, c = np.moveaxis(triangles, 1, 0)
    normal = unit_normals(triangles)
    above, below = dot(p - a, normal), dot(q - a, normal)
    sides = (np.minimum(above, below) < -depth) & (np.maximum(above, below) > depth)

    # ... and it passes all three edges on the same side, at a distance.
    along = q - p
    passed = []
    for u, v in ((a, b), (b, c), (c, a)):
        lengths = np.maximum(norm(np.cross(along, v - u)), 1e-300)
        passed.append(dot(along, np.cross(u - p, v - p)) / lengths)
    return sides & ((np.min(passed, axis=0) > depth) | (np.max(passed, axis=0) < -depth))
