"""The options of commands, created from signatures and docstrings, and the request of a build.

Input: option values that click parsed. Output: a `BuildRequest` with the resolved configuration.

A command lists its options in the section `Options` of its docstring, in the order of its help:

    --port N: Port on this machine; 0 takes any that is free.
    --json FILE (json_file): Write all findings as JSON as well.
    --units, --manifest

The first option belongs to the parameter `port`, whose annotation and default supply the rest. The
second option belongs to a parameter of another name, `json_file`. The third line names options that
several commands share; they are defined in `_shared`.
"""

from __future__ import annotations

import inspect
import os
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, TypeVar, get_args, get_origin

import click

from drakegrasp import registry
from drakegrasp.errors import first_line
from drakegrasp.foreign_files import ADDRESS
from drakegrasp.generation.request import BUILTIN, BuildRequest

if sys.flags.optimize > 1:
    sys.exit("error: python must run without -OO, which leaves out the docstrings with the options")

F = TypeVar("F", bound=Callable[..., Any])
#: An option in a docstring: its names, the placeholder of its value, its parameter, and its help.
_ENTRY = re.compile(r"(--[^\s:]+(?: --[^\s:]+)*)(?: ([^()]+?))?(?: \((\w+)\))?: (.+)")
_SECTION = "\n\nOptions:\n"


class Option(click.Option):
    """An option that the help lists under a heading, and whose help may name registry entries."""

    heading = "Options"

    def get_help_record(self, ctx: click.Context) -> tuple[str, str] | None:
        """Return the names of the option and its help; called by click."""
        self.help = re.sub(
            r"\{(\w+)\}",
            lambda kind: ", ".join(registry.names(kind[1])),  # type: ignore[arg-type]
            self.help or "",
        )
        return super().get_help_record(ctx)


class PathType(click.Path):
    """A path that a file can have."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Reject an empty path, e.g. from an unset shell variable, and impossible names."""
        text = os.fspath(value)
        if not text.strip():
            self.fail(f"must be a path, got {text!r}", param, ctx)
        # Datasets alone are read at an address; nothing is written there.
        if ADDRESS.match(text) and (param is None or param.name != "dataset"):
            self.fail(f"must be a path of this machine, got the address {text!r}", param, ctx)
        try:
            os.lstat(text)
        except (FileNotFoundError, NotADirectoryError, PermissionError):
            pass
        except (OSError, ValueError) as error:
            self.fail(f"must be a path, got one that no file has ({first_line(error)})", param, ctx)
        return super().convert(value, param, ctx)


class FrameType(click.Choice[str]):
    """The frames of grasps; `workspace` is an earlier name of `table`."""

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        """Return the frame that a word names."""
        return super().convert("table" if value == "workspace" else value, param, ctx)


class Named(click.Choice[str]):
    """A name of the registry, which is read only when the option is used or its help is printed."""

    def __init__(self, kind: registry.Kind) -> None:
        self.kind, self.case_sensitive = kind, True

    @property
    def choices(self) -> tuple[str, ...]:  # type: ignore[override]
        """The names."""
        return registry.names(self.kind)


#: Types of options: any path, a file to write, an existing file, any existing path.
PATH = PathType(path_type=Path)
NEW_FILE = PathType(path_type=Path, dir_okay=False)
FILE = PathType(path_type=Path, exists=True, dir_okay=False)
EXISTING = PathType(path_type=Path, exists=True)
#: The splits of a dataset.
SPLITS = click.Choice(["train", "valid", "test"])


@dataclass(frozen=True, kw_only=True)
class VerifyRequest:
    """The options of `verify`, see the help of the command; None if an option was not given."""

    grasps: Path
    mesh: Path | None = None
    dataset: Path | None = None
    split: Annotated[str | None, SPLITS] = None
    frame: Annotated[str | None, FrameType(["object", "camera", "table", "mesh"])] = None
    camera: Path | None = None
    units: str | None = None
    method: Annotated[str, click.Choice(["hand", "forces"])] = "hand"
    snap_points: bool = False
    hand: str | None = None
    config: str | None = None
    overrides: tuple[str, ...] = ()
    out: Path | None = None
    rows: str | None = None
    link: str | None = None
    preshape: str | None = None


