"""Columns and attributes of HDF5 files, spoiled in some ways."""

from __future__ import annotations

from collections.abc import Callable
from itertools import cycle
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from helpers.bad_inputs.kinds import ANY_FILE, Kind

from drakegrasp.dataset.schema import DATA_FIELDS, OBJECT_FIELDS, TRIAL_FIELDS
from drakegrasp.runtime.files import SEAL_SIZE, seal

#: What replaces a dataset, from its values.
Replace = Callable[[Any], Any]


def _other_type(values: Any) -> Any:
    if values.dtype.kind == "O":
        return np.arange(len(values))
    return values.astype(np.float32 if values.dtype == np.float64 else np.float64)


def _texts(values: Any) -> Any:
    return np.array([b"1.0"] * len(values), dtype="S3")


#: Ways to spoil a dataset; None takes it away.
WAYS: dict[str, Replace | None] = {
    "missing": None,
    "of another type": _other_type,
    "one row less": lambda values: values[:-1],
    "one row more": lambda values: np.concatenate([values, values[:1]]),
    "one axis more": lambda values: np.stack([values, values], axis=-1),
    "of texts": _texts,
    "without rows": lambda values: values[:0],
    "a single value": lambda values: values.ravel()[0],
    "pairs": lambda values: np.zeros(len(values), dtype=[("a", "f8"), ("b", "i4")]),
    "complex": lambda values: np.zeros(values.shape, dtype=np.complex128),
    "of any length": lambda values: _ragged(len(values)),
}
#: And one that no value can tell.
GROUP, NULL = "a group", "null space"


def _ragged(count: int) -> Any:
    rows = np.empty(count, dtype=object)
    rows[:] = [np.arange(3.0)] * count
    return rows


def _kind(name: str, spoil: Callable[..., object], *given: object) -> Kind:
    """Return a kind whose file is edited, and sealed again if it was: who spoils can seal."""

    def edit(path: Path) -> None:
        with h5py.File(path, "r+") as file:
            sealed = file.userblock_size == SEAL_SIZE
            spoil(file, *given)
        if sealed:
            seal(path)

    return Kind(name, edit)


def dataset_kind(place: str, way: str) -> Kind:
    """Return a kind in which a dataset is spoiled in one way."""
    return _kind(f"/{place} {way}", _spoil, place, way)


def _spoil(file: h5py.File, place: str, way: str) -> None:
    values, attributes = file[place][()], dict(file[place].attrs)
    del file[place]
    if way == GROUP:
        file.create_group(place)
    elif way == NULL:
        file[place] = h5py.Empty(np.float64)
    elif (replace := WAYS[way]) is not None:
        new = replace(values)
        text = h5py.string_dtype() if np.asarray(new).dtype.kind == "O" else None
        dtype = h5py.vlen_dtype(np.float64) if way == "of any length" else text
        file.create_dataset(place, data=new, dtype=dtype)
    if place in file:
        file[place].attrs.update(attributes)


def value_kind(place: str, name: str, row: int, value: Any) -> Kind:
    """Return a kind in which one row has an impossible value."""
    return _kind(f"/{place} {name}", lambda file: file[place].__setitem__(row, value))


def attribute_kind(key: str, name: str, value: Any) -> Kind:
    """Return a kind in which an attribute has another value, of another type, too."""
    return _kind(f"attribute {key} {name}", _put, key, value)


def _put(file: h5py.File, key: str, value: Any) -> None:
    del file.attrs[key]
    file.attrs[key] = value


def _to_dataset(file: h5py.File, group: str) -> None:
    del file[group]
    file[group] = np.zeros(3)


#: Values of an attribute, most of which are wrong, and which of them are none for some attributes.
ATTRIBUTES: dict[str, Any] = {
    "a number": 55,
    "a text": "x",
    "an array": np.zeros((2, 2)),
    "NaN": np.nan,
}
_FINE = {
    **dict.fromkeys(("config_hash", "signature", "shards"), "a text"),
    **dict.fromkeys(("seed", "near", "far"), "a number"),
}
_TURNS = (*WAYS, GROUP, NULL)
#: Columns that a file may lack.
_OPTIONAL = {f.name for f in (*TRIAL_FIELDS, *DATA_FIELDS, *OBJECT_FIELDS) if f.optional}


def file_kinds(path: Path, *whole: str) -> tuple[Kind, ...]:
    """Return the ways to spoil a file of groups of columns.

    Args:
        path: A sound one.
        *whole: Columns that are spoiled in all ways; the others are in one way each, in turn.
    """
    columns = dict[str, bool]()

    def note(place: str, item: h5py.Dataset | h5py.Group) -> None:
        if isinstance(item, h5py.Dataset):
            columns[place] = item.dtype.kind == "O"

    with h5py.File(path) as file:
        file.visititems(note)
        # Nobody reads conventions but people.
        attributes = [key for key in file.attrs if not key.startswith("convention")]
        groups = [*file]
    kinds = [*ANY_FILE]
    for group in groups:
        kinds.append(_kind(f"/{group} missing", h5py.File.pop, group))
        kinds.append(_kind(f"/{group} a dataset", _to_dataset, group))
    for (place, is_text), turn in zip(columns.items(), cycle(_TURNS), strict=False):
        way = "missing" if is_text and turn == "of texts" else turn
        optional = place.partition("/")[2] in _OPTIONAL
        kinds.append(dataset_kind(place, "of another type" if optional else way))
    kinds += [dataset_kind(place, way) for place in whole for way in _TURNS]
    for key in attributes:
        kinds.append(_kind(f"attribute {key} missing", lambda file, k: file.attrs.pop(k), key))
        wrong = {k: v for k, v in ATTRIBUTES.items() if k != _FINE.get(key)}
        kinds += [attribute_kind(key, name, value) for name, value in wrong.items()]
    kinds.append(attribute_kind("schema_version", "of the future", 999))
    return tuple(kinds)


def trials_kinds(path: Path) -> tuple[Kind, ...]:
    """Return the ways to spoil trials."""
    return (
        *file_kinds(path, "trials/outcome"),
        attribute_kind("schema_version", "before", 1),
        attribute_kind("seed", "negative", -1),
        attribute_kind("config", "NaN inside", '{"physics": {"time_step": NaN}}'),
        # What no header shows.
        value_kind("successes/trial_id", "after the last", 0, 36),
        value_kind("successes/trial_id", "negative", 0, -1),
        value_kind("objects/name", "no UTF-8", 0, b"\xff\xfe"),
        value_kind("objects/class_name", "no UTF-8", 0, b"\xff\xfe"),
    )


def data_kinds(path: Path) -> tuple[Kind, ...]:
    """Return the ways to spoil a data file."""
    return (
        *file_kinds(path, "train/grasps", "test/images"),
        attribute_kind("camera", "unknown", "stereo"),
        attribute_kind("K", "of 9 numbers", np.ones(9)),
    )


#: Shards and plans have a seal, which proves that they are as they were written.
SEALED: tuple[Kind, ...] = (
    *ANY_FILE,
    Kind("not sealed again", lambda path: path.write_bytes(path.read_bytes()[:-1] + b"x")),
)
