"""Reads the JSON files of a dataset as typed data, and writes results as strict JSON.

Input: a file and a pydantic model. Output: the model, or a `DataError` that names the file and the
key: values of another type are rejected.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import numpy as np
from pydantic import AfterValidator, BaseModel, ValidationError

from drakegrasp.config import describe_mistake
from drakegrasp.errors import DataError, one_line, printable
from drakegrasp.filters import Removal
from drakegrasp.foreign_files import LARGEST_TEXT, NAME_RULE, is_name, parse_json, read_content
from drakegrasp.outcomes import Outcome

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

M = TypeVar("M", bound=BaseModel)
#: Significant digits of the numbers in results: a micrometre in a metre.
DIGITS = 6


def _validate_name(text: str) -> str:
    """Raise an error if a name, used as a file's name, could leave the directory."""
    if not is_name(text):
        raise ValueError(f"a name must be {NAME_RULE}, got {text!r}")
    return text


#: The name of an object or a class.
Name = Annotated[str, AfterValidator(_validate_name)]


def stated(entry: DataclassInstance) -> dict[str, Any]:
    """Return a dataclass as JSON types, without the values that equal their defaults."""
    values = asdict(entry)
    return {f.name: values[f.name] for f in fields(entry) if values[f.name] != f.default}


def read_mapping(path: Path, what: str) -> tuple[dict[str, Any], bytes]:
    """Return the content of a JSON file that must be a mapping, and its bytes.

    Args:
        path: Path of the file.
        what: Description of a valid file, for the message.

    Raises:
        FileNotFoundError, NotADirectoryError: If there is no such file.
        DataError: If the file cannot be read, or is not a JSON mapping.
    """
    try:
        content = read_content(path, LARGEST_TEXT)
        tree = parse_json(content)
    except (FileNotFoundError, NotADirectoryError):
        raise
    except (OSError, ValueError) as error:
        got = f"a broken one ({printable(one_line(error))})"
        raise DataError(f"{path}: must be {what}, got {got}") from None
    if not isinstance(tree, dict):
        raise DataError(f"{path}: must be {what}, got a {type(tree).__name__}")
    return tree, content


def validated(path: Path, content: bytes, model: type[M]) -> M:
    """Return JSON text as a model; every value must have exactly the type of its field.

    Args:
        path: Path of the file, for the message.
        content: The text, which `read_mapping` has read.
        model: Class of the model.

    Raises:
        DataError: If a key is missing, unknown or of another type.
    """
    try:
        return model.model_validate_json(content, strict=True)
    except ValidationError as error:
        mistake = error.errors()[0]
        line = describe_mistake(mistake, whole="the file", legal="a known key")
        raise DataError(f"{path}: {printable(line[:300])}") from None


def strict_json(value: Any) -> str:
    """Return a result as a line of strict JSON.

    NaN and infinity become null, outcomes and removals their names, and numbers have `DIGITS`
    digits.
    """
    return json.dumps(_plain(value), ensure_ascii=False, allow_nan=False)


def _plain(value: Any) -> Any:
    """Return a value converted to types of strict JSON."""
    if isinstance(value, Outcome | Removal):
        return value.label
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        # Adding zero turns -0.0 into 0.0.
        return float(f"{value:.{DIGITS}g}") + 0.0 if math.isfinite(value) else None
    return value
