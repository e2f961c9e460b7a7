"""Opens HDF5 files of a dataset for reading, and rejects files that differ from the schema.

Input: a path, or an open file and the fields of its groups. Output: an open file that contains
every group, dataset and attribute of the schema with its type and shape; or every `Difference`.
Only headers are read; `read_codes` also rejects numbers without a defined meaning. Commands reject
a file at the first difference, and `drakegrasp check` lists all of them. The module needs only
NumPy and h5py.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

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
        text_only: Whether only descriptions differ, not values: the rows can be read.
    """

    path: str = ""
    what: str
    got: str
    text_only: bool = False

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
    path: Path, what: str, rules: Mapping[str, Rule], tables: Tables
) -> Iterator[h5py.File]:
    """Open a file, see `opened`, and reject it if it differs from the schema."""
    with opened(path, what) as file:
        refuse_other_attributes(path, file, rules)
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

#: A rule: a description of the valid values, and a function that checks a value.
Rule = tuple[str, Callable[[Any], bool]]


def _is_text(value: Any) -> bool:
    return isinstance(value, str) and bool(value.strip()) and value.isprintable()


def _is_json(
    kind: type[dict[str, Any] | list[Any]], each: Callable[[Any], bool] = lambda value: True
) -> Callable[[Any], bool]:
    """Return a check for JSON text that holds a mapping or a list of such values."""

    def obeys(value: Any) -> bool:
        try:
            tree = parse_json(value) if isinstance(value, str) else None
        except ValueError:
            return False
        if not isinstance(tree, kind):
            return False
        return all(map(each, tree.values() if isinstance(tree, dict) else tree))

    return obeys


def _is_whole(value: Any) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool) and bool(value >= 0)


def _is_matrix(value: Any) -> bool:
    is_array = isinstance(value, np.ndarray) and value.shape == (3, 3) and value.dtype.kind == "f"
    return is_array and bool(np.isfinite(value).all())


TEXT: Rule = ("a text", _is_text)
COUNT: Rule = ("a whole number that is not negative", _is_whole)
#: Rules of the attributes of all three files.
ORIGIN: Mapping[str, Rule] = {
    **dict.fromkeys(("config", "versions"), ("a mapping in JSON", _is_json(dict))),
    **dict.fromkeys(("config_hash", "signature", "shards"), TEXT),
    "seed": COUNT,
    "fingers": (
        "whether a grasp needs each finger, in JSON",
        _is_json(dict, lambda value: isinstance(value, bool)),
    ),
    "joints": ("names of the hand's joints, in JSON", _is_json(list, _is_text)),
    "K": ("a matrix of 3 x 3 finite numbers", _is_matrix),
    **dict.fromkeys(
        ("near", "far"),
        (
            "a positive number",
            lambda v: isinstance(v, float | np.floating) and bool(0.0 < v < np.inf),
        ),
    ),
}
#: Attributes that files from older versions may lack.
_YOUNG = ("fingers", "joints", "split_by")
#: Rules of the attributes of the data files.
OF_CAMERA: Mapping[str, Rule] = {
    **ORIGIN,
    "camera": (f"one of {', '.join(CAMERAS)}", lambda v: isinstance(v, str) and v in CAMERAS),
    "split_by": ("class or object", lambda v: isinstance(v, str) and v in ("class", "object")),
}
#: Rules of the attributes of scenes.hdf5, whose views have their own camera matrices.
OF_SCENES: Mapping[str, Rule] = {key: rule for key, rule in ORIGIN.items() if key != "K"}

#: Context managers that open a file of a dataset, given its path: grasping_oto.hdf5 or
#: grasping_otm.hdf5, trials.hdf5, scenes.hdf5. They raise a DataError if the file is missing,
#: damaged, or differs from the schema.
open_samples, open_trials, open_scenes = (
    partial(_opened_whole, what=what, rules=rules, tables=tables)
    for what, rules, tables in (
        ("a data file of drakegrasp", OF_CAMERA, DATA_TABLES),
        ("the trials of a dataset", ORIGIN, TRIAL_TABLES),
        ("the scenes of a dataset", OF_SCENES, SCENE_TABLES),
    )
)


