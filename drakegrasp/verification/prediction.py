"""Predicted contacts: grasp vectors become a table of contact points and normals.

Input: grasp vectors in one of five frames, as a network returned them. Output: contact points and
unit normals in that frame, or the reason why a row is not a valid grasp. An array that cannot hold
grasps at all is an error, with a message of one line.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from drakegrasp.config import LARGEST
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.errors import GraspError
from drakegrasp.frames import FARTHEST, Array, as_numbers
from drakegrasp.simulation.attempts import GraspRows, read_confidence

#: The row of a split for each of n grasps, or one row for all; None for all rows, in order.
RowChoice: TypeAlias = Sequence[int] | npt.NDArray[np.int64] | int | None

#: A normal whose length differs from one by more than this is reported as normalised.
NORMAL_TOLERANCE = 0.01
#: Length below which a normal has no direction.
SHORTEST_NORMAL = 1e-6


@dataclass(frozen=True, kw_only=True, eq=False)
class ContactRows(GraspRows):
    """n grasps of k contacts, without wrist and joints, built by `read_grasps`.

    Attributes:
        grasps: (n, 6k), the numbers as they were given.
        points, normals: (n, k, 3), contact points [m] and unit normals in the frame of the caller;
            NaN in rows without a valid grasp.
        normalised: (n,), whether a normal was not of unit length.
    """

    grasps: Array
    points: Array
    normals: Array
    normalised: npt.NDArray[np.bool_]

    def numbers(self) -> Array:
        """Return the numbers (n, 6k) as they were given."""
        return self.grasps


def read_grasps(
    grasps: npt.ArrayLike,
    fingers: int,
    *,
    rows: npt.NDArray[np.int64] | None = None,
    confidence: Array | None = None,
) -> ContactRows:
    """Return the grasps of grasp vectors (n, 6k); a bad row does not affect other rows.

    Args:
        grasps: (n, 6k), or (6k,) for one grasp: k points [m], then k outward normals.
        fingers: Number of fingers, k.
        rows: (n,), row of a split that each grasp is for.
        confidence: (n,), greater is better.

    Raises:
        GraspError: If the array does not hold such rows.
    """
    # Each valid row has 6k numbers.
    size = 6 * fingers
    array = as_numbers(grasps, f"a grasp must be {size} numbers")
    if array.ndim not in (1, 2) or array.shape[-1] != size:
        raise GraspError(
            f"a grasp must be {size} numbers ({fingers} points, then {fingers} outward normals), "
            f"got an array of shape {array.shape}"
        )
    array = np.atleast_2d(array)
    invalid = [""] * len(array)

    # Reject numbers that no contact has.
    limit = np.r_[np.full(size // 2, FARTHEST), np.full(size // 2, LARGEST)]
    usable = np.abs(array) <= limit  # false for NaN
    for row, column in zip(*np.nonzero(~usable), strict=True):
        value = array[row, column]
        must = f"beyond {limit[column]:g}" if np.isfinite(value) else "not finite"
        invalid[row] = invalid[row] or f"number {column + 1} is {value:g}, {must}"

    # Reject normals without a direction.
    known = np.where(usable, array, np.nan)
    points, normals = known.reshape(len(array), 2, fingers, 3).swapaxes(0, 1).copy()
    length = np.linalg.norm(normals, axis=-1)
    for row, finger in zip(*np.nonzero(length < SHORTEST_NORMAL), strict=True):
        invalid[row] = invalid[row] or f"normal {finger + 1} is zero"

    # Normalise the remaining normals.
    bad = np.array([bool(reason) for reason in invalid], dtype=np.bool_)
    points[bad], normals[bad], length[bad] = np.nan, np.nan, 1.0
    return ContactRows(
        row=np.arange(len(array), dtype=np.int64),
        invalid=tuple(invalid),
        of_row=rows,
        confidence=confidence,
        grasps=array,
        points=points,
        normals=normals / length[..., None],
        normalised=np.abs(length - 1.0).max(axis=1, initial=0.0) > NORMAL_TOLERANCE,
    )


def choose_rows(
    dataset: GraspDataset,
    rows: RowChoice,
    count: int,
    *,
    said: str = "`rows` says for which rows they are",
) -> npt.NDArray[np.int64]:
    """Return the row (n,) of the dataset's split for each of `count` grasps; one may be for all.

    `said` is the part of the error message that explains how to give rows.

    Raises:
        GraspError: If there is not exactly one row per grasp, or a row does not exist.
    """
    chosen = np.arange(count) if rows is None else np.asarray(rows)
    # NumPy treats an empty list as real numbers.
    if chosen.size and chosen.dtype.kind not in "iu":
        raise GraspError(f"rows must be whole numbers, got values of type {chosen.dtype}")
    chosen = chosen.astype(np.int64)
    chosen = np.full(count, chosen) if chosen.ndim == 0 else chosen.ravel()

    # Check that there is one row per grasp.
    if len(chosen) != count:
        raise GraspError(f"rows must be one per grasp ({count}), got {len(chosen)}")
    if not len(dataset):
        raise GraspError(f"{dataset.path}: {dataset.emptiness}")
    if rows is None and count != len(dataset):
        raise GraspError(
            f"without rows there must be a grasp for each of the {len(dataset)} rows of "
            f"{dataset.split} in {dataset.path.name}, got {count} grasps ({said})"
        )

    # Check that the rows exist.
    wrong = chosen[(chosen < 0) | (chosen >= len(dataset))]
    if len(wrong):
        raise GraspError(
            f"rows must be 0 to {len(dataset) - 1} of {dataset.split} in {dataset.path.name}, "
            f"got {wrong[0]}"
        )
    return chosen


def read_several(
    grasps: npt.ArrayLike,
    data: GraspDataset,
    *,
    fingers: int,
    rows: RowChoice = None,
    confidence: npt.ArrayLike | None = None,
) -> ContactRows:
    """Return predicted contacts for rows of a split; a row may have several predictions.

    Args:
        grasps: (n, 6k), or (n, m, 6k) with m grasps per row. NaN is kept: it is a bad prediction,
            not a mistake of the caller.
        data: The split.
        fingers: Number of fingers, k.
        rows: (n,), row that each prediction is for, with repeats; None for all rows in order.
        confidence: (n,) or (n, m), greater is better.

    Raises:
        GraspError: If the shapes do not match, or a row does not exist.
    """
    array = as_numbers(grasps, "grasps must be numbers")
    if array.ndim not in (2, 3) or array.size == 0:
        raise GraspError(f"grasps must be (n, 6k), or (n, m, 6k) for m per row, got {array.shape}")
    of_row = np.repeat(choose_rows(data, rows, len(array)), array[0, ..., 0].size)
    stated = None
    if confidence is not None:
        stated = read_confidence(confidence, array.shape[:-1]).ravel()
    flat = array.reshape(-1, array.shape[-1])
    return read_grasps(flat, fingers, rows=of_row, confidence=stated)
