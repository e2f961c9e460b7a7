"""Finds things by name: samplers, filters, protocols, formats, hands, kinds of clusters.

Each is an entry point of an installed package in the group `drakegrasp.KIND`. The package's own
entry points are in pyproject.toml like those of any other package, and are loaded on request. A new
one needs one module and one line. In a checkout, pyproject.toml itself is read, so that a new line
works without a new installation.

clusters: a subclass of `cluster.kinds.Local`, or a class of dask-jobqueue.
exporters: a function (dataset, folder, progress) that returns the number of samples.
hands: the path of a hand file.
importers: a function (path, hand) that returns arguments of `simulation.attempts.make_attempts`, or
    None for a file of another format. The name ends with the suffix of the files.
protocols: a subclass of `protocols.protocol.MujocoProtocol`, except for `lift`.
filters: a `filters.Filter`. The package's own are `filters.FILTERS`; each has a limit and a code.
samplers: a `simulation.candidates.Sampler`, like a user-defined one.

A user-defined class is named `file.py:Name`, and imported from the file's text. A configuration
stores the name without folders, followed by 16 digits of the file's SHA-256, so that a changed file
is another setting. The text is sent to every worker with the configuration and is written into no
file. Code is never imported from a dataset, so a command that needs it must be given the file
again.
"""

from __future__ import annotations

import ast
import hashlib
import inspect
import sys
import tomllib
import traceback
from collections.abc import Callable, Mapping, Sequence
from functools import cache, lru_cache
from importlib import metadata, util
from importlib.metadata import EntryPoint
from pathlib import Path
from types import ModuleType
from typing import Any, Literal, TypeAlias

from drakegrasp.errors import ConfigError, MachineError, listed, one_line

#: Kinds of named things; a group of entry points is `drakegrasp.` and one of these.
Kind: TypeAlias = Literal[
    "clusters", "exporters", "hands", "importers", "protocols", "filters", "samplers"
]
#: Number of imported files that a process caches.
_KEPT_FILES = 32
_PROJECT = Path(__file__).resolve().parent.parent / "pyproject.toml"


def names(kind: Kind) -> tuple[str, ...]:
    """Return all names of a kind: the package's own in order, then those of other packages."""
    return (*_ours(kind), *(name for name in _theirs(kind) if name not in _ours(kind)))


def is_known(kind: Kind, name: str) -> bool:
    """Return whether a name is known; other packages are searched last."""
    return name in _ours(kind) or name in _theirs(kind)


def find(kind: Kind, name: str) -> Any:
    """Load and return what is registered under a name.

    Raises:
        ConfigError: If the name is unknown, or its entry point cannot be loaded.
        MachineError: If it needs a library that is missing.
    """
    entry, owned = _entry(kind, name), with_owner(kind, name)
    try:
        return entry.load()
    except ModuleNotFoundError as error:
        extra = "".join(f": pip install '{_package(entry)}[{extra}]'" for extra in entry.extras)
        raise MachineError(f"{error.name} must be installed for {owned}{extra}") from None
    except (Exception, SystemExit) as error:
        got = f"{type(error).__name__} ({one_line(error)})"
        raise ConfigError(
            f"{kind}: {owned} must be loaded from {entry.value}, got {got}"
        ) from error


def with_owner(kind: Kind, name: str) -> str:
    """Return a name with the package that has it, if that is not ours, for error messages."""
    package = _package(_entry(kind, name))
    return name if package == "drakegrasp" else f"{name} of the package {package}"


def summary(kind: Kind, name: str, constant: str = "HELP") -> str:
    """Return a text of the module of a name, without loading the module; empty if it has none."""
    try:
        spec = util.find_spec(_entry(kind, name).module)
        text = Path(spec.origin).read_text(encoding="utf-8") if spec and spec.origin else ""
        body = ast.parse(text).body
    except (Exception, SystemExit):  # of a broken package: `find` tells it
        return ""
    for node in body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == constant:
            return str(ast.literal_eval(node.value))
    return ""


def _entry(kind: Kind, name: str) -> EntryPoint:
    if not is_known(kind, name):
        raise ConfigError(f"{kind} must be one of {listed(names(kind))}, got {name!r}")
    return _ours(kind).get(name) or _theirs(kind)[name]


def _package(entry: EntryPoint) -> str:
    return "drakegrasp" if entry.dist is None else entry.dist.name


