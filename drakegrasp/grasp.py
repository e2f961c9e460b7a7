"""The grasp as a vector, and which grasps are distinct.

The grasp vector is k contact points, then k outward normals, as 6k numbers.

For a three-finger hand, these are the paper's 18 dimensions [p1 p2 p3 n1 n2 n3] (Veres et al.,
"Dataset overview"). The order of the fingers is that of the hand file. Points are in metres.
Normals are unit vectors that point out of the object.

Grasps a few millimetres from each other teach a network little more than one of them, so datasets
are measured by what is distinct: by the palm poses, and by the cell of directions and the height
above the table from which the palm approaches.
"""

from __future__ import annotations

from itertools import combinations, product

import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import dot, norm, sin_cos_deg
from drakegrasp.frames import Array, rotate_vectors, transform_points, without_torch

#: A grasp is not distinct if its palm is within this distance [m] and this angle [degree] of the
#: palm of a distinct grasp.
NEAR_SHIFT, NEAR_TURN = 0.020, 30.0
#: Bands of elevation above the table, from the side to straight from above [degree].
BANDS = ((0, 30), (30, 60), (60, 90))
#: Limits are inclusive by more than rounding: lengths [m], angles [rad] and their cosines.
EDGE = 1e-9


# The grasp vector


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


# Distinct grasps


def distinct_grasps(groups: npt.ArrayLike, X_OG: Array) -> npt.NDArray[np.bool_]:
    """Return which grasps (n,) are distinct: those that no earlier distinct grasp is near to.

    These are a greedy cover of the palm poses, in the order of the rows: every other palm pose is
    within `NEAR_SHIFT` and `NEAR_TURN` of that of a distinct grasp of its group. Memory and time
    grow with the number of rows, because a grasp is compared with the distinct ones around it.

    Args:
        groups: (n,) or (n, m), equal for grasps of the same object and resting pose.
        X_OG: (n, 4, 4), palm poses in the frame of their object.
    """
    # A palm is near only to palms of its cube, and of the 26 cubes around it.
    p, R = X_OG[:, :3, 3], X_OG[:, :3, :3].reshape(-1, 9)
    _, number = np.unique(np.asarray(groups), axis=0, return_inverse=True)
    cubes = np.floor(p / (NEAR_SHIFT + EDGE)).astype(np.int64)
    places = np.column_stack([number.ravel(), cubes]).tolist()
    around = list(product((0, -1, 1), repeat=3))

    found: dict[tuple[int, int, int, int], list[int]] = {}
    distinct = np.zeros(len(X_OG), dtype=np.bool_)
    for row, (group, x, y, z) in enumerate(places):
        others = [
            other
            for dx, dy, dz in around
            for other in found.get((group, x + dx, y + dy, z + dz), ())
        ]
        if others and _is_near(p[row], R[row], p[others], R[others]):
            continue
        distinct[row] = True
        found.setdefault((group, x, y, z), []).append(row)
    return distinct


def _is_near(p: Array, R: Array, others_p: Array, others_R: Array) -> bool:
    """Return whether a palm is near to any other (m,), of origins (m, 3) and rotations (m, 9)."""
    close = norm(others_p - p) <= NEAR_SHIFT + EDGE
    # The trace of R_A^T R_B is 1 + 2 cos(angle).
    cosine = (dot(others_R[close], R) - 1.0) / 2.0
    return bool((cosine >= sin_cos_deg(NEAR_TURN)[1] - EDGE).any())


def cell_directions() -> Array:
    """Return the directions (42, 3) of the cells: the vertices of an icosahedron subdivided once.

    First the twelve vertices of an icosahedron, then the middles of its thirty edges, in the order
    of the edges' vertices; all of length one.
    """
    # (0, ±1, ±golden) and its cyclic permutations; vertices of an edge are at distance 2.
    golden = (1.0 + np.sqrt(5.0)) / 2.0
    corners = [np.roll([0.0, a, b * golden], k) for k in range(3) for a, b in _SIGNS]
    edges = [a + b for a, b in combinations(corners, 2) if abs(float(norm(a - b)) - 2.0) < 0.1]
    directions = np.array([*corners, *edges])
    return np.asarray(directions / norm(directions)[:, None])


_SIGNS = tuple(product((1.0, -1.0), repeat=2))


def approach_cells(X_OG: Array) -> npt.NDArray[np.int64]:
    """Return the cell (n,) of each palm: the nearest of `cell_directions` to its +Gz in {O}.

    Of directions that are equally near, the first counts.

    Args:
        X_OG: (n, 4, 4), palm poses in the frame of their object.
    """
    nearness = dot(X_OG[:, None, :3, 2], cell_directions()[None])
    return np.rint(nearness / EDGE).argmax(axis=1)


def elevation(X_TG: Array) -> Array:
    """Return the elevation (n,) of the approach of each palm above the table [rad].

    It is the angle between -Gz and the table's plane: pi/2 straight from above, negative from
    below.

    Args:
        X_TG: (n, 4, 4), palm poses in the frame of the table.
    """
    return np.asarray(np.arcsin(np.clip(-X_TG[:, 2, 2], -1.0, 1.0)))


def elevation_bands(X_TG: Array) -> npt.NDArray[np.int64]:
    """Return the index (n,) of the band of `BANDS` from which each palm approaches.

    A border belongs to the lower band; below the table is in the lowest.

    Args:
        X_TG: (n, 4, 4), palm poses in the frame of the table.
    """
    borders = np.deg2rad([upper for _, upper in BANDS[:-1]]) + EDGE
    return np.searchsorted(borders, elevation(X_TG))
