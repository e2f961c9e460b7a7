"""Surfaces that carry: a solid comes in; triangles on which it rests as it should go out.

A face of a rigid hydroelastic surface gives one contact polygon, and a polygon has one point of
force: a base of two triangles carries at two points and tips over; one of many small faces carries
nearly up to its rim. So `resting_hull` makes each plane facet of a convex hull a fan of triangles
about a point inside it. Within long edges it has a narrow rim, so that it also carries near its
border: on fans alone a box that is set down from 2 mm falls over. `subdivide` splits long edges.
"""

from __future__ import annotations

import numpy as np
import trimesh

from drakegrasp.arithmetic import dot, norm
from drakegrasp.frames import Array
from drakegrasp.mesh.components import edge_ids
from drakegrasp.mesh.surfaces import (
    Faces,
    Solid,
    compact,
    face_areas,
    half_edges,
    split_faces,
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
