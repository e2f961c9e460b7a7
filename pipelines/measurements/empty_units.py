"""Measure how fast empty work units pass through Dask, and what the client's memory grows by.

\b
    python pipelines/measurements/empty_units.py [--units N] [--workers W]

The units are those of a real build but do no work, so what is measured is the scheduler, the
client and the network. Prints JSON with seconds and megabytes.
"""  # noqa: D301  (click keeps the lines of a paragraph that begins with this character)

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path

import click

from drakegrasp.cluster.connect import connect
from drakegrasp.cluster.executor import DaskExecutor
from drakegrasp.dataset.manifest import Manifest, ObjectEntry
from drakegrasp.generation.work_unit import UnitSummary, WorkUnit
from drakegrasp.hand.settings import load_config
from drakegrasp.outcomes import Outcome

#: Units that run first, so that Dask has allocated what it allocates once.
WARM_UP = 1000
STAGES = ("build", "try", "look", "write")


def run_nothing(unit: WorkUnit) -> UnitSummary:
    """Return the summary of a typical unit without running it."""
    outcomes = {Outcome.MISSING_FINGERTIP: 149, Outcome.SUCCESS: 1}
    seconds = dict.fromkeys(STAGES, 0.0)
    return UnitSummary(header=unit.header, outcomes=outcomes, seconds=seconds, errors={})


def units(count: int) -> Iterator[WorkUnit]:
    """Yield the work units of a dataset of objects with 10,000 palm poses each."""
    config = load_config()
    per_object = len(tuple(config.unit_ranges(config.candidates.max)))
    objects = tuple(
        ObjectEntry(
            name=f"{i}_object",
            class_name="object",
            mesh_sha256="0" * 64,
            scale=1.0,
            up="+z",
            mass=1.0,
            density=1000.0,
            friction=None,
            collision_error=0.0,
            resting=(),
            candidates=config.candidates.max,
            combinations=config.candidates.max,
            valid=config.candidates.max,
            distinct=config.candidates.max,
            notes=(),
        )
        for i in range(-(-count // per_object))
    )
    manifest = Manifest(config=config, objects=objects, versions={})
    for _, header in zip(range(count), manifest.headers(), strict=False):
        yield WorkUnit(out=Path("/nowhere"), header=header, config=config, restartable=True)


def memory() -> float:
    """Return the memory of this process, which also runs the scheduler [MB]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 1e6


@click.command(help=__doc__)
@click.option("--units", "count", default=100_000, show_default=True)
@click.option("--workers", default=2, show_default=True)
def main(count: int, workers: int) -> None:
    """Run the script."""
    with connect(workers) as client:
        execute = DaskExecutor(client)
        done = sum(1 for _ in execute(run_nothing, units(WARM_UP)))

        before, peak = memory(), 0.0
        start, start_cpu = time.monotonic(), time.process_time()
        for done, _ in enumerate(execute(run_nothing, units(count)), start=1):
            if done % 1000 == 0:
                peak = max(peak, memory())
        seconds, cpu = time.monotonic() - start, time.process_time() - start_cpu
    print(  # noqa: T201
        json.dumps(
            {
                "units": done,
                "workers": workers,
                "seconds": round(seconds, 1),
                "CPU seconds of client and scheduler": round(cpu, 1),
                "milliseconds per unit": round(1e3 * seconds / done, 3),
                "memory before [MB]": round(before, 1),
                "growth at most [MB]": round(max(peak, memory()) - before, 1),
            },
            indent=1,
        )
    )


if __name__ == "__main__":
    main()
