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
from drakegrasp.exchange.columns import HDF5_SUFFIXES, TABLES, parquet, read_numbers
from drakegrasp.foreign_files import LARGEST_TEXT, refuse_irregular
from drakegrasp.frames import Array, as_numbers

#: Suffixes of files that can hold grasps.
SUFFIXES = (".npy", *HDF5_SUFFIXES, *TABLES)
#: Advice for a file that holds poses instead of contacts.
_POSES = ": poses of the palm go with joints into a file of postures, as X_FG, object and q_grasp"
#: Names of the arrays in an HDF5 file, and of the columns in a Parquet file.
GRASPS, ROWS, CONFIDENCE = NAMES = ("grasps", "rows", "confidence")


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
    suffix, where = path.suffix.lower(), str(path)
    if suffix not in SUFFIXES:
        *names, last = SUFFIXES
        raise GraspError(f"{path}: must be a file {', '.join(names)} or {last}, got {suffix!r}")
    if not path.is_file():
        raise GraspError(f"{path}: must be a file of grasps, got none")
    try:
        if suffix == ".npy":
            arrays = {GRASPS: read_numbers(path)}
        elif suffix == ".csv":
            arrays = {GRASPS: _read_csv(path)}
        elif suffix == ".parquet":
            table = parquet().read_table(path)
            arrays = {n: table[n].to_pylist() for n in NAMES if n in table.column_names}
            arrays[GRASPS] = np.array(arrays[GRASPS], dtype=float)
        else:
            with open_hdf5(path) as file:
                group = _choose_group(path, file, split)
                where = f"{path}: {group.name.rstrip('/')}"
                arrays = {n: group[n][()] for n in NAMES if isinstance(group.get(n), h5py.Dataset)}
    except (GraspError, MachineError):
        raise
    except Exception as error:  # parsers raise all kinds of exceptions on foreign bytes
        named = "" if suffix == ".csv" else f" by the name {GRASPS!r}"
        raise GraspError(
            f"{path}: must be a file of grasps, rows of equally many numbers{named}, "
            f"got none ({first_line(error)})"
        ) from None

    # One row per grasp.
    name = f"{where}/{GRASPS}" if suffix in HDF5_SUFFIXES else where
    grasps = _grasps(as_numbers(arrays[GRASPS], f"{name}: must hold real numbers"), name, axes)
    rows = arrays.get(ROWS)
    if rows is not None:
        rows = np.asarray(rows)
        if rows.dtype.kind not in "iu" or rows.shape != (len(grasps),):
            raise GraspError(
                f"{where}/{ROWS} must hold one whole number for each of the {len(grasps)} grasps, "
                f"got {rows.dtype} of shape {rows.shape}"
            )
        rows = rows.astype(np.int64)
    return {GRASPS: grasps, ROWS: rows, CONFIDENCE: arrays.get(CONFIDENCE)}


def _read_csv(path: Path) -> Array:
    """Return the numbers of a text file, one row per line, without the header."""
    refuse_irregular(path, LARGEST_TEXT)
    lines = [line for line in path.read_text("utf-8-sig").splitlines() if line.strip()]
    # The first line is a header only if it has several cells and none of them is a number. A
    # mistyped grasp, or a grasp without commas, must not be taken for a header.
    cells = lines[0].split(",") if lines else []
    header = len(cells) > 1 and not any(map(_is_number, cells))
    if not lines[header:]:
        raise GraspError(f"{path}: must hold at least one grasp, got none")
    return np.loadtxt(lines[header:], delimiter=",", comments=None, ndmin=2)


def _choose_group(path: Path, file: h5py.File, split: str | None) -> h5py.Group:
    """Return the group of an HDF5 file from which to read the grasps; see `read_contacts`."""
    # Find all groups with grasps; the root has an empty name here.
    groups = {"": file} | {k: v for k, v in file.items() if isinstance(v, h5py.Group)}
    groups = {k: v for k, v in groups.items() if isinstance(v.get(GRASPS), h5py.Dataset)}
    for name in (split, ""):
        if name in groups:
            return groups[name]
    if split is None and len(groups) == 1:
        return next(iter(groups.values()))

    # No group has grasps, or several have them and none was chosen.
    must = f"in /{split} or at the root" if split else "at the root or in one group"
    got = ", ".join(f"/{name}" for name in groups)
    choose = "; choose with --split" if groups else ""
    raise GraspError(
        f"{path}: must hold an array {GRASPS!r} {must}, "
        f"got {f'them in {got}' if got else 'none'}{choose}"
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
