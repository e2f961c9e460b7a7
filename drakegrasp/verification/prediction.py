"""Predicted grasps, from arrays or files, checked and expressed in {O}.

In: grasp vectors in one of three frames, as a network put them out. Out: contact points and unit
normals in {O}; for a row that is no grasp the reason. An array that is none of grasps at all is an
error that says in one line what is wrong.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import h5py
import numpy as np
import numpy.typing as npt

from drakegrasp.config import LARGEST
from drakegrasp.dataset.hdf5 import open_hdf5
from drakegrasp.errors import GraspError, MachineError, first_line
from drakegrasp.foreign_files import read_text, refuse_irregular
from drakegrasp.frames import FARTHEST, NO_MESH_FRAME, Array, as_numbers, invert_pose, without_torch

Frame = Literal["object", "camera", "table", "mesh"]
FRAMES: tuple[str, ...] = get_args(Frame)
#: An earlier name of the frame "table", which is read still.
WORKSPACE = "workspace"

#: A normal whose length differs from one by more is said to have been normalised.
NORMAL_TOLERANCE = 0.01
#: A shorter normal has no direction.
SHORTEST_NORMAL = 1e-6
#: Suffixes of files with grasps.
HDF5_SUFFIXES = (".h5", ".hdf5")
SUFFIXES = (".npy", ".csv", *HDF5_SUFFIXES, ".parquet")
#: What to do with poses in place of contacts.
_POSES = ": poses of the palm go with joints into a file of postures, as X_FG, object and q_grasp"
#: Names of the arrays in an HDF5 file, and of the columns in a Parquet file.
GRASPS, ROWS, CONFIDENCE = "grasps", "rows", "confidence"


@dataclass(frozen=True, kw_only=True, eq=False)
class GraspRows:
    """The grasps of n rows of numbers, in their frame.

    Attributes:
        points, normals: (n, k, 3), contact points [m] and unit normals; NaN in rows that are no
            grasp.
        normalised: (n,), whether a normal was not of unit length.
        invalid: (n,), why each row is no grasp; empty where it is one.
    """

    points: Array
    normals: Array
    normalised: npt.NDArray[np.bool_]
    invalid: tuple[str, ...]


def read_grasps(grasps: npt.ArrayLike, fingers: int) -> GraspRows:
    """Return the grasps of grasp vectors (n, 6k), each by itself: a bad row spoils no other.

    Args:
        grasps: (n, 6k), or (6k,) for one: k points [m], then k outward normals. A list of rows of
            which some have another length, or are no numbers, is one with invalid rows.
        fingers: Number of fingers, k.

    Raises:
        GraspError: If the array is none of such rows at all.
    """
    # 6k numbers in each row that has as many.
    size = 6 * fingers
    array, invalid = _read_rows(grasps, size, fingers)

    # Numbers that no contact has.
    limit = np.r_[np.full(size // 2, FARTHEST), np.full(size // 2, LARGEST)]
    usable = np.abs(array) <= limit  # false for NaN
    for row, column in zip(*np.nonzero(~usable), strict=True):
        value = array[row, column]
        must = f"beyond {limit[column]:g}" if np.isfinite(value) else "not finite"
        invalid[row] = invalid[row] or f"number {column + 1} is {value:g}, {must}"

    # Normals without a direction.
    known = np.where(usable, array, np.nan)
    points, normals = known.reshape(len(array), 2, fingers, 3).swapaxes(0, 1).copy()
    length = np.linalg.norm(normals, axis=-1)
    for row, finger in zip(*np.nonzero(length < SHORTEST_NORMAL), strict=True):
        invalid[row] = invalid[row] or f"normal {finger + 1} is zero"

    # Unit normals in the others.
    bad = np.array([bool(reason) for reason in invalid], dtype=np.bool_)
    points[bad], normals[bad], length[bad] = np.nan, np.nan, 1.0
    return GraspRows(
        points=points,
        normals=normals / length[..., None],
        normalised=np.abs(length - 1.0).max(axis=1, initial=0.0) > NORMAL_TOLERANCE,
        invalid=tuple(invalid),
    )


def _read_rows(grasps: npt.ArrayLike, size: int, fingers: int) -> tuple[Array, list[str]]:
    """Return rows (n, 6k), NaN where a row has another length, and the reasons."""
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
    """Return the shape of a row of numbers; None if it is none, () for a single one."""
    try:
        return as_numbers(row, "").shape
    except GraspError:
        return None


def frame_poses(
    *, frame: str, X_TC: Array | None, X_TO: Array, count: int, X_OM: Array | None = None
) -> Array:
    """Return the poses X_OA (n, 4, 4) of the frame {A} of n grasps in {O} of the object.

    Args:
        frame: "object" {O}, "camera" {C}, "table" {T} or "mesh" {M}.
        X_TC: With the frame "camera": pose of the camera, (4, 4), or one per grasp (n, 4, 4).
        X_TO: (4, 4), pose of the object.
        count: Number of grasps, n.
        X_OM: (4, 4), pose of the mesh file's frame; None if it is not known.

    Raises:
        GraspError: If the frame or its pose is unknown, a camera's pose is missing, or one is given
            for another frame, or not one per grasp.
    """
    frame = "table" if frame == WORKSPACE else frame
    if frame not in FRAMES:
        raise GraspError(f"frame must be one of {', '.join(FRAMES)}, got {frame!r}")
    if frame == "camera" and X_TC is None:
        raise GraspError(
            "X_TC must be the camera's pose in the table-top frame (frame_work2cam in the files) "
            "if frame is camera, got None"
        )
    if frame != "camera" and X_TC is not None:
        raise GraspError(f"X_TC must be None if frame is {frame}, got a pose")
    if frame == "object":
        return np.tile(np.eye(4), (count, 1, 1))
    if frame == "mesh":
        if X_OM is None:
            raise GraspError(NO_MESH_FRAME)
        return np.tile(X_OM, (count, 1, 1))

    X_OT = invert_pose(X_TO)
    X_OA = X_OT if X_TC is None else X_OT @ X_TC
    if X_OA.ndim == 2:
        X_OA = np.broadcast_to(X_OA, (count, 4, 4))
    if len(X_OA) != count:
        raise GraspError(f"X_TC must be one pose, or one per grasp ({count}), got {len(X_OA)}")
    return X_OA


@dataclass(frozen=True, kw_only=True, eq=False)
class Predictions:
    """The contents of a file of grasps.

    Attributes:
        grasps: (n, m), or (n, j, m) for j per row, with n at least 1.
        rows: (n,), the row of a dataset's split that each is for; None if the file has none.
        confidence: As stated, numbers of any kind; None if the file has none.
    """

    grasps: Array
    rows: npt.NDArray[np.int64] | None = None
    confidence: Any = None


def read_predictions(path: Path, *, split: str | None = None, axes: int = 2) -> Predictions:
    """Return the grasps of a file.

    Args:
        path: A `.npy` file, (n, m) or (m,); a `.csv` file with a line per grasp and optionally a
            header; an HDF5 file (`.h5`, `.hdf5`) with an array `grasps`, and optionally `rows` and
            `confidence` beside it, at the root or in a group; or a Parquet file with a line per
            entry and these as columns, `grasps` of lists.
        split: Name of the group of an HDF5 file. If it is None or there is no such group, the
            root is read; if it is None and the root has no grasps, the only group that has.
        axes: Most axes of the array of grasps: 3 for several per row.

    Raises:
        GraspError: If the file cannot be read as one of these; the message names the file.
        MachineError: If a Parquet file is given and pyarrow is not installed.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise GraspError(f"{path}: must be a file {_listed(SUFFIXES)}, got {suffix!r}")
    if not path.is_file():
        raise GraspError(f"{path}: must be a file of grasps, got none")
    if suffix in HDF5_SUFFIXES:
        arrays, where = _read_hdf5(path, split)
    elif suffix == ".parquet":
        arrays, where = _read_parquet(path), str(path)
    else:
        read = read_numbers if suffix == ".npy" else _read_csv
        arrays, where = {GRASPS: read(path)}, str(path)

    # One row per grasp.
    name = f"{where}/{GRASPS}" if suffix in HDF5_SUFFIXES else where
    numbers = as_numbers(arrays[GRASPS], f"{name}: must hold real numbers")
    grasps, rows = _grasps(numbers, name, axes), arrays.get(ROWS)
    if rows is not None:
        rows = np.asarray(rows)
        if rows.dtype.kind not in "iu" or rows.shape != (len(grasps),):
            raise GraspError(
                f"{where}/{ROWS} must hold one whole number for each of the {len(grasps)} grasps, "
                f"got {rows.dtype} of shape {rows.shape}"
            )
        rows = rows.astype(np.int64)
    return Predictions(grasps=grasps, rows=rows, confidence=arrays.get(CONFIDENCE))


