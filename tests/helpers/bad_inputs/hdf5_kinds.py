"""Every field and attribute of the HDF5 files of a dataset, spoiled in some ways."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from helpers.bad_inputs.kinds import ANY_FILE, Kind

from drakegrasp.dataset.schema import (
    DATA_FIELDS,
    OBJECT_FIELDS,
    SUCCESS_FIELDS,
    TRIAL_FIELDS,
    Field,
)
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


def _sealed(spoil: Callable[[h5py.File], object]) -> Callable[[Path], None]:
    """Return what edits a file and, if it was sealed, seals it again: whoever spoils can seal."""

    def edit(path: Path) -> None:
        with h5py.File(path, "r+") as file:
            sealed = file.userblock_size == SEAL_SIZE
            spoil(file)
        if sealed:
            seal(path)

    return edit


def dataset_kind(place: str, way: str) -> Kind:
    """Return a kind in which a dataset is spoiled in one way."""

    def spoil(file: h5py.File) -> None:
        values = file[place][()]
        attributes = dict(file[place].attrs)
        del file[place]
        if way == GROUP:
            file.create_group(place)
        elif way == NULL:
            file[place] = h5py.Empty(np.float64)
        elif (replace := WAYS[way]) is not None:
            new = replace(values)
            ragged = way == "of any length"
            dtype = h5py.vlen_dtype(np.float64) if ragged else _text_type(new)
            file.create_dataset(place, data=new, dtype=dtype)
        if place in file:
            file[place].attrs.update(attributes)

    return Kind(f"/{place} {way}", _sealed(spoil))


def _text_type(values: Any) -> Any:
    return h5py.string_dtype() if np.asarray(values).dtype.kind == "O" else None


def field_kinds(group: str, fields: Iterable[Field], ways: Sequence[str]) -> Iterator[Kind]:
    """Yield a kind for each field, the ways in turn; texts cannot be spoilt by texts."""
    for field, turn in zip(fields, cycle(ways), strict=False):
        way = "missing" if (field.dtype, turn) == ("str", "of texts") else turn
        # A file may lack an optional field.
        way = "of another type" if field.optional and way == "missing" else way
        yield dataset_kind(f"{group}/{field.name}", way)


def value_kind(place: str, name: str, row: int, value: Any) -> Kind:
    """Return a kind in which one row has an impossible value."""

    def spoil(file: h5py.File) -> None:
        file[place][row] = value

    return Kind(f"/{place} {name}", _sealed(spoil))


def group_kinds(groups: Sequence[str]) -> Iterator[Kind]:
    """Yield kinds in which a group is missing, or a dataset."""
    for group in groups:
        yield Kind(f"/{group} missing", _sealed(lambda file, g=group: file.__delitem__(g)))

        def replaced(file: h5py.File, name: str = group) -> None:
            del file[name]
            file[name] = np.zeros(3)

        yield Kind(f"/{group} a dataset", _sealed(replaced))


#: Wrong values of an attribute.
ATTRIBUTES: dict[str, Any] = {
    "a number": 55,
    "a text": "x",
    "an array": np.zeros((2, 2)),
    "NaN": np.nan,
}


def attribute_kinds(allowed: Mapping[str, Sequence[str]]) -> Iterator[Kind]:
    """Yield each wrong value of each attribute of a file.

    Args:
        allowed: Names of values in ATTRIBUTES that are none, by attribute.
    """
    for key, fine in allowed.items():
        if "missing" not in fine:
            yield Kind(f"attribute {key} missing", _sealed(lambda file, k=key: file.attrs.pop(k)))
        for name, value in ATTRIBUTES.items():
            if name not in fine:

                def put(file: h5py.File, k: str = key, v: Any = value) -> None:
                    del file.attrs[k]
                    file.attrs[k] = v

                yield Kind(f"attribute {key} {name}", _sealed(put))


def attribute_kind(key: str, name: str, value: Any) -> Kind:
    """Return a kind in which an attribute has one other value."""
    return Kind(f"attribute {key} {name}", _sealed(lambda file: file.attrs.__setitem__(key, value)))


#: Attributes of the three files.
_ORIGIN: dict[str, Sequence[str]] = {
    "schema_version": (),
    "config": (),
    "config_hash": ("a text",),
    "seed": ("a number",),
    "versions": (),
    "fingers": (),
    "joints": (),
    "signature": ("a text",),
    "shards": ("a text",),
    "K": (),
    "near": ("a number",),
    "far": ("a number",),
}
_TURNS = (*WAYS, GROUP, NULL)
TRIALS: tuple[Kind, ...] = (
    *ANY_FILE,
    *group_kinds(("objects", "trials", "successes")),
    *field_kinds("objects", OBJECT_FIELDS, _TURNS),
    *field_kinds("trials", TRIAL_FIELDS, _TURNS),
    *field_kinds("successes", SUCCESS_FIELDS, _TURNS[1:]),
    # The ways that did not have their turn.
    *(
        kind
        for kind in (dataset_kind("trials/outcome", way) for way in _TURNS)
        if kind.name not in {k.name for k in field_kinds("trials", TRIAL_FIELDS, _TURNS)}
    ),
    *attribute_kinds(_ORIGIN),
    attribute_kind("schema_version", "of the future", 999),
    attribute_kind("schema_version", "before", 1),
    attribute_kind("seed", "negative", -1),
    attribute_kind("config", "NaN inside", '{"physics": {"time_step": NaN}}'),
)
#: Values that no header shows.
TRIAL_VALUES: tuple[Kind, ...] = (
    value_kind("successes/trial_id", "after the last", 0, 36),
    value_kind("successes/trial_id", "negative", 0, -1),
    value_kind("objects/name", "no UTF-8", 0, b"\xff\xfe"),
    value_kind("objects/class_name", "no UTF-8", 0, b"\xff\xfe"),
)
DATA: tuple[Kind, ...] = (
    *ANY_FILE,
    *group_kinds(("train", "valid", "test")),
    *(
        kind
        for k, split in enumerate(("train", "valid", "test"))
        for kind in field_kinds(split, DATA_FIELDS, _TURNS[k:])
    ),
    *(dataset_kind("train/grasps", way) for way in _TURNS if way != "one row less"),
    *(dataset_kind("test/images", way) for way in _TURNS if way != "one row less"),
    *attribute_kinds({**_ORIGIN, "camera": (), "split_by": ()}),
    attribute_kind("camera", "unknown", "stereo"),
    attribute_kind("schema_version", "of the future", 999),
    attribute_kind("K", "of 9 numbers", np.ones(9)),
)
#: Shards and plans have a seal, which proves that they are as they were written.
SEALED: tuple[Kind, ...] = (
    *ANY_FILE,
    Kind("not sealed again", lambda path: path.write_bytes(path.read_bytes()[:-1] + b"x")),
)
