"""Every key of a JSON file, spoiled in every way that its type does not allow."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from helpers.bad_inputs.kinds import Kind

#: Values by the name of the way; text is put in as it is.
VALUES: dict[str, str] = {
    "null": "null",
    "text": '"x"',
    "number as text": '"1"',
    "empty text": '""',
    "control characters": '"a\\u001b]0;x\\u0007"',
    "half a surrogate": '"\\ud800"',
    "list": "[]",
    "list of lists": "[[[]]]",
    "mapping": "{}",
    "truth value": "true",
    "negative": "-1",
    "zero": "0",
    "fraction": "0.5",
    "NaN": "NaN",
    "infinite": "1e999",
    "beyond 64 bits": "1" + "0" * 30,
}
_NO_TEXT = ("text", "number as text", "empty text")
_NO_TREE = ("null", "list", "mapping", "truth value")
#: Ways that are wrong for a value of a type.
WRONG: dict[str, tuple[str, ...]] = {
    "positive": (*_NO_TREE, *_NO_TEXT, "negative", "zero", "NaN", "infinite"),
    "number": (*_NO_TREE, *_NO_TEXT, "NaN", "infinite"),
    "not negative": (*_NO_TREE, *_NO_TEXT, "negative", "NaN", "infinite"),
    "count": (*_NO_TREE, "number as text", "negative", "fraction", "NaN", "beyond 64 bits"),
    "name": (*_NO_TREE, "empty text", "control characters", "half a surrogate", "zero"),
    "text": (*_NO_TREE, "half a surrogate", "zero"),
    "hash": (*_NO_TREE, "text", "empty text", "zero"),
    "axis": (*_NO_TREE, "text", "empty text", "zero"),
    "truth": ("null", "list", "mapping", "text", "zero"),
    "list": ("null", "mapping", "truth value", "text", "zero"),
    "list of texts": ("null", "mapping", "truth value", "text", "zero", "list of lists"),
    "pose": (*_NO_TREE, "text", "zero", "list of lists"),
    "mapping": ("null", "list", "truth value", "text", "zero"),
}
#: What replaces a value while the file is written, so that no JSON writer has to know NaN.
_MARK = '"put the value here"'

Place = tuple[str | int, ...]


def key_kinds(place: Place, of: str, *, optional: bool = False) -> Iterator[Kind]:
    """Yield every way to spoil one key.

    Args:
        place: Keys and numbers that lead to it.
        of: Type of its value, a key of WRONG.
        optional: Whether it may be left out.
    """
    label = ".".join(map(str, place))
    if not optional:
        yield Kind(f"{label} missing", _edit(place, None))
    for way in WRONG[of]:
        yield Kind(f"{label} {way}", _edit(place, VALUES[way]))


def value_kind(place: Place, name: str, value: str) -> Kind:
    """Return a kind that puts JSON text in the place of a value."""
    return Kind(f"{'.'.join(map(str, place))} {name}", _edit(place, value))


def twice(place: Place) -> Kind:
    """Return a kind in which a key of a mapping is there twice."""

    def spoil(path: Path) -> None:
        key = json.dumps(place[-1])
        text = json.dumps(_changed(path, place, lambda node, last: None))
        path.write_text(text.replace(f"{key}: ", f"{key}: null, {key}: ", 1))

    return Kind(f"{'.'.join(map(str, place))} twice", spoil)


def _edit(place: Place, value: str | None) -> Callable[[Path], None]:
    def change(node: Any, last: str | int) -> None:
        if value is None:
            del node[last]
        else:
            node[last] = json.loads(_MARK)

    def spoil(path: Path) -> None:
        content = _changed(path, place, change)
        path.write_text(json.dumps(content).replace(_MARK, value or ""))

    return spoil


def _changed(path: Path, place: Place, change: Callable[[Any, str | int], None]) -> Any:
    content = json.loads(path.read_text(encoding="utf-8"))
    node: Any = content
    for key in place[:-1]:
        node = node[key]
    change(node, place[-1])
    return content


def table(keys: Mapping[Place, str], optional: tuple[Place, ...] = ()) -> list[Kind]:
    """Return the kinds of all keys of a file."""
    return [
        kind
        for place, of in keys.items()
        for kind in key_kinds(place, of, optional=place in optional)
    ]