def read_numbers(path: Path) -> Array:
    """Return the real numbers of a `.npy` file, of any shape. Pickled objects are not loaded.

    Args:
        path: Of the file.

    Raises:
        GraspError: If the file cannot be read, or holds anything else.
    """
    try:
        refuse_irregular(path)
        with path.open("rb") as file:
            array = np.lib.format.read_array(file, allow_pickle=False)
    # A damaged header may claim any size, hence the MemoryError.
    except (OSError, EOFError, ValueError, TypeError, ArithmeticError, MemoryError) as error:
        raise GraspError(
            f"{path}: must be a .npy file of numbers, got none ({first_line(error)})"
        ) from None
    return as_numbers(array, f"{path}: must hold real numbers")


def _read_csv(path: Path) -> Array:
    """Return the numbers of a text file, a row per line, without a header."""
    # The cells of all lines that are not empty.
    try:
        lines = read_text(path, "utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise GraspError(
            f"{path}: must be a text file of numbers, got none ({first_line(error)})"
        ) from None
    rows = [(n, line.split(",")) for n, line in enumerate(lines, start=1) if line.strip()]

    # The first line is a header only if it has several cells and none of them is a number: a
    # mistyped grasp, or one that is not separated by commas, must not pass for a header.
    if rows and len(rows[0][1]) > 1 and not any(_is_number(cell) for cell in rows[0][1]):
        del rows[0]

    # The other lines hold numbers, all equally many.
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


