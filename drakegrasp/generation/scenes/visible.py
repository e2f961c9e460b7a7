"""Which contacts a camera sees, told from its depth image; NumPy only.

A contact is hidden if its normal points away from the camera, or if the ray from it to the camera
meets the object or the table first. It is the centre of a pressed patch, so it may lie a little
inside the object, and on a surface that is seen at a slant the depth changes by much from one pixel
to the next. So of the four pixels around it the farthest counts, and `BEFORE` is allowed. The patch
of a grasp that is no sample may span an edge: a centre that the camera sees farther than `BESIDE`
from the object is hidden, too, as no image shows it.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import Array, dot
from drakegrasp.dataset.schema import DEPTH_UNIT
from drakegrasp.frames import invert_pose, transform_points
from drakegrasp.vision.camera import project

#: What is nearer than a contact by more than this hides it [m].
BEFORE = 3e-3
#: What is farther from the object's pixels than this is not on it [px].
BESIDE = 2.0


def visible_contacts(
    p_TQ: Array,
    nhat_Q_T: Array,
    X_TC: Array,
    K: Array,
    depth: npt.NDArray[np.uint16],
    mask: npt.NDArray[np.uint8],
) -> npt.NDArray[np.bool_]:
    """Return whether (...,) a camera sees contacts; those that are NaN it does not.

    Args:
        p_TQ: Contact points (..., 3) [m].
        nhat_Q_T: Unit normals out of the object (..., 3).
        X_TC: Pose of the camera (4, 4).
        K: Camera matrix (3, 3) [px].
        depth: Clean depth image (h, w) [DEPTH_UNIT], 0 where there is nothing.
        mask: Mask of the objects (h, w), 0 beside them.
    """
    p = p_TQ.reshape(-1, 3)
    # A comparison with NaN is false.
    rows = np.flatnonzero(dot(nhat_Q_T.reshape(-1, 3), X_TC[:3, 3] - p) > 0.0)
    p_CQ = transform_points(invert_pose(X_TC), p[rows])
    rows, p_CQ = rows[p_CQ[:, 2] > 0.0], p_CQ[p_CQ[:, 2] > 0.0]

    # The four pixels around each that is in the image.
    height, width = depth.shape
    pixels = project(K, p_CQ)
    u, v = np.floor(pixels).astype(np.int64).T
    within = (u >= 0) & (v >= 0) & (u < width - 1) & (v < height - 1)
    u, v, rows, z, pixels = u[within], v[within], rows[within], p_CQ[within, 2], pixels[within]
    around = depth[np.array([v, v, v + 1, v + 1]), np.array([u, u + 1, u, u + 1])]
    farthest = np.where(around == 0, np.inf, around * DEPTH_UNIT).max(axis=0)

    # Few are on no pixel of the object: those are measured.
    beside = mask[v, u] == 0
    own = np.argwhere(mask > 0)[:, ::-1]
    apart = [np.linalg.norm(own - pixel, axis=1).min(initial=np.inf) for pixel in pixels[beside]]
    beside[beside] = np.array(apart) > BESIDE

    visible = np.zeros(len(p), dtype=np.bool_)
    visible[rows] = (farthest >= z - BEFORE) & ~beside
    return visible.reshape(p_TQ.shape[:-1])