def described(function: F, request: type | None = None) -> F:
    """Give a command the options of its docstring; the rest of the docstring is its help.

    Args:
        function: The command.
        request: Dataclass whose fields are added to the parameters of the command.
    """
    text, _, section = inspect.cleandoc(function.__doc__ or "").partition(_SECTION)
    function.__doc__ = text
    own = (function,) if request is None else (request, function)
    return _with_options(list(_options(section, *own)))(function)


def shared(*names: str) -> Callable[[F], F]:
    """Give a command some of the shared options; its help lists them in this order."""
    return _with_options([_SHARED[name] for name in names])


def _with_options(options: list[Option]) -> Callable[[F], F]:
    def give(function: F) -> F:
        # Click expects them in the order of decorators: the last one first.
        vars(function).setdefault("__click_params__", []).extend(reversed(options))
        return function

    return give


def _options(section: str, *signatures: Callable[..., Any]) -> Iterator[Option]:
    """Yield the options of a section of a docstring; `signatures` have their parameters."""
    parameters = dict[str, inspect.Parameter]()
    for each in signatures:
        parameters |= inspect.signature(each, eval_str=True).parameters
    for entry in re.split(r"\n {4}(?! )", f"\n{section}")[1:]:
        text = " ".join(entry.split()).replace(" [default", "  [default")
        if (match := _ENTRY.fullmatch(text)) is None:
            for name in text.split(", "):
                yield from GROUPS.get(name) or (_SHARED[name],)
            continue
        words, metavar, name, text = match.groups()
        name = name or _parameter(words.split()[0].partition("/")[0])
        attributes = _attributes(parameters[name])
        yield Option([*words.split(), name], metavar=metavar, help=text, **attributes)


def _attributes(parameter: inspect.Parameter) -> dict[str, Any]:
    """Return the attributes of the click option of a parameter."""
    kind, default, attributes = parameter.annotation, parameter.default, dict[str, Any]()
    if get_origin(kind) is Annotated:
        kind, attributes["type"] = get_args(kind)
    if isinstance(kind, UnionType):
        kind = get_args(kind)[0]  # the other one is None
    if get_origin(kind) is tuple:
        kind, attributes["multiple"] = get_args(kind)[0], True
    if kind is bool:
        attributes["is_flag"] = True
    else:
        attributes.setdefault("type", {Path: PATH}.get(kind, kind))
    if default is parameter.empty:
        attributes["required"] = True
    elif not (default is None or default is False or default == ()):
        attributes |= {"default": default, "show_default": True}
    return attributes


def _parameter(name: str) -> str:
    """Return the name of the parameter that click derives from an option's name."""
    return name.removeprefix("--").replace("-", "_")


