"""Options that several commands share, each told once in a table, and those of a build.

In: what click parsed. Out: a `BuildRequest`, with the configuration resolved.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import click

from drakegrasp import registry
from drakegrasp.cli.console import Option
from drakegrasp.errors import first_line
from drakegrasp.generation.request import BUILTIN, BuildRequest

F = TypeVar("F", bound=Callable[..., Any])


class PathType(click.Path):
    """A path that a file can have."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Refuse an empty path, e.g. of an unset shell variable, and impossible names."""
        text = os.fspath(value)
        if not text.strip():
            self.fail(f"must be a path, got {text!r}", param, ctx)
        try:
            os.lstat(text)
        except (FileNotFoundError, NotADirectoryError, PermissionError):
            pass
        except (OSError, ValueError) as error:
            self.fail(f"must be a path, got one that no file has ({first_line(error)})", param, ctx)
        return super().convert(value, param, ctx)


class Named(click.Choice[str]):
    """A name of the registry; it is asked when the option is used, or its help is printed."""

    def __init__(self, kind: registry.Kind) -> None:
        self.kind, self.case_sensitive = kind, True

    @property
    def choices(self) -> tuple[str, ...]:  # type: ignore[override]
        """The names."""
        return registry.names(self.kind)


#: Types of options: any path, a file to write, a file that is there.
PATH = PathType(path_type=Path)
NEW_FILE = PathType(path_type=Path, dir_okay=False)
FILE = PathType(path_type=Path, exists=True, dir_okay=False)


def _set_text(what: str, example: str) -> str:
    """Return the help of a `--set`, with a value that its command takes."""
    return f"Change {what}, e.g. {example}; may be given several times."


#: The options that more than one command has: metavar, help, and what else click shall know.
_TABLE: dict[str, tuple[str | None, str, dict[str, Any]]] = {
    # What is built.
    "--objects": (
        "MESH_DIR|builtin",
        "A directory of .obj, .stl, .ply or .glb files, or the built-in objects.",
        {"required": True},
    ),
    "--per-class": ("N", "Built-in objects of each class.  [default: 2]", {"type": int}),
    "--objects-seed": (
        "S",
        "Seed of the sizes of the built-in objects.  [default: 0]",
        {"type": int},
    ),
    "--units": ("m|cm|mm", "Unit of length of the meshes.", {"default": "m", "show_default": True}),
    "--manifest": (
        "FILE",
        "YAML file with units and classes by mesh.  [default: objects.yaml beside the meshes]",
        {"type": PATH},
    ),
    "--postures": (
        "FILE|DIR",
        "Try these postures (wrist and joints) instead of drawn palm poses, on the objects that "
        "they name: .npz, .hdf5, .csv, .parquet, DexGraspBench .npy or isaac_grasp .yaml.",
        {"type": PathType(path_type=Path, exists=True)},
    ),
    "--only": ("NAME", "Build this object only; may be given several times.", {"multiple": True}),
    "--out": (
        "DIR",
        "Directory of the dataset. The same command continues an interrupted build.",
        {"type": PATH, "required": True},
    ),
    # By which rules.
    "--config": (
        "YAML|PRESET",
        "Configuration: a file, or the preset paper, fast, randomized or released.  [default: "
        "paper, but with split.by=auto]",
        {},
    ),
    "--set": ("KEY=VALUE", _set_text("one setting", "lift.hold_time=1"), {"multiple": True}),
    "--candidates": ("N", "Palm poses per object.  [default: 10000]", {"type": int}),
    "--max-grasps": ("N", "Stop an object after N successes.  [default: no limit]", {"type": int}),
    "--samples": (
        "N",
        "Stop when there are N samples, which the objects share in turns; a larger N goes on from "
        "there.  [default: no limit]",
        {"type": int},
    ),
    "--samples-per-object": (
        "N",
        "Stop an object when it has N samples.  [default: no limit]",
        {"type": int},
    ),
    "--certify": (
        "K",
        "Repeat each sample K times, disturbed, and store how many hold.  [default: 0]",
        {"type": int},
    ),
    "--seed": ("S", "Seed of all random draws.  [default: 0]", {"type": int}),
    # Who does the work.
    "--workers": ("N", "Processes on this machine.  [default: one per core]", {"type": int}),
    "--scheduler": ("ADDRESS", "Use the running Dask scheduler at this address.", {}),
    "--scheduler-file": (
        "FILE",
        "Use the running Dask scheduler that wrote this file.",
        {"type": PATH},
    ),
    "--tls-ca-file": (
        "FILE",
        "Your own certificate authority (PEM), as a running scheduler needs it; with the next two "
        "options.",
        {"type": FILE},
    ),
    "--tls-cert": (
        "FILE",
        "Certificate of client, scheduler and workers, signed by that authority.",
        {"type": FILE},
    ),
    "--tls-key": ("FILE", "The certificate's private key.", {"type": FILE}),
    "--tls/--no-tls": (
        None,
        "Whether connections need a certificate. Workers that the command starts get one that is "
        "made for the run.",
        {"default": True, "show_default": True},
    ),
    # What is said.
    "--times": (
        "FILE",
        "Estimate from these times, which measure_stages.py of pipelines/measurements printed.  "
        "[default: OUT/log.jsonl, else times measured on other meshes]",
        {"type": FILE},
    ),
    "--quiet": (None, "Show no progress.", {"is_flag": True}),
    "--json": (None, "Print one document of JSON, and nothing else.", {"is_flag": True}),
}
#: Words of options whose parameters have other names.
_PARAMETERS = {"--set": "--set overrides", "--json": "--json as_json"}
#: The options of the table that stand for `--set KEY=VALUE`, and their keys.
SETTINGS = {
    "--per-class": "builtin.per_class",
    "--objects-seed": "builtin.seed",
    "--candidates": "candidates.max",
    "--max-grasps": "max_grasps",
    "--samples": "samples",
    "--samples-per-object": "samples_per_object",
    "--certify": "certify.repeats",
    "--seed": "seed",
}
#: Groups of options: of a build, of the certificates, and of who does the work.
BUILD = (
    *("--objects", "--per-class", "--objects-seed", "--out", "--config", "--set", "--candidates"),
    *("--max-grasps", "--samples", "--samples-per-object", "--postures", "--only", "--certify"),
    *("--seed", "--units", "--manifest", "--quiet"),
)
_TLS_FILES = ("--tls-ca-file", "--tls-cert", "--tls-key")
TLS = ("--tls/--no-tls", *_TLS_FILES)
CONNECTION = ("--workers", "--scheduler", "--scheduler-file", *TLS)
#: Help of a `--set` for some settings alone.
SET_ASSEMBLED = (
    f"{_set_text('a setting of the filters or the split', 'filters.outlier_sigma=3')} Filters of "
    "your own must be given again: filters.own=FILE.py:NAME."
)
SET_SCENES = _set_text("a key of `scenes`", "scenes.views=8")


