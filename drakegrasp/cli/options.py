"""Options that several commands share, and those of a build.

In: what click parsed. Out: a `BuildRequest`, with the configuration resolved.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import click

from drakegrasp.build.request import BUILTIN, BuildRequest
from drakegrasp.errors import first_line

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


#: Which built-in objects there are, for every command that takes them.
per_class_option = click.option(
    "--per-class",
    type=click.IntRange(min=1),
    metavar="N",
    help="Built-in objects of each class.  [default: 2]",
)
objects_seed_option = click.option(
    "--objects-seed",
    type=click.IntRange(min=0),
    metavar="S",
    help="Seed of the sizes of the built-in objects.  [default: 0]",
)
units_option = click.option(
    "--units",
    default="m",
    show_default=True,
    metavar="m|cm|mm",
    help="Unit of length of the meshes.",
)
manifest_option = click.option(
    "--manifest",
    type=PathType(path_type=Path),
    metavar="FILE",
    help="YAML file with units and classes by mesh.  [default: objects.yaml beside the meshes]",
)
set_option = click.option(
    "--set",
    "overrides",
    multiple=True,
    metavar="KEY=VALUE",
    help="Change one setting, e.g. lift.hold_time=1; may be given several times.",
)
times_option = click.option(
    "--times",
    type=PathType(path_type=Path, exists=True, dir_okay=False),
    metavar="FILE",
    help="Estimate from these times, which measure_stages.py of pipelines/measurements printed.  "
    "[default: OUT/log.jsonl, else times measured on other meshes]",
)

_OPTIONS = (
    click.option(
        "--objects",
        required=True,
        metavar="MESH_DIR|builtin",
        help="A directory of .obj, .stl, .ply or .glb files, or the built-in objects.",
    ),
    per_class_option,
    objects_seed_option,
    click.option(
        "--out",
        required=True,
        type=PathType(path_type=Path),
        metavar="DIR",
        help="Directory of the dataset. The same command continues an interrupted build.",
    ),
    click.option(
        "--config",
        metavar="YAML|PRESET",
        help="Configuration: a file, or the preset paper, fast, randomized or released.  [default: "
        "paper, but with split.by=auto]",
    ),
    set_option,
    click.option(
        "--candidates", type=int, metavar="N", help="Palm poses per object.  [default: 10000]"
    ),
    click.option(
        "--max-grasps",
        type=int,
        metavar="N",
        help="Stop an object after N successes.  [default: no limit]",
    ),
    click.option(
        "--samples",
        type=int,
        metavar="N",
        help="Stop when there are N samples, which the objects share in turns; a larger N goes on "
        "from there.  [default: no limit]",
    ),
    click.option(
        "--samples-per-object",
        type=int,
        metavar="N",
        help="Stop an object when it has N samples.  [default: no limit]",
    ),
    click.option(
        "--only",
        multiple=True,
        metavar="NAME",
        help="Build this object only; may be given several times.",
    ),
    click.option(
        "--certify",
        type=click.IntRange(min=0),
        metavar="K",
        help="Repeat each success K times with noise and store how robust it is.",
        show_default="0",
    ),
    click.option("--seed", type=int, metavar="S", help="Seed of all random draws.  [default: 0]"),
    units_option,
    manifest_option,
    click.option("--quiet", is_flag=True, help="Show no progress."),
)


def tidied(context: click.Context, parameter: click.Parameter, out: Path) -> Path:
    """Put in order what a dead process left in a dataset, before a command looks at it."""
    from drakegrasp.dataset.lock import tidy

    if not context.resilient_parsing and out.is_dir():
        tidy(out)
    return out


out_argument = click.argument("out", type=PathType(path_type=Path), metavar="OUT", callback=tidied)
workers_option = click.option(
    "--workers",
    type=int,
    metavar="N",
    help="Processes on this machine.  [default: one per core]",
)


processes_option = click.option(
    "--workers",
    type=click.IntRange(1, 1024),
    default=1,
    show_default=True,
    metavar="N",
    help="Processes on this machine; the result is the same.",
)


def _address(context: click.Context, parameter: click.Parameter, text: str | None) -> str | None:
    """Refuse an empty address, as of a variable that is not set."""
    if text is not None and not text.strip():
        raise click.UsageError(f"--scheduler must be an address like tcp://host:8786, got {text!r}")
    return text


scheduler_option = click.option(
    "--scheduler",
    metavar="ADDRESS",
    callback=_address,
    help="Use the running Dask scheduler at this address.",
)
scheduler_file_option = click.option(
    "--scheduler-file",
    type=PathType(path_type=Path),
    metavar="FILE",
    help="Use the running Dask scheduler that wrote this file.",
)
_TLS_OPTIONS = (
    click.option(
        "--tls-ca-file",
        type=PathType(path_type=Path, exists=True, dir_okay=False),
        metavar="FILE",
        help="Encrypt, with your own certificate authority (PEM); needs the next two options.",
    ),
    click.option(
        "--tls-cert",
        type=PathType(path_type=Path, exists=True, dir_okay=False),
        metavar="FILE",
        help="Certificate of client, scheduler and workers, signed by that authority.",
    ),
    click.option(
        "--tls-key",
        type=PathType(path_type=Path, exists=True, dir_okay=False),
        metavar="FILE",
        help="The certificate's private key.",
    ),
)


def tls_options(command: F) -> F:
    """Give a command the files of TLS; it passes them on to `tls_files`."""
    for option in reversed(_TLS_OPTIONS):
        command = option(command)
    return command


def tls_files(*paths: Path | None) -> tuple[Path, Path, Path] | None:
    """Return the authority, the certificate and its key, or None if none of them is given.

    Raises:
        click.UsageError: If only some are given.
    """
    match paths:
        case (None, None, None):
            return None
        case (Path() as ca, Path() as cert, Path() as key):
            return ca, cert, key
    raise click.UsageError("--tls-ca-file, --tls-cert and --tls-key must be given together")


def build_options(command: F) -> F:
    """Give a command the options of a build; it passes them on to `parse_request`."""
    for option in reversed(_OPTIONS):
        command = option(command)
    return command


def parse_request(
    *,
    objects: str,
    per_class: int | None,
    objects_seed: int | None,
    out: Path,
    config: str | None,
    overrides: Sequence[str],
    candidates: int | None,
    max_grasps: int | None,
    samples: int | None,
    samples_per_object: int | None,
    only: tuple[str, ...],
    certify: int | None,
    seed: int | None,
    units: str,
    manifest: Path | None,
    quiet: bool,
) -> BuildRequest:
    """Return what the options of `build_options` ask for.

    Raises:
        click.UsageError: If options of the built-in objects are given with other meshes.
        ConfigError: If a value of the configuration cannot be used.
        HandError: If the hand's file cannot be read.
    """
    # Loading pydantic takes a while, and `--help` must answer at once.
    from drakegrasp.hand.settings import load_config

    chosen = [*overrides, *builtin_overrides(objects, per_class, objects_seed)]
    if candidates is not None:
        chosen.append(f"candidates.max={candidates}")
    if certify is not None:
        chosen.append(f"certify.repeats={certify}")
    stops = {
        "max_grasps": max_grasps,
        "samples": samples,
        "samples_per_object": samples_per_object,
    }
    return BuildRequest(
        objects=objects,
        out=out.absolute(),
        config=load_config(config, chosen, seed=seed, **stops),
        units=units,
        manifest=manifest,
        only=only,
        show=not quiet,
    )


def builtin_overrides(objects: str, per_class: int | None, seed: int | None) -> list[str]:
    """Return what the options of the built-in objects change in the configuration.

    Args:
        objects: A directory of meshes, or "builtin".
        per_class: Objects of each class; the configuration's if None.
        seed: Seed of their sizes; the configuration's if None.

    Raises:
        click.UsageError: If they are given with a directory of meshes.
    """
    values = {"per-class": per_class, "objects-seed": seed}
    given = [f"--{name}" for name, value in values.items() if value is not None]
    if given and objects != BUILTIN:
        raise click.UsageError(f"{given[0]} must be used with --objects builtin, got {objects}")
    keys = {"builtin.per_class": per_class, "builtin.seed": seed}
    return [f"{key}={value}" for key, value in keys.items() if value is not None]
