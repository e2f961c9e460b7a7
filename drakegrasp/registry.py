"""What is looked up by name: samplers, protocols, exporters, kinds of clusters.

Each is an entry point of an installed package in the group `drakegrasp.KIND`. Ours stand in
pyproject.toml like anybody's, and are loaded when they are asked for, so a new one is one module
and one line. In a checkout that file itself is read: no line in it waits for an installation.
"""

from __future__ import annotations

import ast
import tomllib
from functools import cache
from importlib import metadata, util
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any, Literal, TypeAlias

from drakegrasp.errors import ConfigError, MachineError, listed, one_line

#: What has names; a group of entry points is `drakegrasp.` and one of these.
Kind: TypeAlias = Literal["clusters", "exporters", "protocols", "samplers"]
_PROJECT = Path(__file__).resolve().parent.parent / "pyproject.toml"


def names(kind: Kind) -> tuple[str, ...]:
    """Return all names of a kind: ours in their order, and then those of other packages."""
    return (*_ours(kind), *(name for name in _theirs(kind) if name not in _ours(kind)))


def is_known(kind: Kind, name: str) -> bool:
    """Return whether there is something of a name; other packages are asked last."""
    return name in _ours(kind) or name in _theirs(kind)


def find(kind: Kind, name: str) -> Any:
    """Return what a name stands for, loaded now.

    Raises:
        ConfigError: If there is none of that name, or it cannot be loaded.
        MachineError: If a library is missing that it needs.
    """
    entry = _entry(kind, name)
    try:
        return entry.load()
    except ModuleNotFoundError as error:
        extra = "".join(f": pip install 'drakegrasp[{extra}]'" for extra in entry.extras)
        raise MachineError(f"{error.name} must be installed{extra}") from None
    except Exception as error:
        got = f"{type(error).__name__} ({one_line(error)})"
        raise ConfigError(f"{kind}: {name} must be loaded from {entry.value}, got {got}") from error


def summary(kind: Kind, name: str) -> str:
    """Return what the module of a name says of it in its constant `HELP`, without loading it."""
    spec = util.find_spec(_entry(kind, name).module)
    text = Path(spec.origin).read_text(encoding="utf-8") if spec and spec.origin else ""
    for node in ast.parse(text).body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "HELP":
            return str(ast.literal_eval(node.value))
    return ""


def _entry(kind: Kind, name: str) -> EntryPoint:
    if not is_known(kind, name):
        raise ConfigError(f"{kind} must be one of {listed(names(kind))}, got {name!r}")
    return _ours(kind).get(name) or _theirs(kind)[name]


@cache
def _ours(kind: Kind) -> dict[str, EntryPoint]:
    group = f"drakegrasp.{kind}"
    try:
        project = tomllib.loads(_PROJECT.read_text(encoding="utf-8"))["project"]
        entries = project["entry-points"][group] if project["name"] == "drakegrasp" else {}
        return {name: EntryPoint(name, value, group) for name, value in entries.items()}
    except (OSError, KeyError, ValueError):  # installed, and no checkout
        found = metadata.distribution("drakegrasp").entry_points.select(group=group)
        return {entry.name: entry for entry in found}


@cache
def _theirs(kind: Kind) -> dict[str, EntryPoint]:
    return {entry.name: entry for entry in metadata.entry_points(group=f"drakegrasp.{kind}")}
