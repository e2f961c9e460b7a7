"""Files of contacts: k points and k outward normals for each grasp, and optional columns.

Input: a .npy, CSV, HDF5 or Parquet file. Output: the numbers of the file, of any shape, with the
dataset rows and the confidence that the file states, or an error in one line that names the file.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np

from drakegrasp.dataset.hdf5 import open_hdf5
from drakegrasp.errors import GraspError, MachineError, first_line
from drakegrasp.foreign_files import read_text, refuse_irregular
from drakegrasp.frames import Array, as_numbers

#: Suffixes of files that can hold grasps.
HDF5_SUFFIXES = (".h5", ".hdf5")
SUFFIXES = (".npy", ".csv", *HDF5_SUFFIXES, ".parquet")
#: Advice for a file that holds poses instead of contacts.
_POSES = ": poses of the palm go with joints into a file of postures, as X_FG, object and q_grasp"
#: Names of the arrays in an HDF5 file, and of the columns in a Parquet file.
GRASPS, ROWS, CONFIDENCE = "grasps", "rows", "confidence"


def read_contacts(path: Path, *, split: str | None = None, axes: int = 2) -> dict[str, Any]:
    """Return the `grasps`, `rows` and `confidence` of a file.

    The grasps are (n, m), or (n, j, m) for j grasps per row, with n at least 1. The rows (n,) are
    row numbers in a dataset's split. The confidence is returned as stored. Rows or confidence that
    the file does not have are None.

    Args:
        path: A `.npy` file, (n, m) or (m,); a `.csv` file with a line per grasp and optionally a
            header; an HDF5 file (`.h5`, `.hdf5`) with an array `grasps`, and optionally `rows` and
            `confidence`, all at the root or all in one group; or a Parquet file with a line per
            grasp and columns of the same names, in which `grasps` are lists.
        split: Name of the group to read in an HDF5 file. If it is None or there is no such group,
            the root is read. If it is None and the root has no grasps, the only group with grasps
            is read.
        axes: Maximum number of axes of the array of grasps; 3 allows several grasps per row.

    Raises:
        GraspError: If the file cannot be read as one of these; the message names the file.
        MachineError: If the file is a Parquet file and pyarrow is not installed.
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
    return {GRASPS: grasps, ROWS: rows, CONFIDENCE: arrays.get(CONFIDENCE)}


def read_numbers(path: Path) -> Array:
    """Return the real numbers of a `.npy` file, of any shape. Pickled objects are not loaded.

    Args:
        path: Path of the file.

    Raises:
        GraspError: If the file cannot be read, or does not hold real numbers.
    """
    try:
        refuse_irregular(path)
        with path.open("rb") as file:
            array = np.lib.format.read_array(file, allow_pickle=False)
    # A damaged header may state any size, and then NumPy raises a MemoryError.
    except (OSError, EOFError, ValueError, TypeError, ArithmeticError, MemoryError) as error:
        raise GraspError(
            f"{path}: must be a .npy file of numbers, got none ({first_line(error)})"
        ) from None
    return as_numbers(array, f"{path}: must hold real numbers")


def _read_csv(path: Path) -> Array:
    """Return the numbers of a text file, one row per line, without the header."""
    # Read the cells of all lines that are not empty.
    try:
        lines = read_text(path, "utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise GraspError(
            f"{path}: must be a text file of numbers, got none ({first_line(error)})"
        ) from None
    rows = [(n, line.split(",")) for n, line in enumerate(lines, start=1) if line.strip()]

    # The first line is a header only if it has several cells and none of them is a number. A
    # mistyped grasp, or a grasp without commas, must not be taken for a header.
    if rows and len(rows[0][1]) > 1 and not any(_is_number(cell) for cell in rows[0][1]):
        del rows[0]

    # All other lines hold the same number of numbers.
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
    """Return those of the known arrays that an HDF5 file has, and their location."""
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
    """Return those of the known columns that a Parquet file has."""
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
    """Return the group of an HDF5 file from which to read the grasps; see `read_contacts`."""
    # Find all groups with grasps; the root has an empty name here.
    groups = {"": file} | {k: v for k, v in file.items() if isinstance(v, h5py.Group)}
    groups = {k: v for k, v in groups.items() if isinstance(v.get(GRASPS), h5py.Dataset)}
    if split in groups:
        return groups[split]
    if "" in groups:
        return groups[""]
    if split is None and len(groups) == 1:
        return next(iter(groups.values()))

    # No group has grasps, or several have them and none was chosen.
    must = f"in /{split} or at the root" if split else "at the root or in one group"
    got = ", ".join(f"/{name}" for name in groups)
    choose = "; choose with --split" if groups else ""
    raise GraspError(
        f"{path}: must hold an array {GRASPS!r} {must}, got {f'them in {got}' if got else 'none'}"
        + choose
    )


def _grasps(array: Array, where: str, axes: int) -> Array:
    """Return an array with one row per grasp; a single grasp (m,) becomes one row."""
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
    """Return names in the form "a, b or c"."""
    return f"{', '.join(names[:-1])} or {names[-1]}"
