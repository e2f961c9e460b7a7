"""Predicted contacts: grasp vectors become a table of contact points and normals.

Input: grasp vectors in one of four frames, as a network returned them. Output: contact points and
unit normals in that frame, or the reason why a row is not a valid grasp. An array that cannot hold
grasps at all is an error, with a message of one line.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from drakegrasp.config import LARGEST
from drakegrasp.errors import GraspError
from drakegrasp.frames import FARTHEST, Array, Frame, as_numbers, without_torch
from drakegrasp.simulation.attempts import GraspRows

#: Frames of predicted contacts.
FRAMES = (Frame.OBJECT, Frame.CAMERA, Frame.TABLE, Frame.MESH)
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
        grasps: (n, 6k), or (6k,) for one grasp: k points [m], then k outward normals. In a list of
            rows, rows of another length and rows that are not numbers are invalid rows.
        fingers: Number of fingers, k.
        rows: (n,), row of a split that each grasp is for.
        confidence: (n,), greater is better.

    Raises:
        GraspError: If the array does not hold such rows.
    """
    # Each valid row has 6k numbers.
    size = 6 * fingers
    array, invalid = _read_rows(grasps, size, fingers)

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


def _read_rows(grasps: npt.ArrayLike, size: int, fingers: int) -> tuple[Array, list[str]]:
    """Return rows (n, 6k), NaN for rows of another length, and the reasons."""
    # Rows of different lengths come as a list, or as an array of objects.
    rows = without_torch(grasps)
    rows = rows if isinstance(rows, list) else np.asarray(rows)
    if isinstance(rows, list) or (rows.dtype == object and rows.ndim == 1):
        shapes = [_shape(row) for row in rows]
        if len(set(shapes)) > 1 and any(shapes):
            array, invalid = np.full((len(rows), size), np.nan), [""] * len(rows)
            for i, (row, shape) in enumerate(zip(rows, shapes, strict=True)):
                if shape == (size,):
                    array[i] = as_numbers(row, f"a grasp must be {size} numbers")
                else:
                    numbers = 0 if shape is None else int(np.prod(shape))
                    invalid[i] = f"the row has {numbers} numbers, not {size}"
            return array, invalid

    array = as_numbers(grasps, f"a grasp must be {size} numbers")
    if array.ndim not in (1, 2) or array.shape[-1] != size:
        raise GraspError(
            f"a grasp must be {size} numbers ({fingers} points, then {fingers} outward normals), "
            f"got an array of shape {array.shape}"
        )
    array = np.atleast_2d(array)
    return array, [""] * len(array)


def _shape(row: Any) -> tuple[int, ...] | None:
    """Return the shape of a row of numbers, () for a single number; None for no numbers."""
    try:
        return as_numbers(row, "").shape
    except GraspError:
        return None
