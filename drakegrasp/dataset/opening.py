"""Opens HDF5 files of a dataset for reading, and rejects files that differ from the schema.

Input: a path, or an open file and the fields of its groups. Output: an open file that contains
every group, dataset and attribute of the schema with its type and shape; or every `Difference`.
Only headers are read; `read_codes` also rejects numbers without a defined meaning. Commands reject
a file at the first difference, and `drakegrasp check` lists all of them. The module needs only
NumPy and h5py.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from drakegrasp.dataset.hdf5 import open_hdf5, says_damage
from drakegrasp.dataset.schema import (
    CAMERAS,
    DATA_FIELDS,
    OBJECT_FIELDS,
    SCENE_FIELDS,
    SCENE_GRASP_FIELDS,
    SCENE_OBJECT_FIELDS,
    SPLITS,
    SUCCESS_FIELDS,
    TRIAL_FIELDS,
    VIEW_FIELDS,
    VISIBLE_FIELDS,
    Field,
    refuse_other_schema,
)
from drakegrasp.errors import DataError, first_line, printable
from drakegrasp.foreign_files import parse_json

#: Fields of each group of a file, by the group's name.
Tables = Mapping[str, tuple[Field, ...]]
DATA_TABLES: Tables = {split: DATA_FIELDS for split in SPLITS}
TRIAL_TABLES: Tables = {
    "objects": OBJECT_FIELDS,
    "trials": TRIAL_FIELDS,
    "successes": SUCCESS_FIELDS,
}
SCENE_TABLES: Tables = {
    "objects": SCENE_OBJECT_FIELDS,
    "scenes": SCENE_FIELDS,
    "views": VIEW_FIELDS,
    "grasps": SCENE_GRASP_FIELDS,
    "visible": VISIBLE_FIELDS,
}


@dataclass(frozen=True, kw_only=True)
class Difference:
    """A difference between a file and the schema.

    Attributes:
        path: Path of the group or the dataset; empty for the whole file.
        what: What the file must have there, in words.
        got: What the file has there instead.
    """

    path: str = ""
    what: str
    got: str

    def __str__(self) -> str:
        return f"{self.path + ': ' if self.path else ''}{self.what}, got {self.got}"


# Files


@contextmanager
def opened(path: Path, what: str, *, again: bool = False) -> Iterator[h5py.File]:
    """Open an HDF5 file while the block runs; HDF5 errors in the block become a DataError.

    Args:
        path: Path of the file.
        what: What the file must be, in words.
        again: See `open_hdf5`.

    Raises:
        DataError: If the file is missing or damaged.
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


@contextmanager
def _opened_whole(
    path: Path, what: str, kinds: Mapping[str, Kind], tables: Tables
) -> Iterator[h5py.File]:
    """Open a file, see `opened`, and reject it if it differs from the schema."""
    with opened(path, what) as file:
        refuse_other_attributes(path, file, kinds)
        refuse_first(path, differences(file, tables))
        yield file


def refuse_first(path: Path, mistakes: Iterable[object]) -> None:
    """Reject a file that has any mistake; the error reports the first one.

    Raises:
        DataError: If there is a mistake.
    """
    if (first := next(iter(mistakes), None)) is not None:
        raise DataError(f"{path}: {printable(str(first))}")


def read_codes(
    dataset: h5py.Dataset, codes: int | Sequence[int], rows: slice = slice(None)
) -> npt.NDArray[Any]:
    """Return a column (n,) of codes, and reject codes without a defined meaning.

    Args:
        dataset: The column.
        codes: The number of valid codes, which are counted from 0, or the valid codes themselves.
        rows: The rows that are read.

    Raises:
        DataError: If a code has no defined meaning.
    """
    values: npt.NDArray[Any] = dataset[rows]
    path = Path(dataset.file.filename)
    refuse_other_codes(path, dataset.name, values, codes, rows.start or 0)
    return values