def _read_hdf5(path: Path, split: str | None) -> tuple[dict[str, Any], str]:
    """Return the arrays of an HDF5 file that it has, and where they are."""
    try:
        with open_hdf5(path) as file:
            group = _choose_group(path, file, split)
            names = [
                n for n in (GRASPS, ROWS, CONFIDENCE) if isinstance(group.get(n), h5py.Dataset)
            ]
            return {n: group[n][()] for n in names}, f"{path}: {group.name.rstrip('/')}"
    except (OSError, KeyError, RuntimeError, MemoryError) as error:
        raise GraspError(
            f"{path}: must be an HDF5 file with grasps, got none ({first_line(error)})"
        ) from None


def _read_parquet(path: Path) -> dict[str, Any]:
    """Return the columns of a Parquet file that it has."""
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ModuleNotFoundError:
        raise MachineError(
            f"{path}: Parquet needs pyarrow, got none: pip install 'drakegrasp[hub]'"
        ) from None
    try:
        table = pq.read_table(path)
        names = [name for name in (GRASPS, ROWS, CONFIDENCE) if name in table.column_names]
        found = {name: table.column(name).to_pylist() for name in names}
        found[GRASPS] = np.array(found[GRASPS], dtype=float)
    except (OSError, KeyError, TypeError, ValueError, pa.ArrowException) as error:
        raise GraspError(
            f"{path}: must be a Parquet file with a column {GRASPS!r} of equally long lists of "
            f"numbers, got none ({first_line(error)})"
        ) from None
    return found


def _choose_group(path: Path, file: h5py.File, split: str | None) -> h5py.Group:
    """Return the group of an HDF5 file whose grasps to read; see `read_predictions`."""
    # All groups with grasps; the name of the root is empty.
    groups = {"": file} | {k: v for k, v in file.items() if isinstance(v, h5py.Group)}
    groups = {k: v for k, v in groups.items() if isinstance(v.get(GRASPS), h5py.Dataset)}
    if split in groups:
        return groups[split]
    if "" in groups:
        return groups[""]
    if split is None and len(groups) == 1:
        return next(iter(groups.values()))

    # There are none, or it is not clear which to read.
    must = f"in /{split} or at the root" if split else "at the root or in one group"
    got = ", ".join(f"/{name}" for name in groups)
    choose = "; choose with --split" if groups else ""
    raise GraspError(
        f"{path}: must hold an array {GRASPS!r} {must}, got {f'them in {got}' if got else 'none'}"
        + choose
    )


def _grasps(array: Array, where: str, axes: int) -> Array:
    """Return an array with a row per grasp, from such an array or from a single grasp."""
    if array.size == 0:
        raise GraspError(f"{where}: must hold at least one grasp, got none")
    if not 1 <= array.ndim <= axes:
        raise GraspError(
            f"{where}: must be an array with a row per grasp, or one grasp, "
            f"got an array of shape {array.shape}{_POSES if array.shape[-2:] == (4, 4) else ''}"
        )
    return np.atleast_2d(array)


def _is_number(text: str) -> bool:
    """Return whether a cell of a text file is a number."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def _listed(names: tuple[str, ...]) -> str:
    """Return names as in "a, b or c"."""
    return f"{', '.join(names[:-1])} or {names[-1]}"
