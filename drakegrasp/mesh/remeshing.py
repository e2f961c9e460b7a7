"""Remeshing: a surface comes in; about the same surface, with other triangles, goes out.

`decimate` reduces a solid to what Drake simulates. `coarsen` is applied before a file is repaired,
which takes kilobytes for each face: a scan may have far more faces than a fingertip feels or a
camera sees.

The other functions prepare surfaces that support an object. Each face of a rigid hydroelastic
surface yields one contact polygon, and each polygon has one point of force: a base of two triangles
is supported at two points and tips over; a base of many small faces is supported nearly up to its
rim. So `resting_hull` divides each plane facet of a convex hull into a narrow rim, by which it is
supported near its border, and a fan of few triangles inside it: with fans only, boxes and cylinders
that are set down from 2 mm fall over. `subdivide` splits long edges.
"""

from __future__ import annotations

import math

import fast_simplification
import numpy as np
import trimesh

from drakegrasp.arithmetic import dot
from drakegrasp.errors import MeshError
from drakegrasp.frames import Array
from drakegrasp.mesh.components import edge_ids, find_components, part_touching_edges
from drakegrasp.mesh.repair import weld
from drakegrasp.mesh.surfaces import (
    MAX_OVERLAP,
    Faces,
    Solid,
    compact,
    diagonal,
    even_points,
    face_areas,
    from_manifold,
    half_edges,
    is_solid_surface,
    on_faces,
    overlap_share,
    signed_volume,
    split_faces,
    stack,
    to_manifold,
    unit_normals,
)

#: Aggressiveness of the quadric decimation, best quality first.
DECIMATION_STEPS = (2.0, 3.0, 5.0, 7.0)
#: Deviation, as a fraction of the diagonal, above which the second method is tried.
FAITHFUL = 2e-3
#: Deviation [m] above which the methods for scans are tried as well.
COARSE = 2e-3
#: Target of the methods for scans, as a fraction of the allowed faces, since parting adds some; and
#: the larger target of a first decimation, after which fewer spikes of noise are left.
PARTED, FIRST = 0.97, 5.0 / 3.0
#: Fraction of its volume that a decimated mesh may gain or lose.
MAX_VOLUME_CHANGE = 0.05
#: Number of points on each surface at which the deviation of two surfaces is measured.
DEVIATION_POINTS = 3000


def decimate(solid: Solid, max_faces: int) -> tuple[Solid, float]:
    """Return a solid with at most `max_faces` faces, and its deviation [m] from the original.

    Quadric decimation (Garland and Heckbert 1997) keeps the shape better, but does not guarantee a
    closed surface; manifold3d's simplification does. The latter is tried if the former fails or
    deviates by more than `FAITHFUL`. If both fail or deviate by more than `COARSE`, as for noisy
    thin walls, quadric decimation is tried again, with its surface parted where it then touches
    itself. The closest result is returned.

    Raises:
        MeshError: If no method yields a closed surface of about the same volume.
    """
    if len(solid.faces) <= max_faces:
        return solid, 0.0

    # Keep the closest valid result; the first that is close enough ends the search.
    faithful = FAITHFUL * diagonal(solid.vertices)
    best: tuple[Solid, float] | None = None
    for candidate, enough in (
        (_decimate_quadric, faithful),
        (_simplify_manifold, max(faithful, COARSE)),
        (_decimate_parted, max(faithful, COARSE)),
        (_decimate_twice, 0.0),
    ):
        reduced = candidate(solid, max_faces)
        if reduced is not None and _is_sound(reduced, solid):
            error = surface_deviation(solid, reduced)
            if best is None or error < best[1]:
                best = reduced, error
        if best is not None and best[1] <= enough:
            break

    if best is None:
        raise MeshError(
            f"the collision mesh must keep its shape with at most {max_faces} faces, got a broken "
            f"one from {len(solid.faces)}: raise max_collision_faces"
        )
    return best


def surface_deviation(first: Solid, second: Solid) -> float:
    """Return the largest distance between two surfaces [m], in both directions, at fixed points."""
    meshes = [trimesh.Trimesh(s.vertices, s.faces, process=False) for s in (first, second)]
    worst = 0.0
    for mesh, other in (meshes, meshes[::-1]):
        # Points evenly spread over the faces, and vertices, at which the deviation is largest.
        points = on_faces(mesh.vertices, mesh.faces, even_points(DEVIATION_POINTS))[0]
        points = np.vstack((points, some_vertices(mesh.vertices)))
        worst = max(worst, float(trimesh.proximity.closest_point(other, points)[1].max()))
    return worst


def some_vertices(vertices: Array) -> Array:
    """Return at most `DEVIATION_POINTS` of the vertices (n, 3), evenly spaced in their order."""
    count = min(DEVIATION_POINTS, len(vertices))
    return vertices[np.linspace(0, len(vertices) - 1, count).astype(int)]


