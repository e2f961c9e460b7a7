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
from drakegrasp.cli.help import Option
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


def _row(metavar: str | None, text: str, **attributes: Any) -> dict[str, Any]:
    """Return a row of the table: what click calls metavar and help, and its other attributes."""
    return {"metavar": metavar, "help": text, **attributes}


def _set_text(what: str, example: str) -> str:
    """Return the help of a `--set`, with a value that its command takes."""
    return f"Change {what}, e.g. {example}; may be given several times."


#: The options that more than one command has.
_TABLE = {
    # What is built.
    "--objects": _row(
        "MESH_DIR|builtin",
        "A directory of .obj, .stl, .ply or .glb files, or the built-in objects.",
        required=True,
    ),
    "--per-class": _row("N", "Built-in objects of each class.  [default: 2]", type=int),
    "--objects-seed": _row(
        "S", "Seed of the sizes of the built-in objects.  [default: 0]", type=int
    ),
    "--units": _row("m|cm|mm", "Unit of length of the meshes.", default="m", show_default=True),
    "--manifest": _row(
        "FILE",
        "YAML file with units and classes by mesh.  [default: objects.yaml beside the meshes]",
        type=PATH,
    ),
    "--postures": _row(
        "FILE|DIR",
        "Try these postures (wrist and joints) instead of drawn palm poses, on the objects that "
        "they name: .npz, .hdf5, .csv, .parquet, DexGraspBench .npy or isaac_grasp .yaml.",
        type=PathType(path_type=Path, exists=True),
    ),
    "--only": _row("NAME", "Build this object only; may be given several times.", multiple=True),
    "--out": _row(
        "DIR",
        "Directory of the dataset. The same command continues an interrupted build.",
        type=PATH,
        required=True,
    ),
    # By which rules.
    "--config": _row(
        "YAML|PRESET",
        "Configuration: a file, or the preset paper, fast, randomized or released.  [default: "
        "paper, but with split.by=auto]",
    ),
    "--set": _row("KEY=VALUE", _set_text("one setting", "lift.hold_time=1"), multiple=True),
    "--candidates": _row("N", "Palm poses per object.  [default: 10000]", type=int),
    "--max-grasps": _row("N", "Stop an object after N successes.  [default: no limit]", type=int),
    "--samples": _row(
        "N",
        "Stop when there are N samples, which the objects share in turns; a larger N goes on from "
        "there.  [default: no limit]",
        type=int,
    ),
    "--samples-per-object": _row(
        "N", "Stop an object when it has N samples.  [default: no limit]", type=int
    ),
    "--certify": _row(
        "K",
        "Repeat each sample K times, disturbed, and store how many hold.  [default: 0]",
        type=int,
    ),
    "--seed": _row("S", "Seed of all random draws.  [default: 0]", type=int),
    # Who does the work.
    "--workers": _row("N", "Processes on this machine.  [default: one per core]", type=int),
    "--scheduler": _row("ADDRESS", "Use the running Dask scheduler at this address."),
    "--scheduler-file": _row(
        "FILE", "Use the running Dask scheduler that wrote this file.", type=PATH
    ),
    "--tls-ca-file": _row(
        "FILE",
        "Your own certificate authority (PEM), as a running scheduler needs it; with the next two "
        "options.",
        type=FILE,
    ),
    "--tls-cert": _row(
        "FILE",
        "Certificate of client, scheduler and workers, signed by that authority.",
        type=FILE,
    ),
    "--tls-key": _row("FILE", "The certificate's private key.", type=FILE),
    "--tls/--no-tls": _row(
        None,
        "Whether connections need a certificate. Workers that the command starts get one that is "
        "made for the run.",
        default=True,
        show_default=True,
    ),
    # What is said.
    "--times": _row(
        "FILE",
        "Estimate from these times, which measure_stages.py of pipelines/measurements printed.  "
        "[default: OUT/log.jsonl, else times measured on other meshes]",
        type=FILE,
    ),
    "--quiet": _row(None, "Show no progress.", is_flag=True),
    "--json": _row(None, "Print one document of JSON, and nothing else.", is_flag=True),
}
#: Options whose parameters have other names.
_PARAMETERS = {"--set": "overrides", "--json": "as_json"}
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
_BUILD = (
    *("--objects", "--per-class", "--objects-seed", "--out", "--config", "--set", "--candidates"),
    *("--max-grasps", "--samples", "--samples-per-object", "--postures", "--only", "--certify"),
    *("--seed", "--units", "--manifest", "--quiet"),
)
_TLS_FILES = ("--tls-ca-file", "--tls-cert", "--tls-key")
_TLS = ("--tls/--no-tls", *_TLS_FILES)
#: Options that the help lists behind all others.
_CLUSTER = ("--scheduler", "--scheduler-file", *_TLS)
_CONNECTION = ("--workers", "--scheduler", "--scheduler-file")


def shared(*names: str, **changes: Any) -> Callable[[F], F]:
    """Give a command options of the table, which its help lists in this order.

    Args:
        names: Of the options; their parameters have the same names but for `_PARAMETERS`.
        changes: What click shall know of them otherwise than the table says.
    """

    def give(command: F) -> F:
        for name in reversed(names):
            words = (name, _PARAMETERS[name]) if name in _PARAMETERS else (name,)
            heading = {"heading": "Cluster options"} if name in _CLUSTER else {}
            row = _TABLE[name] | heading | changes
            command = click.option(*words, cls=Option, **row)(command)
        return command

    return give


def build_options(command: F) -> F:
    """Give a command the options of a build; it passes them on to `parse_request`."""
    return shared(*_BUILD)(command)


def postprocessing_options(command: F) -> F:
    """Give a command the `--set` of what is decided after the simulation."""
    text = _set_text("a setting of the filters or the split", "filters.outlier_sigma=3")
    again = "Filters of your own must be given again: filters.own=FILE.py:NAME."
    return shared("--set", help=f"{text} {again}")(command)


def scenes_options(command: F) -> F:
    """Give a command the `--set` of the scenes."""
    return shared("--set", help=_set_text("a key of `scenes`", "scenes.views=8"))(command)


def tls_options(command: F) -> F:
    """Give a command the options of TLS; it passes them on to `chosen_tls`."""
    return shared(*_TLS)(command)


def connection_options(command: F) -> F:
    """Give a command the options of who does the work; it passes them on to `chosen_workers`."""
    return shared(*_CONNECTION, *_TLS)(command)


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
    """Take the values of `connection_options` out of a command's options, for a public call."""
    return {
        **{_parameter(name): options.pop(_parameter(name)) for name in _CONNECTION},
        **chosen_tls(options),
    }


def chosen_tls(options: dict[str, Any]) -> dict[str, Any]:
    """Take the values of `tls_options` out of a command's options.

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
    """Return what the options of `build_options` ask for, given their values by parameter.

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