def refuse_other_codes(
    path: Path,
    name: str,
    values: npt.NDArray[Any],
    codes: int | Sequence[int],
    first: int = 0,
) -> None:
    """Reject codes without a defined meaning, see `read_codes`; `first` is the first row.

    Raises:
        DataError: If there is such a code.
    """
    if isinstance(codes, int):
        bad, must = (values < 0) | (values >= codes), f"0 to {codes - 1}"
    else:
        bad, must = ~np.isin(values, codes), f"one of {', '.join(str(int(c)) for c in codes)}"
    if bad.any():
        row = int(np.argmax(bad))
        raise DataError(f"{path}: {name} must be {must}, got {values[row]} in row {first + row}")


# Attributes

#: What an attribute holds: one of the keys of _KINDS, or one of some texts.
Kind = type | str | tuple[str, ...]
MATRIX = "matrix"
#: Attributes of all three files.
ORIGIN: Mapping[str, Kind] = {
    **dict.fromkeys(("config", "versions", "fingers"), dict),
    **dict.fromkeys(("config_hash", "signature", "shards"), str),
    "joints": list,
    "seed": int,
    "K": MATRIX,
    "near": float,
    "far": float,
}
#: Attributes of the data files.
OF_CAMERA: Mapping[str, Kind] = {**ORIGIN, "camera": CAMERAS, "split_by": ("class", "object")}
#: Attributes of scenes.hdf5, whose views have their own camera matrices.
OF_SCENES: Mapping[str, Kind] = {key: kind for key, kind in ORIGIN.items() if key != "K"}

#: Context managers that open a file of a dataset, given its path: grasping_oto.hdf5 or
#: grasping_otm.hdf5, trials.hdf5, scenes.hdf5. They raise a DataError if the file is missing,
#: damaged, or differs from the schema.
open_samples, open_trials, open_scenes = (
    partial(_opened_whole, what=what, kinds=kinds, tables=tables)
    for what, kinds, tables in (
        ("a data file of drakegrasp", OF_CAMERA, DATA_TABLES),
        ("the trials of a dataset", ORIGIN, TRIAL_TABLES),
        ("the scenes of a dataset", OF_SCENES, SCENE_TABLES),
    )
)


def attribute_mistakes(file: h5py.File, kinds: Mapping[str, Kind]) -> Iterator[Difference]:
    """Yield the attributes of a file that are missing or hold something else."""
    for key, kind in kinds.items():
        value = file.attrs.get(key)
        if not _holds(value, kind):
            must = _KINDS[kind] if isinstance(kind, type | str) else f"one of {', '.join(kind)}"
            got = printable(" ".join(repr(value).split())[:60]) if key in file.attrs else "none"
            yield Difference(what=f"attribute {key} must be {must}", got=got)


#: The kinds in words.
_KINDS: Mapping[Any, str] = {
    str: "a text",
    dict: "a mapping in JSON",
    list: "a list in JSON",
    int: "a whole number that is not negative",
    float: "a positive number",
    MATRIX: "a matrix of 3 x 3 numbers",
}


def _holds(value: Any, kind: Kind) -> bool:
    """Return whether an attribute holds a value of its kind."""
    if kind is int:
        return isinstance(value, np.integer) and bool(value >= 0)
    if kind is float:
        return isinstance(value, np.floating) and bool(value > 0.0)
    if kind == MATRIX:
        return isinstance(value, np.ndarray) and value.shape == (3, 3) and value.dtype.kind == "f"
    if not isinstance(value, str) or kind is str:
        return isinstance(value, str) and value.isprintable()
    if isinstance(kind, tuple):
        return value in kind
    try:
        return type(parse_json(value)) is kind
    except ValueError:
        return False


def refuse_other_attributes(path: Path, file: h5py.File, kinds: Mapping[str, Kind]) -> None:
    """Reject a file of another schema version, or with an attribute of another kind.

    Raises:
        DataError: If the file is rejected; the error reports the first mistake.
    """
    # Check the version first: another version may have other attributes, and a foreign file has
    # none.
    if "schema_version" not in file.attrs:
        raise DataError(f"{path}: must be a data file of drakegrasp, got another HDF5 file")
    refuse_other_schema(path, file.attrs["schema_version"])
    refuse_first(path, attribute_mistakes(file, kinds))


# Groups and datasets


