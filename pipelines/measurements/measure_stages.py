"""Measure the seconds and bytes of every stage of a build on some meshes.

\b
    python pipelines/measurements/measure_stages.py MESH_DIR OUT --candidates 20 > times.json
    drakegrasp build --objects MESH_DIR ... --plan --times times.json

The script builds a small dataset in this process alone, so that no other worker disturbs the
clock. The defaults of `drakegrasp.build.estimate` were measured with it.
"""  # noqa: D301  (click keeps the lines of a paragraph that begins with this character)

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from drakegrasp.build.estimate import StageTimes, measure_storage
from drakegrasp.build.pipeline import build
from drakegrasp.build.work_unit import UnitSummary
from drakegrasp.cli.options import manifest_option, set_option, units_option
from drakegrasp.config import load_config
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.statistics import count_splits
from drakegrasp.objects.sources import find_meshes
from drakegrasp.outcomes import Outcome


class Clock:
    """An executor that keeps the time and the result of every task."""

    def __init__(self) -> None:
        self.prepare: list[float] = []
        self.units: list[UnitSummary] = []
        self.last = 0.0

    def __call__(self, function: Callable[[Any], Any], items: Iterable[Any]) -> Iterator[Any]:
        """Yield function(item) of every item, in order."""
        for item in items:
            start = time.perf_counter()
            result = function(item)
            self.last = time.perf_counter()
            if isinstance(result, UnitSummary):
                self.units.append(result)
            else:
                self.prepare.append(self.last - start)
            yield result


@click.command(help=__doc__)
@click.argument("meshes", type=click.Path(path_type=Path, exists=True))
@click.argument("out", type=click.Path(path_type=Path))
@click.option(
    "--config", "config_name", metavar="YAML|PRESET", help="Configuration.  [default: paper]"
)
@set_option
@click.option(
    "--candidates", type=int, default=20, show_default=True, help="Palm poses per object."
)
@units_option
@manifest_option
def main(
    meshes: Path,
    out: Path,
    config_name: str | None,
    overrides: tuple[str, ...],
    candidates: int,
    units: str,
    manifest: Path | None,
) -> None:
    """Run the script."""
    sources = find_meshes(meshes, units=units, manifest=manifest)
    config = load_config(config_name, [*overrides, f"candidates.max={candidates}"])
    clock, begin, begin_cpu = Clock(), time.perf_counter(), time.process_time()
    build(sources, out, config, clock, show=False)
    end = time.perf_counter()

    # The wall clock counts the time of other processes, too; CPU time is the share of this one.
    core = (time.process_time() - begin_cpu) / (end - begin)
    times = stage_times(clock, core, assembled=end - clock.last, out=out)
    click.echo(json.dumps(asdict(times), indent=1))


def stage_times(clock: Clock, core: float, *, assembled: float, out: Path) -> StageTimes:
    """Return the seconds of each stage of a build.

    Args:
        clock: What the tasks took by the wall clock.
        core: CPU time of this process per wall-clock time.
        assembled: Time of the assembly [s].
        out: The dataset.
    """
    # Sum over all units, and over those of each object.
    outcomes: Counter[Outcome] = Counter()
    seconds: Counter[str] = Counter()
    for unit in clock.units:
        outcomes.update(unit.outcomes)
        seconds.update({stage: core * spent for stage, spent in unit.seconds.items()})

    attempts, successes = sum(outcomes.values()), outcomes[Outcome.SUCCESS]
    samples = sum(split.samples for split in count_splits(out))
    objects = len(read_manifest(out).objects)

    # How unequal objects are: the time of each over the mean.
    by_object: dict[str, float] = {}
    for unit in clock.units:
        name = unit.header.object_name
        by_object[name] = by_object.get(name, 0.0) + core * unit.seconds["try"]
    mean = seconds["try"] / objects

    return StageTimes(
        prepare=core * sum(clock.prepare) / len(clock.prepare),
        scene=seconds["build"] / objects,
        attempt=(seconds["try"] + seconds["write"]) / attempts,
        shares=tuple(sorted(spent / mean for spent in by_object.values())),
        look=seconds["look"] / max(1, successes),
        assemble=core * assembled / attempts,
        successes=successes / attempts,
        samples=samples / max(1, successes),
        **measure_storage(out),
        source=f"measured on {objects} objects, {attempts} attempts",
    )


if __name__ == "__main__":
    main()