def attribute_mistakes(file: h5py.File, rules: Mapping[str, Rule]) -> dict[str, Difference]:
    """Return the attributes that are missing or break their rules, by name.

    Args:
        file: The file.
        rules: Rules by the attributes' names.
    """
    mistakes = {}
    for key, (must, obeys) in rules.items():
        value = file.attrs.get(key)
        if key not in file.attrs and key not in _YOUNG:
            mistakes[key] = Difference(what=f"attribute {key} must be {must}", got="none")
        elif key in file.attrs and not obeys(value):
            got = printable(" ".join(repr(value).split())[:60])
            mistakes[key] = Difference(what=f"attribute {key} must be {must}", got=got)
    return mistakes


def refuse_other_attributes(path: Path, file: h5py.File, rules: Mapping[str, Rule]) -> None:
    """Reject a file of another schema version, or with an attribute that breaks its rule.

    Args:
        path: Path of the file, for the message.
        file: The file.
        rules: Rules by the attributes' names.

    Raises:
        DataError: If the file is rejected; the error reports the first mistake.
    """
    # Check the version first: another version may have other attributes, and a foreign file has
    # none.
    if "schema_version" not in file.attrs:
        raise DataError(f"{path}: must be a data file of drakegrasp, got another HDF5 file")
    refuse_other_schema(path, file.attrs["schema_version"])
    refuse_first(path, attribute_mistakes(file, rules).values())


# Groups and datasets


def differences(file: h5py.File, tables: Tables, *, thorough: bool = False) -> Iterator[Difference]:
    """Yield the differences between the groups and datasets of a file and the schema.

    Args:
        file: The file.
        tables: Fields of each group; the fields of the whole file are under "/".
        thorough: Whether to report harmless differences as well: additional fields, and other
            attributes of fields.
    """
    # The headers of all datasets; each is read once.
    headers = {name: _datasets(file, name, fields) for name, fields in tables.items()}
    lengths = _lengths(tables, headers)
    if thorough:
        yield from _extras(file, tables)
    for name, fields in tables.items():
        datasets, place = headers[name], f"/{name}".rstrip("/")
        if datasets is None:
            yield Difference(path=place, what="the group must be there", got="none")
            continue

        # Check each field by itself; the number of rows must be that of most datasets.
        meanings = {f.meaning: f.name for f in fields}
        rows = _most_frequent([each.shape[0] for each in datasets.values() if each.shape])
        for f in fields:
            path, header = f"{place}/{f.name}", datasets.get(f.name)
            if header is not None:
                yield from _of_field(path, header, f, rows, lengths)
                yield from _of_words(path, header.dataset, f, meanings, thorough)
            elif not f.optional or f.name in file[name]:
                yield Difference(path=path, what="the dataset must be there", got="none")


class _Header(NamedTuple):
    """A dataset, its type, and its shape, which is None without a dataspace."""

    dataset: h5py.h5d.DatasetID
    dtype: np.dtype[Any]
    shape: tuple[int, ...] | None


def _datasets(file: h5py.File, name: str, fields: Iterable[Field]) -> dict[str, _Header] | None:
    """Return the datasets of a group that are fields; None if the group does not exist."""
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
            datasets[f.name] = _Header(item, item.dtype, item.shape)
    return datasets


def _extras(file: h5py.File, tables: Tables) -> Iterator[Difference]:
    """Yield a difference for each group and dataset that is not in the schema."""
    for extra in sorted(set(file) - set(tables)):
        yield Difference(what="groups must be those of the schema", got=f"/{extra} too")
    for name, fields in tables.items():
        group, paths = file.get(name), list[str]()
        if isinstance(group, h5py.Group):
            group.visititems(
                lambda path, node, paths=paths: (
                    paths.append(path) if isinstance(node, h5py.Dataset) else None
                )
            )
        for key in sorted(set(paths) - {f.name for f in fields}):
            what = "datasets must be those of the schema"
            yield Difference(path=f"/{name}", what=what, got=f"{key} too")