def differences(file: h5py.File, tables: Tables) -> Iterator[Difference]:
    """Yield the differences between the groups and datasets of a file and their fields.

    The first dataset of a group tells the number of its rows, and the first field with a letter in
    its shape the length of this letter in the file.
    """
    lengths: dict[str, int] = {}
    for name, fields in tables.items():
        group, place, rows = file.get(name), f"/{name}".rstrip("/"), None
        if not isinstance(group, h5py.Group):
            yield Difference(path=place, what="the group must be there", got="none")
            continue
        for f in fields:
            path, found = f"{place}/{f.name}", _dataset(group, f.name)
            if found is None:
                if not f.optional or f.name in group:
                    yield Difference(path=path, what="the dataset must be there", got="none")
                continue

            # Its type, and its shape.
            dtype, shape = found.dtype, found.shape
            text = h5py.check_string_dtype(dtype) is not None
            if text != (f.dtype == "str") or not (text or dtype == np.dtype(f.dtype)):
                yield Difference(path=path, what=f"type must be {f.dtype}", got=str(dtype))
            rows = shape[0] if rows is None and shape else rows
            due = (rows or 0, *_row_shape(f, shape, lengths))
            if shape != due:
                yield Difference(path=path, what=f"shape must be {due}", got=str(shape))


def _dataset(group: h5py.Group, name: str) -> h5py.h5d.DatasetID | None:
    """Return a dataset of a group, or None; much faster than `group[name]`."""
    try:
        item = h5py.h5o.open(group.id, name.encode())
    except KeyError:
        return None
    return item if isinstance(item, h5py.h5d.DatasetID) else None


def _row_shape(
    field: Field, shape: tuple[int, ...] | None, lengths: dict[str, int]
) -> tuple[int, ...]:
    """Return the shape of a field's row; a letter that is not known yet gets its length here."""
    if shape is not None and len(shape) == 1 + len(field.axes):
        for axis, length in zip(field.axes, shape[1:], strict=True):
            letter, each = ("k", 6) if axis == "6k" else (axis, 1)
            if isinstance(letter, str):
                lengths.setdefault(letter, length // each)
    known = {**lengths, "6k": 6 * lengths.get("k", 0)}
    return tuple(known.get(axis, 0) if isinstance(axis, str) else axis for axis in field.axes)


# Plans


def _array(name: str, shape: str, dtype: str) -> Field:
    return Field(name, shape, dtype, "-", "-", "")


#: Arrays of an object's plan, `objects/NAME.plan.h5`, in two tables whose columns have equally many
#: rows: resting poses and palm poses.
PLAN_TABLES: Sequence[tuple[Field, ...]] = (
    (
        _array("X_TO", "4 4", "float64"),
        _array("probability", "", "float64"),
        _array("table_force", "", "float64"),
        _array("stopped", "", "bool"),
    ),
    (
        _array("X_OG", "4 4", "float64"),
        _array("distance", "", "float64"),
        _array("resting", "", "int64"),
        _array("source", "", "int64"),
        _array("spread", "", "float64"),
        _array("preshape_index", "", "int64"),
    ),
)
#: Additional arrays of a plan with external postures; they have as many rows as the palm poses.
POSTURE_FIELDS = (
    *(_array(name, "j", "float64") for name in ("q_grasp", "q_pregrasp", "q_squeeze")),
    _array("row", "", "int64"),
)
#: The list of their preshapes, as the bytes of JSON.
POSTURE_PRESHAPES = _array("preshape", "", "uint8")
_PLAN_ATTRIBUTES: Mapping[str, Kind] = {
    **dict.fromkeys(("model_sha256", "config_hash", "mesh_sha256"), str),
    "asked": int,
}


def refuse_other_plan(path: Path, file: h5py.File) -> None:
    """Reject a file that is not a plan of an object.

    Raises:
        DataError: If the file is rejected; the error reports the first difference.
    """
    refuse_first(path, attribute_mistakes(file, _PLAN_ATTRIBUTES))
    resting, palms = PLAN_TABLES
    tables = [resting, palms]
    if "q_grasp" in file:
        tables = [resting, (*palms, *POSTURE_FIELDS), (POSTURE_PRESHAPES,)]
    for table in tables:
        refuse_first(path, differences(file, {"/": table}))
