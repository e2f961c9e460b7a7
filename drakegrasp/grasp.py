"""The grasp vector: k contact points, then k outward normals, as 6k numbers.

For a three-finger hand, these are the paper's 18 dimensions [p1 p2 p3 n1 n2 n3] (Veres et al.,
"Dataset overview"). The order of the fingers is that of the hand file. Points are in metres.
Normals are unit vectors that point out of the object.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from drakegrasp.frames import Array, rotate_vectors, transform_points, without_torch


def pack_grasp(p_AQ: npt.ArrayLike, nhat_Q_A: npt.ArrayLike) -> Array:
    """Return the grasp vector (6k,) of points (k, 3) [m] and unit normals (k, 3) in one frame A.

    Raises:
        ValueError: If the two arrays are not both (k, 3) with the same k.
    """
    points = np.asarray(without_torch(p_AQ), dtype=float)
    normals = np.asarray(without_torch(nhat_Q_A), dtype=float)
    if points.ndim != 2 or points.shape[1] != 3 or normals.shape != points.shape:
        raise ValueError(
            f"points and normals must both be (k, 3) arrays, got {points.shape} and {normals.shape}"
        )
    return np.concatenate([points.ravel(), normals.ravel()])


def unpack_grasp(grasp: npt.ArrayLike) -> tuple[Array, Array]:
    """Return points (k, 3) [m] and normals (k, 3) of a grasp vector (6k,).

    Raises:
        ValueError: If the vector's length is not a positive multiple of six.
    """
    vector = np.asarray(without_torch(grasp), dtype=float)
    if vector.ndim != 1 or vector.size == 0 or vector.size % 6:
        raise ValueError(
            "a grasp must be a vector of 6 numbers per finger (18 for three fingers), "
            f"got an array of shape {vector.shape}"
        )
    half = vector.size // 2
    return vector[:half].reshape(-1, 3), vector[half:].reshape(-1, 3)


def unused_fingers(bits: npt.ArrayLike, fingers: int) -> npt.NDArray[np.bool_]:
    """Return the fingers (..., k) that grasps leave out, from bits (...); bit 0 is the first."""
    place = np.arange(fingers, dtype=np.int64)
    return np.asarray(np.asarray(bits, dtype=np.int64)[..., None] >> place & 1, dtype=np.bool_)


def for_all_fingers(values: Array, unused: int, fingers: int, fill: float = np.nan) -> Array:
    """Return values (k, ...) for all fingers, given values (m, ...) for the used fingers.

    Args:
        values: Values of the used fingers, in their order.
        unused: The unused fingers, as bits; bit 0 is the first finger.
        fingers: Number of fingers, k.
        fill: Value for the unused fingers.
    """
    spread = np.full((fingers, *values.shape[1:]), fill, dtype=values.dtype)
    spread[~unused_fingers(unused, fingers)] = values
    return spread


def transform_grasp(X_AB: npt.ArrayLike, grasp_B: npt.ArrayLike) -> Array:
    """Return a grasp vector (6k,) of frame B in frame A, given X_AB (4, 4).

    Points are moved by the whole pose, normals by its rotation alone.
    """
    p_BQ, nhat_Q_B = unpack_grasp(grasp_B)
    return pack_grasp(transform_points(X_AB, p_BQ), rotate_vectors(X_AB, nhat_Q_B))
