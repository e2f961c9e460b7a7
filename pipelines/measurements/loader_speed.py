"""Measure how many random samples per second torch's DataLoader reads, compared with h5py alone.

\b
    python pipelines/measurements/speed.py loader OUT --samples 6000 > loader_speed.json

The compressed samples of the dataset OUT are repeated until there are as many as requested, in a
temporary file of about 40 kB per sample. Images and grasps are read in random order: by
`GraspDataset.to_torch` under a DataLoader with two workers, and by two processes that only read the
same chunks with h5py. Both are timed in turn, after a first pass that starts their processes. The
script prints JSON: samples per wall-clock second of each turn, the median of the turns' ratios, and
the same for CPU seconds, which are more reliable on a busy machine. It needs the extra `[torch]`.
"""  # noqa: D301  (click keeps the lines of a paragraph that begins with this character)

from __future__ import annotations

import json
import multiprocessing
import os
import tempfile
import time
from multiprocessing.pool import Pool
from pathlib import Path

import click
import h5py
import numpy as np
import numpy.typing as npt

from drakegrasp.dataset.hdf5 import create_field
from drakegrasp.dataset.paths import DATA_FILES
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.schema import DATA_FIELDS, SPLITS

#: Fields that are read.
FIELDS = ("images", "grasps")
WORKERS = 2


@click.command(help=__doc__)
@click.argument("out", type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option("--samples", type=click.IntRange(min=64), default=6000, show_default=True)
@click.option("--rounds", type=click.IntRange(min=1), default=5, show_default=True)
@click.option("--batch-size", type=click.IntRange(min=1), default=32, show_default=True)
def main(out: Path, samples: int, rounds: int, batch_size: int) -> None:
    """Run the script."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / DATA_FILES["oto"]
        repeat_samples(out / DATA_FILES["oto"], path, samples)
        with multiprocessing.get_context("spawn").Pool(WORKERS) as pool:
            turns = measure(path, pool, samples, rounds, batch_size)

    wall, cpu = samples / turns[..., 0], 1e6 * turns[..., 1] / samples
    result = {
        "samples": samples,
        "load_average": round(os.getloadavg()[0], 1),
        "h5py_per_second": wall[:, 0].round().tolist(),
        "loader_per_second": wall[:, 1].round().tolist(),
        "ratio": round(float(np.median(wall[:, 1] / wall[:, 0])), 3),
        "h5py_cpu_microseconds": cpu[:, 0].round().tolist(),
        "loader_cpu_microseconds": cpu[:, 1].round().tolist(),
        "ratio_by_cpu": round(float(np.median(cpu[:, 0] / cpu[:, 1])), 3),
    }
    click.echo(json.dumps(result, indent=1))


def repeat_samples(old: Path, new: Path, samples: int) -> None:
    """Write a data file whose split `train` repeats the samples of all splits."""
    with h5py.File(old) as source, h5py.File(new, "w") as target:
        target.attrs.update(source.attrs)
        places = [(split, row) for split in SPLITS for row in range(len(source[split]["grasps"]))]
        if not places:
            raise click.UsageError(f"{old}: must hold samples, got none")
        taken = [places[i % len(places)] for i in range(samples)]

        for field in DATA_FIELDS:
            shape = source["train"][field.name].shape[1:]
            for split in SPLITS:
                create_field(target.require_group(split), field, shape)
            made = target["train"][field.name]
            made.resize(samples, axis=0)
            if field.sample:
                _copy_chunks(source, taken, field.name, made)
            elif field.name == "trial_id":
                made[:] = np.arange(samples)
            else:
                columns = {split: source[split][field.name][:] for split in SPLITS}
                made[:] = np.array([columns[split][row] for split, row in taken])


def _copy_chunks(
    source: h5py.File, taken: list[tuple[str, int]], name: str, made: h5py.Dataset
) -> None:
    """Copy the compressed images of the chosen rows of all splits."""
    place = (0,) * (made.ndim - 1)
    for k, (split, row) in enumerate(taken):
        mask, content = source[split][name].id.read_direct_chunk((row, *place))
        made.id.write_direct_chunk((k, *place), content, mask)


def measure(
    path: Path, pool: Pool, samples: int, rounds: int, batch_size: int
) -> npt.NDArray[np.float64]:
    """Return wall-clock and CPU seconds (rounds, 2, 2) of h5py alone, then of the loader."""
    from torch.utils.data import DataLoader

    data = GraspDataset(path).to_torch(FIELDS)
    loader = DataLoader(
        data, batch_size=batch_size, shuffle=True, num_workers=WORKERS, persistent_workers=True
    )
    rng = np.random.default_rng(0)
    marks = []
    for _ in range(rounds + 1):
        halves = np.array_split(rng.permutation(samples), WORKERS)
        marks.append(_now())
        pool.starmap(read_alone, [(path, rows) for rows in halves])
        marks.append(_now())
        seen = sum(len(batch["grasps"]) for batch in loader)
        if seen != samples:
            raise RuntimeError(f"the loader must give {samples} samples, got {seen}")

    # Leave out the first round, which starts the processes.
    return np.diff([*marks, _now()], axis=0).reshape(-1, 2, 2)[1:]


def _now() -> tuple[float, float]:
    """Return the wall clock, and the CPU time of this process and its children [s]."""
    children = Path(f"/proc/self/task/{os.getpid()}/children").read_text(encoding="utf-8").split()
    used = time.process_time()
    for pid in children:
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
        used += (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return time.perf_counter(), used


def read_alone(path: Path, rows: npt.NDArray[np.int64]) -> None:
    """Read images and grasps of some rows."""
    with h5py.File(path, "r") as file:
        fields = [file["train"][name] for name in FIELDS]
        for row in rows:
            for field in fields:
                field[row]
