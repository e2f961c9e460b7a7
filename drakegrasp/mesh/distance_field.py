"""How far points are from an object's surface: signed distances on a grid, looked up in bulk.

In: a closed surface of triangles. Out: a `DistanceField`. Simulating asks Drake, which is exact;
this is for deciding in bulk what need not be simulated. Its error is a part of the grid's spacing:
see `DistanceField.error`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import trimesh
from scipy.ndimage import distance_transform_edt

from drakegrasp.arithmetic import multiply, norm
from drakegrasp.frames import Array

Distances = npt.NDArray[np.float32]
Faces = npt.NDArray[np.int32]

#: Cells of a grid, about; they decide its spacing, so that every object costs the same.
CELLS = 800_000
#: No grid is finer than this [m]: the collision mesh itself is not.
FINEST = 1.5e-3
#: Empty cells around the bounding box on each side.
PADDING = 4
#: Cells from the surface up to which distances are those to a triangle, not to a point on it.
BAND = 2.5
#: Points for which triangles are measured at a time: all of them would take hundreds of megabytes.
BAND_CHUNK = 20_000
#: Error of a look-up at the nearest grid point in cells: half of a cell's diagonal, and what the
#: grid's own distances may be wrong by.
ERROR_CELLS = 1.3
#: Part of a spacing between points by which the surface is found in the grid.
DENSITY = 0.7


@dataclass(frozen=True, kw_only=True, eq=False)
class DistanceField:
    """Signed distances from a surface, negative inside, at the points of a grid.

    Attributes:
        origin: (3,), the first grid point in {O} [m].
        spacing: Of the grid [m].
        values: (nx, ny, nz) [m].
        lower, upper: (3,), corners of the object's bounding box in {O} [m].
    """

    origin: Array
    spacing: float
    values: Distances
    lower: Array
    upper: Array

    @property
    def error(self) -> float:
        """By how much `nearest` may be wrong [m].

        `interpolate` is several times better near a surface that is smooth on the scale of a
        cell, and not better than this where a wall is thinner than a cell.
        """
        return ERROR_CELLS * self.spacing

    @property
    def blur(self) -> float:
        """By how much `interpolate` may be wrong at walls and slots thinner than a cell [m].

        No grid point need lie in one: then its surface reads as half of the spacing.
        """
        return self.spacing / 2.0

    def nearest(self, x: Distances, y: Distances, z: Distances) -> Distances:
        """Return distances [m], each at the grid point next to where it is asked for.

        Outside of the grid they are too small.

        Args:
            x: Coordinates in {O} [m], of any shape.
            y: See x.
            z: See x.
        """
        scale = np.float32(1.0 / self.spacing)
        index = np.zeros(np.shape(x), dtype=np.int32)
        beside = np.full(np.shape(x), -np.inf, dtype=np.float32)
        for axis, value in enumerate((x, y, z)):
            lower, upper = np.float32(self.lower[axis]), np.float32(self.upper[axis])
            np.maximum(beside, lower - value, out=beside)
            np.maximum(beside, value - upper, out=beside)
            place = (value - np.float32(self.origin[axis])) * scale
            place += np.float32(0.5)
            count = self.values.shape[axis]
            np.maximum(place, np.float32(0.0), out=place)
            np.minimum(place, np.float32(count - 1), out=place)
            index *= np.int32(count)
            index += place.astype(np.int32)
        return np.asarray(np.maximum(self.values.ravel().take(index), beside))

    def interpolate(self, x: Distances, y: Distances, z: Distances) -> Distances:
        """Return distances [m], interpolated in the grid's cells; see `nearest`."""
        scale = np.float32(1.0 / self.spacing)
        index = np.zeros(np.shape(x), dtype=np.int32)
        parts = []
        for value, start, count in zip((x, y, z), self.origin, self.values.shape, strict=True):
            place = np.clip((value - np.float32(start)) * scale, 0, np.float32(count) - 1.001)
            cell = place.astype(np.int32)
            index *= np.int32(count)
            index += cell
            parts.append(place - cell)
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
    for _ in range(4):  # the padding depends on the spacing
        room = upper - lower + 2 * PADDING * spacing
        spacing = max(FINEST, float(np.cbrt(np.prod(room) / CELLS)))
    # An odd part of a cell keeps corners and edges of made objects off the grid's columns.
    origin = lower - (PADDING - 0.3819) * spacing
    shape = tuple(np.ceil((upper - origin) / spacing).astype(int) + PADDING)
    distance = _unsigned(triangles, origin, spacing, shape)
    inside = _inside(triangles, origin, spacing, shape)
    values = np.where(inside, -distance, distance).astype(np.float32)
    values.setflags(write=False)
    return DistanceField(origin=origin, spacing=spacing, values=values, lower=lower, upper=upper)


