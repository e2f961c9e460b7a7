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
from drakegrasp.generation.prepare import prepare_one
from drakegrasp.generation.work_unit import run_unit
from drakegrasp.hand.settings import load_config
from drakegrasp.runtime.executor import run_here
from drakegrasp.shapes.catalog import builtin_sources

WORKERS = 2


class Scale:
    """An executor that weighs what goes to workers and what comes back, while this process works.

    Attributes:
        weights: Bytes by what they are; nothing of tasks that are not sent by wire.
        seconds: CPU time of this process [s].
    """

    def __init__(self, execute: DaskExecutor) -> None:
        self._execute = execute
        self.weights, self.seconds = Counter[str](), 0.0

    def __call__(self, function: Callable[[Any], Any], items: Iterable[Any]) -> Iterator[Any]:
        """Yield function(item) of every item."""
        start = time.process_time()
        for result in self._execute(function, map(self._weighed, items)):
            if isinstance(result, wire.Delivery):
                self.weights["results"] += len(result.result)
                self.weights["shards and objects"] += sum(map(len, result.files.values()))
            yield result
        self.seconds += time.process_time() - start

    def _weighed(self, item: Any) -> Any:
        if isinstance(item, wire.Parcel):
            self.weights["tasks"] += len(item.call) + len(json.dumps(dict(item.files)))
        return item


def weigh_files(dask_worker: Worker) -> None:
    """Have a worker count the bytes of the files that it gets."""
    fetch = wire._fetched
    dask_worker.fetched = 0

    def weighing(name: str, worker: Worker) -> bytes:
        content = fetch(name, worker)
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
        sources = builtin_sources(Path(folder) / "meshes", config.builtin, only=OBJECTS)
        client.run(weigh_files)
        out, dask = Path(folder) / "out", DaskExecutor(client)
        scale = Scale(dask)
        with wire.by_wire(scale, client, out) as execute:
            build(sources, out, config, execute, pool=dask.pool, show=False)
        scale.weights["files to workers"] = sum(client.run(weight).values())
        attempts = int(count_funnel(out).outcomes.sum())
        shards = len(list(out.glob("shards/*/*.h5")))

        # The same with a disk in common, but for what reads shards.
        plain = Scale(dask)

        def beside(function: Callable[[Any], Any], items: Iterable[Any]) -> Iterator[Any]:
            return (plain if function in (prepare_one, run_unit) else run_here)(function, items)

        build(sources, out.with_name("seen"), config, beside, pool=dask.pool, show=False)

    result: dict[str, Any] = {"attempts": attempts, "units": shards, "objects": len(sources)}
    result["kB"] = {name: round(size / attempts, 1) for name, size in scale.weights.items()}
    for name, of in (("wire", scale), ("disk", plain)):
        result[f"client_cpu_seconds_{name}"] = round(1000 * of.seconds / attempts, 2)
    click.echo(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
