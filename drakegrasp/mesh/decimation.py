"""Decimation: a solid comes in; one with fewer faces and its deviation go out."""

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
