"""What a build sends to workers that do not see OUT, and what the client computes for that.

\b
    python pipelines/measurements/speed.py wire [--candidates N] [--set KEY=VALUE]

The workers are of this machine, but get every file over the network. The scheduler runs in the
client's process, so the time of the client has that of the scheduler in it. Prints JSON: kB and
CPU seconds for 1,000 attempts.
"""  # noqa: D301  (click keeps the lines of a paragraph that begins with this character)

from __future__ import annotations

import json
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import click
from build_overhead import OBJECTS
from distributed import Worker

from drakegrasp.cli.options import shared
from drakegrasp.cluster import wire
from drakegrasp.cluster.connect import connect
from drakegrasp.cluster.executor import DaskExecutor
from drakegrasp.dataset.statistics import count_funnel
from drakegrasp.generation.pipeline import build
from drakegrasp.hand.settings import load_config
from drakegrasp.shapes.catalog import builtin_sources

WORKERS = 2


class Scale:
    """An executor that weighs what goes to workers and what comes back, while this process works.

    Attributes:
        weights: Bytes by what they are.
        seconds: CPU time of this process [s].
    """

    def __init__(self, execute: DaskExecutor) -> None:
        self._execute = execute
        self.weights, self.seconds = Counter[str](), 0.0

    def __call__(self, function: Callable[[Any], Any], items: Iterable[Any]) -> Iterator[Any]:
        """Yield function(item) of every item."""

        def weighed() -> Iterator[Any]:
            for parcel in items:
                self.weights["tasks"] += len(parcel.call) + len(json.dumps(dict(parcel.files)))
                yield parcel

        start = time.process_time()
        for delivery in self._execute(function, weighed()):
            self.weights["results"] += len(delivery.result)
            self.weights["shards and objects"] += sum(map(len, delivery.files.values()))
            yield delivery
        self.seconds += time.process_time() - start


def weigh_files(dask_worker: Worker) -> None:
    """Have a worker count the bytes of the files that it gets."""
    fetch = wire._fetched
    dask_worker.fetched = 0

    def weighing(build: str, digest: str, worker: Worker) -> bytes:
        content = fetch(build, digest, worker)
        worker.fetched += len(content)
        return content

    wire._fetched = weighing


def weight(dask_worker: Worker) -> int:
    """Return the bytes of the files that a worker got."""
    return int(dask_worker.fetched)


@click.command(help=__doc__)
@click.option("--candidates", default=100, help="Palm poses of each object.")
@shared("--set")
def main(candidates: int, overrides: tuple[str, ...]) -> None:
    """Run the script."""
    config = load_config(overrides=[f"candidates.max={candidates}", *overrides])
    with tempfile.TemporaryDirectory() as folder, connect(workers=WORKERS) as client:
        out = Path(folder) / "out"
        sources = builtin_sources(Path(folder) / "meshes", config.builtin, only=OBJECTS)
        client.run(weigh_files)
        dask = DaskExecutor(client)
        scale = Scale(dask)
        with wire.by_wire(scale, client, out) as execute:
            build(sources, out, config, execute, pool=dask.pool, show=False)
        scale.weights["files to workers"] = sum(client.run(weight).values())
        attempts = int(count_funnel(out).outcomes.sum())
        shards = len(list(out.glob("shards/*/*.h5")))

    kilobytes = {name: round(size / attempts, 1) for name, size in scale.weights.items()}
    result = {"attempts": attempts, "units": shards, "objects": len(sources), "workers": WORKERS}
    seconds = round(1000 * scale.seconds / attempts, 2)
    click.echo(json.dumps({**result, "kB": kilobytes, "client_cpu_seconds": seconds}, indent=1))


if __name__ == "__main__":
    main()