@cache
def _ours(kind: Kind) -> dict[str, EntryPoint]:
    group = f"drakegrasp.{kind}"
    try:
        project = tomllib.loads(_PROJECT.read_text(encoding="utf-8"))["project"]
        if project["name"] == "drakegrasp":
            entries = project["entry-points"][group].items()
            return {name: EntryPoint(name, value, group) for name, value in entries}
    except (OSError, KeyError, ValueError):
        pass
    # Installed, and no checkout.
    found = metadata.distribution("drakegrasp").entry_points.select(group=group)
    return {entry.name: entry for entry in found}


@cache
def _theirs(kind: Kind) -> dict[str, EntryPoint]:
    entries = metadata.entry_points(group=f"drakegrasp.{kind}")
    # The metadata of a checkout is as old as its installation.
    return {entry.name: entry for entry in entries if _package(entry) != "drakegrasp"}


# User-defined classes


def read_class(setting: str) -> tuple[str, str]:
    """Return the name that a configuration stores for `path/file.py:Name`, and the file's text.

    Raises:
        ConfigError: If the file cannot be read, or has no class of that name.
    """
    path_text, _, name = setting.rpartition(":")
    path = Path(path_text)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(
            f"{path}: must be a readable UTF-8 file, got: {one_line(error)}"
        ) from None
    stored = f"{path.name}:{name}@{hashlib.sha256(text.encode()).hexdigest()[:16]}"
    _import(stored, text)
    return stored, text


def own_class(
    stored: str,
    code: Mapping[str, str],
    *,
    key: str,
    arguments: Sequence[str] = (),
    method: str,
    takes: Sequence[str] = (),
) -> type[Any]:
    """Return a user-defined class.

    Args:
        stored: Name of the class in a configuration.
        code: Texts of the files by such names; empty for a configuration from a dataset.
        key: The setting that names the class.
        arguments: Arguments of its constructor, by position.
        method: Name of a method that its instances must have.
        takes: Arguments of the method, by position.

    Raises:
        ConfigError: If the text is missing or cannot be imported, or the class has another
            signature.
    """
    if stored not in code:
        raise ConfigError(
            f"{stored}: must be given again, --set {key}=FILE.py:NAME, because code of a dataset "
            "is never imported, got its name alone"
        )
    found = _import(stored, code[stored])
    name = stored.partition("@")[0]
    if not accepts(found, arguments):
        raise ConfigError(f"{name}: must take ({', '.join(arguments)}), got other arguments")
    if not accepts(getattr(found, method, None), ("self", *takes)):
        listed = ", ".join(("self", *takes))
        raise ConfigError(f"{name}: must have a method {method}({listed}), got none like it")
    return found


def run_own(stored: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """Call user-defined code, or code of another package.

    Args:
        stored: Name of the code in a configuration.
        function: The function to call.
        arguments: Arguments by position.

    Raises:
        ConfigError: If the code raises an error, with the line of the user's file.
    """
    try:
        return function(*arguments)
    except Exception as error:
        place = stored.partition("@")[0]
        got = _described(error, place.partition(":")[0])
        raise ConfigError(f"{place}: must run, got {got}") from error


def accepts(function: object, arguments: Sequence[str]) -> bool:
    """Return whether something can be called with these arguments by position."""
    try:
        inspect.signature(function).bind(*arguments)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        return False
    return True


def _import(stored: str, text: str) -> type[Any]:
    """Return the class of a stored name."""
    place, _, digest = stored.partition("@")
    file, _, name = place.partition(":")
    found = getattr(_module(file, digest, text), name, None)
    if not isinstance(found, type):
        raise ConfigError(f"{file}: must have a class {name}, got none")
    return found


@lru_cache(maxsize=_KEPT_FILES)
def _module(file: str, digest: str, text: str) -> ModuleType:
    """Return the module of a file's text."""
    # Data classes look for the module of their field types among the loaded modules.
    module = ModuleType(f"drakegrasp_user_{digest}")
    module.__file__ = file
    sys.modules[module.__name__] = module
    try:
        exec(compile(text, file, "exec"), vars(module))
    except (Exception, SystemExit) as error:
        del sys.modules[module.__name__]
        raise ConfigError(f"{file}: must be imported, got {_described(error, file)}") from error
    return module


def _described(error: BaseException, file: str) -> str:
    """Return an error with the line of the user's file in which it was raised."""
    lines = [f.lineno for f in traceback.extract_tb(error.__traceback__) if f.filename == file]
    where = f" in line {lines[-1]}" if lines else ""
    return f"{type(error).__name__}{where} ({one_line(error)})"
