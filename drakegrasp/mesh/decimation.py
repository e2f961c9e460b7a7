"""Decimation: a surface comes in; one with fewer faces and its deviation go out.

`decimate` makes what Drake simulates of a solid. `coarsen` comes before a file is mended: mending
takes kilobytes for each face, and a scan may have millions of them, far finer than what a fingertip
feels or a camera sees. It merges near vertices first, as quadric decimation itself takes much
memory, and that does the rest; a surface of at most `MOST_FACES` faces stays as it is.
"""

from __future__ import annotations

import math

import fast_simplification
import numpy as np
import trimesh

from drakegrasp.errors import MeshError
from drakegrasp.frames import Array
from drakegrasp.mesh.components import find_components, part_touching_edges
from drakegrasp.mesh.repair import weld
from drakegrasp.mesh.surfaces import (
    MAX_OVERLAP,
    Faces,
    Solid,
    connect,
    diagonal,
    even_points,
    from_manifold,
    is_solid_surface,
    on_faces,
    overlap_share,
    signed_volume,
    stack,
    to_manifold,
)
from drakegrasp.runtime.environment import release_memory

#: Aggressiveness of the quadric decimation, best quality first.
DECIMATION_STEPS = (2.0, 3.0, 5.0, 7.0)
#: Deviation, as a fraction of the diagonal, above which the second method is tried.
FAITHFUL = 2e-3
#: Deviation above which the ways for scans are tried too [m].
COARSE = 2e-3
#: The ways for scans aim at this fraction of the faces that are allowed, as parting adds some; and
#: at so many times as many first: then fewer spikes of noise are left.
PARTED, FIRST = 0.97, 5.0 / 3.0
#: Fraction of its volume that a decimated mesh may gain or lose.
MAX_VOLUME_CHANGE = 0.05
#: Points on each surface at which the deviation of two surfaces is measured.
DEVIATION_POINTS = 3000


def decimate(solid: Solid, max_faces: int) -> tuple[Solid, float]:
    """Return a solid with at most `max_faces` faces, and its deviation from the given one [m].

    Quadric decimation (Garland and Heckbert 1997) keeps the shape better, but does not guarantee
    a closed surface; manifold3d's simplification does. The second is tried where the first fails
    or deviates by more than `FAITHFUL`. Where both fail or deviate by more than `COARSE`, as with
    noisy thin walls, quadric decimation follows whose surface is parted where it then touches
    itself. The closest result wins.

    Raises:
        MeshError: If none gives a closed surface of about the same volume.
    """
    if len(solid.faces) <= max_faces:
        return solid, 0.0

    # The closest sound result; the first that is close enough ends the search.
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
    """Return the largest distance between two surfaces [m], both ways, at fixed points."""
    meshes = [trimesh.Trimesh(s.vertices, s.faces, process=False) for s in (first, second)]
    worst = 0.0
    for mesh, other in (meshes, meshes[::-1]):
        # Points evenly spread over the faces, and vertices, where the deviation is largest.
        points = on_faces(mesh.vertices, mesh.faces, even_points(DEVIATION_POINTS))[0]
        points = np.vstack((points, some_vertices(mesh.vertices)))
        worst = max(worst, float(trimesh.proximity.closest_point(other, points)[1].max()))
    return worst


def some_vertices(vertices: Array) -> Array:
    """Return at most `DEVIATION_POINTS` of the vertices (n, 3), spread over their order."""
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
    """Return the result of the least aggressive decimation that gives few enough faces."""
    for aggressiveness in DECIMATION_STEPS:
        vertices, faces = _simplify(solid, max_faces, aggressiveness)
        if 0 < len(faces) <= max_faces:
            # Walls that have come to touch now share edges; separating them closes both again.
            components = find_components(vertices, faces, [])
            return stack([(part.vertices, part.faces) for part in components])
    return None


def _decimate_parted(solid: Solid, max_faces: int) -> Solid | None:
    """Return the least aggressive decimation, parted where its surface touches itself."""
    target = int(PARTED * max_faces)
    if len(solid.faces) <= target:
        return solid  # fast_simplification refuses to aim at more faces than there are
    for aggressiveness in DECIMATION_STEPS:
        reduced = reduce_and_part(solid, target, aggressiveness)
        if 0 < len(reduced.faces) <= max_faces:
            return reduced
    return None


def _decimate_twice(solid: Solid, max_faces: int) -> Solid | None:
    """Return what `_decimate_parted` makes of a surface with somewhat more faces."""
    between = int(FIRST * max_faces)
    if len(solid.faces) <= between:
        return None  # fast_simplification refuses to aim at more faces than there are
    return _decimate_parted(reduce_and_part(solid, between, DECIMATION_STEPS[0]), max_faces)


