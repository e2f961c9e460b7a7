"""The options of a build on a command line, shared by `drakegrasp build` and the scripts.

In: what click parsed. Out: a `BuildRequest`, with the configuration resolved.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import click

from drakegrasp.build.request import BuildRequest

F = TypeVar("F", bound=Callable[..., Any])


units_option = click.option(
    "--units", default="m", show_default=True, help="Unit of length of the meshes: m, cm or mm."
)
manifest_option = click.option(
    "--manifest",
    type=click.Path(path_type=Path),
    help="YAML file with units and classes by mesh.  [default: objects.yaml beside the meshes]",
)
set_option = click.option(
    "--set",
    "overrides",
    multiple=True,
    metavar="KEY=VALUE",
    help="Set one value, e.g. lift.hold_time=1.",
)
times_option = click.option(
    "--times",
    type=click.Path(path_type=Path, exists=True, dir_okay=False),
    help="What pipelines/measurements/measure_stages.py printed, to plan by.  [OUT/log.jsonl, or "
    "measured on other meshes]",
)

_OPTIONS = (
    click.option(
        "--objects",
        required=True,
        metavar="MESH_DIR|builtin",
        help="Directory of .obj, .stl, .ply or .glb files, or the built-in objects.",
    ),
    click.option(
        "--out",
        required=True,
        type=click.Path(path_type=Path),
        help="Directory of the dataset; the same command goes on with what is there.",
    ),
    click.option(
        "--config",
        metavar="YAML|PRESET",
        help="Configuration: a file, or paper or released.  [paper]",
    ),
    set_option,
    click.option("--candidates", type=int, help="Palm poses per object.  [10000]"),
    click.option("--max-grasps", type=int, help="Grasps per object after which no more are tried."),
    click.option(
        "--certify",
        type=click.IntRange(min=0),
        metavar="K",
        help="Repeat each success K times with noise, to store how robust it is.  [0]",
    ),
    click.option("--seed", type=int, help="Of all random draws.  [0]"),
    units_option,
    manifest_option,
    click.option("--quiet", is_flag=True, help="Show no progress."),
)


out_argument = click.argument("out", type=click.Path(path_type=Path), metavar="OUT")
workers_option = click.option(
    "--workers", type=int, help="Processes on this machine.  [one per core]"
)
scheduler_option = click.option(
    "--scheduler", metavar="ADDRESS", help="A running Dask scheduler to use instead."
)
scheduler_file_option = click.option(
    "--scheduler-file",
    type=click.Path(path_type=Path),
    help="Its JSON file, instead of the address.",
)


def build_options(command: F) -> F:
    """Give a command the options of a build; it passes them on to `parse_request`."""
    for option in reversed(_OPTIONS):
        command = option(command)
    return command


def parse_request(
    *,
    objects: str,
    out: Path,
    config: str | None,
    overrides: Sequence[str],
    candidates: int | None,
    max_grasps: int | None,
    certify: int | None,
    seed: int | None,
    units: str,
    manifest: Path | None,
    quiet: bool,
) -> BuildRequest:
    """Return what the options of `build_options` ask for.

    Raises:
        ConfigError: If a value of the configuration cannot be used.
    """
    # Pydantic takes a while to load, and `--help` answers at once.
    from drakegrasp.config import load_config

    chosen = list(overrides)
    if candidates is not None:
        chosen.append(f"candidates.max={candidates}")
    if certify is not None:
        chosen.append(f"certify.repeats={certify}")
    return BuildRequest(
        objects=objects,
        out=out.absolute(),
        config=load_config(config, chosen, seed=seed, max_grasps=max_grasps),
        units=units,
        manifest=manifest,
        show=not quiet,
    )
