"""Measure how fast grasps are verified, and how that grows with workers: prints JSON.

    python pipelines/measurements/verify_speed.py OUT --grasps 500 > speed.json

The samples of a dataset's test split are verified by method `hand`, over again until there are
as many as asked for, with one worker and then with two.
"""

from __future__ import annotations

import json
import time
from pathlib import Path

import click
import numpy as np

from drakegrasp.api import verify_grasps
from drakegrasp.cluster.connect import connect
from drakegrasp.dataset.paths import DATA_FILES
from drakegrasp.dataset.reader import GraspDataset


@click.command(help=__doc__)
@click.argument("out", type=click.Path(path_type=Path, exists=True))
@click.option("--grasps", type=int, default=500, show_default=True)
def main(out: Path, grasps: int) -> None:
    """Print the figures as JSON."""
    data = GraspDataset(out / DATA_FILES["oto"], split="test")
    rows = [i % len(data) for i in range(grasps)]
    vectors = data.column("grasps")[rows].astype(float)
    seconds, by_stage = {}, {}
    for workers in (1, 2):
        with connect(workers) as client:
            # The first grasp pays for imports and tables, once per worker.
            verify_grasps(vectors[:8], dataset=data, rows=rows[:8], client=client)
            start = time.perf_counter()
            found = verify_grasps(vectors, dataset=data, rows=rows, client=client, show=True)
            seconds[workers] = time.perf_counter() - start
        if workers == 1:
            for stage in ("surface", "margin", "fit", "simulate"):
                spent = [v.seconds[stage] for v in found if stage in v.seconds]
                by_stage[stage] = float(np.median(spent))
            by_stage["in all"] = float(np.median([sum(v.seconds.values()) for v in found]))
    result = {
        "grasps": grasps,
        "median seconds of a verification, one worker": by_stage,
        "seconds of the batch by number of workers": seconds,
        "two workers over one": seconds[1] / seconds[2],
    }
    click.echo(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
