"""Measure how fast grasps are verified and datasets are read.

\b
    python pipelines/measurements/speed.py verdicts OUT
    python pipelines/measurements/speed.py loader OUT
    python pipelines/measurements/speed.py scenes OUT

`verdicts` verifies samples with the method `hand`, at most six of each object, a quarter of them
moved by 8 mm (standard deviation), so that some fail. `loader` reads images and grasps in random
order, by `GraspDataset.to_torch` under torch's DataLoader and by h5py alone. `scenes` reads the
training items of `SceneDataset`, as points and as images, for the first time and again. Everything
runs in this process. The script prints JSON, with CPU seconds, which are reliable on a busy machine
also.
"""  # noqa: D301  (click keeps the lines of a paragraph that begins with this character)

from __future__ import annotations

import json
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import click
import h5py
import numpy as np

from drakegrasp.dataset.paths import DATA_FILES, SCENES_FILE
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.scenes import SceneDataset
from drakegrasp.verification.placing import dataset_config, place_on_rows
from drakegrasp.verification.verify import verify_placed

#: Maximum number of grasps per object, fraction of them that are moved, and the shift [m].
SEVERAL, MOVED, SIGMA = 6, 0.25, 0.008
FIELDS, BATCH, ROUNDS = ("images", "grasps"), 64, 5
OUT = click.argument("out", type=click.Path(path_type=Path, exists=True, file_okay=False))


@click.group(help=__doc__)
def main() -> None:
    """Run the script."""


@main.command()
@OUT
def verdicts(out: Path) -> None:
    """Measure the cost of a verdict."""
    data = GraspDataset(out / DATA_FILES["oto"], split="train")
    names = data.column("object_props/object_name")
    rows = [
        row
        for name in dict.fromkeys(names.tolist())
        for row in np.flatnonzero(names == name)[:SEVERAL].tolist()
    ]
    generator = np.random.default_rng(0)
    grasps = data.column("grasps")[rows].astype(float)
    points = grasps[:, : grasps.shape[1] // 2]
    moved = generator.random((len(rows), 1)) < MOVED
    points += moved * generator.normal(0.0, SIGMA, points.shape)

    # The first verdict also includes the time of imports and tables, so it is not measured.
    placed = place_on_rows(grasps, data, rows, config=dataset_config(data))
    verify_placed(placed[-1])
    seconds, matching = [], 0
    for grasp in placed:
        start = time.process_time()
        matching += verify_placed(grasp).matches
        seconds.append(time.process_time() - start)
    tell(
        grasps=len(placed),
        match=matching,
        median=round(float(np.median(seconds)), 3),
        mean=round(float(np.mean(seconds)), 3),
    )


@main.command()
@OUT
def loader(out: Path) -> None:
    """Measure how many samples per second are read."""
    from torch.utils.data import DataLoader

    path = out / DATA_FILES["oto"]
    data = GraspDataset(path)
    batches = DataLoader(data.to_torch(FIELDS), batch_size=BATCH, shuffle=True)
    rng = np.random.default_rng(0)

    def alone() -> None:
        with h5py.File(path) as file:
            columns = [file["train"][name] for name in FIELDS]
            for row in rng.permutation(len(data)):
                for column in columns:
                    column[row]

    # The first round fills the disk's cache.
    rates = [
        [rate(len(data), read) for read in (alone, lambda: list(batches))] for _ in range(ROUNDS)
    ]
    h5py_alone, torch = np.median(rates[1:], axis=0).round().tolist()
    tell(samples=len(data), h5py_per_second=h5py_alone, loader_per_second=torch)


@main.command()
@OUT
def scenes(out: Path) -> None:
    """Measure how many items of scenes per second are read."""
    kinds: dict[str, dict[str, Any]] = {"points": {}, "images": {"points": None}}
    for kind, options in kinds.items():
        data = SceneDataset(out / SCENES_FILE, **options)
        read = partial(read_all, data)
        first, later = rate(len(data), read), rate(len(data), read)
        tell(kind=kind, items=len(data), first_per_second=first, later_per_second=later)


def read_all(data: SceneDataset) -> None:
    """Read each item of a dataset."""
    for index in range(len(data)):
        data[index]


def rate(count: int, read: Callable[[], object]) -> float:
    """Return how many items per CPU second a function reads."""
    start = time.process_time()
    read()
    return count / (time.process_time() - start)


def tell(**values: Any) -> None:
    """Print values as JSON."""
    click.echo(json.dumps(values, indent=1))


if __name__ == "__main__":
    main()
