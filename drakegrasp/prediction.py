"""What a caller hands in to be verified: grasp vectors and their frame, checked.

In: arrays of any kind. Out: contact points and unit normals in {O}, or one clear line that
says what is wrong. Whether the contacts are on the object is not asked here.
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from drakegrasp.errors import GraspError
from drakegrasp.frames import Array, invert_pose, rotate_vectors, transform_points

Frame = Literal["object", "camera", "workspace"]
FRAMES: tuple[str, ...] = get_args(Frame)

#: A predicted normal may be this much longer or shorter than one; it is then made a unit vector.
NORMAL_TOLERANCE = 0.05
#: How far a rotation matrix may be from orthogonal: files hold them in single precision.
ROTATION_TOLERANCE = 1e-4
#: Points farther out than so many times the bounding box are of another unit of length.
UNIT_FACTOR = 3.0

#: What else an array may hold, by NumPy's letter.
_OTHER_KINDS = {"U": "text", "S": "text", "b": "truth values", "c": "complex numbers"}


def read_grasps(grasps: npt.ArrayLike, fingers: int) -> tuple[Array, Array]:
    """Return points (n, k, 3) [m] and unit normals (n, k, 3) of grasp vectors (n, 6k).

    Args:
        grasps: (n, 6k), or (6k,) for one: k points [m], then k outward normals.
        fingers: Number of fingers, k.

    Raises:
        GraspError: If the numbers are not finite, not 6k, or a normal is not of unit length
            within 5 %.
    """
    size = 6 * fingers
    array = as_numbers(grasps, f"a grasp must be {size} numbers")
    if array.ndim not in (1, 2) or array.shape[-1] != size:
        raise GraspError(
            f"a grasp must be {size} numbers ({fingers} points, then {fingers} outward normals), "
            f"got an array of shape {array.shape}"
        )
    array = np.atleast_2d(array)
    finite = np.isfinite(array)
    if not finite.all():
        row, number = np.argwhere(~finite)[0]
        raise GraspError(
            f"{_of(array, row)}number {number + 1} must be finite, got {array[row, number]}"
        )
    points, normals = array.reshape(len(array), 2, fingers, 3).swapaxes(0, 1)
    length = np.linalg.norm(normals, axis=-1)
    wrong = np.abs(length - 1.0) > NORMAL_TOLERANCE
    if wrong.any():
        row, finger = np.argwhere(wrong)[0]
        raise GraspError(
            f"{_of(array, row)}normal {finger + 1} must be of length 1 within "
            f"{NORMAL_TOLERANCE:.0%}, got {length[row, finger]:.3g}"
        )
    return points, normals / length[..., None]


def _of(rows: Array, row: int) -> str:
    return f"grasp {row}: " if len(rows) > 1 else ""


def as_numbers(value: npt.ArrayLike, must: str) -> Array:
    """Return an array of real numbers, of any shape; text and truth values are none.

    Args:
        value: The numbers.
        must: What the error says that it must be.

    Raises:
        GraspError: If it is anything else.
    """
    try:
        array = np.asarray(value)
    except (TypeError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise GraspError(f"{must}, got a {type(value).__name__} that is none ({reason})") from None
    # No grasps at all may come as an empty list, which NumPy takes for real numbers.
    if array.dtype.kind not in "fiu":
        got = _OTHER_KINDS.get(array.dtype.kind, f"a {type(value).__name__}")
        raise GraspError(f"{must}, got {'None' if value is None else got}")
    return array.astype(np.float64)


def read_pose(X_AB: npt.ArrayLike, name: str) -> Array:
    """Return a pose (4, 4), or poses (n, 4, 4), with exact rotations.

    Args:
        X_AB: (4, 4), (3, 4) or (12,), or many of them.
        name: What to call it in an error.

    Raises:
        GraspError: If it is no pose.
    """
    X = as_numbers(X_AB, f"{name} must be a pose, 4 x 4 numbers")
    if X.shape[-1:] == (12,):
        X = X.reshape(*X.shape[:-1], 3, 4)
    if X.shape[-2:] == (3, 4):
        last = np.broadcast_to([0.0, 0.0, 0.0, 1.0], (*X.shape[:-2], 1, 4))
        X = np.concatenate([X, last], axis=-2)
    if X.ndim not in (2, 3) or X.shape[-2:] != (4, 4):
        raise GraspError(f"{name} must be a pose, 4 x 4 numbers, got an array of shape {X.shape}")
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
    U, _, Vt = np.linalg.svd(R)
    exact = X.copy()
    exact[..., :3, :3], exact[..., 3, :] = U @ Vt, [0.0, 0.0, 0.0, 1.0]
    return exact


def to_object_frame(
    points: Array, normals: Array, *, frame: str, X: Array | None, X_TO: Array
) -> tuple[Array, Array]:
    """Return points and normals (n, k, 3), given in one of three frames, in {O}.

    Args:
        points: (n, k, 3) [m].
        normals: (n, k, 3).
        frame: "object" {O}, "camera" {C} or "workspace" {T}.
        X: For the camera frame the pose of the camera in the table-top frame, X_TC (4, 4), or
            one per grasp (n, 4, 4).
        X_TO: (4, 4), pose of the object.

    Raises:
        GraspError: If the frame is unknown, or a camera's pose is missing or out of place.
    """
    if frame not in FRAMES:
        raise GraspError(f"frame must be one of {', '.join(FRAMES)}, got {frame!r}")
    if frame == "camera" and X is None:
        raise GraspError(
            "X must be the camera's pose in the table-top frame (X_TC, frame_work2cam in the "
            "files) where frame is camera, got None"
        )
    if frame != "camera" and X is not None:
        raise GraspError(f"X must be None where frame is {frame}, got a pose")
    if frame == "object":
        return points, normals
    X_OT = invert_pose(X_TO)
    X_OA = X_OT if X is None else X_OT @ X
    if X_OA.ndim == 2:
        X_OA = np.broadcast_to(X_OA, (len(points), 4, 4))
    if len(X_OA) != len(points):
        raise GraspError(f"X must be one pose, or one per grasp ({len(points)}), got {len(X_OA)}")
    moved = [transform_points(A, p) for A, p in zip(X_OA, points, strict=True)]
    turned = [rotate_vectors(A, n) for A, n in zip(X_OA, normals, strict=True)]
    # No grasps at all keep their shape, too.
    return np.reshape(moved, points.shape), np.reshape(turned, normals.shape)


def boxes_away(p_OQ: Array, half_extents: Array) -> float:
    """Return how many times the bounding box the nearest of points (n, k, 3) is out; 1 is on it."""
    return float(np.abs(p_OQ / half_extents).max(axis=-1).min(initial=np.inf))


def refuse_other_units(p_OQ: Array, half_extents: Array) -> None:
    """Refuse points (n, k, 3) that are all far outside of the object.

    Raises:
        GraspError: If every point is beyond three times the bounding box.
    """
    factor = boxes_away(p_OQ, half_extents)
    if p_OQ.size and factor > UNIT_FACTOR:
        size = " x ".join(f"{edge:.3g}" for edge in 2.0 * half_extents)
        raise GraspError(
            f"contact points must lie on the object, whose box is {size} m, got points all "
            f"outside {UNIT_FACTOR:g} times that (the nearest at {factor:.3g} times): are grasp "
            "and mesh in the same units (metres, see units) and is the frame the right one?"
        )
