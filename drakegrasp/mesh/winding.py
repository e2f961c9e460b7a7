"""Winding numbers of many points: a surface and points come in, how often it winds around them out.

Far triangles count in bundles, as one dipole each (Barill et al. 2018, "Fast winding numbers for
soups and clouds"; here with one level of bundles instead of a tree). Near ones count exactly.
"""

from __future__ import annotations

import numpy as np

from drakegrasp.arithmetic import dot
from drakegrasp.frames import Array
from drakegrasp.mesh.surfaces import Faces, winding_numbers

#: Triangles in a bundle, on average; the edge of its cell follows.
BUNDLE = 12
#: Bundles within so many cells of a point's own count exactly, triangle by triangle.
NEAR = 1
#: Points whose bundles are summed at a time.
CHUNK = 2000


def fast_winding_numbers(points: Array, vertices: Array, faces: Faces) -> Array:
    """Return how often a surface winds around points, as `surfaces.winding_numbers` does.

    The error is some hundredths, more than enough to tell inside from outside.

    Args:
        points: (k, 3) [m].
        vertices: (n, 3) [m].
        faces: (m, 3).
    """
    # Bundles: the triangles whose centres are in the same cell.
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    centres, vectors = (a + b + c) / 3.0, np.cross(b - a, c - a) / 2.0
    areas = np.sqrt(dot(vectors, vectors))
    edge = float(np.sqrt(BUNDLE * areas.sum() / len(faces)))
    low = np.minimum(vertices.min(axis=0), points.min(axis=0)) - (NEAR + 1) * edge
    shape = tuple(
        ((np.maximum(vertices.max(axis=0), points.max(axis=0)) - low) / edge).astype(int)
        + NEAR + 2
    )  # fmt: skip
    cell = np.ravel_multi_index(tuple(((centres - low) / edge).astype(int).T), shape)
    order = np.argsort(cell, kind="stable")
    cells, starts = np.unique(cell[order], return_index=True)
    weights = np.maximum(areas, 1e-300)[:, None]
    dipoles = np.add.reduceat(vectors[order], starts)
    at = np.add.reduceat((weights * centres)[order], starts) / np.add.reduceat(
        weights[order], starts
    )

    # The points of a cell have the same near bundles.
    home = np.ravel_multi_index(tuple(((points - low) / edge).astype(int).T), shape)
    by_home = np.argsort(home, kind="stable")
    homes, firsts = np.unique(home[by_home], return_index=True)
    steps = np.arange(-NEAR, NEAR + 1)
    around = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    offsets = (around[:, 0] * shape[1] + around[:, 1]) * shape[2] + around[:, 2]
    ends = np.append(starts[1:], len(faces))
    winding = np.empty(len(points))
    for here, own in zip(homes, np.split(by_home, firsts[1:]), strict=True):
        near = np.isin(cells, here + offsets)
        for chunk in np.array_split(own, -(-len(own) // CHUNK)):
            winding[chunk] = _dipole_sum(points[chunk], at[~near], dipoles[~near])
        if near.any():
            bundles = [order[starts[i] : ends[i]] for i in np.flatnonzero(near)]
            winding[own] += winding_numbers(points[own], vertices, faces[np.concatenate(bundles)])
    return winding


def _dipole_sum(points: Array, at: Array, dipoles: Array) -> Array:
    """Return the winding numbers (k,) that dipoles (b, 3) at points (b, 3) [m] add."""
    total = np.zeros((len(points), len(at)))
    squared = np.zeros_like(total)
    for axis in range(3):
        apart = at[:, axis] - points[:, None, axis]
        squared += apart * apart
        total += apart * dipoles[:, axis]
    return np.asarray((total / (squared * np.sqrt(squared))).sum(axis=1) / (4.0 * np.pi))
