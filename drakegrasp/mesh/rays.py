"""Rays: where they first meet a surface of triangles.

The result has the same bits on every machine, since only sums, products and roots are used.
Embree cannot replace this module: it computes in single precision, with kernels that depend on the
CPU.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import dot, norm
from drakegrasp.frames import Array

#: A ray that misses a triangle by this fraction of its size still meets it, so that no ray passes
#: between two triangles.
EDGE = 1e-9
#: Margin of the sphere around a triangle [m], far above rounding.
MARGIN = 1e-6
#: Number of pairs of a ray and a triangle that are tested together; they fit into a CPU's cache.
PAIRS = 65_536


def first_hits(triangles: Array, p: Array, z: Array) -> Array:
    """Return the distance (n,) [m] at which each ray first meets a triangle; inf if it meets none.

    Möller and Trumbore's test (1997); a ray through an edge or a corner counts as a hit.

    Args:
        triangles: Corners (m, 3, 3) [m].
        p: Starting points of the rays, (n, 3) [m].
        z: Unit directions of the rays, (n, 3).
    """
    # A sphere around each triangle.
    a, b, c = np.moveaxis(np.asarray(triangles, dtype=float), 1, 0)
    centre = (a + b + c) / 3.0
    radius = np.sqrt(np.max([dot(q - centre, q - centre) for q in (a, b, c)], axis=0, initial=0.0))

    # Test only triangles whose sphere the ray meets.
    distance = np.full(len(p), np.inf)
    step = max(1, PAIRS // max(1, len(a)))
    for start in range(0, len(p), step):
        block = slice(start, start + step)
        ray, triangle = np.nonzero(_pass_spheres(p[block], z[block], centre, radius + MARGIN))
        ray += start
        hits = _triangle_hits(p[ray], z[ray], a[triangle], b[triangle], c[triangle])
        np.minimum.at(distance, ray, hits)
    return distance


def _pass_spheres(p: Array, z: Array, centre: Array, radius: Array) -> npt.NDArray[np.bool_]:
    """Return (n, m) whether each ray meets each sphere of centre (m, 3) and radius (m,)."""
    along, squared = np.zeros((len(p), len(centre))), np.zeros((len(p), len(centre)))
    for axis in range(3):
        apart = centre[:, axis] - p[:, None, axis]
        along += apart * z[:, None, axis]
        squared += apart * apart
    # The difference of two squares loses digits; MARGIN in the radius is far above this error.
    return (squared - along * along <= radius * radius) & (along >= -radius)


def _triangle_hits(p: Array, z: Array, a: Array, b: Array, c: Array) -> Array:
    """Return the distance (n,) at which each ray meets its triangle; inf if it does not."""
    ab, ac, ap = b - a, c - a, p - a
    across, up = np.cross(z, ac), np.cross(ap, ab)
    volume = dot(ab, across)
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v, t = dot(ap, across) / volume, dot(z, up) / volume, dot(ac, up) / volume
        meets = (u >= -EDGE) & (v >= -EDGE) & (u + v <= 1.0 + EDGE) & (t >= 0.0)
    # A triangle seen edge-on is skipped: the ray meets its neighbours.
    flat = np.abs(volume) <= EDGE * norm(ab) * norm(ac)
    return np.where(meets & ~flat, t, np.inf)
