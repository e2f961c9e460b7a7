"""Measure how fast `drakegrasp inspect` shows a large dataset, and its memory.

\b
    python pipelines/measurements/speed.py page OUT --grasps 50000 > inspect_speed.json

The script repeats the attempts of the dataset OUT, with their images, under new numbers until there
are as many grasps as requested, and serves the result from a separate process. It measures the
wall-clock and CPU seconds of the server for each kind of request, and its peak memory. The large
files are in a temporary folder and need about 60 kB per grasp. The script prints JSON.
"""  # noqa: D301  (click keeps the lines of a paragraph that begins with this character)

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path
from typing import Any

import click
import h5py
import numpy as np

from drakegrasp.dataset.hdf5 import COLUMN_CHUNK, create_field
from drakegrasp.dataset.paths import DATA_FILES, TRIALS_FILE
from drakegrasp.dataset.schema import CAMERAS, DATA_FIELDS, SUCCESS_FIELDS, TRIAL_FIELDS
from drakegrasp.outcomes import Outcome
from drakegrasp.page.catalog import Catalog

#: Filters that are requested, each new to the server.
FILTERS = ("min_slip=5", "object=50_carton_final&sort=slip", "outcome=any&sort=penetration",
           "hold=stable&min_force=40", "outcome=dropped&sort=force", "decision=open")  # fmt: skip
#: Number of grasps whose pages are requested.
PAGES = 20
SERVE = "from drakegrasp.cli.main import run; run()"


