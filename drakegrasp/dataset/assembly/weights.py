"""How much a sample counts among others that are like it, and how many samples count in effect.

Grasps that are all alike are not more grasps: a palm pose that was refined gives many with almost
the same palm. A sample's weight is 1 / (number of samples of the same object and resting pose whose
palm is near, itself included). Imports NumPy only.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import dot, norm
from drakegrasp.frames import Array

#: Palms are near within this distance [m] and angle [rad].
NEAR_SHIFT, NEAR_TURN = 0.010, float(np.deg2rad(15.0))
#: Samples whose distances from all others of their group are computed together.
BLOCK = 256


def weigh_samples(groups: npt.ArrayLike, X_OG: Array) -> Array:
    """Return the weight (n,) of each sample.

    Args:
        groups: (n,) or (n, m), equal for samples of the same object and resting pose.
        X_OG: (n, 4, 4), poses of the palm.
    """
    count = np.ones(len(X_OG))
    for rows in _rows_by_group(np.asarray(groups)):
        p, R = X_OG[rows, :3, 3], X_OG[rows, :3, :3].reshape(-1, 9)
        for start in range(0, len(rows), BLOCK):
            part = slice(start, start + BLOCK)
            # The trace of R_A^T R_B is 1 + 2 cos(angle).
            shift = norm(p[part, None] - p[None])
            cosine = (dot(R[part, None], R[None]) - 1.0) / 2.0
            near = (shift <= NEAR_SHIFT) & (cosine >= np.cos(NEAR_TURN))
            count[rows[part]] = near.sum(axis=1)
    return 1.0 / count


def number_poses(meshes: Sequence[str], up: Sequence[npt.ArrayLike]) -> list[npt.NDArray[np.int64]]:
    """Return a number (r,) of each resting pose of each object.

    It is another for each pose; but a mesh that has several seeds has drops of each, and poses of
    these that are near count as one.

    Args:
        meshes: Names of the objects' meshes.
        up: (r, 3) of each object: upward directions in {O} of its resting poses.
    """
    known: dict[str, tuple[Array, npt.NDArray[np.int64]]] = {}
    numbers, count = list[npt.NDArray[np.int64]](), 0
    for mesh, directions in zip(meshes, map(np.asarray, up), strict=True):
        own = np.arange(count, count + len(directions))
        count += len(directions)
        if mesh not in known:
            known[mesh] = directions, own
        else:
            # The nearest pose of another seed.
            theirs, indices = known[mesh]
            cosine = dot(directions[:, None], theirs[None])
            near = cosine.max(axis=1) >= np.cos(NEAR_TURN)
            own = np.where(near, indices[cosine.argmax(axis=1)], own)
            known[mesh] = np.concatenate([theirs, directions]), np.concatenate([indices, own])
        numbers.append(own)
    return numbers


def effective_number(weights: npt.ArrayLike) -> float:
    """Return how many samples (n,) count in effect, (sum w)^2 / sum w^2 (Kish 1965)."""
    w = np.asarray(weights, dtype=float)
    return float(w.sum() ** 2 / (w * w).sum()) if len(w) else 0.0


def _rows_by_group(groups: npt.NDArray[np.generic]) -> Iterator[npt.NDArray[np.int64]]:
    _, numbers = np.unique(groups, axis=0, return_inverse=True)
    order = np.argsort(numbers.ravel(), kind="stable")
    starts = np.flatnonzero(np.diff(numbers.ravel()[order])) + 1
    yield from np.split(order, starts)
