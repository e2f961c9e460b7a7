"""The fingertips' surfaces as smooth functions of a point.

In: the corners of k convex fingertips. Out: how far points lie outside of them, which way
the surface there faces, and how that turns from point to point: what an optimiser needs to
bring a fingertip to a contact with exact gradients.

The distance of p from a convex body with face planes n_j . p = d_j is at least the largest
of n_j . p - d_j, and equal to it before a face. Here the largest is replaced by the smooth
maximum s log sum exp((n_j . p - d_j) / s) (Boyd and Vandenberghe, "Convex Optimization",
3.1.5), which rounds edges with a radius of about s.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.spatial import ConvexHull

from drakegrasp.frames import Array

#: Radius of the rounding [m]: the pads' own unevenness.
ROUNDING = 0.7e-3
#: Face normals that agree to this many digits are one plane.
SAME_PLANE = 6


@dataclass(frozen=True, kw_only=True, eq=False)
class Pads:
    """The surfaces of k fingertips, each with m planes (padded with ones that never matter).

    Attributes:
        normals: (k, m, 3), unit, outward, in each fingertip's frame.
        offsets: (k, m), n . p on the plane [m].
        triangles: For each fingertip (t, 3, 3), the corners of its surface's triangles [m].
    """

    normals: Array
    offsets: Array
    triangles: tuple[Array, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class PadContact:
    """Where k points stand to k pads, one each.

    Attributes:
        distance: (k,), smooth distance outside of the pad, negative inside [m].
        normal: (k, 3), unit outward normal of the pad nearest to the point.
        gradient: (k, 3), of `distance` by the point; along `normal`, shorter at edges.
        normal_slope: (k, 3, 3), derivative of `normal` by the point [1/m].
    """

    distance: Array
    normal: Array
    gradient: Array
    normal_slope: Array


def make_pads(corners: Sequence[Array]) -> Pads:
    """Return the pads of k fingertips, each the convex hull of corners (n, 3) [m]."""
    hulls = [ConvexHull(points) for points in corners]
    # A row of equations is a unit normal and minus the offset.
    planes = [np.unique(np.round(hull.equations, SAME_PLANE), axis=0) for hull in hulls]
    most = max(map(len, planes))
    normals = np.zeros((len(planes), most, 3))
    offsets = np.full((len(planes), most), np.inf)
    for i, found in enumerate(planes):
        normals[i, : len(found)] = found[:, :3]
        offsets[i, : len(found)] = -found[:, 3]
    triangles = tuple(hull.points[hull.simplices] for hull in hulls)
    return Pads(normals=normals, offsets=offsets, triangles=triangles)


def nearest_on_pads(pads: Pads, p_FiQ: Array) -> Array:
    """Return the points (k, 3) [m] of the pads, without rounding, nearest to points (k, 3)."""
    found = []
    for triangles, point in zip(pads.triangles, p_FiQ, strict=True):
        near = trimesh.triangles.closest_point(triangles, np.tile(point, (len(triangles), 1)))
        found.append(near[np.argmin(np.sum((near - point) ** 2, axis=1))])
    return np.array(found)


def touch(pads: Pads, p_FiQ: Array) -> PadContact:
    """Return how points (k, 3) [m], each in its fingertip's frame, stand to the pads."""
    height = (np.matmul(pads.normals, p_FiQ[:, :, None])[..., 0] - pads.offsets) / ROUNDING
    highest = height.max(axis=1)
    weight = np.exp(height - highest[:, None])
    total = weight.sum(axis=1)
    weight /= total[:, None]
    gradient = np.matmul(weight[:, None, :], pads.normals)[:, 0]
    weighted = pads.normals * weight[:, :, None]
    outer = gradient[:, :, None] * gradient[:, None, :]
    hessian = (np.matmul(weighted.transpose(0, 2, 1), pads.normals) - outer) / ROUNDING
    length = np.sqrt((gradient * gradient).sum(axis=1))
    normal = gradient / length[:, None]
    # The derivative of g/|g| is (1 - n n') H / |g|.
    along = np.matmul(normal[:, None, :], hessian)
    slope = (hessian - normal[:, :, None] * along) / length[:, None, None]
    return PadContact(
        distance=ROUNDING * (highest + np.log(total)),
        normal=normal,
        gradient=gradient,
        normal_slope=slope,
    )
