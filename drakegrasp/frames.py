"""Frame letters and the packing of poses. Uses NumPy only.

Drake's monogram notation is used everywhere: `X_AB` is the pose of frame B expressed in frame A (it
maps coordinates in B to coordinates in A), `R_AB` its rotation, `p_AB` its translation. Composition
matches neighbouring letters: `X_AC = multiply(X_AB, X_BC)` (`arithmetic.multiply`, whose bits do
not depend on the CPU).

`Frame` names the frames in which a caller may give or ask for grasps.

Letters: W world, T table-top centre, O object (centre of the mesh's bounding box, axes of the file
turned so that its `up` is +z), M mesh (origin and axes of the file), Ocm the object's centre of
mass, G palm (+Gz out of the palm), Fi distal link of finger i, Qi contact point of finger i, C
camera (+X right, +Y down, +Z forward), I image frame.

Inside the package a pose is a (4, 4) float64 array. In files it is (12,): the first three rows,
row-major. Drake's `RigidTransform` is used only where Drake is called.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Any

import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import Array as Array
from drakegrasp.arithmetic import multiply, sin_cos
from drakegrasp.errors import GraspError, first_line

#: Position of the table-top centre T in the world [m] (Veres et al., "Coordinate frames").
P_WT = np.array([0.0, 0.0, 0.65])
#: Acceleration of gravity along -Wz [m/s^2], that of Drake.
GRAVITY = 9.81

#: Largest deviation of a rotation matrix from orthogonal; files store them in single precision.
ROTATION_TOLERANCE = 1e-4
#: Largest distance of a contact or a palm from the origin of its frame [m].
FARTHEST = 1e3
#: Names of other kinds of array in errors, by NumPy's letter.
_OTHER_KINDS = {"U": "text", "S": "text", "b": "truth values", "c": "complex numbers"}


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

    Only the rotation of X_AB is applied, because a free vector has no position.
    """
    X = np.asarray(X_AB, dtype=float)
    return multiply(v_B, X[:3, :3].T)


