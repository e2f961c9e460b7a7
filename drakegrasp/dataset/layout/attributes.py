"""Rules of the attributes of a file: which there are, and of what kind.

In: an open HDF5 file. Out: every `Difference` from them. Whether they agree with the configuration
is for `checks.layout`: that needs more than NumPy and h5py.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import h5py
import numpy as np

from drakegrasp.dataset.layout.structure import Difference
from drakegrasp.dataset.schema import CAMERAS
from drakegrasp.errors import printable
from drakegrasp.foreign_files import parse_json


def _is_text(value: Any) -> bool:
    return isinstance(value, str) and bool(value.strip()) and value.isprintable()


def _is_mapping(value: Any) -> bool:
    try:
        return isinstance(value, str) and isinstance(parse_json(value), dict)
    except ValueError:
        return False


def _is_truths(value: Any) -> bool:
    return _is_mapping(value) and all(isinstance(v, bool) for v in parse_json(value).values())


def _is_names(value: Any) -> bool:
    try:
        names = parse_json(value) if isinstance(value, str) else None
    except ValueError:
        return False
    return isinstance(names, list) and all(map(_is_text, names))


def _is_whole(value: Any) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool) and bool(value >= 0)


def _is_positive(value: Any) -> bool:
    return isinstance(value, float | np.floating) and bool(0.0 < value < np.inf)


def _is_matrix(value: Any) -> bool:
    return (
        isinstance(value, np.ndarray)
        and value.shape == (3, 3)
        and value.dtype.kind == "f"
        and bool(np.isfinite(value).all())
    )


#: A rule: what the value must be, in words, and whether it is.
Rule = tuple[str, Callable[[Any], bool]]
TEXT: Rule = ("a text", _is_text)
COUNT: Rule = ("a whole number that is not negative", _is_whole)
_POSITIVE: Rule = ("a positive number", _is_positive)
_MAPPING: Rule = ("a mapping in JSON", _is_mapping)

#: Attributes of all three files.
ORIGIN: Mapping[str, Rule] = {
    "config": _MAPPING,
    "config_hash": TEXT,
    "seed": COUNT,
    "versions": _MAPPING,
    "fingers": ("whether a grasp needs each finger, in JSON", _is_truths),
    "joints": ("names of the hand's joints, in JSON", _is_names),
    "signature": TEXT,
    "shards": TEXT,
    "K": ("a matrix of 3 x 3 finite numbers", _is_matrix),
    "near": _POSITIVE,
    "far": _POSITIVE,
}
#: Those that files of before they were written may lack.
_YOUNG = ("fingers", "joints", "split_by")
#: And of the data files.
OF_CAMERA: Mapping[str, Rule] = {
    **ORIGIN,
    "camera": (f"one of {', '.join(CAMERAS)}", lambda v: isinstance(v, str) and v in CAMERAS),
    "split_by": ("class or object", lambda v: isinstance(v, str) and v in ("class", "object")),
}
#: Of scenes.hdf5, whose views have their own camera matrices.
OF_SCENES: Mapping[str, Rule] = {key: rule for key, rule in ORIGIN.items() if key != "K"}


def attribute_mistakes(file: h5py.File, rules: Mapping[str, Rule]) -> dict[str, Difference]:
    """Return by their names the attributes that are missing or break their rules.

    Args:
        file: The file.
        rules: By the attributes' names.
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
