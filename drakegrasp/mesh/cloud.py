"""Solids from what a camera saw: the visible points of an object on the table, filled.

Input: points (n, 3) in {T}, whose table is z = 0. Output: distance fields in {T}. The back and the
underside of the object are not seen, so a solid is a guess; two solids bracket the object. The
convex hull of the points and of their projections on the table fills every hollow; the columns from
the points down to the table keep handles and waists that are seen from above.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import binary_closing, distance_transform_edt
from scipy.spatial import ConvexHull, QhullError, cKDTree

from drakegrasp.arithmetic import Array, cube_root, dot, multiply, norm
from drakegrasp.errors import GraspError, TooLittleSeenError
from drakegrasp.frames import as_numbers
from drakegrasp.mesh.distance_field import DistanceField

#: Minimum number of points of a cloud, maximum number that is used, and the largest size [m] of an
#: object.
FEWEST, MOST, LARGEST = 10, 4096, 1.0
#: The highest point must be at least this far above the table [m]: a solid cannot show thinner
#: objects.
LEAST_HEIGHT = 0.004
#: The lowest points, except this fraction of outliers, are not farther than this below the table,
#: nor above it [m].
OUTLIERS, BELOW, ABOVE = 0.02, 0.02, 0.3
#: Approximate number of cells of a grid, its smallest spacing [m], and empty cells around it.
CELLS, FINEST, PADDING = 150_000, 0.002, 6
#: A normal is the slope between points this many cells to both sides, since columns have steps of
#: one cell.
SLOPE = 2.0
#: Gaps between columns are filled up to this multiple of the distance between neighbouring points,
#: with this minimum and maximum number of cells.
CLOSED, LEAST_CLOSED, MOST_CLOSED = 2.0, 3, 2 * PADDING - 1
#: Number of cells along the longest side of a large cloud, from which the edge of smaller cells
#: follows; and the factor by which this edge grows until there are few enough cells.
COARSE, GROWTH = 15, 1.1
#: Relative difference of two lengths or areas that rounding can make.
TIE = 1e-9


@dataclass(frozen=True, kw_only=True, eq=False)
class Solid:
    """A filled cloud: its distance field in {T}, and the centre (3,) of its volume [m]."""

    field: DistanceField
    middle: Array

    def normals(self, p_TQ: Array) -> Array:
        """Return unit normals (n, 3), outward, of the solid nearest to points (n, 3) [m]."""
        slope = np.zeros_like(p_TQ)
        for axis, step in enumerate(SLOPE * self.field.spacing * np.eye(3)):
            ahead, behind = (
                self.field.interpolate(*(p_TQ + sign * step).astype(np.float32).T)
                for sign in (1.0, -1.0)
            )
            slope[:, axis] = ahead - behind
        return slope / np.maximum(norm(slope), np.finfo(float).tiny)[:, None]


def read_cloud(cloud: npt.ArrayLike) -> Array:
    """Return at most `MOST` points (n, 3) of a cloud [m], raised to the table if below it.

    Raises:
        GraspError: If they cannot be points of one object that stands on the table.
    """
    must = "cloud must be points (n, 3) of one object, in {T} and in metres"
    points = as_numbers(cloud, must)
    if points.ndim != 2 or points.shape[1] != 3:
        raise GraspError(f"{must}, got an array of shape {points.shape}")
    if wrong := np.count_nonzero(~np.isfinite(points)):
        raise GraspError(f"{must}, got {wrong:,} of {points.size:,} numbers that are not finite")
    if len(points) < FEWEST:
        raise TooLittleSeenError(f"{must}, {FEWEST} or more, got {len(points)}")

    # One object that stands on the table.
    if (size := float(np.ptp(points, axis=0).max())) > LARGEST:
        raise GraspError(f"{must}, got points {size:.3g} m apart: is it in another unit?")
    low = float(np.quantile(points[:, 2], OUTLIERS))
    if not -BELOW <= low <= ABOVE:
        raise GraspError(
            f"{must}: the table must be z = 0, got the lowest points at z = {low:.3g} m"
        )
    if (top := float(points[:, 2].max())) < LEAST_HEIGHT:
        raise TooLittleSeenError(f"{must}, got none higher than {1e3 * top:.3g} mm above the table")

    points = np.maximum(points, [-np.inf, -np.inf, 0.0])
    return points if len(points) <= MOST else _thinned(points)


def _thinned(points: Array) -> Array:
    """Return at most `MOST` points, one per cell of a grid; the order of the points is ignored.

    The point of a cell is the outermost, so that the outline stays.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    away = points - (low + high) / 2.0
    points = points[np.lexsort([*points.T, -dot(away, away)])]

    def kept(edge: float) -> npt.NDArray[np.int64]:
        """Return the first point of each cell with an edge [m]."""
        cells = np.floor((points - low) / edge).astype(np.int64)
        number = np.ravel_multi_index(tuple(cells.T), tuple(cells.max(axis=0) + 1))
        return np.unique(number, return_index=True)[1]

    # A surface has four times as many cells of half the edge.
    edge = max(float((high - low).max()), LEAST_HEIGHT) / COARSE
    edge *= float(np.sqrt(len(kept(edge)) / MOST))
    while len(found := kept(edge)) > MOST:
        edge *= GROWTH
    return points[found]


