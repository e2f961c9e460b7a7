"""Measure the seconds and bytes of every stage of a build: the defaults of `drakegrasp.plan`.

    python pipelines/measure_stages.py MESH_DIR OUT --candidates 20 > stages.json

Builds a dataset in this process alone, so that no other worker of it disturbs the clock.
"""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import click

from drakegrasp.build import build
from drakegrasp.config import load_config
from drakegrasp.manifest import read_manifest
from drakegrasp.meshes import find_meshes
from drakegrasp.outcomes import Outcome
from drakegrasp.plan import measure_storage
from drakegrasp.units import UnitSummary


class Clock:
    """An executor that keeps what every task took and said."""

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
@click.option("--candidates", type=int, default=20, show_default=True, help="Per object.")
@click.option("--units", default="m", show_default=True, help="Of the meshes.")
@click.option("--manifest", type=click.Path(path_type=Path), help="Units by mesh.")
def main(meshes: Path, out: Path, candidates: int, units: str, manifest: Path | None) -> None:
    """Print the figures as JSON."""
    begin = time.perf_counter() - time.process_time()
    clock = Clock()
    config = load_config(overrides=[f"candidates.max={candidates}"])
    sources = find_meshes(meshes, units=units, manifest=manifest)
    build(sources, out, config, clock, show=False)
    assembled = time.perf_counter() - clock.last
    outcomes: Counter[Outcome] = Counter()
    seconds: Counter[str] = Counter()
    for unit in clock.units:
        outcomes.update(unit.outcomes)
        seconds.update(unit.seconds)
    attempts = sum(outcomes.values())
    by_object = [u.seconds["try"] / sum(u.outcomes.values()) for u in clock.units]
    click.echo(
        json.dumps(
            {
                "objects": len(read_manifest(out).objects),
                "attempts": attempts,
                "share of a core that was had": time.process_time() / (time.perf_counter() - begin),
                "outcomes": {o.label: n for o, n in outcomes.items()},
                "prepare [s/object]": sum(clock.prepare) / len(clock.prepare),
                "build [s/object]": seconds["build"] / len(clock.units),
                "try [s/attempt]": seconds["try"] / attempts,
                "look [s/success]": seconds["look"] / max(1, outcomes[Outcome.SUCCESS]),
                "write [s/unit]": seconds["write"] / len(clock.units),
                "assemble [s/attempt]": assembled / attempts,
                "try by object [s/attempt]": sorted(by_object),
                "storage [B]": measure_storage(out),
            },
            indent=1,
        )
    )


if __name__ == "__main__":
    main()
