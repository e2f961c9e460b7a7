"""What a caller hands in to be verified: grasp vectors and their frame, checked.

In: arrays of any kind. Out: contact points and unit normals in {O}, or one clear line that
says what is wrong. Whether the contacts are on the object is not asked here.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import h5py
import numpy as np
import numpy.typing as npt

from drakegrasp.errors import GraspError, first_line
from drakegrasp.frames import Array, as_numbers, invert_pose, rotate_vectors, transform_points

Frame = Literal["object", "camera", "workspace"]
FRAMES: tuple[str, ...] = get_args(Frame)

#: A predicted normal may be this much longer or shorter than one; it is then made a unit vector.
NORMAL_TOLERANCE = 0.05
#: Points farther out than so many times the bounding box are of another unit of length.
UNIT_FACTOR = 3.0


HDF5_SUFFIXES = (".h5", ".hdf5")
SUFFIXES = (".npy", ".csv", *HDF5_SUFFIXES)
#: Names of the arrays in an HDF5 file.
GRASPS, ROWS = "grasps", "rows"


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


@dataclass(frozen=True, kw_only=True, eq=False)
class Predictions:
    """What a file holds.

    Attributes:
        grasps: (n, m) with n at least 1.
        rows: (n,), the rows of a dataset's split that they are for, if the file says so.
    """

    grasps: Array
    rows: npt.NDArray[np.int64] | None = None


def read_predictions(path: Path, *, split: str | None = None) -> Predictions:
    """Return the grasps of a file.

    Args:
        path: A `.npy` file, (n, m) or (m,); a `.csv` file with a line per grasp and maybe a
            header; or an HDF5 file (`.h5`, `.hdf5`) with an array `grasps`, and maybe `rows`
            beside it, at its root or in a group.
        split: The group of an HDF5 file to take. Where there is none of that name, the root is
            taken; where no split is asked for, the only group that has grasps.

    Raises:
        GraspError: If the file cannot be read as one of these; the message names it.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise GraspError(f"{path}: grasps must be in a file {_listed(SUFFIXES)}, got {suffix!r}")
    if not path.is_file():
        raise GraspError(f"{path}: must be a file of grasps, got none")
    if suffix in HDF5_SUFFIXES:
        return _read_hdf5(path, split)
    array = read_numbers(path) if suffix == ".npy" else _read_csv(path)
    return Predictions(grasps=_grasps(array, str(path)))


def read_numbers(path: Path) -> Array:
    """Return the real numbers of a `.npy` file, of any shape; nothing in it is executed.

    Raises:
        GraspError: If it cannot be read, or holds anything else.
    """
    try:
        with path.open("rb") as file:
            array = np.lib.format.read_array(file, allow_pickle=False)
    # A damaged header may claim any size.
    except (OSError, EOFError, ValueError, MemoryError) as error:
        raise GraspError(
            f"{path}: must be a .npy file of numbers, got none ({first_line(error)})"
        ) from None
    return _real(array, str(path))


def _read_csv(path: Path) -> Array:
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise GraspError(
            f"{path}: must be a text file of numbers, got none ({first_line(error)})"
        ) from None
    rows = [(n, line.split(",")) for n, line in enumerate(lines, start=1) if line.strip()]
    # One number in the first line is enough: a mistyped grasp must not pass for a header, and
    # neither must numbers that something else than commas divides.
    if rows and len(rows[0][1]) > 1 and not any(_is_number(cell) for cell in rows[0][1]):
        del rows[0]
    for number, cells in rows:
        for column, cell in enumerate(cells, start=1):
            if not _is_number(cell):
                raise GraspError(
                    f"{path}, line {number}: must be numbers with commas between them, "
                    f"got {cell.strip()[:40]!r} as number {column}"
                )
        if len(cells) != len(rows[0][1]):
            raise GraspError(
                f"{path}, line {number}: must have {len(rows[0][1])} numbers like line "
                f"{rows[0][0]}, got {len(cells)}"
            )
    return np.array([[float(cell) for cell in cells] for _, cells in rows])


def _read_hdf5(path: Path, split: str | None) -> Predictions:
    try:
        with h5py.File(path, "r") as file:
            group = _choose_group(path, file, split)
            where = f"{path}: {_place(group, GRASPS)}"
            grasps = _grasps(_real(group[GRASPS][()], where), where)
            if not isinstance(group.get(ROWS), h5py.Dataset):
                return Predictions(grasps=grasps)
            rows = np.asarray(group[ROWS][()])
            place = _place(group, ROWS)
    except (OSError, KeyError, RuntimeError) as error:
        raise GraspError(
            f"{path}: must be an HDF5 file with grasps, got none ({first_line(error)})"
        ) from None
    if rows.dtype.kind not in "iu" or rows.shape != (len(grasps),):
        raise GraspError(
            f"{path}: {place} must be a whole number for each of the {len(grasps)} grasps, "
            f"got {rows.dtype} of shape {rows.shape}"
        )
    return Predictions(grasps=grasps, rows=rows.astype(np.int64))


def _choose_group(path: Path, file: h5py.File, split: str | None) -> h5py.Group:
    groups = {"": file} | {k: v for k, v in file.items() if isinstance(v, h5py.Group)}
    found = {k: v for k, v in groups.items() if isinstance(v.get(GRASPS), h5py.Dataset)}
    if split in found:
        return found[split]
    if "" in found:
        return found[""]
    if split is None and len(found) == 1:
        return next(iter(found.values()))
    must = f"in /{split} or at the root" if split else "at the root or in one group"
    got = ", ".join(f"/{name}" for name in found)
    choose = "; choose with --split" if found else ""
    raise GraspError(
        f"{path}: must hold an array {GRASPS!r} {must}, got {f'them in {got}' if got else 'none'}"
        + choose
    )


def _grasps(array: Array, where: str) -> Array:
    """Return an array as one with a row per grasp, if it is that or a single grasp."""
    if array.size == 0:
        raise GraspError(f"{where}: must hold at least one grasp, got none")
    if array.ndim not in (1, 2):
        raise GraspError(
            f"{where}: must be an array with a row per grasp, or one grasp, "
            f"got one of shape {array.shape}"
        )
    return np.atleast_2d(array)


def _real(values: Any, where: str) -> Array:
    array = np.asarray(values)
    if array.dtype.kind not in "fiu":
        raise GraspError(f"{where}: must hold real numbers, got values of type {array.dtype}")
    return array.astype(np.float64)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _place(group: h5py.Group, name: str) -> str:
    return f"{group.name.rstrip('/')}/{name}"


def _listed(names: tuple[str, ...]) -> str:
    return f"{', '.join(names[:-1])} or {names[-1]}"
