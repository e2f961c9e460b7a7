"""Opens the three files of a dataset to read them: one that differs from the schema is refused.

In: a path. Out: an open file in which every group, dataset and attribute of the schema is there,
of its type and shape. What the rows hold is not read; `read_codes` refuses numbers of things that
do not exist. `drakegrasp check` lists all that is wrong with a file, and does not go through here.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from drakegrasp.dataset.hdf5 import open_hdf5, says_damage
from drakegrasp.dataset.layout.attributes import (
    OF_CAMERA,
    OF_SCENES,
    ORIGIN,
    Rule,
    attribute_mistakes,
)
from drakegrasp.dataset.layout.structure import DATA_TABLES, SCENE_TABLES, TRIAL_TABLES, differences
from drakegrasp.dataset.schema import refuse_other_schema
from drakegrasp.errors import DataError, first_line, printable


@contextmanager
def open_samples(path: Path) -> Iterator[h5py.File]:
    """Open grasping_oto.hdf5 or grasping_otm.hdf5 while the block runs.

    Raises:
        DataError: If it is missing, damaged, or differs from the schema.
    """
    with opened(path, "a data file of drakegrasp") as file:
        refuse_other_attributes(path, file, OF_CAMERA)
        refuse_first(path, differences(file, DATA_TABLES))
        yield file


@contextmanager
def open_trials(path: Path) -> Iterator[h5py.File]:
    """Open trials.hdf5 while the block runs.

    Raises:
        DataError: If it is missing, damaged, or differs from the schema.
    """
    with opened(path, "the trials of a dataset") as file:
        refuse_other_attributes(path, file, ORIGIN)
        refuse_first(path, differences(file, TRIAL_TABLES))
        yield file


@contextmanager
def open_scenes(path: Path) -> Iterator[h5py.File]:
    """Open scenes.hdf5 while the block runs.

    Raises:
        DataError: If it is missing, damaged, or differs from the schema.
    """
    with opened(path, "the scenes of a dataset") as file:
        refuse_other_attributes(path, file, OF_SCENES)
        refuse_first(path, differences(file, SCENE_TABLES))
        yield file


@contextmanager
def opened(path: Path, what: str, *, again: bool = False) -> Iterator[h5py.File]:
    """Open an HDF5 file while the block runs; HDF5 errors in the block become a DataError.

    Args:
        path: Of the file.
        what: What it must be, in words.
        again: See `open_hdf5`.

    Raises:
        DataError: If it is missing or damaged.
    """
    if path.is_dir():
        raise DataError(f"{path}: must be {what}, got a folder; name the file in it")
    try:
        with open_hdf5(path, again=again) as file:
            yield file
    except DataError:
        raise
    except Exception as error:
        if not says_damage(error):
            raise
        raise DataError(f"{path}: must be {what}, got none ({first_line(error)})") from None


def refuse_other_attributes(path: Path, file: h5py.File, rules: Mapping[str, Rule]) -> None:
    """Refuse a file of another version of the schema, or with an attribute that breaks its rule.

    Args:
        path: Of the file, for the message.
        file: The file.
        rules: By the attributes' names.

    Raises:
        DataError: If there is one; the first is told.
    """
    # The version first: another schema may have other attributes, and a stranger's file has none.
    if "schema_version" not in file.attrs:
        raise DataError(f"{path}: must be a data file of drakegrasp, got another HDF5 file")
    refuse_other_schema(path, file.attrs["schema_version"])
    refuse_first(path, attribute_mistakes(file, rules).values())


def refuse_first(path: Path, mistakes: Iterable[object]) -> None:
    """Refuse a file with any mistake; the first is told.

    Raises:
        DataError: If there is one.
    """
    if (first := next(iter(mistakes), None)) is not None:
        raise DataError(f"{path}: {printable(str(first))}")


def read_codes(
    dataset: h5py.Dataset, codes: int | Sequence[int], rows: slice = slice(None)
) -> npt.NDArray[Any]:
    """Return a column (n,) of numbers that stand for something.

    Args:
        dataset: The column.
        codes: How many things there are, counted from 0, or the numbers of those that there are.
        rows: Those that are read.

    Raises:
        DataError: If a number stands for nothing.
    """
    values: npt.NDArray[Any] = dataset[rows]
    first = rows.start or 0
    refuse_other_codes(Path(dataset.file.filename), dataset.name, values, codes, first)
    return values


def refuse_other_codes(
    path: Path,
    name: str,
    values: npt.NDArray[Any],
    codes: int | Sequence[int],
    first: int = 0,
) -> None:
    """Refuse numbers that stand for nothing, see `read_codes`; `first` is the row of the first.

    Raises:
        DataError: If there is one.
    """
    if isinstance(codes, int):
        bad, must = (values < 0) | (values >= codes), f"0 to {codes - 1}"
    else:
        bad, must = ~np.isin(values, codes), f"{min(codes)} to {max(codes)}"
    if bad.any():
        row = int(np.argmax(bad))
        raise DataError(f"{path}: {name} must be {must}, got {values[row]} in row {first + row}")
