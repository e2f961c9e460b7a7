"""Measure how much memory one worker uses while it tries attempts on many objects.

\b
    python pipelines/measurements/speed.py worker MESH_DIR [--only NAME ...]
        [--trials N] [--set KEY=VALUE]

The script builds a dataset with one worker process and reads its memory after every work unit,
until the given number of trials (attempts whose palm ray meets the object) is done. It mixes the
units of the objects, so that the worker constantly builds and drops scenes. It prints JSON.
"""  # noqa: D301  (click keeps the lines of a paragraph that begins with this character)

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from itertools import zip_longest
from pathlib import Path
from typing import Any, TypeVar

import click
from distributed import Client

from drakegrasp.cli.options import shared
from drakegrasp.cluster.connect import connect
from drakegrasp.cluster.executor import DaskExecutor
from drakegrasp.generation.pipeline import build
from drakegrasp.generation.work_unit import UnitSummary, WorkUnit
from drakegrasp.hand.settings import load_config
from drakegrasp.objects.sources import find_meshes
from drakegrasp.outcomes import Outcome

T = TypeVar("T")
R = TypeVar("R")
NO_TRIAL = (Outcome.RAY_MISS, Outcome.BELOW_TABLE)
#: Number of successive units of one object, before those of the next object.
RUN = 2


class EnoughError(Exception):
    """The requested number of trials is done."""


class Scale:
    """An executor that reads the memory of the only worker after every unit."""

    def __init__(self, client: Client, trials: int) -> None:
        """Work through a client until this many trials are done."""
        self._execute, self._client, self._trials = DaskExecutor(client), client, trials
        self.weights: list[tuple[int, float]] = []

    def __call__(self, function: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
        """Yield the results of the units of all objects in turn."""
        done = 0
        for result in self._execute(function, mixed(items)):
            if isinstance(result, UnitSummary):
                done += sum(n for o, n in result.outcomes.items() if o not in NO_TRIAL)
                self.weights.append((done, self.weigh()))
            yield result
            if done >= self._trials:
                raise EnoughError

    def weigh(self) -> float:
        """Return the memory of the worker [MB]."""
        (worker,) = self._client.scheduler_info(n_workers=-1)["workers"].values()
        return float(worker["metrics"]["memory"]) / 1e6


def mixed(items: Iterable[T]) -> Iterator[T]:
    """Yield work units of all objects in turn, and other items as they come."""
    by_object: dict[str, list[Any]] = {}
    for item in items:
        if isinstance(item, WorkUnit):
            by_object.setdefault(item.header.object_name, []).append(item)
        else:
            yield item
    runs = ([u[k : k + RUN] for k in range(0, len(u), RUN)] for u in by_object.values())
    for round_ in zip_longest(*runs, fillvalue=[]):
        for run in round_:
            yield from run


@click.command(help=__doc__)
@click.argument("meshes", type=click.Path(path_type=Path, exists=True))
@click.option(
    "--only", multiple=True, metavar="NAME", help="Only objects whose names begin with NAME."
)
@click.option("--trials", default=5000, show_default=True)
@click.option("--candidates", default=2000, show_default=True, help="Palm poses per object.")
@shared("--set", "--units", "--manifest")
def main(
    meshes: Path,
    only: tuple[str, ...],
    trials: int,
    candidates: int,
    overrides: tuple[str, ...],
    units: str,
    manifest: Path | None,
) -> None:
    """Run the script."""
    config = load_config(overrides=[f"candidates.max={candidates}", *overrides])
    every = find_meshes(meshes, units=units, manifest=manifest)
    sources = [s for s in every if not only or s.name.startswith(only)]

    # The build only serves the measurement: it ends after enough trials.
    with tempfile.TemporaryDirectory() as folder, connect(1) as client:
        scale = Scale(client, trials)
        with suppress(EnoughError):
            build(sources, Path(folder) / "out", config, scale, show=False)

    # If memory still grew over the second half, that would be a leak.
    done, weights = zip(*scale.weights, strict=True)
    half = next(weight for n, weight in scale.weights if n >= done[-1] / 2)
    late = [weight for n, weight in scale.weights if n >= done[-1] / 2]
    quarter = len(late) // 2
    means = [sum(part) / len(part) for part in (late[:quarter], late[quarter:])]

    figures = {
        "objects": len(sources),
        "trials": done[-1],
        "units": len(done),
        "largest [MB]": round(max(weights), 1),
        "at half, at the end [MB]": [round(half, 1), round(weights[-1], 1)],
        "third and last quarter, means [MB]": [round(mean, 1) for mean in means],
        "growth over the last half, by these": round(means[1] / means[0] - 1.0, 4),
    }
    click.echo(json.dumps(figures, indent=1))