def _shared(
    *,
    objects: str,
    per_class: int | None = None,
    objects_seed: int | None = None,
    units: str = "m",
    manifest: Path | None = None,
    postures: Annotated[Path | None, EXISTING] = None,
    link: str | None = None,
    preshape: str | None = None,
    only: tuple[str, ...] = (),
    out: Path,
    config: str | None = None,
    overrides: tuple[str, ...] = (),
    candidates: int | None = None,
    max_grasps: int | None = None,
    samples: int | None = None,
    samples_per_object: int | None = None,
    seed: int | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    scheduler_file: Path | None = None,
    tls_ca_file: Annotated[Path | None, FILE] = None,
    tls_cert: Annotated[Path | None, FILE] = None,
    tls_key: Annotated[Path | None, FILE] = None,
    tls: bool = True,
    quiet: bool = False,
    as_json: bool = False,
) -> None:
    """Define the options that more than one command has.

    Options:
        --objects MESH_DIR|builtin: A directory of .obj, .stl, .ply or .glb files, or the built-in
            objects.
        --per-class N: Number of built-in objects of each class. [default: 2]
        --objects-seed S: Seed of the sizes of the built-in objects. [default: 0]
        --units m|cm|mm: Unit of length of the meshes.
        --manifest FILE: YAML file with units and classes by mesh. [default: objects.yaml in the
            directory of the meshes]
        --postures FILE|DIR: Try these postures (wrist and joints) instead of drawn palm poses, on
            the objects that the postures name: .npz, .hdf5, .csv, .parquet, DexGraspBench .npy or
            isaac_grasp .yaml.
        --link NAME: Frame or link of the poses in files of postures, which overrides the files:
            palm, the palm link, or a frame of another tool that the hand file names, e.g. graspgen.
        --preshape NAME: Preshape for rows of postures that name none; the value each, for palm
            poses alone, tries all preshapes in turn.
        --only NAME: Build this object only; may be given several times.
        --out DIR: Directory of the dataset. The same command continues an interrupted build.
        --config YAML|PRESET: Configuration: a file, or the preset paper, fast, randomized or
            released. [default: fast]
        --set KEY=VALUE (overrides): Change one setting, e.g. lift.hold_time=1; may be given several
            times.
        --candidates N: Largest number of palm poses per object. [default: 10000]
        --max-grasps N: Stop an object after N successes. [default: no limit]
        --samples N: Stop when all objects together have N samples; a larger N continues the build.
        --samples-per-object N: Stop an object when it has N samples. [default: 20, with fast and
            without --samples, --max-grasps and --candidates]
        --seed S: Seed of all random draws. [default: 0]
        --workers N: Number of processes on this machine. [default: one per core]
        --scheduler ADDRESS: Use the running Dask scheduler at this address.
        --scheduler-file FILE: Use the running Dask scheduler that wrote this file.
        --tls-ca-file FILE: Your own certificate authority (PEM), if a running scheduler needs one;
            requires the next two options.
        --tls-cert FILE: Certificate of client, scheduler and workers, signed by that authority.
        --tls-key FILE: Private key of the certificate.
        --tls/--no-tls: Whether connections need a certificate. Workers that the command starts get
            a certificate that is created for the run.
        --quiet: Show no progress.
        --json (as_json): Print one document of JSON instead of text.
    """


def _assembled(*, overrides: tuple[str, ...] = ()) -> None:
    """Define the option for settings of filters and split.

    Options:
        --set KEY=VALUE (overrides): Change a setting of the filters or the split, e.g.
            filters.outlier_sigma=3; may be given several times. Your own filters must be given
            again: filters.own=FILE.py:NAME.
    """


def _said(function: Callable[..., Any]) -> tuple[Option, ...]:
    """Return the options that the docstring of a function defines."""
    section = inspect.cleandoc(function.__doc__ or "").partition(_SECTION)[2]
    return tuple(_options(section, function))


#: The options that are short forms of `--set KEY=VALUE`, and their keys.
SETTINGS = {
    "--per-class": "builtin.per_class",
    "--objects-seed": "builtin.seed",
    "--candidates": "candidates.max",
    "--max-grasps": "max_grasps",
    "--samples": "samples",
    "--samples-per-object": "samples_per_object",
    "--seed": "seed",
}
#: Names of options: of a build, and of the workers.
BUILD = (
    *("--objects", "--per-class", "--objects-seed", "--out", "--config", "--set", "--candidates"),
    *("--max-grasps", "--samples", "--samples-per-object", "--postures", "--link", "--preshape"),
    *("--only", "--seed", "--units", "--manifest", "--quiet"),
)
_TLS_FILES = ("--tls-ca-file", "--tls-cert", "--tls-key")
TLS = ("--tls/--no-tls", *_TLS_FILES)
CONNECTION = ("--workers", "--scheduler", "--scheduler-file", *TLS)
_SHARED: dict[str, Option] = {"/".join((*o.opts, *o.secondary_opts)): o for o in _said(_shared)}
for _name in CONNECTION[1:]:
    _SHARED[_name].heading = "Cluster options"
