"""Measure the overhead of a build, and the gain of a second worker.

\b
    python pipelines/measurements/speed.py build [--objects MESH_DIR] [--candidates N]
        [--set KEY=VALUE]

The script builds the same dataset with one worker and with two, and reads the logs. With one
worker, all time that is not spent on scenes, attempts or images is overhead: scheduling, shards,
the log, and waiting. The script also measures how long it takes to check all shards when the same
build is requested again. Two busy cores of one machine are slower than one. To show what the cores
can achieve, two builds of half the objects each run at the same time, with one worker each. The
script prints JSON. It needs two idle cores.
"""  # noqa: D301  (click keeps the lines of a paragraph that begins with this character)

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from datetime import datetime
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import click

from drakegrasp.api.building import build_dataset
from drakegrasp.cli.options import shared
from drakegrasp.config import Config
from drakegrasp.dataset.lock import LOG_FILE
from drakegrasp.hand.settings import load_config
from drakegrasp.objects.sources import find_meshes
from drakegrasp.shapes.catalog import export_builtin

#: Stages of a work unit that a plain loop without files would also have.
WORK = ("build", "try", "look")
#: The built-in objects that are used by default.
OBJECTS = (
    "1_mug_1",
    "2_bottle_1",
    "4_wineglass_1",
    "5_box_1",
    "16_spray_bottle_1",
    "20_apple_1",
)


def work_seconds(events: Iterable[dict[str, Any]]) -> float:
    """Return the seconds of work that a log reports."""
    done = (event for event in events if event["event"] == "unit done")
    return float(sum(event["seconds"][stage] for event in done for stage in WORK))


def independent_builds(objects: str | Path, units: str, config: Config) -> list[float]:
    """Return the seconds of two simultaneous builds with one worker, of every other object each."""
    names = [source.name for source in find_meshes(objects, units=units)]
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        halves = [pool.submit(seconds, objects, units, config, 1, names[i::2]) for i in (0, 1)]
        return [half.result() for half in halves]


def seconds(
    objects: str | Path, units: str, config: Config, workers: int, only: Sequence[str] = ()
) -> float:
    """Return the seconds of a whole build, including the start of its workers."""
    with tempfile.TemporaryDirectory() as folder:
        begin = time.monotonic()
        build_dataset(
            objects,
            Path(folder) / "out",
            config=config,
            units=units,
            only=only,
            workers=workers,
            show=False,
        )
        return time.monotonic() - begin


def measure(objects: str | Path, units: str, config: Config, workers: int) -> dict[str, float]:
    """Return the wall-clock seconds of the parts of a build."""
    # Build, and request the same build again.
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out"
        build_dataset(objects, out, config=config, units=units, workers=workers, show=False)
        begin = time.monotonic()
        report = build_dataset(
            objects, out, config=config, units=units, workers=workers, show=False
        )
        again = time.monotonic() - begin
        events = [json.loads(line) for line in (out / LOG_FILE).read_text().splitlines()]
    assert report.simulated == 0

    # The log of the first build ends with `finished`.
    first = events[: 1 + next(i for i, e in enumerate(events) if e["event"] == "finished")]
    done = [event for event in first if event["event"] == "unit done"]
    started, prepared, simulated, finished = (
        datetime.fromisoformat(event["time"]).timestamp()
        for event in (
            next(e for e in first if e["event"] == "started"),
            [e for e in first if e["event"].startswith("mesh ")][-1],
            done[-1],
            first[-1],
        )
    )

    return {
        "units": len(done),
        "attempts": sum(sum(event["outcomes"].values()) for event in done),
        "prepare": prepared - started,
        "simulate": simulated - prepared,
        "assemble": finished - simulated,
        "work": work_seconds(first),
        "write": sum(event["seconds"]["write"] for event in done),
        "again": again,
    }


@click.command(help=__doc__)
@click.option(
    "--objects",
    type=click.Path(path_type=Path, exists=True),
    metavar="MESH_DIR",
    help="[six built-in objects]",
)
@shared("--units", "--set")
@click.option("--candidates", default=100, show_default=True, help="Palm poses per object.")
def main(objects: Path | None, units: str, overrides: tuple[str, ...], candidates: int) -> None:
    """Run the script."""
    # Both builds and the plain loops use the same meshes.
    config = load_config(overrides=[f"candidates.max={candidates}", *overrides])
    with tempfile.TemporaryDirectory() as folder:
        if objects is None:
            export_builtin(folder, OBJECTS)
        one, two = (measure(objects or folder, units, config, workers) for workers in (1, 2))
        whole = seconds(objects or folder, units, config, workers=2)
        halves = independent_builds(objects or folder, units, config)

    figures: dict[str, Any] = {
        "seconds with one worker": {k: round(v, 3) for k, v in one.items()},
        "seconds with two workers": {k: round(v, 3) for k, v in two.items()},
        "overhead, one worker": round(one["simulate"] / one["work"] - 1.0, 4),
        "of which shards": round(one["write"] / one["work"], 4),
        "two workers over one": round(one["simulate"] / two["simulate"], 3),
        "two independent builds": [round(half, 3) for half in halves],
        "the same with two workers": round(whole, 3),
        "over their mean": round(sum(halves) / 2.0 / whole, 3),
        "over the later one": round(max(halves) / whole, 3),
    }
    click.echo(json.dumps(figures, indent=1))