@click.command(help=__doc__)
@click.argument("out", type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option("--grasps", type=click.IntRange(min=1), default=50_000, show_default=True)
def main(out: Path, grasps: int) -> None:
    """Run the script."""
    with tempfile.TemporaryDirectory() as folder:
        large = Path(folder) / "large"
        large.mkdir()
        (large / "objects").symlink_to((out / "objects").resolve())
        attempts = repeat_dataset(out, large, grasps)
        result = {"attempts": attempts, "grasps": grasps, **measure(large)}
    click.echo(json.dumps(result, indent=1))


def repeat_dataset(out: Path, large: Path, grasps: int) -> int:
    """Write a dataset that repeats the attempts of another one; return their number.

    Only whole chunks of the columns are taken, so that their compressed bytes can be copied.
    """
    with h5py.File(out / TRIALS_FILE) as source, h5py.File(large / TRIALS_FILE, "w") as target:
        # Number of copies that are needed.
        count = len(source["trials/outcome"]) // COLUMN_CHUNK * COLUMN_CHUNK
        hits = int(np.count_nonzero(source["trials/outcome"][:count] == Outcome.SUCCESS))
        if not hits:
            raise click.UsageError(f"{out}: the first {count} attempts must have a success")
        copies = -(-grasps // hits)
        target.attrs.update(source.attrs)
        source.copy("objects", target)

        # The numbers of trials and palm poses continue from copy to copy; other values stay.
        poses = int(source["trials/candidate"][:].max()) + 1
        shifts = {"trial_id": count, "candidate": poses}
        group = target.create_group("trials")
        for field in TRIAL_FIELDS:
            old = source["trials"][field.name]
            new = create_field(group, field, old.shape[1:])
            new.resize(copies * count, axis=0)
            if field.name in shifts:
                steps = np.repeat(np.arange(copies) * shifts[field.name], count)
                new[:] = np.tile(old[:count], copies) + steps
                continue
            _repeat_chunks(old, new, COLUMN_CHUNK, count // COLUMN_CHUNK, copies)

        kept = source["successes/trial_id"][:] < count
        successes = target.create_group("successes")
        for field in SUCCESS_FIELDS:
            values = np.tile(source["successes"][field.name][:][kept], copies)
            if field.name == "trial_id":
                values = values + np.repeat(np.arange(copies) * count, hits)
            dataset = create_field(successes, field, ())
            dataset.resize(len(values), axis=0)
            dataset[:] = values
    for camera in CAMERAS:
        _repeat_samples(out / DATA_FILES[camera], large / DATA_FILES[camera], copies, count)
    return copies * count


def _repeat_samples(old: Path, new: Path, copies: int, count: int) -> None:
    """Write a data file that repeats the samples of another one."""
    with h5py.File(old) as source, h5py.File(new, "w") as target:
        target.attrs.update(source.attrs)
        for split in source:
            rows = int(np.searchsorted(source[split]["trial_id"][:], count))
            for field in DATA_FIELDS:
                dataset = source[split][field.name]
                made = create_field(target.require_group(split), field, dataset.shape[1:])
                made.resize(copies * rows, axis=0)
                if field.sample:
                    _repeat_chunks(dataset, made, 1, rows, copies)
                elif rows:
                    values = dataset[:rows]
                    many = np.concatenate([values] * copies)
                    if field.name == "trial_id":
                        many = many + np.repeat(np.arange(copies) * count, rows)
                    made[:] = many


def _repeat_chunks(
    old: h5py.Dataset, new: h5py.Dataset, size: int, number: int, copies: int
) -> None:
    """Copy the first chunks of a dataset, each with `size` rows, repeatedly and unchanged."""
    place = (0,) * (old.ndim - 1)
    for k in range(number):
        mask, content = old.id.read_direct_chunk((k * size, *place))
        for copy in range(copies):
            new.id.write_direct_chunk(((copy * number + k) * size, *place), content, mask)


def measure(out: Path) -> dict[str, Any]:
    """Return the seconds of requests by kind, and the memory of the server."""
    snapshot = Catalog(out).current()
    rng = np.random.default_rng(0)
    (hits,) = np.nonzero(snapshot.table.outcome == Outcome.SUCCESS)
    labels = [snapshot.label(int(i)) for i in rng.choice(hits, PAGES, replace=False)]
    del snapshot

    # Start the server in a separate process.
    start = time.perf_counter()
    command = [sys.executable, "-c", SERVE, "inspect", str(out), "--port", "0", "--no-browser"]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert server.stdout is not None
    try:
        address = server.stdout.readline().strip()
        result: dict[str, Any] = {
            "start_wall": round(time.perf_counter() - start, 2),
            "start_cpu": _cpu_seconds(server.pid),
        }

        def ask(paths: list[str]) -> dict[str, float]:
            """Return the largest and median seconds of the requests, wall-clock and CPU."""
            found = []
            for path in paths:
                cpu, wall = _cpu_seconds(server.pid), time.perf_counter()
                with urllib.request.urlopen(address + path, timeout=120.0) as answer:
                    answer.read()
                found.append((time.perf_counter() - wall, _cpu_seconds(server.pid) - cpu))
            names = ("wall_max", "cpu_max", "wall_median", "cpu_median")
            values = (*np.max(found, axis=0), *np.median(found, axis=0))
            return {n: round(float(v), 3) for n, v in zip(names, values, strict=True)}

        result["first_page"] = ask([""])
        result["filter"] = ask([f"?{text}" for text in FILTERS])
        result["grasp"] = ask([f"grasp/{label}" for label in labels])
        result["image"] = ask([f"strip/{label}-oto.png" for label in _seen(address, labels)])
        status = Path(f"/proc/{server.pid}/status").read_text(encoding="utf-8")
        peak = next(line for line in status.splitlines() if line.startswith("VmHWM"))
        result["peak_megabytes"] = round(int(peak.split()[1]) / 1e3)
    finally:
        server.terminate()
        server.wait()
    return result


def _seen(address: str, labels: list[str]) -> list[str]:
    """Return those of the grasps that have images."""
    seen = []
    for label in labels:
        try:
            urllib.request.urlopen(f"{address}strip/{label}-otm.png").close()
        except OSError:
            continue
        seen.append(label)
    return seen


def _cpu_seconds(pid: int) -> float:
    """Return the CPU time that a process has used [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / 100.0
