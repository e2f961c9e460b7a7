"""Values of JSON and YAML files, spoiled in every way."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import yaml
from helpers.bad_inputs.kinds import Kind

#: Values by the name of the way.
VALUES: dict[str, Any] = {
    "null": None,
    "text": "x",
    "number as text": "1",
    "empty text": "",
    "control characters": "a\x1b]0;x\x07",
    "half a surrogate": "\ud800",
    "date": "2026-01-01T00:00:00Z",
    "list": [],
    "list of lists": [[[]]],
    "mapping": {"a": 1},
    "truth value": True,
    "negative": -1,
    "zero": 0,
    "fraction": 0.5,
    "NaN": float("nan"),
    "infinite": float("inf"),
    "huge": 10**30,
}
Place = tuple[str | int, ...]


def some_values(tree: Any, each: int) -> Iterator[Kind]:
    """Yield one in so many ways to spoil or leave out a value of a tree.

    With a prime number of them all ways have their turn. A value that is there already is no way.
    """
    return (kind for kind in islice(_every_value(tree, ()), 0, None, each) if kind is not None)


def _every_value(tree: Any, place: Place) -> Iterator[Kind | None]:
    for key, value in list(tree.items() if isinstance(tree, dict) else enumerate(tree)):
        yield without((*place, key))
        for name, other in VALUES.items():
            same = type(other) is type(value) and other == value
            yield None if same else value_kind((*place, key), name, other)
        if isinstance(value, dict | list):
            yield from _every_value(value, (*place, key))


def keys(wrong: Mapping[Place, Sequence[str]]) -> Iterator[Kind]:
    """Yield the ways to spoil some keys of a file, none of which it may lack."""
    for place, names in wrong.items():
        yield from (without(place), *ways(place, *names))


def ways(place: Place, *names: str) -> Iterator[Kind]:
    """Yield ways to spoil a value, by their names in VALUES."""
    return (value_kind(place, name, VALUES[name]) for name in names)


def value_kind(place: Place, name: str, value: Any) -> Kind:
    """Return a kind that puts a value in the place of another."""
    return _edited(place, name, lambda node, last: node.__setitem__(last, value))


def without(place: Place) -> Kind:
    """Return a kind in which a value is missing."""
    return _edited(place, "missing", lambda node, last: node.__delitem__(last))


def twice(place: Place) -> Kind:
    """Return a kind of JSON in which a key of a mapping is there twice."""
    key = json.dumps(place[-1])

    def spoil(path: Path) -> None:
        text = json.dumps(json.loads(path.read_text(encoding="utf-8")))
        path.write_text(text.replace(f"{key}: ", f"{key}: null, {key}: ", 1))

    return Kind(f"{key} twice", spoil)


def _edited(place: Place, name: str, edit: Callable[[Any, str | int], object]) -> Kind:
    def spoil(path: Path) -> None:
        text, is_json = path.read_text(encoding="utf-8"), path.suffix == ".json"
        node = tree = json.loads(text) if is_json else yaml.safe_load(text)
        for key in place[:-1]:
            node = node[key]
        edit(node, place[-1])
        path.write_text(json.dumps(tree) if is_json else yaml.safe_dump(tree))

    return Kind(f"{'.'.join(map(str, place))} {name}", spoil)