def rotation_about(axis: npt.ArrayLike, angle: npt.ArrayLike) -> Array:
    """Return the rotations (..., 3, 3) by angles (...,) [rad] about a unit axis (3,).

    Rodrigues' formula: R = 1 + sin(a) K + (1 - cos(a)) K^2, where K is the cross product with the
    axis.
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


class Frame(StrEnum):
    """The frames of grasps that a caller gives or asks for."""

    OBJECT = "object"  # {O}
    TABLE = "table"  # {T}
    CAMERA = "camera"  # {C}
    WORLD = "world"  # {W}
    MESH = "mesh"  # {M}, the axes and the origin of the mesh file
    PALM = "palm"  # {G}


#: The frames in which grasps are given; those of a file of grasps, too.
GRASP_FRAMES = (Frame.OBJECT, Frame.TABLE, Frame.CAMERA, Frame.WORLD, Frame.MESH)


def validate_frame(frame: object) -> None:
    """Reject anything but the name of one of `GRASP_FRAMES`.

    Raises:
        GraspError: If it is none of them.
    """
    if frame not in GRASP_FRAMES:
        raise GraspError(f"frame must be one of {', '.join(GRASP_FRAMES)}, got {frame!r}")


def frame_in_object(
    frame: str,
    X_TO: Array | None,
    X_OM: Array | None = None,
    X_TC: Array | None = None,
) -> Array:
    """Return the pose X_OF (4, 4) of a frame {F} in {O}.

    Args:
        frame: A `Frame`, except for the palm.
        X_TO: Pose (4, 4) of the object on the table, for any frame but "object" and "mesh".
        X_OM: Pose (4, 4) of the mesh file's frame in {O}, for the frame "mesh".
        X_TC: Pose (4, 4) of the camera in {T}, for the frame "camera".

    Raises:
        GraspError: If a pose is not given that the frame needs.
    """
    if frame == Frame.OBJECT:
        return np.eye(4)
    if frame == Frame.MESH:
        return _given(X_OM, "X_OM", frame)
    X_OT = invert_pose(_given(X_TO, "X_TO", frame))
    if frame == Frame.TABLE:
        return X_OT
    X_TF = invert_pose(X_WT) if frame == Frame.WORLD else _given(X_TC, "X_TC", frame)
    return multiply(X_OT, X_TF)


def _given(X: Array | None, name: str, frame: str) -> Array:
    if X is None:
        raise GraspError(f"{name} must be given with the frame {frame}, got None")
    return X


def without_torch(value: Any) -> Any:
    """Return torch tensors, also in lists, as NumPy arrays, and other values unchanged.

    NumPy rejects tensors that require gradients, and has no bfloat16.
    """
    if isinstance(value, list | tuple):
        return [without_torch(each) for each in value]
    if not hasattr(value, "is_floating_point"):
        return value
    tensor = value.detach().cpu()
    return (tensor.double() if tensor.is_floating_point() else tensor).numpy()


def as_numbers(value: npt.ArrayLike, must: str) -> Array:
    """Return an array of real numbers, of any shape; text and truth values are rejected.

    Args:
        value: The numbers.
        must: Beginning of the error message, e.g. "X_TC must be a pose".

    Raises:
        GraspError: If the value is anything else.
    """
    try:
        plain = without_torch(value)
        array = np.asarray(plain)
    except (TypeError, ValueError, RuntimeError) as error:
        raise GraspError(
            f"{must}, got a {type(value).__name__} that cannot be read ({first_line(error)})"
        ) from None
    # An empty list is accepted: NumPy gives it real numbers. It also reads [True, 0.5] as numbers.
    kind = array.dtype.kind
    if kind in "fiu" and isinstance(plain, list):
        flat = np.asarray(plain, dtype=object).flat
        kind = "b" if any(isinstance(each, bool | np.bool_) for each in flat) else kind
    if kind not in "fiu":
        got = _OTHER_KINDS.get(kind, f"a {type(value).__name__}")
        raise GraspError(f"{must}, got {'None' if value is None else got}")
    return array.astype(np.float64)


def read_pose(X_AB: npt.ArrayLike, name: str) -> Array:
    """Return a pose (4, 4), or poses (n, 4, 4), with exact rotations.

    Args:
        X_AB: (4, 4), (3, 4) or (12,), or many poses in one of these shapes.
        name: Name of the argument in errors.

    Raises:
        GraspError: If X_AB is not a pose.
    """
    # Any layout as (4, 4) or (n, 4, 4).
    X = as_numbers(X_AB, f"{name} must be a pose, 4 x 4 numbers")
    if X.shape[-1:] == (12,):
        X = X.reshape(*X.shape[:-1], 3, 4)
    if X.shape[-2:] == (3, 4):
        last = np.broadcast_to([0.0, 0.0, 0.0, 1.0], (*X.shape[:-2], 1, 4))
        X = np.concatenate([X, last], axis=-2)
    if X.ndim not in (2, 3) or X.shape[-2:] != (4, 4):
        raise GraspError(f"{name} must be a pose, 4 x 4 numbers, got an array of shape {X.shape}")

    # Reject what is not a rigid transform.
    if not np.isfinite(X).all():
        raise GraspError(f"{name} must be finite, got numbers that are not")
    if np.any(np.abs(X[..., 3, :] - [0.0, 0.0, 0.0, 1.0]) > ROTATION_TOLERANCE):
        raise GraspError(
            f"{name} must have 0 0 0 1 as its last row, got another: are rows and columns swapped?"
        )
    R = X[..., :3, :3]
    off = float(np.abs(np.swapaxes(R, -1, -2) @ R - np.eye(3)).max(initial=0.0))
    if off > ROTATION_TOLERANCE or np.any(np.linalg.det(R) < 0.0):
        raise GraspError(
            f"{name} must hold a rotation, an orthogonal matrix with determinant +1, "
            f"got one that is off by {off:.2g} with determinant {np.linalg.det(R).min():.3g}"
        )

    # Replace each rotation by the closest exact rotation (orthogonal Procrustes).
    U, _, Vt = np.linalg.svd(R)
    exact = X.copy()
    exact[..., :3, :3], exact[..., 3, :] = U @ Vt, [0.0, 0.0, 0.0, 1.0]
    return exact
