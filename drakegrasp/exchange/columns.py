"""Files of columns, as other programs write them: NumPy, HDF5, CSV and Parquet.

Input: a file. Output: its columns as they are stored, or an error in one line. What they mean is a
matter of `contacts` and `attempts`.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any, TextIO

import h5py
import numpy as np

from drakegrasp.dataset.hdf5 import open_hdf5
from drakegrasp.errors import GraspError, MachineError, first_line, one_line
from drakegrasp.foreign_files import LARGEST_TEXT, read_npz, refuse_irregular
from drakegrasp.frames import Array, as_numbers

#: Suffixes of HDF5 files, of all files of arrays, and of tables.
HDF5_SUFFIXES = (".h5", ".hdf5")
ARRAYS, TABLES = (".npz", *HDF5_SUFFIXES), (".csv", ".parquet")
#: Maximum total size of the columns of a file [bytes]: two million postures of a hand with 16
#: joints.
MOST_BYTES = 1_000_000_000


def column_names(path: Path) -> list[str]:
    """Return the names of a file's columns, of an HDF5 file those at its root."""
    suffix = path.suffix.lower()
    if suffix in HDF5_SUFFIXES:
        with open_hdf5(path) as file:
            return list(file)
    if suffix == ".parquet":
        return list(parquet().read_schema(path).names)
    if suffix == ".csv":
        with path.open(encoding="utf-8-sig", newline="") as file:
            return next(_cells(file), [])
    return list(read_arrays(path))


def read_arrays(path: Path) -> dict[str, Any]:
    """Return the arrays of a NumPy file of several (.npz), or those at the root of an HDF5 file."""
    try:
        if path.suffix.lower() == ".npz":
            return read_npz(path, MOST_BYTES)
        with open_hdf5(path) as file:
            refuse_large(sum(getattr(item, "nbytes", 0) for item in file.values()))
            return {name: _dataset(item) for name, item in file.items()}
    except Exception as error:  # parsers raise all kinds of exceptions on foreign bytes
        raise GraspError(f"must be a readable file of arrays, got: {one_line(error)}") from None


def _dataset(item: h5py.Dataset | h5py.Group) -> Any:
    if not isinstance(item, h5py.Dataset):
        raise GraspError(f"{item.name} must be a dataset, got a group")
    return item.asstr()[()] if h5py.check_string_dtype(item.dtype) else item[()]


def refuse_large(size: int) -> None:
    """Reject arrays larger than any file of postures; a small file can unpack to terabytes."""
    if size > MOST_BYTES:
        raise GraspError(f"arrays must be at most {MOST_BYTES:.0e} bytes, got {size:.1e}")


def read_table(path: Path) -> tuple[dict[str, list[Any]], list[str]]:
    """Return the columns of a CSV or Parquet file, and for each row why it is invalid, or ""."""
    if path.suffix.lower() == ".parquet":
        library = parquet()
        try:
            said = library.read_metadata(path)
            refuse_large(8 * said.num_rows * said.num_columns)
            table = library.read_table(path)
            return dict(table.to_pydict()), [""] * table.num_rows
        except Exception as error:
            raise GraspError(f"must be a Parquet file, got: {one_line(error)}") from None

    # CSV: a row with too few or too many cells is invalid by itself.
    try:
        refuse_irregular(path, LARGEST_TEXT)
        with path.open(encoding="utf-8-sig", newline="") as file:
            header, *rows = _cells(file)
    except (OSError, ValueError, csv.Error) as error:
        raise GraspError(f"must be a table with a header, got: {one_line(error)}") from None
    if twice := [name for name in header if header.count(name) > 1]:
        raise GraspError(f"columns must have different names, got {twice[0]} twice")
    size = len(header)
    invalid = [
        "" if len(row) == size else f"the row must have {size} values, got {len(row)}"
        for row in rows
    ]
    cells = [[*row, *[""] * size][:size] for row in rows]
    return {name: [row[i] for row in cells] for i, name in enumerate(header)}, invalid


def parquet() -> Any:
    """Return the library that reads Parquet."""
    try:
        import pyarrow.parquet
    except ImportError:
        raise MachineError("Parquet needs pyarrow: pip install 'drakegrasp[hub]'") from None
    return pyarrow.parquet


def _cells(file: TextIO) -> Iterator[list[str]]:
    """Yield the cells of each line of a CSV file, without the blanks around them.

    Cells are separated by semicolons if the first line has semicolons and no comma, else by commas.
    """
    first = file.readline()
    comma = "," if "," in first or ";" not in first else ";"
    for row in csv.reader(chain([first], file), delimiter=comma, skipinitialspace=True):
        yield [cell.strip() for cell in row]


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
