"""Modelling of solids: curves in metres come in, watertight meshes go out.

`trimesh.creation` is not enough: its `revolve` puts the same number of vertices on every ring, so
that a stem gets slivers where a rim gets good triangles, and its `extrude_polygon` needs Shapely.
Here the number of vertices of a ring depends on its circumference. Nothing is random.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import trimesh
from scipy.interpolate import PchipInterpolator

from drakegrasp.frames import Array
from drakegrasp.mesh.surfaces import Faces
from drakegrasp.shapes.modelling.profiles import EDGE, arc_length, ring_angles, ring_size

#: Vertices are rounded to this many decimals [m], in files too. This also hides the rounding
#: errors by which machines differ.
DECIMALS = 7

#: A point nearer to the axis than this lies on it, and no edge is shorter [m].
ON_AXIS = 1e-9


def solid(vertices: npt.ArrayLike, faces: npt.ArrayLike) -> trimesh.Trimesh:
    """Return a mesh with outward winding, rounded vertices and a canonical order of both.

    The order depends on the shape alone, not on how a library numbered it.
    """
    mesh = trimesh.Trimesh(
        np.round(np.asarray(vertices, dtype=float), DECIMALS) + 0.0, faces, process=False
    )
    mesh.merge_vertices(digits_vertex=DECIMALS)
    mesh.update_faces(mesh.nondegenerate_faces(height=0.0))
    mesh.remove_unreferenced_vertices()
    if mesh.volume < 0.0:
        mesh.invert()

    # Sort the vertices, start each face at its lowest one, then sort the faces.
    order = np.lexsort(mesh.vertices.T[::-1])
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    ranked = rank[mesh.faces]
    first = ranked.argmin(axis=1)
    ranked = np.take_along_axis(ranked, (first[:, None] + np.arange(3)) % 3, axis=1)
    ranked = ranked[np.lexsort(ranked.T[::-1])]
    return trimesh.Trimesh(mesh.vertices[order], ranked, process=False)


# From curves.


def revolve(
    profile: npt.ArrayLike, *, edge: float | npt.ArrayLike = EDGE, closed: bool = False
) -> trimesh.Trimesh:
    """Return the solid of revolution about z of a profile (n, 2) of points (r, z) [m].

    Args:
        profile: Outline from one point of the axis to another, or, if `closed`, a loop
            off the axis. Its points become rings: see `resample` and `smooth`.
        edge: Wanted edge length along a ring [m], one for all or one per point.
        closed: Whether the last ring is joined to the first.
    """
    points = np.asarray(profile, dtype=float)
    edges = np.broadcast_to(np.asarray(edge, dtype=float), len(points))
    rings: list[Array] = []
    for (r, z), length in zip(points, edges, strict=True):
        if r < ON_AXIS:
            rings.append(np.array([[0.0, 0.0, z]]))
            continue
        angles = ring_angles(ring_size(float(r), float(length)))
        rings.append(
            np.column_stack([r * np.cos(angles), r * np.sin(angles), np.full(len(angles), z)])
        )
    return skin(rings, closed=closed)


def sweep(
    path: npt.ArrayLike, section: npt.ArrayLike, *, normal: npt.ArrayLike, scale: npt.ArrayLike
) -> trimesh.Trimesh:
    """Return the solid of a section moved along a plane path, with flat ends.

    Args:
        path: Points (k, 3) [m] in a plane.
        section: Closed outline (n, 2) [m] round its origin: first coordinate in the plane
            of the path, across it, second along `normal`.
        normal: Unit normal (3,) of the plane of the path.
        scale: Factor on the section, (), (k,) or, one per coordinate of it, (k, 2).
            Zero makes an end a point.
    """
    points, outline = np.asarray(path, dtype=float), np.asarray(section, dtype=float)
    factors = np.asarray(scale, dtype=float)
    if factors.ndim < 2:
        factors = np.repeat(np.broadcast_to(factors, len(points))[:, None], 2, axis=1)
    binormal = np.asarray(normal, dtype=float)
    tangent = np.gradient(points, arc_length(points), axis=0)
    across = np.cross(binormal, tangent)
    across /= np.linalg.norm(across, axis=1, keepdims=True)

    rings = []
    for point, side, (a, b) in zip(points, across, factors, strict=True):
        ring = point + np.outer(a * outline[:, 0], side) + np.outer(b * outline[:, 1], binormal)
        rings.append(ring if a > 0.0 else point[None])
    # A flat end is a fan round its centre.
    if len(rings[0]) > 1:
        rings.insert(0, points[:1])
    if len(rings[-1]) > 1:
        rings.append(points[-1:])
    return skin(rings, closed=False)


def bar(
    start: npt.ArrayLike,
    end: npt.ArrayLike,
    section: npt.ArrayLike,
    *,
    normal: npt.ArrayLike,
    scale: npt.ArrayLike = ((0.0, 1.0), (1.0, 1.0)),
    edge: float = EDGE,
) -> trimesh.Trimesh:
    """Return a straight bar with rounded ends.

    Args:
        start: Point (3,) [m] in the middle of one end.
        end: Point (3,) [m] in the middle of the other.
        section: As for `sweep`.
        normal: As for `sweep`.
        scale: Thickness along the bar: pairs (fraction of the length, factor).
        edge: Edge length along the bar [m].
    """
    p, q = np.asarray(start, dtype=float), np.asarray(end, dtype=float)
    length = float(np.linalg.norm(q - p))
    along = np.linspace(0.0, 1.0, max(4, round(length / edge)) + 1)
    knots = np.asarray(scale, dtype=float)
    factor = PchipInterpolator(knots[:, 0], knots[:, 1])(along)
    # The end rings are smaller: a bevel instead of a sharp edge.
    factor[[0, -1]] *= 0.8
    return sweep(p + along[:, None] * (q - p), section, normal=normal, scale=factor)


def extrude(section: npt.ArrayLike, profile: npt.ArrayLike) -> trimesh.Trimesh:
    """Return a section (n, 2) [m] raised along z by a profile (k, 2) of points (scale, z [m])."""
    outline = np.asarray(section, dtype=float)
    rings = []
    for scale, z in np.asarray(profile, dtype=float):
        ring = np.column_stack([scale * outline, np.full(len(outline), z)])
        rings.append(ring if scale > 0.0 else np.array([[0.0, 0.0, z]]))
    return skin(rings, closed=False)


def grid_box(extents: npt.ArrayLike, *, centre: npt.ArrayLike, edge: float) -> trimesh.Trimesh:
    """Return a box of `extents` (3,) [m] round `centre` (3,) [m] whose faces are grids."""
    size = np.asarray(extents, dtype=float)
    counts = np.maximum(1, np.round(size / edge).astype(int))
    vertices: list[Array] = []
    faces: list[Faces] = []
    total = 0
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        i, j = np.meshgrid(np.arange(counts[u] + 1), np.arange(counts[v] + 1), indexing="ij")
        number = np.arange(i.size).reshape(i.shape)
        a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
        quads = np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)
        for side in (0.0, 1.0):
            points = np.empty((i.size, 3))
            points[:, axis] = side
            points[:, u], points[:, v] = i.ravel() / counts[u], j.ravel() / counts[v]
            vertices.append((points - 0.5) * size + np.asarray(centre, dtype=float))
            faces.append((quads if side else quads[:, ::-1]) + total)
            total += i.size
    return solid(np.concatenate(vertices), np.concatenate(faces))


def skin(rings: list[Array], *, closed: bool) -> trimesh.Trimesh:
    """Return the surface through rings (n_i, 3) of vertices [m].

    Rings begin at the same angle; a ring of one point is a tip.

    Args:
        rings: In order.
        closed: Whether the last ring is joined to the first.
    """
    starts = np.cumsum([0, *(len(ring) for ring in rings)])
    faces: list[tuple[int, int, int]] = []
    pairs = [(k, k + 1) for k in range(len(rings) - 1)]
    if closed:
        pairs.append((len(rings) - 1, 0))
    for lower, upper in pairs:
        faces += _zip_rings(
            int(starts[lower]), len(rings[lower]), int(starts[upper]), len(rings[upper])
        )
    return solid(np.concatenate(rings), np.array(faces))


def _zip_rings(a0: int, a_size: int, b0: int, b_size: int) -> list[tuple[int, int, int]]:
    """Return the triangles between two rings of vertex numbers, stepping on the one behind."""
    a_steps, b_steps = (size if size > 1 else 0 for size in (a_size, b_size))
    faces = []
    i = j = 0
    while i < a_steps or j < b_steps:
        a, b = a0 + i % a_size, b0 + j % b_size
        if j == b_steps or (i < a_steps and (2 * i + 1) * b_size <= (2 * j + 1) * a_size):
            faces.append((a, a0 + (i + 1) % a_size, b))
            i += 1
        else:
            faces.append((a, b0 + (j + 1) % b_size, b))
            j += 1
    return faces
