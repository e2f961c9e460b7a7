"""Frame letters and the packing of poses, in NumPy only.

Drake's monogram notation is used everywhere: `X_AB` is the pose of frame B
expressed in frame A (it maps coordinates in B to coordinates in A), `R_AB` its
rotation, `p_AB` its translation. Composition matches neighbouring letters:
`X_AC = multiply(X_AB, X_BC)` (`arithmetic.multiply`, whose bits no CPU changes).

Letters: W world, T table-top centre, O object (centre of the mesh's bounding box),
Ocm its centre of mass, G palm (+Gz out of the palm), Fi distal link of finger i,
Qi contact point of finger i, C camera (+X right, +Y down, +Z forward), I image frame.

Inside the package a pose is a (4, 4) float64 array; in files it is (12,), the first
three rows, row-major. Drake's `RigidTransform` appears only where Drake is called.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import Array as Array
from drakegrasp.arithmetic import multiply, sin_cos

#: Position of the table-top centre T in the world [m] (Veres et al., "Coordinate frames").
P_WT = np.array([0.0, 0.0, 0.65])


def make_pose(R_AB: npt.ArrayLike, p_AB: npt.ArrayLike) -> Array:
    """Return the pose X_AB, (4, 4), from a (3, 3) rotation and a (3,) position [m]."""
    X_AB = np.eye(4)
    X_AB[:3, :3] = R_AB
    X_AB[:3, 3] = p_AB
    return X_AB


def invert_pose(X_AB: npt.ArrayLike) -> Array:
    """Return X_BA of one pose (4, 4) or of many (..., 4, 4)."""
    X = np.asarray(X_AB, dtype=float)
    R_BA = np.swapaxes(X[..., :3, :3], -1, -2)
    X_BA = np.zeros_like(X)
    X_BA[..., :3, :3] = R_BA
    X_BA[..., :3, 3] = -multiply(R_BA, X[..., :3, 3, None])[..., 0]
    X_BA[..., 3, 3] = 1.0
    return X_BA


def pack_pose(X_AB: npt.ArrayLike) -> Array:
    """Return poses (..., 4, 4) as (..., 12): the first three rows, row-major."""
    X = np.asarray(X_AB, dtype=float)
    return X[..., :3, :].reshape(*X.shape[:-2], 12)


def unpack_pose(packed: npt.ArrayLike) -> Array:
    """Return packed poses (..., 12) as (..., 4, 4)."""
    rows = np.asarray(packed, dtype=float)
    X = np.zeros((*rows.shape[:-1], 4, 4))
    X[..., :3, :] = rows.reshape(*rows.shape[:-1], 3, 4)
    X[..., 3, 3] = 1.0
    return X


def transform_points(X_AB: npt.ArrayLike, p_BQ: npt.ArrayLike) -> Array:
    """Return points p_AQ (n, 3) [m] of p_BQ (n, 3) under X_AB (4, 4)."""
    X = np.asarray(X_AB, dtype=float)
    return multiply(p_BQ, X[:3, :3].T) + X[:3, 3]


def rotate_vectors(X_AB: npt.ArrayLike, v_B: npt.ArrayLike) -> Array:
    """Return free vectors (n, 3) of frame B (normals, forces) expressed in frame A.

    Only the rotation of X_AB acts: a normal has no position.
    """
    X = np.asarray(X_AB, dtype=float)
    return multiply(v_B, X[:3, :3].T)


def rotation_about(axis: npt.ArrayLike, angle: npt.ArrayLike) -> Array:
    """Return the rotations (..., 3, 3) by angles (...,) [rad] about a unit axis (3,).

    Rodrigues' formula: R = 1 + sin(a) K + (1 - cos(a)) K^2, with K the cross product by the axis.
    """
    x, y, z = np.asarray(axis, dtype=float)
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    s, c = (f[..., None, None] for f in sin_cos(angle))
    return np.asarray(np.eye(3) + s * K + (1.0 - c) * multiply(K, K))


def rotation_angle(R_AB: npt.ArrayLike) -> float:
    """Return the angle of a rotation (3, 3), 0..pi [rad]."""
    cosine = (np.trace(np.asarray(R_AB, dtype=float)) - 1.0) / 2.0
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)))


#: Pose of the table-top frame T in the world.
X_WT = make_pose(np.eye(3), P_WT)
