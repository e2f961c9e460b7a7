"""Signed distances from an object's surface on a grid, for many points at a time.

Input: a closed surface of triangles. Output: a `DistanceField`. The simulation uses Drake's exact
distances; this field decides for many poses at once what need not be simulated. Its error is a
fraction of the grid's spacing, see `DistanceField.error`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import trimesh
from scipy.ndimage import distance_transform_edt

from drakegrasp.arithmetic import cube_root, norm
from drakegrasp.frames import Array
from drakegrasp.mesh.surfaces import cover_triangles, enumerate_pairs

Distances = npt.NDArray[np.float32]

#: Approximate number of cells; it determines the spacing, so that all objects take equally long.
CELLS = 800_000
#: Smallest spacing of a grid [m], because the collision mesh is not finer.
FINEST = 1.5e-3
#: Empty cells around the bounding box on each side.
PADDING = 4
#: Within this many cells of the surface, distances are from a triangle instead of a point on it.
BAND = 2.5
#: Number of grid points per chunk of these distances; all at once would take hundreds of megabytes.
BAND_CHUNK = 20_000
#: Error of `nearest` in cells: half of a cell's diagonal plus the error of the stored distances.
ERROR_CELLS = 1.3
#: Distance between the points that cover the surface, as a fraction of the grid's spacing.
DENSITY = 0.7


@dataclass(frozen=True, kw_only=True, eq=False)
class DistanceField:
    """Signed distances from a surface, negative inside, at the points of a grid.

    Attributes:
        origin: (3,), the first grid point in {O} [m].
        spacing: Distance between neighbouring grid points [m].
        values: (nx, ny, nz), signed distances [m].
        lower: (3,), lowest corner of the object's bounding box in {O} [m].
        upper: (3,), highest corner of the bounding box in {O} [m].
    """

    origin: Array
    spacing: float
    values: Distances
    lower: Array
    upper: Array

    @property
    def error(self) -> float:
        """Largest error of `nearest` [m].

        `interpolate` is several times better near a surface that is smooth on the scale of a cell,
        but no better than this at a wall thinner than a cell.
        """
        return ERROR_CELLS * self.spacing

    @property
    def blur(self) -> float:
        """Largest error of `interpolate` at walls and slots thinner than a cell [m].

        A wall thinner than a cell may contain no grid point; the field is then spacing / 2 on its
        surface.
        """
        return self.spacing / 2.0

    def nearest(self, x: Distances, y: Distances, z: Distances) -> Distances:
        """Return the distances [m] that are stored at the nearest grid points.

        Outside of the grid they are lower bounds.

        Args:
            x: Coordinates in {O} [m], of any shape.
            y: Coordinates of the same shape.
            z: Coordinates of the same shape.
        """
        scale = np.float32(1.0 / self.spacing)
        index = np.zeros(np.shape(x), dtype=np.int32)
        beside = np.full(np.shape(x), -np.inf, dtype=np.float32)
        for axis, value in enumerate((x, y, z)):
            # Distance from the bounding box along the axis on which it is largest.
            lower, upper = np.float32(self.lower[axis]), np.float32(self.upper[axis])
            np.maximum(beside, lower - value, out=beside)
            np.maximum(beside, value - upper, out=beside)

            # Flat index of the nearest grid point.
            cell = (value - np.float32(self.origin[axis])) * scale
            cell += np.float32(0.5)
            count = self.values.shape[axis]
            np.clip(cell, np.float32(0.0), np.float32(count - 1), out=cell)
            index *= np.int32(count)
            index += cell.astype(np.int32)
        return np.asarray(np.maximum(self.values.ravel().take(index), beside))

    def interpolate(self, x: Distances, y: Distances, z: Distances) -> Distances:
        """Return distances [m] by trilinear interpolation in the grid's cells.

        Outside of the grid they are the distances at the nearest point of the grid.

        Args:
            x: Coordinates in {O} [m], of any shape.
            y: Coordinates of the same shape.
            z: Coordinates of the same shape.
        """
        # Flat index of each cell's lowest corner, and the position within the cell, 0 to 1.
        scale = np.float32(1.0 / self.spacing)
        index = np.zeros(np.shape(x), dtype=np.int32)
        parts = []
        for value, start, count in zip((x, y, z), self.origin, self.values.shape, strict=True):
            cells = np.clip((value - np.float32(start)) * scale, 0, np.float32(count) - 1.001)
            cell = cells.astype(np.int32)
            index *= np.int32(count)
            index += cell
            parts.append(cells - cell)

        # Interpolate along z, then y, then x.
        flat = self.values.ravel()
        _, ny, nz = self.values.shape
        steps = (ny * nz, nz, 1)
        fx, fy, fz = parts

        def along_z(base: npt.NDArray[np.int32]) -> Distances:
            low = flat.take(base)
            return np.asarray(low + (flat.take(base + steps[2]) - low) * fz)

        def along_y(base: npt.NDArray[np.int32]) -> Distances:
            low = along_z(base)
            return np.asarray(low + (along_z(base + steps[1]) - low) * fy)

        low = along_y(index)
        return np.asarray(low + (along_y(index + steps[0]) - low) * fx)


def make_distance_field(vertices: npt.ArrayLike, faces: npt.ArrayLike) -> DistanceField:
    """Return the distance field of a closed surface.

    Args:
        vertices: (n, 3) [m].
        faces: (m, 3), counter-clockwise seen from outside.
    """
    v = np.asarray(vertices, dtype=float)
    triangles = v[np.asarray(faces)]
    lower, upper = v.min(axis=0), v.max(axis=0)
    spacing = FINEST
    # The spacing is chosen for about CELLS cells; the padding depends on it, hence the iterations.
    for _ in range(4):
        room = upper - lower + 2 * PADDING * spacing
        spacing = max(FINEST, cube_root(float(np.prod(room)) / CELLS))

    # An odd fraction of a cell keeps corners and edges of modelled objects off the grid's columns.
    origin = lower - (PADDING - 0.3819) * spacing
    shape = tuple(np.ceil((upper - origin) / spacing).astype(int) + PADDING)

    distance = _unsigned(triangles, origin, spacing, shape)
    inside = _inside(triangles, origin, spacing, shape)
    values = np.where(inside, -distance, distance).astype(np.float32)
    values.setflags(write=False)
    return DistanceField(origin=origin, spacing=spacing, values=values, lower=lower, upper=upper)


def _unsigned(triangles: Array, origin: Array, spacing: float, shape: tuple[int, ...]) -> Distances:
    """Return the distance of each grid point from the surface [m], an array of `shape`.

    A grid point is a seed if a point of the surface is in the cell around it. A distance transform
    finds the nearest seed of each grid point. The distance is measured from the seed's surface
    point or, near the surface, from the triangle of this surface point.
    """
    # Seeds: one surface point for each cell that has any.
    points, owner = cover_triangles(triangles, DENSITY * spacing)
    cell = np.floor((points - origin) / spacing + 0.5).astype(np.int64)
    flat = np.ravel_multi_index(tuple(cell.T), shape)
    seeds, first = np.unique(flat, return_index=True)

    # The nearest seed of each grid point, and its distance in cells.
    empty = np.ones(shape, dtype=bool)
    empty.ravel()[seeds] = False
    far, nearest = distance_transform_edt(empty, return_indices=True)
    seed_of = np.zeros(shape, dtype=np.int32)
    seed_of.ravel()[seeds] = np.arange(len(seeds), dtype=np.int32)
    seed = seed_of[tuple(nearest)]

    # The distance from the seed's surface point.
    grid = np.indices(shape, dtype=np.float32)
    squared = np.zeros(shape, dtype=np.float32)
    sample = points[first].astype(np.float32)
    for axis in range(3):
        coordinate = grid[axis] * np.float32(spacing) + np.float32(origin[axis])
        squared += (coordinate - sample[seed, axis]) ** 2
    distance = np.sqrt(squared)

    # Near the surface, the distance from the triangle.
    band = np.flatnonzero(far.ravel() <= BAND)
    for start in range(0, len(band), BAND_CHUNK):
        chunk = band[start : start + BAND_CHUNK]
        at = np.column_stack(np.unravel_index(chunk, shape)) * spacing + origin
        near = triangles[owner[first[seed.ravel()[chunk]]]]
        on_triangle = trimesh.triangles.closest_point(near, at)
        distance.ravel()[chunk] = norm(at - on_triangle)
    return distance


def _inside(
    triangles: Array, origin: Array, spacing: float, shape: tuple[int, ...]
) -> npt.NDArray[np.bool_]:
    """Return which grid points are inside a closed surface, an array of `shape`.

    On the way up a column of grid points, a triangle that faces down is an entry and one that faces
    up is an exit; the sum of both is the winding number.
    """
    # All pairs of a triangle and a column (x, y) within its bounding rectangle, in cells.
    flat = (triangles - origin) / spacing
    low = np.ceil(flat[:, :, :2].min(axis=1)).astype(int)
    size = np.floor(flat[:, :, :2].max(axis=1)).astype(int) - low + 1
    size = np.maximum(size, 0)
    count = size[:, 0] * size[:, 1]
    t, k = enumerate_pairs(count)
    x, y = low[t, 0] + k // size[t, 1], low[t, 1] + k % size[t, 1]

    # Twice the signed areas of the three triangles between the column and the projected edges: the
    # column passes through the triangle if all have the same sign.
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = np.moveaxis(flat, 0, 2)
    u = (bx[t] - x) * (cy[t] - y) - (cx[t] - x) * (by[t] - y)
    v = (cx[t] - x) * (ay[t] - y) - (ax[t] - x) * (cy[t] - y)
    w = (ax[t] - x) * (by[t] - y) - (bx[t] - x) * (ay[t] - y)
    up = (u >= 0) & (v >= 0) & (w >= 0)
    down = (u <= 0) & (v <= 0) & (w <= 0)
    area = u + v + w
    hit = (up ^ down) & (area != 0.0)
    t, x, y, u, v, w, area = (values[hit] for values in (t, x, y, u, v, w, area))

    # Winding numbers change where a column meets a triangle; sum them up along the column.
    z = (u * az[t] + v * bz[t] + w * cz[t]) / area
    winding = np.zeros(shape, dtype=np.int16)
    np.add.at(winding, (x, y, np.ceil(z).astype(int)), np.where(area < 0.0, 1, -1))
    np.cumsum(winding, axis=2, out=winding)

    # A column exactly through an edge may count the edge twice or not at all, and then does not end
    # at zero: copy the neighbouring column.
    for i, j in np.argwhere(winding[:, :, -1] != 0):
        winding[i, j] = winding[i - 1, j]
    return np.asarray(winding > 0)
