"""The resting hull: points of a solid come in; their convex hull in triangles that carry goes out.

A face of a rigid hydroelastic surface gives one contact polygon, and a polygon has one point of
force. So each plane facet of the hull becomes a fan of triangles about a point inside it. Within
long edges it has a narrow rim, so that it also carries near its border: on fans alone a box that is
set down from 2 mm falls over.
"""

from __future__ import annotations

import numpy as np
import trimesh

from drakegrasp.arithmetic import dot, norm
from drakegrasp.frames import Array
from drakegrasp.mesh.surfaces import (
    Faces,
    Solid,
    compact,
    face_areas,
    half_edges,
    unit_normals,
)

#: Triangles of the hull are one facet where their corners are this near to the plane of its largest
#: one [m], and their normals agree with its normal to this cosine.
FLATNESS, ALIKE = 1e-5, 0.99
#: Facets of a smaller extent stay as they are; those with a longer edge get a rim [m].
SMALL, LONG = 0.01, 0.02
#: Width of the rim, as a fraction of the way from the border to the inner point.
RIM = 0.1


def resting_hull(points: Array) -> Solid:
    """Return the convex hull of points (n, 3) [m] as a closed surface, its facets as fans.

    Facets that are plane to within `FLATNESS` are made of the corners of their border alone.
    """
    hull = trimesh.convex.convex_hull(points)
    vertices, faces = np.asarray(hull.vertices), np.asarray(hull.faces, dtype=np.int64)
    blocks, triangles, count = [vertices], list[Faces](), len(vertices)
    for facet in _facets(vertices, faces):
        border = _border(facet)
        if border is None or np.ptp(vertices[border], axis=0).max() < SMALL:
            triangles.append(facet)
            continue

        # The inner point is the centroid: facets are convex.
        corners = vertices[border]
        weights = face_areas(vertices, facet)
        centroid = weights @ vertices[facet].mean(axis=1) / weights.sum()

        # Two narrow triangles within each edge.
        if norm(np.roll(corners, -1, axis=0) - corners).max() > LONG:
            inner = count + np.arange(len(border))
            after, inner_after = np.roll(border, -1), np.roll(inner, -1)
            triangles.append(np.column_stack((border, after, inner_after)))
            triangles.append(np.column_stack((border, inner_after, inner)))
            blocks.append(corners + RIM * (centroid - corners))
            border, count = inner, count + len(inner)

        # The fan.
        middle = np.full(len(border), count)
        triangles.append(np.column_stack((border, np.roll(border, -1), middle)))
        blocks.append(centroid[None])
        count += 1
    vertices, faces = compact(np.vstack(blocks), np.vstack(triangles))
    return Solid(vertices=vertices, faces=faces)


def _facets(vertices: Array, faces: Faces) -> list[Faces]:
    """Return the facets of a convex surface, each as its triangles (m, 3), largest first."""
    areas, normals = face_areas(vertices, faces), unit_normals(vertices[faces])

    # The largest triangle that is left takes those in its plane.
    facets, free = [], np.ones(len(faces), dtype=bool)
    for largest in np.argsort(-areas, kind="stable"):
        if free[largest]:
            corner = vertices[faces[largest, 0]]
            near = np.abs(dot(vertices - corner, normals[largest])) <= FLATNESS
            alike = dot(normals, normals[largest]) >= ALIKE
            members = free & alike & near[faces].all(axis=1)
            members[largest] = True
            free &= ~members
            facets.append(faces[members])
    return facets


def _border(facet: Faces) -> Faces | None:
    """Return the corners (n,) around a facet in order; None if it has more than one border."""
    halves = {(int(start), int(end)) for start, end in half_edges(facet)}
    rim = [(start, end) for start, end in halves if (end, start) not in halves]
    after = dict(rim)
    if len(after) < len(rim):
        return None
    corners = [min(after)]
    while (corner := after[corners[-1]]) != corners[0]:
        corners.append(corner)
    return np.array(corners) if len(corners) == len(rim) else None
