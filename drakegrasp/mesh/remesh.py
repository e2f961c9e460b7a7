"""Remeshing: any triangles that nearly bound a solid come in; a closed surface goes out.

Signed distances are sampled on a lattice, and marching tetrahedra make the surface where they
change sign. What is inside is told by winding numbers, which do not mind holes, walls that
touch, edges with four faces or bodies that overlap (Jacobson et al. 2013). A hole is closed where
the winding number is one half, which is in the plane of a flat hole.
"""

from __future__ import annotations

import manifold3d
import numpy as np
import trimesh
from scipy.spatial import cKDTree

from drakegrasp.arithmetic import norm
from drakegrasp.frames import Array
from drakegrasp.mesh.surfaces import Faces, Solid, cover_triangles, from_manifold, stack
from drakegrasp.mesh.winding import fast_winding_numbers

#: Lattice points, about; they decide the spacing.
POINTS = 700_000
#: No lattice is finer than this [m]: below it is the noise of a scan.
FINEST = 1.2e-3
#: Lattice cells around the bounding box on each side.
PADDING = 2
#: Within so many cells of the surface, a point has a distance of its own.
BAND = 2.6
#: Near a hole the distance is this many cells times the winding number's distance from one half.
BLEND = 6.0
#: A winding number nearer than this to one half is one near a hole, and is not shared.
DOUBT = 0.35
#: Pieces below this fraction of the volume are crumbs between walls that touch.
CRUMB = 1e-3
#: Distance between the points that cover the surface, in cells.
DENSITY = 0.4


def lattice_spacing(vertices: Array) -> float:
    """Return the spacing of the lattice for a surface [m]."""
    room = np.ptp(vertices, axis=0) + 2 * PADDING * FINEST
    return max(FINEST, float(np.cbrt(2.0 * np.prod(room) / POINTS)))


def remesh(vertices: Array, faces: Faces, spacing: float) -> Solid | None:
    """Return the closed surface around what some triangles enclose, or None if that is nothing.

    Args:
        vertices: (n, 3) [m].
        faces: (m, 3), most of them counter-clockwise seen from outside.
        spacing: Of the lattice [m]; thinner walls may be lost.
    """
    # A body-centred lattice, as `level_set` has it: the corners of cubes, and the centres of
    # these and of the cubes around them. Coordinates are odd for corners, even for centres.
    low = vertices.min(axis=0) - (PADDING + 0.3819) * spacing
    counts = np.ceil((vertices.max(axis=0) - low) / spacing).astype(int) + PADDING
    corners = 2 * np.stack(np.indices(tuple(counts + 1)), axis=-1).reshape(-1, 3) + 1
    centres = 2 * np.stack(np.indices(tuple(counts + 2)), axis=-1).reshape(-1, 3)
    halves = np.vstack((corners, centres))
    origin = low - spacing / 2.0

    # The distances at its points; marching looks them up by their coordinates.
    values = np.zeros(tuple(2 * counts + 3))
    values[tuple(halves.T)] = _distances(halves, origin, spacing, vertices, faces)
    table, (_, rows, columns) = values.ravel().tolist(), values.shape
    x0, y0, z0 = origin.tolist()
    scale = 2.0 / spacing

    def at(x: float, y: float, z: float) -> float:
        i, j, k = round((x - x0) * scale), round((y - y0) * scale), round((z - z0) * scale)
        return float(table[(i * rows + j) * columns + k])

    # The wanted edge is a hair shorter than the spacing, or rounding would lose a cell.
    box = [*low.tolist(), *(low + counts * spacing).tolist()]
    solid = manifold3d.Manifold.level_set(at, box, spacing * (1.0 - 1e-9))
    pieces = [p for p in solid.decompose() if p.volume() > CRUMB * solid.volume()]
    return stack([from_manifold(piece) for piece in pieces]) if pieces else None


def _distances(
    halves: Faces, origin: Array, spacing: float, vertices: Array, faces: Faces
) -> Array:
    """Return the signed distances (n,) [m] of lattice points, positive inside.

    Args:
        halves: (n, 3), coordinates in halves of the spacing.
        origin: (3,), where they are zero [m].
        spacing: Of the lattice [m].
        vertices: (k, 3) [m].
        faces: (m, 3).
    """
    # Near the surface: the distance from the triangle on which the nearest of many points lies.
    points = origin + halves * (spacing / 2.0)
    triangles = vertices[faces]
    cover, owner = cover_triangles(triangles, DENSITY * spacing)
    limit = BAND * spacing
    distance, nearest = cKDTree(cover).query(points, distance_upper_bound=limit)
    near = np.isfinite(distance)
    foot = trimesh.triangles.closest_point(triangles[owner[nearest[near]]], points[near])
    distance[near] = norm(points[near] - foot)
    distance[~near] = limit

    # Far from it neighbours share a winding number: no surface lies between them.
    key = np.ravel_multi_index(tuple(halves.T), tuple(halves.max(axis=0) + 5))
    leader = np.ravel_multi_index(tuple(4 * ((halves + 2) // 4).T), tuple(halves.max(axis=0) + 5))
    order = np.argsort(key)
    place = order[np.minimum(np.searchsorted(key[order], leader), len(key) - 1)]
    led = ~near & (key[place] == leader) & ~near[place]
    winding = np.full(len(points), np.nan)
    first = np.unique(np.concatenate((np.flatnonzero(~led), place[led])))
    winding[first] = fast_winding_numbers(points[first], vertices, faces)
    winding[led] = winding[place[led]]

    # But near a hole each has its own.
    doubtful = np.setdiff1d(np.flatnonzero(led & (np.abs(winding - 0.5) < DOUBT)), first)
    if len(doubtful):
        winding[doubtful] = fast_winding_numbers(points[doubtful], vertices, faces)
    inside = winding - 0.5
    return np.asarray(np.sign(inside) * np.minimum(distance, BLEND * spacing * np.abs(inside)))