def _is_sound(reduced: Solid, solid: Solid) -> bool:
    """Return whether a surface bounds a solid of about the same volume."""
    volume = signed_volume(solid.vertices, solid.faces)
    change = signed_volume(reduced.vertices, reduced.faces) / volume - 1.0
    return (
        is_solid_surface(reduced.faces)
        and abs(change) < MAX_VOLUME_CHANGE
        and overlap_share(reduced.vertices, reduced.faces) < MAX_OVERLAP
    )


def _decimate_quadric(solid: Solid, max_faces: int) -> Solid | None:
    """Return the result of the least aggressive decimation that has few enough faces, or None."""
    for aggressiveness in DECIMATION_STEPS:
        vertices, faces = _simplify(solid, max_faces, aggressiveness)
        if 0 < len(faces) <= max_faces:
            # Walls that now touch share edges; separating the walls closes both again.
            components = find_components(vertices, faces, [])
            return stack([(part.vertices, part.faces) for part in components])
    return None


def _decimate_parted(solid: Solid, max_faces: int) -> Solid | None:
    """Return the least aggressive decimation, parted where its surface touches itself, or None."""
    target = int(PARTED * max_faces)
    if len(solid.faces) <= target:
        return solid  # fast_simplification rejects a target above the number of faces
    for aggressiveness in DECIMATION_STEPS:
        reduced = reduce_and_part(solid, target, aggressiveness)
        if 0 < len(reduced.faces) <= max_faces:
            return reduced
    return None


def _decimate_twice(solid: Solid, max_faces: int) -> Solid | None:
    """Return `_decimate_parted` of a surface that was first reduced to somewhat more faces."""
    between = int(FIRST * max_faces)
    if len(solid.faces) <= between:
        return None  # fast_simplification rejects a target above the number of faces
    return _decimate_parted(reduce_and_part(solid, between, DECIMATION_STEPS[0]), max_faces)


def reduce_and_part(solid: Solid, target: int, aggressiveness: float) -> Solid:
    """Return a quadric decimation without duplicate faces and touching edges.

    Args:
        solid: The surface, which has more faces than `target`.
        target: Desired number of faces.
        aggressiveness: How fast the error may grow from round to round, see `DECIMATION_STEPS`.
    """
    vertices, faces = part_touching_edges(*weld(*_simplify(solid, target, aggressiveness)))
    return Solid(vertices=vertices, faces=faces)


def _simplify(solid: Solid, target: int, aggressiveness: float) -> tuple[Array, Faces]:
    """Return vertices and faces of a quadric decimation, see `reduce_and_part`."""
    vertices, faces = fast_simplification.simplify(
        np.ascontiguousarray(solid.vertices),
        np.ascontiguousarray(solid.faces),
        target_count=target,
        agg=aggressiveness,
    )
    return np.asarray(vertices, dtype=np.float64), np.asarray(faces, dtype=np.int64)


def _simplify_manifold(solid: Solid, max_faces: int) -> Solid | None:
    """Return the simplification of smallest tolerance with few enough faces, by bisection."""
    source = to_manifold(solid.vertices, solid.faces).as_original()
    low, high = 1e-6 * diagonal(solid.vertices), 0.05 * diagonal(solid.vertices)
    best = None
    for _ in range(14):
        middle = math.sqrt(low * high)
        reduced = source.simplify(middle)
        if 0 < reduced.num_tri() <= max_faces:
            best, high = reduced, middle
        else:
            low = middle
    return None if best is None else stack([from_manifold(best)])


# Before repair

#: Number of faces to which a surface with more is reduced: edges of 0.9 mm on a ball of 10 cm; and
#: the largest number, because decimation takes much memory as well.
MOST_FACES, MOST_READ = 100_000, 1_000_000


def coarsen(vertices: Array, faces: Faces) -> tuple[Array, Faces, tuple[str, ...]]:
    """Return a surface with at most about `MOST_FACES` faces, and a sentence about what was done.

    The surface may be open and consist of several pieces.

    Args:
        vertices: (n, 3) [m].
        faces: (m, 3), as `weld` returns them.

    Raises:
        MeshError: If it has more than `MOST_READ` faces.
    """
    if len(faces) <= MOST_FACES:
        return vertices, faces, ()
    if len(faces) > MOST_READ:
        raise MeshError(
            f"a mesh must have at most {MOST_READ:,} faces, got {len(faces):,}: reduce it with "
            "another program"
        )

    # The least aggressive decimation with few enough faces.
    solid = Solid(vertices=vertices, faces=faces)
    for aggressiveness in DECIMATION_STEPS:
        fewer, new = weld(*_simplify(solid, MOST_FACES, aggressiveness))
        if 0 < len(new) <= 1.05 * MOST_FACES:
            break

    # In millimetres: trimesh (5) treats triangles with edges below a millimetre as degenerate.
    surface = trimesh.Trimesh(1e3 * fewer, new, process=False)
    deviation = trimesh.proximity.closest_point(surface, 1e3 * some_vertices(vertices))[1].max()
    note = f"its {len(faces):,} faces were reduced to {len(new):,}, within {deviation:.2g} mm"
    return fewer, new, (note,)


