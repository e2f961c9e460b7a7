"""Measure how fast grasps are verified, and what a second worker gains.

\b
    python pipelines/measurements/verify_speed.py OUT --grasps 500 > speed.json

The script verifies the samples of a dataset's test split by method `hand`, with one worker and
then with two. It repeats them until there are as many as asked for. Prints JSON.
"""  # noqa: D301  (click keeps the lines of a paragraph that begins with this character)

from __future__ import annotations

import json
import time
from pathlib import Path

import click
import numpy as np

from drakegrasp.api.verifying import verify_rows
from drakegrasp.cluster.connect import connect
from drakegrasp.dataset.paths import DATA_FILES
from drakegrasp.dataset.reader import GraspDataset


@click.command(help=__doc__)
@click.argument("out", type=click.Path(path_type=Path, exists=True))
@click.option("--grasps", type=int, default=500, show_default=True)
def main(out: Path, grasps: int) -> None:
    """Run the script."""
    data = GraspDataset(out / DATA_FILES["oto"], split="test")
    rows = [i % len(data) for i in range(grasps)]
    vectors = data.column("grasps")[rows].astype(float)

    # The batch by the wall clock; the stages of a grasp where no other worker disturbs them.
    seconds, by_stage = {}, {}
    for workers in (1, 2):
        with connect(workers) as client:
            # The first grasps of each worker also pay for imports and tables.
            verify_rows(data, vectors[:8], rows[:8], client=client)

            start = time.perf_counter()
            verdicts = verify_rows(data, vectors, rows, client=client, show=True)
            seconds[workers] = time.perf_counter() - start
        if workers == 1:
            for stage in ("surface", "margin", "fit", "simulate"):
                spent = [v.seconds[stage] for v in verdicts if stage in v.seconds]
                by_stage[stage] = float(np.median(spent))
            by_stage["in all"] = float(np.median([sum(v.seconds.values()) for v in verdicts]))

    result = {
        "grasps": grasps,
        "median seconds of a verification, one worker": by_stage,
        "seconds of the batch by number of workers": seconds,
        "two workers over one": seconds[1] / seconds[2],
    }
    click.echo(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
