"""Measure how many items per second `SceneDataset` returns to two processes.

\b
    python pipelines/measurements/speed.py scenes OUT

Two processes share the items of the training scenes of OUT, for point clouds and for images: one
round reads each view for the first time, and another round reads it again. The script prints JSON:
items per wall-clock second, and items per CPU second of both processes times two, which is more
reliable on a busy machine.
"""  # noqa: D301  (click keeps the lines of a paragraph that begins with this character)

from __future__ import annotations

import json
import multiprocessing
import os
import time
from pathlib import Path
from typing import Any

import click

from drakegrasp.dataset.paths import SCENES_FILE
from drakegrasp.dataset.scenes import SceneDataset

WORKERS = 2
KINDS: dict[str, dict[str, Any]] = {"points": {}, "images": {"points": None}}


@click.command(help=__doc__)
@click.argument("out", type=click.Path(path_type=Path, exists=True, file_okay=False))
def main(out: Path) -> None:
    """Run the script."""
    result: dict[str, Any] = {"load_average": round(os.getloadavg()[0], 1)}
    for kind, arguments in KINDS.items():
        tasks = [(out / SCENES_FILE, arguments, worker) for worker in range(WORKERS)]
        with multiprocessing.get_context("spawn").Pool(WORKERS) as pool:
            rounds = zip(*pool.map(read, tasks, chunksize=1), strict=True)
        for name, workers in zip(("first", "later"), rounds, strict=True):
            items, wall, cpu = zip(*workers, strict=True)
            result[f"{kind}_{name}_per_second"] = round(sum(items) / max(wall))
            result[f"{kind}_{name}_by_cpu"] = round(WORKERS * sum(items) / sum(cpu))
    click.echo(json.dumps(result, indent=1))


def read(task: tuple[Path, dict[str, Any], int]) -> list[tuple[int, float, float]]:
    """Return items, seconds and CPU seconds of a worker's two rounds."""
    path, arguments, worker = task
    data = SceneDataset(path, **arguments)
    turns = []
    for epoch in range(2):
        own = range(worker, len(data), WORKERS)
        wall, cpu = time.perf_counter(), time.process_time()
        for index in own:
            data[epoch, index]
        turns.append((len(own), time.perf_counter() - wall, time.process_time() - cpu))
    return turns
