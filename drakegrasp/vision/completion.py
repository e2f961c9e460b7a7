"""Completion: what a depth image shows of an object, closed to a surface that can be simulated.

Input: a solid that was guessed from the visible points in {T} (`mesh.cloud`), and the view that
shows them, if it is known. Output: the closed surface of the solid, from which the space that the
view shows to be free is cut away: what is in front of the object's pixels, and what is beside them
in front of the table.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import manifold3d
import numpy as np
import numpy.typing as npt
from scipy.ndimage import distance_transform_edt, map_coordinates

from drakegrasp.arithmetic import Array
from drakegrasp.errors import TooLittleSeenError
from drakegrasp.frames import invert_pose, transform_points
from drakegrasp.mesh.distance_field import DistanceField
from drakegrasp.mesh.surfaces import Solid, from_manifold

#: Edges of the lattice in which the surface is found [m].
EDGE = 0.006
#: Error that the simplified surface may have [m].
TOLERANCE = 0.0008
#: The depth of a pixel of the object also holds for pixels of unknown depth this close to it [px].
AROUND = 2.0
#: A point hides behind what is seen beside the object if it is farther away by this fraction.
BEHIND = 0.02


class View(NamedTuple):
    """A depth image of an object on the table, and the camera that took it.

    Attributes:
        depth: (h, w), along the camera's z axis [m]; 0, NaN or infinite where it is unknown.
        mask: (h, w), 0 beside the object, and one other value on it.
        K: Camera matrix (3, 3) [px].
        X_TC: Pose of the camera in {T} (4, 4).
    """

    depth: npt.ArrayLike
    mask: npt.ArrayLike
    K: npt.ArrayLike
    X_TC: npt.ArrayLike


def complete(field: DistanceField, view: View | None = None) -> Solid:
    """Return the closed surface in {T} of a guessed solid, without what a view shows to be free.

    Of several parts the largest is returned. The surface stands on the table.

    Args:
        field: Distances from the solid in {T}, whose table is z = 0.
        view: An image, valid for `cloud_from_depth`; None if it is not known.

    Raises:
        TooLittleSeenError: If no solid is left.
    """
    values = np.asarray(field.values, dtype=float)
    if view is not None:
        axes = [
            start + field.spacing * np.arange(n)
            for start, n in zip(field.origin, values.shape, strict=True)
        ]
        p_TQ = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        values = np.maximum(values, _in_free_space(p_TQ, view).reshape(values.shape))

    # Outside is negative for manifold3d.
    bounds = (*field.origin, *(field.origin + field.spacing * (np.array(values.shape) - 1)))
    inside = _interpolation(-values, field)
    whole = manifold3d.Manifold.level_set(inside, bounds, EDGE).trim_by_plane((0.0, 0.0, 1.0), 0.0)
    if whole.is_empty():
        raise TooLittleSeenError("cloud must show a solid, got one that the view shows to be free")
    largest = max(whole.decompose(), key=lambda part: float(part.volume()))
    vertices, faces = from_manifold(largest.simplify(TOLERANCE))
    return Solid(vertices=vertices, faces=faces)


def _in_free_space(p_TQ: Array, view: View) -> Array:
    """Return how far points (m, 3) are in what a view shows to be free [m], negative beyond it."""
    depth, mask = np.asarray(view.depth, dtype=float), np.asarray(view.mask)
    known = np.isfinite(depth) & (depth > 0.0)
    own = known & (mask.any(axis=2) if mask.ndim == 3 else mask != 0)
    beside = known & ~own

    # The pixels of the points.
    K, p_CQ = np.reshape(view.K, (3, 3)), transform_points(invert_pose(np.asarray(view.X_TC)), p_TQ)
    z = np.where(p_CQ[:, 2] > 0.0, p_CQ[:, 2], np.nan)
    u, v = (K[i, i] * p_CQ[:, i] / z + K[i, 2] for i in range(2))
    height, width = depth.shape
    in_image = (u >= 0.0) & (u <= width - 1) & (v >= 0.0) & (v <= height - 1)
    z, u, v = (np.where(in_image, each, 0.0) for each in (z, u, v))

    # In front of the object, whose depth is continued to the pixels around it.
    apart, near = distance_transform_edt(~own, return_indices=True)
    row, column = np.rint(v).astype(int), np.rint(u).astype(int)
    ahead = map_coordinates(depth[tuple(near)], [v, u], order=1) - z
    ahead = np.where(apart[row, column] <= AROUND, ahead, -np.inf)

    # Beside the object, in front of what is seen there; an unknown pixel shows nothing free.
    pixels = distance_transform_edt(beside) - distance_transform_edt(~beside)
    aside = map_coordinates(pixels - 0.5 * np.sign(pixels), [v, u], order=1) * z / K[0, 0]
    hidden = beside[row, column] & (z > (1.0 + BEHIND) * depth[row, column])
    free = np.maximum(ahead, np.where(hidden, -np.inf, aside))
    return np.where(in_image, free, -np.inf)


def _interpolation(values: Array, field: DistanceField) -> Callable[[float, float, float], float]:
    """Return the trilinear interpolation of values (nx, ny, nz) at one point of a field's grid.

    manifold3d asks for one point at a time, for which lists are faster than arrays.
    """
    far = 4.0 * EDGE
    rows, last = np.clip(values, -far, far).tolist(), [n - 2 for n in values.shape]
    (x0, y0, z0), scale = field.origin.tolist(), 1.0 / field.spacing

    def at(x: float, y: float, z: float) -> float:
        x, y, z = scale * (x - x0), scale * (y - y0), scale * (z - z0)
        i, j, k = (min(max(int(each), 0), n) for each, n in zip((x, y, z), last, strict=True))
        x, y, z = x - i, y - j, z - k
        corners = rows[i][j], rows[i][j + 1], rows[i + 1][j], rows[i + 1][j + 1]
        a, b, c, d = (edge[k] + (edge[k + 1] - edge[k]) * z for edge in corners)
        a, c = a + (b - a) * y, c + (d - c) * y
        return float(a + (c - a) * x)

    return at
