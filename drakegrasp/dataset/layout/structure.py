"""Rules of the groups and datasets of a file: they are those of the schema, and agree in length.

In: an open HDF5 file and the fields of its groups. Out: every `Difference` from them. Only headers
are read. `opening` refuses the first one for all commands, `checks.layout` lists all of them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import h5py
import numpy as np

from drakegrasp.dataset.schema import (
    DATA_FIELDS,
    OBJECT_FIELDS,
    SCENE_FIELDS,
    SCENE_GRASP_FIELDS,
    SCENE_OBJECT_FIELDS,
    SCHEMA_VERSION,
    SPLITS,
    SUCCESS_FIELDS,
    TRIAL_FIELDS,
    VIEW_FIELDS,
    VISIBLE_FIELDS,
    Field,
    is_readable,
)

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
    """How a file differs from the schema.

    Attributes:
        path: Path of the group or the dataset; empty for the whole file.
        what: What must be there, in words.
        got: What is there instead.
        text_only: Whether it is in the words beside the values: the rows can be read.
    """

    path: str = ""
    what: str
    got: str
    text_only: bool = False

    def __str__(self) -> str:
        return f"{self.path + ': ' if self.path else ''}{self.what}, got {self.got}"


def differences(
    file: h5py.File, tables: Tables, *, image: int | None = None, thorough: bool = False
) -> Iterator[Difference]:
    """Yield how the groups and datasets of a file differ from the schema.

    Args:
        file: The file.
        tables: Fields of each group.
        image: Size of the images [px]; what most datasets say if None.
        thorough: Whether to report harmless differences as well: additional fields, and other
            attributes of fields.
    """
    # Older files have fewer fields.
    version = file.attrs.get("schema_version")
    version = version if is_readable(version) and not thorough else SCHEMA_VERSION
    tables = {
        name: tuple(f for f in fields if f.since <= version) for name, fields in tables.items()
    }

    # The headers of all datasets, each looked at once.
    headers = {name: _datasets(file, name, fields) for name, fields in tables.items()}
    lengths = _lengths(tables, headers)
    if image is not None:
        lengths["S"] = image

    if thorough:
        yield from _extras(file, tables)
    for name, fields in tables.items():
        datasets = headers[name]
        if datasets is None:
            yield Difference(path=f"/{name}", what="the group must be there", got="none")
            continue

        meanings = {f.meaning: f.name for f in fields}
        # Each field by itself; the number of rows is that of most datasets.
        rows = _most_frequent([dataset.shape[0] for dataset in datasets.values() if dataset.shape])
        for f in fields:
            if f.optional and f.name not in file[name]:
                continue
            path, dataset = f"/{name}/{f.name}", datasets.get(f.name)
            yield from _of_field(path, dataset, f, rows, lengths)
            if dataset is not None:
                yield from _of_another(path, h5py.Dataset(dataset), f, meanings)
            if thorough and dataset is not None:
                yield from _of_attributes(path, h5py.Dataset(dataset), f)


def _datasets(
    file: h5py.File, name: str, fields: Iterable[Field]
) -> dict[str, h5py.h5d.DatasetID] | None:
    """Return the datasets of a group that are fields; None if there is no such group."""
    group = file.get(name)
    if not isinstance(group, h5py.Group):
        return None
    datasets = {}
    for f in fields:
        try:
            item = h5py.h5o.open(group.id, f.name.encode())
        except KeyError:
            continue
        if isinstance(item, h5py.h5d.DatasetID):
            datasets[f.name] = item
    return datasets


def _extras(file: h5py.File, tables: Tables) -> Iterator[Difference]:
    """Yield the groups and datasets that are no fields."""
    for extra in sorted(set(file) - set(tables)):
        yield Difference(what="groups must be those of the schema", got=f"/{extra} too")
    for name, fields in tables.items():
        group = file.get(name)
        paths: set[str] = set()

        def visit(path: str, node: h5py.Dataset | h5py.Group, paths: set[str] = paths) -> None:
            if isinstance(node, h5py.Dataset):
                paths.add(path)

        if isinstance(group, h5py.Group):
            group.visititems(visit)
        for key in sorted(paths - {f.name for f in fields}):
            got = f"{key} too"
            yield Difference(path=f"/{name}", what="datasets must be those of the schema", got=got)


def _lengths(
    tables: Tables, headers: Mapping[str, dict[str, h5py.h5d.DatasetID] | None]
) -> dict[str, int]:
    """Return the lengths of the letters in the shapes that most datasets of a file agree on."""
    votes: dict[str, list[int]] = {"k": [], "j": [], "S": []}
    for name, fields in tables.items():
        datasets = headers[name] or {}
        for f in fields:
            shape = datasets[f.name].shape if f.name in datasets else None
            if not shape or len(shape) != 1 + len(f.axes):
                continue
            for axis, length in zip(f.axes, shape[1:], strict=True):
                if axis == "6k":
                    votes["k"].append(length // 6)
                elif isinstance(axis, str):
                    votes.setdefault(axis, []).append(length)
    known = {letter: _most_frequent(lengths) for letter, lengths in votes.items()}
    return {letter: length for letter, length in (known | {"6k": 6 * known["k"]}).items() if length}


def _most_frequent(numbers: list[int]) -> int:
    return max(numbers, key=numbers.count, default=0)


def _of_field(
    path: str,
    dataset: h5py.h5d.DatasetID | None,
    field: Field,
    rows: int,
    lengths: Mapping[str, int],
) -> Iterator[Difference]:
    """Yield how the type and shape of a dataset differ from its field.

    Args:
        path: Path of the dataset.
        dataset: The dataset; None if it is missing.
        field: The field.
        rows: Number of rows that it must have.
        lengths: Of the letters in the shapes, where they are known.
    """
    if dataset is None:
        yield Difference(path=path, what="the dataset must be there", got="none")
        return

    dtype, stored = dataset.dtype, dataset.shape
    text = h5py.check_string_dtype(dtype) is not None
    if text != (field.dtype == "str") or not (text or dtype == np.dtype(field.dtype)):
        yield Difference(path=path, what=f"type must be {field.dtype}", got=str(dtype))
    try:
        shape = (rows, *field.row_shape(lengths))
    except KeyError:
        # No sound dataset tells the length of a letter; one without a space has no shape.
        shape = (rows, *(stored or ())[1:])
    if stored != shape:
        yield Difference(path=path, what=f"shape must be {shape}", got=str(stored))


def _of_another(
    path: str, dataset: h5py.Dataset, field: Field, meanings: Mapping[str, str]
) -> Iterator[Difference]:
    """Yield that a dataset is, as it says itself, another field: two were swapped.

    Args:
        path: Path of the dataset.
        dataset: The dataset.
        field: The field.
        meanings: Names of the fields of the group by their meanings.
    """
    # Wording may improve without a new version of the schema: only what is another's is told.
    said = dataset.attrs.get("meaning")
    if isinstance(said, str) and said != field.meaning and said in meanings:
        yield Difference(path=path, what=f"must be {field.name}", got=meanings[said])


def _of_attributes(path: str, dataset: h5py.Dataset, field: Field) -> Iterator[Difference]:
    """Yield how the attributes of a dataset differ from its field."""
    attrs = dict(dataset.attrs)
    for key, value in (("unit", field.unit), ("frame", field.frame)):
        if not (isinstance(attrs.get(key), str) and attrs[key] == value):
            what, got = f"attribute {key} must be {value!r}", repr(attrs.get(key))
            yield Difference(path=path, what=what, got=got, text_only=True)
    # Wording may improve without a new version of the schema.
    if not str(attrs.get("meaning", "")):
        what = "attribute meaning must be there"
        yield Difference(path=path, what=what, got="none", text_only=True)
