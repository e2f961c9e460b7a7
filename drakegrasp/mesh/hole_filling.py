"""Hole filling: a component with open rims comes in, the triangles that close them go out.

Only a flat or a small rim is surely a hole, and is closed; others raise `MeshError`.
"""

from __future__ import annotations

import manifold3d
import numpy as np

from drakegrasp.errors import MeshError
from drakegrasp.frames import Array
from drakegrasp.mesh.components import Component
from drakegrasp.mesh.surfaces import Faces, diagonal, half_edges

#: A rim is planar if it leaves its plane by no more than this fraction of its own size ...
PLANAR = 0.05
#: ... and small if its size is below this fraction of the object's diagonal.
SMALL_RIM = 0.15


def close_rims(component: Component, size: float) -> tuple[list[Faces], int]:
    """Return the triangles that close all rims of a component, and the number of rims.

    Args:
        component: The surface; the triangles use its vertices.
        size: Diagonal of the whole object [m].

    Raises:
        MeshError: If a rim is neither flat nor small, or crosses itself.
    """
    # Large rims first, so that an outer rim comes before the inner ones in its plane.
    vertices = component.vertices
    rims = sorted(_rims(component), key=lambda r: -float(np.linalg.norm(_area_vector(vertices[r]))))
    lids: list[Faces] = []
    holes = 0
    while rims:
        # The plane through the rim, by least squares, with its normal towards the missing side.
        outer = rims.pop(0)
        points = vertices[outer]
        centre, width = points.mean(axis=0), diagonal(points)
        basis = np.linalg.svd(points - centre, full_matrices=False)[2][:2]
        if np.dot(np.cross(basis[0], basis[1]), _area_vector(points)) < 0.0:
            basis = basis[::-1]
        normal = np.cross(basis[0], basis[1])
        off_plane = float(np.abs((points - centre) @ normal).max())
        if off_plane > PLANAR * width and width > SMALL_RIM * size:
            raise MeshError(
                f"open edges must surround a flat or a small hole, got {len(outer)} that span "
                f"{width * 1e3:.3g} mm and leave their plane by {off_plane * 1e3:.3g} mm"
            )

        # A second rim in the same plane, inside the first and running the other way,
        # is the inner edge of a wall: the gap between the two is a ring.
        flat = (points - centre) @ basis.T
        loops, polygons = [outer], [flat]
        for rim in list(rims):
            local = (vertices[rim] - centre) @ basis.T
            away = np.abs((vertices[rim] - centre) @ normal).max()
            backward = float(np.dot(_area_vector(vertices[rim]), normal)) < 0.0
            if away < 1e-3 * width and backward and _inside_polygon(local[0], flat):
                loops.append(rim)
                polygons.append(local)
                rims = [r for r in rims if r is not rim]

        # Triangulate in the plane; a rim that crosses itself covers more than its area.
        triangles = manifold3d.triangulate([np.ascontiguousarray(p) for p in polygons])
        corners = np.vstack(polygons)[triangles]
        u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        covered = np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]).sum() / 2.0
        wanted = sum(_area_vector(np.pad(p, ((0, 0), (0, 1))))[2] for p in polygons)
        if covered > 1.01 * abs(wanted) + 1e-6 * width**2 and width > SMALL_RIM * size:
            raise MeshError(f"the rim of a hole of {width * 1e3:.3g} mm must not cross itself")
        lids.append(np.concatenate(loops)[triangles].astype(np.int64))
        holes += len(loops)
    return lids, holes


def _rims(component: Component) -> list[Faces]:
    """Return the boundary loops as vertex indices, in the direction of the missing faces."""
    # The vertex that follows each vertex; two followers mean that two rims touch.
    open_halves = np.flatnonzero(component.twins < 0)
    ends = half_edges(component.faces)[open_halves]
    after = {int(b): int(a) for a, b in ends}
    if len(after) != len(ends):
        raise MeshError("the rim of a hole must not cross itself")

    # Follow each loop from its lowest vertex.
    loops = []
    while after:
        first = min(after)
        loop = [first]
        while (vertex := after.pop(loop[-1])) != first:
            if vertex not in after:
                raise MeshError("the rim of a hole must be a closed loop")
            loop.append(vertex)
        loops.append(np.array(loop, dtype=np.int64))
    return loops


def _area_vector(points: Array) -> Array:
    """Return the vector area (3,) [m^2] of a closed polygon (n, 3)."""
    centred = points - points.mean(axis=0)
    return np.asarray(np.cross(centred, np.roll(centred, -1, axis=0)).sum(axis=0) / 2.0)


def _inside_polygon(point: Array, polygon: Array) -> bool:
    """Return whether a point (2,) is in a polygon (n, 2), by the crossings of a ray."""
    (x, y), a, b = point, polygon, np.roll(polygon, -1, axis=0)
    crosses = (a[:, 1] > y) != (b[:, 1] > y)
    a, b = a[crosses], b[crosses]
    at = a[:, 0] + (y - a[:, 1]) / (b[:, 1] - a[:, 1]) * (b[:, 0] - a[:, 0])
    return bool((at > x).sum() % 2)
