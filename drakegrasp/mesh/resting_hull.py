"""The resting hull: points of a solid come in; its convex hull in triangles that carry goes out.

A face of a rigid hydroelastic surface gives one contact polygon, and a polygon has one point of
force. So each plane facet of the hull becomes a fan of triangles about a point inside it, within a
rim of narrow triangles whose points of force are near its border.
"""

from __future__ import annotations

import numpy as np
import trimesh

from drakegrasp.arithmetic import dot
from drakegrasp.frames import Array
from drakegrasp.mesh.surfaces import Faces, Solid, face_areas, half_edges

#: Triangles of the hull whose corners are within this distance of a plane are one facet [m].
FLATNESS = 1e-5
#: And whose normals are within this angle of it, as a cosine.
ALIKE = 0.99
#: Width of the rim, as a fraction of the distance from the inner point to the border.
RIM = 0.2


def resting_hull(points: Array, *, rim: float = RIM, small: float = 0.0) -> Solid:
    """Return the convex hull of points (n, 3) [m] as a closed surface that carries well."""
    hull = trimesh.convex.convex_hull(points)
    vertices, faces = np.asarray(hull.vertices), np.asarray(hull.faces, dtype=np.int64)

    corners = [vertices]
    triangles = []
    count = len(vertices)
    for loop, inner in _facets(vertices, faces):
        n = len(loop)
        after = np.roll(loop, -1)
        size = np.ptp(vertices[loop], axis=0).max()
        if n == 3 and size < small:
            triangles.append(loop[None])
            continue
        if rim > 0.0:
            corners.append(inner + (1 - rim) * (vertices[loop] - inner))
            ring = count + np.arange(n)
            ring_after = np.roll(ring, -1)
            count += n
            triangles.append(np.column_stack((loop, after, ring_after)))
            triangles.append(np.column_stack((loop, ring_after, ring)))
            loop, after = ring, ring_after
        corners.append(inner[None])
        triangles.append(np.column_stack((loop, after, np.full(n, count))))
        count += 1
    return Solid(vertices=np.vstack(corners), faces=np.vstack(triangles))


def _facets(vertices: Array, faces: Faces):
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    areas = face_areas(vertices, faces)
    normals = np.cross(b - a, c - a) / np.maximum(2.0 * areas, 1e-300)[:, None]
    free = np.ones(len(faces), dtype=bool)
    for seed in np.argsort(-areas, kind="stable"):
        if not free[seed]:
            continue
        near = np.abs(dot(vertices - a[seed], normals[seed])) <= FLATNESS
        members = np.flatnonzero(
            free & near[faces].all(axis=1) & (dot(normals, normals[seed]) >= ALIKE)
        )
        loop = _border(faces[members])
        if loop is None:
            members = np.array([seed])
            loop = faces[seed]
        free[members] = False
        weight = areas[members, None]
        inner = (weight * vertices[faces[members]].mean(axis=1)).sum(axis=0) / weight.sum()
        yield loop, inner


def _border(faces: Faces) -> Faces | None:
    """Return the corners (n,) of the one border of a patch, in their order; None if it has more."""
    halves = half_edges(faces)
    inner = set(map(tuple, halves.tolist()))
    follow = {a: b for a, b in inner if (b, a) not in inner}
    if sum((b, a) not in inner for a, b in inner) != len(follow):
        return None
    start = next(iter(follow))
    loop = [start]
    while (after := follow[loop[-1]]) != start:
        loop.append(after)
        if len(loop) > len(follow):
            return None
    return np.array(loop) if len(loop) == len(follow) else None
