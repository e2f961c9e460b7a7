"""JSON of unknown origin: every mistake is a `ValueError`, and nothing is read in two ways.

Python's own reader takes NaN, keeps the last of two equal keys, and gives up in other ways at
bytes that are no text, at values that are nested too deeply and at numbers of thousands of digits.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NoReturn

from drakegrasp.foreign_files import LARGEST_TEXT, read_content


def read_json(path: Path) -> Any:
    """Return the content of a JSON file.

    Raises:
        OSError: If it cannot be read.
        ValueError: As for `parse_json`.
    """
    return parse_json(read_content(path, LARGEST_TEXT))


def parse_json(text: str | bytes) -> Any:
    """Return the content of a JSON text.

    Raises:
        ValueError: If it is no JSON in UTF-8, is nested too deeply, has a key twice or a number
            that is none, with the reason.
    """
    try:
        text = text if isinstance(text, str) else text.decode("utf-8")
        return json.loads(text, object_pairs_hook=_mapping, parse_constant=_no_number)
    except RecursionError:
        raise ValueError("values nested too deeply") from None
    except ValueError as error:
        if "integer string conversion" in str(error):
            raise ValueError("a number of too many digits") from None
        raise


def _mapping(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        keys = [key for key, _ in pairs]
        twice = next(key for key in keys if keys.count(key) > 1)
        raise ValueError(f"the key {twice!r} twice")
    return found


def _no_number(text: str) -> NoReturn:
    raise ValueError(f"the number {text}")