def _lengths(tables: Tables, headers: Mapping[str, dict[str, _Header] | None]) -> dict[str, int]:
    """Return the lengths of the letters in shapes, as most datasets of a file have them."""
    votes: dict[str, list[int]] = {}
    for name, fields in tables.items():
        datasets = headers[name] or {}
        for f in fields:
            shape = datasets[f.name].shape if f.name in datasets else None
            if shape and len(shape) == 1 + len(f.axes):
                for axis, length in zip(f.axes, shape[1:], strict=True):
                    letter, each = ("k", 6) if axis == "6k" else (str(axis), 1)
                    votes.setdefault(letter, []).append(length // each)
    known = {letter: _most_frequent(lengths) for letter, lengths in votes.items()}
    known["6k"] = 6 * known.get("k", 0)
    return {letter: length for letter, length in known.items() if length}


def _most_frequent(numbers: Sequence[int]) -> int:
    return Counter(numbers).most_common(1)[0][0] if numbers else 0


def _of_field(
    path: str,
    header: _Header,
    field: Field,
    rows: int,
    lengths: Mapping[str, int],
) -> Iterator[Difference]:
    """Yield the differences between the type and shape of a dataset and its field.

    Args:
        path: Path of the dataset.
        header: The dataset.
        field: The field.
        rows: Number of rows that the dataset must have.
        lengths: Lengths of the letters in the shapes, as far as they are known.
    """
    _, dtype, stored = header
    text = h5py.check_string_dtype(dtype) is not None
    if text != (field.dtype == "str") or not (text or dtype == np.dtype(field.dtype)):
        yield Difference(path=path, what=f"type must be {field.dtype}", got=str(dtype))
    try:
        shape = (rows, *field.row_shape(lengths))
    except KeyError:
        # No sound dataset determines the letter; a dataset without a dataspace has no shape.
        shape = (rows, *(stored or ())[1:])
    if stored != shape:
        yield Difference(path=path, what=f"shape must be {shape}", got=str(stored))


def _of_words(
    path: str,
    dataset: h5py.h5d.DatasetID,
    field: Field,
    meanings: Mapping[str, str],
    thorough: bool,
) -> Iterator[Difference]:
    """Yield the differences between the attributes of a dataset and its field.

    Args:
        path: Path of the dataset.
        dataset: The dataset.
        field: The field.
        meanings: Names of the fields of the group by their meanings.
        thorough: Whether unit and frame must also match the field, and a meaning must exist.
    """
    # Wording may improve without a new version of the schema. Only the meaning of another field is
    # reported, because two fields were swapped then.
    attrs = h5py.AttributeManager(h5py.Dataset(dataset))  # each is read when it is used
    said = attrs.get("meaning")
    if isinstance(said, str) and said != field.meaning and said in meanings:
        yield Difference(path=path, what=f"must be {field.name}", got=meanings[said])
    if not thorough:
        return
    for key, value in (("unit", field.unit), ("frame", field.frame)):
        got = attrs.get(key)
        if not (isinstance(got, str) and got == value):
            what = f"attribute {key} must be {value!r}"
            yield Difference(path=path, what=what, got=repr(got), text_only=True)
    if not str("" if said is None else said):
        what = "attribute meaning must be there"
        yield Difference(path=path, what=what, got="none", text_only=True)


# Plans


def _array(name: str, shape: str, dtype: str, optional: bool = False) -> Field:
    return Field(name, shape, dtype, "-", "-", "", optional=optional)


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
#: Lists of texts in JSON; `preshape` is left out if all its texts are empty.
POSTURE_TEXTS = (_array("said", "", "uint8"), _array("preshape", "", "uint8", optional=True))
_PLAN_ATTRIBUTES = {
    **dict.fromkeys(("model_sha256", "config_hash", "mesh_sha256"), TEXT),
    "asked": COUNT,
}


def refuse_other_plan(path: Path, file: h5py.File) -> None:
    """Reject a file that is not a plan of an object.

    Raises:
        DataError: If the file is rejected; the error reports the first difference.
    """
    refuse_first(path, attribute_mistakes(file, _PLAN_ATTRIBUTES).values())
    resting, palms = PLAN_TABLES
    tables = [resting, palms]
    if "q_grasp" in file:
        tables = [resting, (*palms, *POSTURE_FIELDS), *((text,) for text in POSTURE_TEXTS)]
    for table in tables:
        refuse_first(path, differences(file, {"/": table}))
