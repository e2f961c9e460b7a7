"""The surfaces of the fingertips as smooth signed distances.

In: the corners of k convex fingertips. Out: the distances of points from them, the normals there,
and the derivatives of both: what an optimiser needs to bring a fingertip to a contact with exact
gradients.

The distance of p from a convex body with face planes n_j . p = d_j is at least the largest
of n_j . p - d_j, and equal to it in front of a face. Here the largest is replaced by the smooth
maximum s log sum exp((n_j . p - d_j) / s) (Boyd and Vandenberghe, "Convex Optimization",
3.1.5), which rounds edges with a radius of about s.

A fingertip may touch within its pad region only. The planes of the region are no surface, so the
distance is that of the whole fingertip, and how far a point is outside of the region is told beside
it: a point on the fingertip but so far outside is about as far from the pad.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.spatial import ConvexHull

from drakegrasp.frames import Array
from drakegrasp.hand.file_format import HalfSpace

#: Rounding s of the edges [m]: about the unevenness of the pads themselves.
ROUNDING = 0.7e-3
#: Faces whose normals and offsets agree to this many decimals are one plane.
SAME_PLANE = 6


@dataclass(frozen=True, kw_only=True, eq=False)
class Pads:
    """The surfaces of k fingertips, each with m planes and h half-spaces (padded).

    Attributes:
        normals: (k, m, 3), unit, outward, in each fingertip's frame.
        offsets: (k, m), n . p on the plane [m]; padded with planes at infinity.
        region_normals: (k, h, 3), unit, into the pad region; padded with zeros.
        region_offsets: (k, h), n . p on the border of the region [m]; padded with -1.
        triangles: For each fingertip (t, 3, 3), the corners of its pad's triangles [m].
    """

    normals: Array
    offsets: Array
    region_normals: Array
    region_offsets: Array
    triangles: tuple[Array, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class PadContact:
    """Distances and normals of k pads at k points, one each.

    Attributes:
        distance: (k,), smooth signed distance from the pad, negative inside [m].
        normal: (k, 3), unit outward normal of the pad next to the point.
        gradient: (k, 3), derivative of `distance` by the point; along `normal`, shorter than one at
            edges.
        normal_jacobian: (k, 3, 3), derivative of `normal` by the point [1/m].
        outside: (k, h), how far the point is outside of each half-space of the pad region, 0 inside
            [m].
        outside_gradient: (k, h, 3), derivative of `outside` by the point.
    """

    distance: Array
    normal: Array
    gradient: Array
    normal_jacobian: Array
    outside: Array
    outside_gradient: Array


def make_pads(
    corners: Sequence[Array], regions: Sequence[Sequence[HalfSpace]], triangles: Sequence[Array]
) -> Pads:
    """Return the pads of k fingertips.

    Args:
        corners: (n, 3), of each fingertip; its shape is their convex hull [m].
        regions: Half-spaces of each pad.
        triangles: (t, 3, 3), surface of each pad, see `hand.shapes.pad_surfaces` [m].
    """
    # The planes of each hull; a row of equations is a unit normal and minus the offset.
    hulls = [ConvexHull(points) for points in corners]
    planes = [np.unique(np.round(hull.equations, SAME_PLANE), axis=0) for hull in hulls]

    # Stack them; a plane at infinity never has the largest n . p - d.
    most = max(map(len, planes))
    normals = np.zeros((len(planes), most, 3))
    offsets = np.full((len(planes), most), np.inf)
    for i, equations in enumerate(planes):
        normals[i, : len(equations)] = equations[:, :3]
        offsets[i, : len(equations)] = -equations[:, 3]

    # Stack the half-spaces; every point is in one without a normal whose border is at -1.
    most = max(map(len, regions))
    region_normals = np.zeros((len(planes), most, 3))
    region_offsets = np.full((len(planes), most), -1.0)
    for i, region in enumerate(regions):
        for j, (*normal, offset) in enumerate(region):
            length = np.linalg.norm(normal)
            region_normals[i, j] = np.array(normal) / length
            region_offsets[i, j] = offset / length

    return Pads(
        normals=normals,
        offsets=offsets,
        region_normals=region_normals,
        region_offsets=region_offsets,
        triangles=tuple(triangles),
    )


def nearest_on_pads(pads: Pads, p_FiQ: Array) -> Array:
    """Return the point of each pad, without rounding, that is nearest to a point.

    Args:
        pads: Of k fingertips.
        p_FiQ: (k, 3), a point in each fingertip's frame [m].

    Returns:
        (k, 3), in the fingertips' frames [m].
    """
    nearest = []
    for triangles, point in zip(pads.triangles, p_FiQ, strict=True):
        near = trimesh.triangles.closest_point(triangles, np.tile(point, (len(triangles), 1)))
        nearest.append(near[np.argmin(np.sum((near - point) ** 2, axis=1))])
    return np.array(nearest)


def signed_distance(pads: Pads, p_FiQ: Array) -> PadContact:
    """Return the smooth signed distance of each point from its pad, with derivatives.

    With the heights h_j = n_j·p − d_j of a point p over the face planes and the rounding s:

        φ = s log Σ_j exp(h_j / s),   max h_j ≤ φ ≤ max h_j + s log M for M planes
        w_j = exp(h_j / s) / Σ exp(h_j / s)
        g = ∇φ = Σ_j w_j n_j
        H = ∇∇φ = (Σ_j w_j n_j n_jᵀ − g gᵀ) / s
        m = g / |g|,   ∂m/∂p = (1 − m mᵀ) H / |g|

    (Boyd and Vandenberghe, 3.1.5), and outside of a half-space n·p ≥ d of the pad region by
    o = max(0, d − n·p).

    Args:
        pads: Of k fingertips.
        p_FiQ: (k, 3), a point in each fingertip's frame [m].
    """
    # The smooth maximum of the heights over the planes, and the weights of the planes.
    height = (np.matmul(pads.normals, p_FiQ[:, :, None])[..., 0] - pads.offsets) / ROUNDING
    highest = height.max(axis=1)
    weight = np.exp(height - highest[:, None])
    total = weight.sum(axis=1)
    weight /= total[:, None]

    # First and second derivatives by the point.
    gradient = np.matmul(weight[:, None, :], pads.normals)[:, 0]
    weighted = pads.normals * weight[:, :, None]
    outer = gradient[:, :, None] * gradient[:, None, :]
    hessian = (np.matmul(weighted.transpose(0, 2, 1), pads.normals) - outer) / ROUNDING

    # The normal m = g / |g|; its derivative is (1 - m m') H / |g|.
    length = np.sqrt((gradient * gradient).sum(axis=1))
    normal = gradient / length[:, None]
    along = np.matmul(normal[:, None, :], hessian)
    normal_jacobian = (hessian - normal[:, :, None] * along) / length[:, None, None]

    # How far outside of the pad region the point is.
    outside = pads.region_offsets - np.matmul(pads.region_normals, p_FiQ[:, :, None])[..., 0]

    return PadContact(
        distance=ROUNDING * (highest + np.log(total)),
        normal=normal,
        gradient=gradient,
        normal_jacobian=normal_jacobian,
        outside=np.maximum(outside, 0.0),
        outside_gradient=-pads.region_normals * (outside > 0.0)[..., None],
    )