def reduce_and_part(solid: Solid, target: int, aggressiveness: float) -> Solid:
    """Return a quadric decimation without duplicate faces and touching edges.

    Args:
        solid: The surface, which has more faces than `target`.
        target: Number of faces to aim at.
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
    """Return the result of the smallest tolerance that gives few enough faces, by bisection."""
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


# Before mending

#: Faces above which a surface is reduced, to about as many: edges of 0.9 mm on a ball of 10 cm.
MOST_FACES = 100_000
#: Faces above which near vertices are merged first, to at most as many.
MOST_DECIMATED = 300_000
#: Cells in which vertices are merged: the first edge, as a fraction of the diagonal, and the factor
#: from one try to the next. Products, so that every machine has the same.
FIRST_CELL, CELL_FACTOR = 1.0 / 8192.0, 1.25


def coarsen(vertices: Array, faces: Faces) -> tuple[Array, Faces, tuple[str, ...]]:
    """Return a surface with about `MOST_FACES` faces at most, and what was done in a sentence.

    It may be open, and need not be of one piece.

    Args:
        vertices: (n, 3) [m].
        faces: (m, 3), as `weld` returns them.
    """
    if len(faces) <= MOST_FACES:
        return vertices, faces, ()

    # The allocator keeps what reading the file took.
    release_memory()

    # What is too much for quadric decimation is clustered first.
    solid = Solid(vertices=vertices, faces=faces)
    if len(faces) > MOST_DECIMATED:
        solid = _cluster(vertices, faces)

    # The least aggressive decimation that gives few enough faces; what it parts adds some.
    if len(solid.faces) > MOST_FACES:
        full = solid
        for aggressiveness in DECIMATION_STEPS:
            solid = reduce_and_part(full, MOST_FACES, aggressiveness)
            if 0 < len(solid.faces) <= 1.05 * MOST_FACES:
                break

    release_memory()
    deviation = _deviation(vertices, solid)
    note = (
        f"its {len(faces):,} faces were reduced to {len(solid.faces):,}, within "
        f"{deviation * 1e3:.2g} mm"
    )
    return solid.vertices, solid.faces, (note,)


def _cluster(vertices: Array, faces: Faces) -> Solid:
    """Return a surface with at most `MOST_DECIMATED` faces by merging near vertices.

    After Rossignac and Borrel 1993, "Multi-resolution 3D approximations for rendering complex
    scenes": vertices in the same cell of a grid become their mean. Only those that edges join
    within the cell do here, so that two sheets of surface that lie close to each other stay two.
    """
    low, cell = vertices.min(axis=0), FIRST_CELL * diagonal(vertices)
    while True:
        # Of a closed surface, vertices are half as many as faces.
        key = _cells(vertices - low, cell)
        if len(np.unique(key)) <= MOST_DECIMATED // 2:
            merged = weld(*_merge(vertices, faces, key))
            if len(merged[1]) <= MOST_DECIMATED:
                return Solid(vertices=merged[0], faces=merged[1])
        cell *= CELL_FACTOR


def _cells(points: Array, cell: float) -> Faces:
    """Return the number of the cell of each point (n,) in a grid of cubes with an edge `cell`."""
    x, y, z = np.floor(points / cell).astype(np.int64).T
    return np.asarray((x * (int(y.max()) + 1) + y) * (int(z.max()) + 1) + z)


def _merge(vertices: Array, faces: Faces, key: Faces) -> tuple[Array, Faces]:
    """Return a surface whose vertices that edges join within a cell are one, at their mean."""
    # The edges within cells, from each corner to the next.
    pairs = []
    for corner in range(3):
        a, b = faces[:, corner], faces[:, (corner + 1) % 3]
        within = key[a] == key[b]
        pairs.append(np.stack((a[within], b[within])).astype(np.int32))
    first, second = np.concatenate(pairs, axis=1)
    count, cluster = connect(first, second, len(vertices))

    sizes = np.bincount(cluster, minlength=count)
    means = [np.bincount(cluster, vertices[:, axis], count) / sizes for axis in range(3)]
    faces = cluster[faces].astype(np.int64)
    return np.column_stack(means), faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]


def _deviation(vertices: Array, solid: Solid) -> float:
    """Return how far some vertices of the full surface are at most from the reduced one [m]."""
    # In millimetres: trimesh (5) takes triangles with edges below a millimetre for degenerate.
    surface = trimesh.Trimesh(1e3 * solid.vertices, solid.faces, process=False)
    points = 1e3 * some_vertices(vertices)
    return float(trimesh.proximity.closest_point(surface, points)[1].max()) / 1e3