# Surfaces that support

#: Triangles of the hull belong to one facet if their corners are this close to the plane of the
#: facet's largest triangle [m], and the cosine between their normals is at least this.
FLATNESS, ALIKE = 1e-5, 0.99
#: Facets with a smaller extent are not changed [m].
SMALL = 0.01
#: Width of the rim, as a fraction of the way from the border to the inner point, and the largest
#: number of corners of the ring inside it.
RIM, RING = 0.1, 8


def resting_hull(points: Array) -> Solid:
    """Return the convex hull of points (n, 3) [m] as a closed surface, its facets as rims and fans.

    Facets that are plane within `FLATNESS` keep only the corners of their border.
    """
    hull = trimesh.convex.convex_hull(points)
    vertices, faces = np.asarray(hull.vertices), np.asarray(hull.faces, dtype=np.int64)
    # trimesh merges vertices that nearly coincide, which leaves triangles without an area.
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    blocks, triangles, count = [vertices], list[Faces](), len(vertices)
    for facet in _facets(vertices, faces):
        border = _border(facet)
        if border is None or np.ptp(vertices[border], axis=0).max() < SMALL:
            triangles.append(facet)
            continue

        # The inner point is the centroid: facets are convex.
        corners = vertices[border]
        weights = face_areas(vertices, facet)
        centroid = dot(vertices[facet].mean(axis=1).T, weights) / weights.sum()

        # A rim of narrow triangles between the border and a ring of a few of its corners.
        size = min(len(border), RING)
        picked = np.arange(size) * len(border) // size
        ring = count + np.arange(size)
        ring_after = np.roll(ring, -1)
        nearest = ring[np.searchsorted(picked, np.arange(len(border)), side="right") - 1]
        triangles.append(np.column_stack((border, np.roll(border, -1), nearest)))
        triangles.append(np.column_stack((ring, border[np.roll(picked, -1)], ring_after)))
        blocks.append(corners[picked] + RIM * (centroid - corners[picked]))
        count += size

        # The fan.
        triangles.append(np.column_stack((ring, ring_after, np.full(size, count))))
        blocks.append(centroid[None])
        count += 1
    vertices, faces = compact(np.vstack(blocks), np.vstack(triangles))
    return Solid(vertices=vertices, faces=faces)


def _facets(vertices: Array, faces: Faces) -> list[Faces]:
    """Return the facets of a convex surface, each as its triangles (m, 3), largest first."""
    areas, normals = face_areas(vertices, faces), unit_normals(vertices[faces])

    # The largest remaining triangle takes all triangles in its plane.
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
    """Return the corners (n,) around a facet in order; None if it has several borders."""
    halves = {(int(start), int(end)) for start, end in half_edges(facet)}
    rim = [(start, end) for start, end in halves if (end, start) not in halves]
    after = dict(rim)
    if len(after) < len(rim):
        return None
    corners = [min(after)]
    while (corner := after[corners[-1]]) != corners[0]:
        corners.append(corner)
    return np.array(corners) if len(corners) == len(rim) else None


#: An edge that exceeds the limit only by rounding is not split.
TOLERANCE = 1e-9


def subdivide(solid: Solid, max_edge: float, max_faces: int) -> Solid:
    """Return the same surface with no edge longer than `max_edge` [m].

    All edges that are too long are split at their midpoints, in both of their faces, until none is
    left. So no vertex is inside another face's edge, and a closed surface stays closed. The old
    vertices come first, in their order.

    If this results in more than `max_faces` faces, the limit is raised in steps of a quarter until
    it does not; a surface that already has more is not changed.
    """
    while True:
        finer = _split_long_edges(solid, max_edge, max(max_faces, len(solid.faces)))
        if finer is not None:
            return finer
        max_edge *= 1.25


def _split_long_edges(solid: Solid, max_edge: float, max_faces: int) -> Solid | None:
    """Return the surface without longer edges, or None if it would have too many faces."""
    vertices, faces = solid.vertices, solid.faces
    limit = (max_edge * (1.0 + TOLERANCE)) ** 2
    while len(faces) <= max_faces:
        # The ends of each edge, from one of its two half-edges, and which edges are too long.
        ids, counts = edge_ids(faces)
        ends = np.empty((len(counts), 2), dtype=np.int64)
        ends[ids] = np.sort(half_edges(faces), axis=1)
        along = vertices[ends[:, 1]] - vertices[ends[:, 0]]
        long = dot(along, along) > limit
        if not long.any():
            return Solid(vertices=vertices, faces=faces, notes=solid.notes)

        # A vertex at the centre of each such edge, for the faces on both sides.
        midpoint = np.full(len(counts), -1, dtype=np.int64)
        midpoint[long] = len(vertices) + np.arange(int(long.sum()))
        new = (vertices[ends[long, 0]] + vertices[ends[long, 1]]) / 2.0
        vertices = np.vstack((vertices, new))
        faces = split_faces(vertices, faces, midpoint[ids].reshape(-1, 3))
    return None
