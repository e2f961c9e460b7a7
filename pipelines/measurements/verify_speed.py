"""Measure the cost of a verdict over mixed objects, with one or several grasps per object.

\b
    python pipelines/measurements/speed.py verdicts OUT [OUT]... > speed.json

The script verifies samples of the datasets with the method `hand` in this process: first one of
each object, then at most six others of each object. A quarter of them are moved by 8 mm (standard
deviation), so that some fail. The script prints JSON.
"""  # noqa: D301  (click keeps the lines of a paragraph that begins with this character)

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import click
import numpy as np

from drakegrasp.dataset.paths import DATA_FILES
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.schema import SPLITS
from drakegrasp.verification.placing import PlacedGrasp, dataset_config, place_on_rows
from drakegrasp.verification.verify import verify_placed

#: Maximum number of grasps per object in the second measurement.
SEVERAL = 6
#: Fraction of the grasps that are moved, and the standard deviation of the shift [m].
MOVED, SIGMA = 0.25, 0.008


@click.command(help=__doc__)
@click.argument("outs", type=click.Path(path_type=Path, exists=True), nargs=-1, required=True)
def main(outs: tuple[Path, ...]) -> None:
    """Run the script."""
    one = list(_grasps(outs, lambda rows: rows[:1]))
    several = list(_grasps(outs, lambda rows: rows[1 : 1 + SEVERAL]))

    # The first verdict also includes the time of imports and tables, so it is not measured.
    verify_placed(several[-1])
    result = {"one grasp of each object": _measure(one), "several of each": _measure(several)}
    click.echo(json.dumps(result, indent=1))


def _grasps(
    outs: tuple[Path, ...], choose: Callable[[list[int]], list[int]]
) -> Iterator[PlacedGrasp]:
    """Yield grasps of all objects; grasps of an object are together."""
    generator = np.random.default_rng(0)
    for out in outs:
        for split in SPLITS:
            data = GraspDataset(out / DATA_FILES["oto"], split=split)
            names = data.column("object_props/object_name") if len(data) else np.zeros(0)
            rows = [
                row
                for name in dict.fromkeys(names.tolist())
                for row in choose(np.flatnonzero(names == name).tolist())
            ]
            grasps = data.column("grasps")[rows].astype(float)
            moved = generator.random(len(rows)) < MOVED
            points = slice(grasps.shape[1] // 2)
            noise = generator.normal(0.0, SIGMA, grasps[:, points].shape)
            grasps[moved, points] += noise[moved]
            yield from place_on_rows(grasps, data, rows, config=dataset_config(data))


def _measure(grasps: list[PlacedGrasp]) -> dict[str, object]:
    """Return the CPU seconds of verdicts, and the number of grasps that succeed."""
    seconds, success = [], 0
    for grasp in grasps:
        start = time.process_time()
        success += verify_placed(grasp).success
        seconds.append(time.process_time() - start)
    return {
        "grasps": len(grasps),
        "objects": len({grasp.placed.model.name for grasp in grasps}),
        "succeed": success,
        "median CPU seconds": round(float(np.median(seconds)), 3),
        "mean CPU seconds": round(float(np.mean(seconds)), 3),
    }