def hull_solid(points: Array) -> Solid:
    """Return the convex hull of points (n, 3) and of their projections on the table.

    Raises:
        GraspError: If the points are in a vertical plane.
    """
    planes = _hull(np.concatenate([points, points * [1.0, 1.0, 0.0]])).equations
    origin, spacing, shape = _grid(points)
    x, y, z = (o + spacing * np.arange(n) for o, n in zip(origin, shape, strict=True))

    # Distances from the face planes: beside edges and corners they are too small.
    values = np.full(shape, -np.inf)
    for a, b, c, d in np.unique(planes.round(6), axis=0):
        np.maximum(values, a * x[:, None, None] + b * y[:, None] + (c * z + d), out=values)
    return _solid(values, points, origin, spacing)


def column_solid(points: Array) -> Solid:
    """Return the columns from points (n, 3) down to the table, with small gaps filled."""
    origin, spacing, shape = _grid(points)
    i, j, k = np.rint((points - origin) / spacing).astype(np.int64).T
    top = np.full(shape[:2], -1)
    np.maximum.at(top, (i, j), k)
    layers = np.arange(shape[2])
    filled = (layers <= top[:, :, None]) & (layers >= PADDING)

    # If there are few points, the gaps between them are wide.
    apart = np.quantile(cKDTree(points).query(points, k=2)[0][:, 1], 0.9)
    width = int(np.clip(np.ceil(CLOSED * apart / spacing) + 1, LEAST_CLOSED, MOST_CLOSED))
    filled |= binary_closing(filled, np.ones((width, width, 1)))

    # Half a cell, since the surface is between a filled grid point and an empty one.
    inside, outside = distance_transform_edt(filled), distance_transform_edt(~filled)
    steps = np.where(filled, 0.5 - inside, outside - 0.5)
    return _solid(spacing * steps, points, origin, spacing)


def smallest_rectangle(points: Array) -> tuple[Array, Array, Array]:
    """Return the smallest rectangle around points (n, 3), seen from above.

    Of rectangles or sides that only rounding distinguishes, the long side is the one nearest to Tx.

    Returns:
        Unit axes (2, 2) as rows, the long side first; the centre (2,) and the half sides (2,) [m].

    Raises:
        GraspError: If the points are in a vertical plane.
    """
    corners = points[_hull(points[:, :2]).vertices, :2]
    edges = np.roll(corners, -1, axis=0) - corners
    u = edges / norm(edges)[:, None]
    axes = np.stack([u, np.column_stack([-u[:, 1], u[:, 0]])], axis=1)
    along = multiply(axes, corners.T)
    low, high = along.min(axis=2), along.max(axis=2)
    middles = multiply(np.swapaxes(axes, 1, 2), (low + high)[:, :, None])[..., 0] / 2.0
    halves = (high - low) / 2.0

    # The long side of each rectangle along an edge; in a square that is the edge.
    upright = halves[:, 1] > halves[:, 0] * (1.0 + TIE)
    axes[upright], halves[upright] = axes[upright, ::-1], halves[upright, ::-1]
    areas = halves.prod(axis=1)
    tied = np.flatnonzero(areas <= areas.min() * (1.0 + TIE))
    x, y = np.rint(axes[tied, 0] / TIE).T
    best = tied[np.lexsort((y, x))[-1]]
    return axes[best], middles[best], halves[best]


def _hull(points: Array) -> ConvexHull:
    try:
        return ConvexHull(points)
    except QhullError:
        raise TooLittleSeenError(
            "cloud must show an object from above or aslant, got a flat one"
        ) from None


def _grid(points: Array) -> tuple[Array, float, tuple[int, ...]]:
    """Return the first point (3,) [m], the spacing [m] and the shape of a grid around a cloud."""
    low, high = points.min(axis=0) * [1.0, 1.0, 0.0], points.max(axis=0)
    room = high - low + 2 * PADDING * FINEST
    spacing = max(FINEST, cube_root(float(np.prod(room)) / CELLS))
    shape = np.ceil((high - low) / spacing).astype(int) + 2 * PADDING + 1
    return low - PADDING * spacing, spacing, tuple(shape.tolist())


def _solid(values: Array, points: Array, origin: Array, spacing: float) -> Solid:
    """Return the solid of signed distances (nx, ny, nz) [m] on a grid."""
    field = DistanceField(
        origin=origin,
        spacing=spacing,
        values=values.astype(np.float32),
        lower=points.min(axis=0) * [1.0, 1.0, 0.0],
        upper=points.max(axis=0),
    )
    return Solid(field=field, middle=np.argwhere(values < 0.0).mean(axis=0) * spacing + origin)