def _unsigned(
    triangles: Array, origin: Array, spacing: float, shape: tuple[int, ...]
) -> npt.NDArray[np.float32]:
    """Return the distance of each grid point from the surface.

    Each grid point knows the grid point nearest to it that has a point of the surface in its
    cell (a distance transform); its distance is that to this point, or close by to the
    triangle on which this point is.
    """
    points, owner = _surface_points(triangles, DENSITY * spacing)
    cell = np.floor((points - origin) / spacing + 0.5).astype(np.int64)
    flat = np.ravel_multi_index(tuple(cell.T), shape)
    seeds, first = np.unique(flat, return_index=True)
    empty = np.ones(shape, dtype=bool)
    empty.ravel()[seeds] = False
    far, nearest = distance_transform_edt(empty, return_indices=True)
    seed_of = np.zeros(shape, dtype=np.int32)
    seed_of.ravel()[seeds] = np.arange(len(seeds), dtype=np.int32)
    seed = seed_of[tuple(nearest)]
    grid = np.indices(shape, dtype=np.float32)
    squared = np.zeros(shape, dtype=np.float32)
    sample = points[first].astype(np.float32)
    for axis in range(3):
        place = grid[axis] * np.float32(spacing) + np.float32(origin[axis])
        squared += (place - sample[seed, axis]) ** 2
    distance = np.sqrt(squared)
    band = np.flatnonzero(far.ravel() <= BAND)
    for start in range(0, len(band), BAND_CHUNK):
        some = band[start : start + BAND_CHUNK]
        at = np.column_stack(np.unravel_index(some, shape)) * spacing + origin
        near = triangles[owner[first[seed.ravel()[some]]]]
        on_triangle = trimesh.triangles.closest_point(near, at)
        distance.ravel()[some] = norm(at - on_triangle)
    return distance


def _surface_points(triangles: Array, spacing: float) -> tuple[Array, npt.NDArray[np.int64]]:
    """Return points on triangles at most a spacing [m] apart, and the triangle of each."""
    edges = norm(triangles - np.roll(triangles, 1, axis=1)).max(axis=1)
    parts = np.maximum(1, np.ceil(edges / spacing)).astype(int)
    points, owners = [], []
    for n in np.unique(parts):
        which = np.flatnonzero(parts == n)
        i, j = (a.ravel() for a in np.indices((n + 1, n + 1)))
        i, j = i[i + j <= n], j[i + j <= n]
        weights = np.column_stack([i, j, n - i - j]) / n
        points.append(multiply(weights, triangles[which]).reshape(-1, 3))
        owners.append(np.repeat(which, len(weights)))
    return np.concatenate(points), np.concatenate(owners)


def _inside(
    triangles: Array, origin: Array, spacing: float, shape: tuple[int, ...]
) -> npt.NDArray[np.bool_]:
    """Return which grid points are inside a closed surface, by counting along its columns.

    Along each column of the grid, upwards, a triangle that looks down is an entry and one
    that looks up an exit.
    """
    flat = (triangles - origin) / spacing
    low = np.ceil(flat[:, :, :2].min(axis=1)).astype(int)
    size = np.floor(flat[:, :, :2].max(axis=1)).astype(int) - low + 1
    size = np.maximum(size, 0)
    count = size[:, 0] * size[:, 1]
    t = np.repeat(np.arange(len(flat)), count)
    k = np.arange(len(t)) - np.repeat(np.cumsum(count) - count, count)
    x, y = low[t, 0] + k // size[t, 1], low[t, 1] + k % size[t, 1]
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = np.moveaxis(flat, 0, 2)
    # Twice the areas of the projected triangle's parts, seen from the column.
    u = (bx[t] - x) * (cy[t] - y) - (cx[t] - x) * (by[t] - y)
    v = (cx[t] - x) * (ay[t] - y) - (ax[t] - x) * (cy[t] - y)
    w = (ax[t] - x) * (by[t] - y) - (bx[t] - x) * (ay[t] - y)
    up = (u >= 0) & (v >= 0) & (w >= 0)
    down = (u <= 0) & (v <= 0) & (w <= 0)
    area = u + v + w
    hit = (up ^ down) & (area != 0.0)
    t, x, y, u, v, w, area = (values[hit] for values in (t, x, y, u, v, w, area))
    z = (u * az[t] + v * bz[t] + w * cz[t]) / area
    winding = np.zeros(shape, dtype=np.int16)
    np.add.at(winding, (x, y, np.ceil(z).astype(int)), np.where(area < 0.0, 1, -1))
    np.cumsum(winding, axis=2, out=winding)
    # A column through an edge may count it twice or not at all: it never gets back to zero,
    # and its neighbour speaks for it.
    for i, j in np.argwhere(winding[:, :, -1] != 0):
        winding[i, j] = winding[i - 1, j]
    return np.asarray(winding > 0)
