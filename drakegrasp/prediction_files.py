"""Predicted grasps in files: .npy, .csv and HDF5.

In: a file from anywhere. Out: its numbers, a row per grasp, or one line that says what is
wrong with it. What the numbers mean, and how many a grasp must have, is asked by `prediction`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from drakegrasp.errors import GraspError
from drakegrasp.frames import Array

HDF5_SUFFIXES = (".h5", ".hdf5")
SUFFIXES = (".npy", ".csv", *HDF5_SUFFIXES)
#: Names of the arrays in an HDF5 file.
GRASPS, ROWS = "grasps", "rows"


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
            f"{path}: must be a .npy file of numbers, got none ({_first_line(error)})"
        ) from None
    return _real(array, str(path))


def _read_csv(path: Path) -> Array:
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise GraspError(
            f"{path}: must be a text file of numbers, got none ({_first_line(error)})"
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
            f"{path}: must be an HDF5 file with grasps, got none ({_first_line(error)})"
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


def _first_line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