#: Options that a docstring names together.
GROUPS = {
    "BUILD": tuple(map(_SHARED.__getitem__, BUILD)),
    "CONNECTION": tuple(map(_SHARED.__getitem__, CONNECTION)),
    "TLS": tuple(map(_SHARED.__getitem__, TLS)),
    "ASSEMBLED": _said(_assembled),
}


def _tidied(context: click.Context, parameter: click.Parameter, out: Path) -> Path:
    """Clean up what a dead process left in a dataset, before a command reads the dataset."""
    from drakegrasp.dataset.lock import tidy

    if not context.resilient_parsing and out.is_dir():
        tidy(out)
    return out


def dataset_argument(name: str = "out", metavar: str = "OUT") -> Callable[[F], F]:
    """Give a command an argument for the directory of a dataset, or one of its files."""
    return click.argument(name, type=PATH, metavar=metavar, callback=_tidied)


def chosen_workers(options: dict[str, Any]) -> dict[str, Any]:
    """Remove the values of `CONNECTION` from a command's options, and return them for `connect`."""
    names = map(_parameter, CONNECTION[:3])
    return {**{name: options.pop(name) for name in names}, **chosen_tls(options)}


def chosen_tls(options: dict[str, Any]) -> dict[str, Any]:
    """Remove the values of `TLS` from a command's options, and return them.

    Returns:
        `tls`, and `tls_files`: the paths of authority, certificate and key, or None.

    Raises:
        click.UsageError: If only some of the files are given.
    """
    files = tuple(options.pop(_parameter(name)) for name in _TLS_FILES)
    if None in files and any(files):
        raise click.UsageError(
            f"{', '.join(_TLS_FILES[:-1])} and {_TLS_FILES[-1]} must be given together"
        )
    return {"tls": options.pop("tls"), "tls_files": files if any(files) else None}


def parse_request(options: Mapping[str, Any]) -> BuildRequest:
    """Return the request that the options of `BUILD` describe, given their values by parameter.

    Raises:
        click.UsageError: If options of the built-in objects are given with other meshes.
        ConfigError: If a value of the configuration cannot be used.
        HandError: If the hand's file cannot be read.
    """
    # Loading pydantic takes a while, and `--help` must answer immediately.
    from drakegrasp.config import BUILD_PRESET
    from drakegrasp.hand.settings import load_config

    config = BUILD_PRESET if options["config"] is None else options["config"]
    return BuildRequest(
        objects=options["objects"],
        out=options["out"].absolute(),
        config=load_config(config, chosen_settings(options)),
        units=options["units"],
        manifest=options["manifest"],
        only=options["only"],
        postures=options["postures"],
        show=not options["quiet"],
        read_as=chosen_reading(options),
    )


def chosen_reading(options: Mapping[str, Any]) -> dict[str, str]:
    """Return the options that apply to all postures, see `exchange.attempts.read_attempts`."""
    names = ("frame", "link", "preshape")
    return {name: options[name] for name in names if options.get(name) is not None}


def chosen_settings(options: Mapping[str, Any]) -> list[str]:
    """Return the changes of the configuration that a command's options request, as `KEY=VALUE`.

    Args:
        options: Values by parameter: of `--set` and those options of `SETTINGS` that the command
            has, and of `--objects`.

    Raises:
        click.UsageError: If options of the built-in objects are given with a directory of meshes.
    """
    chosen = list(options.get("overrides", ()))
    for name, key in SETTINGS.items():
        value = options.get(_parameter(name))
        if value is None:
            continue
        if key.startswith("builtin.") and options["objects"] != BUILTIN:
            raise click.UsageError(
                f"{name} must be used with --objects builtin, got {options['objects']}"
            )
        chosen.append(f"{key}={value}")
    return chosen
