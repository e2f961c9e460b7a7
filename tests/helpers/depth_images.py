"""A depth image of a box on a table before a wall, made by casting rays."""

from __future__ import annotations

import numpy as np

from drakegrasp.vision.camera import look_at
from drakegrasp.vision.depth_image import View, cloud_from_depth

#: A camera of 160 x 120 pixels, which looks at a box on a table, with a wall behind the table.
K = np.array([[150.0, 0.0, 80.0], [0.0, 152.0, 58.0], [0.0, 0.0, 1.0]])
HIGH, WIDE = 120, 160
X_TC = look_at(np.array([0.0, 0.0, 0.05]), 0.6, 0.4, np.sin(0.26), 0.3)
#: Half extents of the box, and its height [m].
BOX = np.array([0.04, 0.03, 0.1])
#: The wall, in {T}: the plane of these normals and this offset [m].
WALL, BEHIND = np.array([np.cos(0.4), np.sin(0.4), 0.0]), -0.1


def image(noise=0.0, table=True, offset=BEHIND):
    """Return depth (h, w) [m] and mask of the box, by casting rays; unknown far away."""
    v, u = np.mgrid[:HIGH, :WIDE].reshape(2, -1)
    rays = np.linalg.inv(K) @ np.stack([u, v, np.ones(len(u))])
    way, eye = X_TC[:3, :3] @ rays, X_TC[:3, 3:]
    low, high = np.array([-BOX[0], -BOX[1], 0.0])[:, None], np.array([*BOX])[:, None]
    ends = np.sort([(low - eye) / way, (high - eye) / way], axis=0)
    enters, leaves = ends[0].max(axis=0), ends[1].min(axis=0)
    box = np.where(enters <= leaves, enters, np.inf)
    floor = np.where(way[2] < 0.0, -eye[2] / way[2], np.inf) if table else np.full(len(u), np.inf)
    behind = WALL @ way
    wall = np.where(behind < 0.0, (offset - WALL @ eye) / behind, np.inf)
    depth = np.minimum(np.minimum(box, floor), wall)
    mask = (box <= depth) & np.isfinite(box)
    depth *= 1.0 + noise * np.random.default_rng(0).normal(size=len(depth))
    depth[::17] = np.nan
    depth[5::19] = 0.0
    return depth.reshape(HIGH, WIDE), mask.reshape(HIGH, WIDE)


def box_view():
    """Return the view of the box, with unknown pixels on it and beside it."""
    depth, mask = image()
    return View(depth=depth, mask=mask, K=K, X_TC=X_TC)


def cloud_of(view):
    """Return the visible points and normals of a view's object, in {T}."""
    return cloud_from_depth(view.depth, view.K, view.mask, view.X_TC)