def option(words: str, metavar: str | None, text: str, **attributes: Any) -> Callable[[F], F]:
    """Give a command an option.

    Args:
        words: Its name, and after a blank the name of its parameter if that differs.
        metavar: What stands for the value in the help.
        text: Its help.
        attributes: What else click shall know.
    """
    return click.option(*words.split(), cls=Option, metavar=metavar, help=text, **attributes)


def shared(*names: str, **changes: Any) -> Callable[[F], F]:
    """Give a command options of the table, which its help lists in this order.

    Args:
        names: Of the options; their parameters have the same names but for `_PARAMETERS`.
        changes: What click shall know of them otherwise than the table says.
    """

    def give(command: F) -> F:
        for name in reversed(names):
            metavar, text, attributes = _TABLE[name]
            heading = {"heading": "Cluster options"} if name in CONNECTION[1:] else {}
            row = {"metavar": metavar, "text": text, **attributes, **heading, **changes}
            command = option(_PARAMETERS.get(name, name), **row)(command)
        return command

    return give


def _tidied(context: click.Context, parameter: click.Parameter, out: Path) -> Path:
    """Put in order what a dead process left in a dataset, before a command looks at it."""
    from drakegrasp.dataset.lock import tidy

    if not context.resilient_parsing and out.is_dir():
        tidy(out)
    return out


def dataset_argument(name: str = "out", metavar: str = "OUT") -> Callable[[F], F]:
    """Give a command the directory of a dataset, or one of its files."""
    return click.argument(name, type=PATH, metavar=metavar, callback=_tidied)


def chosen_workers(options: dict[str, Any]) -> dict[str, Any]:
    """Take the values of `CONNECTION` out of a command's options: arguments of `connect`."""
    names = map(_parameter, CONNECTION[:3])
    return {**{name: options.pop(name) for name in names}, **chosen_tls(options)}


def chosen_tls(options: dict[str, Any]) -> dict[str, Any]:
    """Take the values of `TLS` out of a command's options.

    Returns:
        `tls`, and `tls_files`: the authority, the certificate and its key, or None.

    Raises:
        click.UsageError: If only some are given.
    """
    files = tuple(options.pop(_parameter(name)) for name in _TLS_FILES)
    if None in files and any(files):
        raise click.UsageError(
            f"{', '.join(_TLS_FILES[:-1])} and {_TLS_FILES[-1]} must be given together"
        )
    return {"tls": options.pop("tls"), "tls_files": files if any(files) else None}


def parse_request(options: Mapping[str, Any]) -> BuildRequest:
    """Return what the options of `BUILD` ask for, given their values by parameter.

    Raises:
        click.UsageError: If options of the built-in objects are given with other meshes.
        ConfigError: If a value of the configuration cannot be used.
        HandError: If the hand's file cannot be read.
    """
    # Loading pydantic takes a while, and `--help` must answer at once.
    from drakegrasp.hand.settings import load_config

    return BuildRequest(
        objects=options["objects"],
        out=options["out"].absolute(),
        config=load_config(options["config"], chosen_settings(options)),
        units=options["units"],
        manifest=options["manifest"],
        only=options["only"],
        postures=options["postures"],
        show=not options["quiet"],
    )


def chosen_settings(options: Mapping[str, Any]) -> list[str]:
    """Return the changes of the configuration that a command's options ask for, as `KEY=VALUE`.

    Args:
        options: Values by parameter: of `--set` and the options of `SETTINGS`, as far as the
            command has them, and of `--objects`.

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


def _parameter(name: str) -> str:
    """Return the name of the parameter that click makes of an option's name."""
    return name.removeprefix("--").replace("-", "_")
