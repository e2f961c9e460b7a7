"""Interrupt builds at many points; the same command must then finish with equal arrays.

\b
    python pipelines/measurements/interruptions.py disk [--amounts N]
    python pipelines/measurements/interruptions.py kills [--rounds N]

`disk`, which needs root, runs a build and `assemble` in a file system in memory (tmpfs) that
becomes full at a different moment each time: each must end with exit code 1 and one line, and keep
the previous files. `kills` ends the client of a build with SIGKILL at random moments, in each round
twice while it prepares, twice while it simulates and twice while it assembles: the files must be of
one state, or be told not to be, and no temporary file may be left at the end. Both print a line of
JSON for each interruption; the exit code is 1 if any is wrong.
"""  # noqa: D301  (click keeps the lines of a paragraph that begins with this character)

from __future__ import annotations

import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click
import h5py
import numpy as np
import psutil
import trimesh

from drakegrasp.dataset.assemble import is_assembled
from drakegrasp.dataset.lock import tidy
from drakegrasp.dataset.manifest import read_manifest

DATA = ("trials.hdf5", "grasping_oto.hdf5", "grasping_otm.hdf5")
PAGE, ROOM = 4096, 2**31
#: Settings with which two boxes quickly yield some successes.
SETTINGS = [
    "screen.mode=off",
    "candidates.max=4",
    "candidates.global_x_deg=[0]",
    "candidates.global_y_deg=[0]",
    "candidates.global_z_deg=[0,45,90]",
    "candidates.local_z_deg=[0,90]",
    "unit_candidates=1",
    "settle.drop_height=0.01",
    "physics.time_step=0.002",
    "lift.max_speed=2",
    "lift.max_acceleration=20",
    "lift.hold_time=0.1",
    "camera.size=64",
    "filters.outlier_sigma=0",
]
MAIN = [sys.executable, "-c", "from drakegrasp.cli.main import main; main()"]
LINE = "the disk or the quota is full (No space left on device); make room"
#: Time that the workers of a killed client may live on [s]: they finish their attempt.
ORPHANED = 60.0
#: Phases of a build, and the longest time from the beginning of a phase to a kill [s].
PHASES = {"prepare": 1.5, "simulate": 2.0, "assemble": 0.8}
#: Files that each phase writes.
MADE = {"prepare": "objects/*.plan.h5", "simulate": "shards/*/*.h5", "assemble": "*.hdf5"}


def write_boxes(folder: Path) -> None:
    """Write two boxes as meshes."""
    folder.mkdir()
    trimesh.creation.box([0.06, 0.05, 0.12]).export(folder / "1_box_a.obj")
    trimesh.creation.box([0.07, 0.05, 0.14]).export(folder / "2_box_b.obj")


def build_command(meshes: Path, out: Path, workers: int = 1) -> list[str]:
    """Return the command of the build."""
    command = [*MAIN, "build", "--quiet", "--objects", str(meshes), "--out", str(out)]
    command += ["--workers", str(workers)]
    for setting in SETTINGS:
        command += ["--set", setting]
    return command


def same_arrays(first: Path, second: Path) -> bool:
    """Return whether the three files of two datasets hold the same arrays."""
    for name in DATA:
        a, b = arrays(first / name), arrays(second / name)
        if a.keys() != b.keys():
            return False
        for key, values in a.items():
            floats = values.dtype.kind == "f"
            if not np.array_equal(values, b[key], equal_nan=floats):
                return False
    return True


def arrays(path: Path) -> dict[str, Any]:
    """Return the arrays of an HDF5 file by their paths."""
    found: dict[str, Any] = {}

    def visit(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset):
            found[name] = item[()]

    with h5py.File(path) as file:
        file.visititems(visit)
    return found


# Full disks


@contextmanager
def small_disk(folder: Path, size: int) -> Iterator[None]:
    """Mount a file system of a given size [B] on a folder while the block runs."""
    options = f"size={size // PAGE * PAGE},mode=700"
    subprocess.run(["mount", "-t", "tmpfs", "-o", options, "none", str(folder)], check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def resize(folder: Path, size: int) -> None:
    """Change the size [B] of a mounted file system."""
    options = f"remount,size={size // PAGE * PAGE}"
    subprocess.run(["mount", "-o", options, str(folder)], check=True)


def used(out: Path, names: Sequence[str] = ()) -> int:
    """Return the bytes of a folder's files, or of those with given names, in whole pages."""
    files = [path for path in out.rglob("*") if path.is_file()]
    chosen = [path for path in files if not names or path.name in names]
    return sum(-(-path.stat().st_size // PAGE) * PAGE for path in chosen)


def fill_disk(
    command: Sequence[str], reference: Path, disk: Path, size: int, content: Path | None
) -> dict[str, Any]:
    """Run a command with too little space, and again with enough; report how both ended.

    Args:
        command: The command, which writes to `out` on the disk.
        reference: The dataset that the command should produce.
        disk: Folder on which the disk is mounted.
        size: Free space [B].
        content: The dataset that is there before, if any.
    """
    out = disk / "out"
    with small_disk(disk, ROOM):
        if content is not None:
            shutil.copytree(content, out)
        before = {name: (out / name).read_bytes() for name in DATA if content is not None}

        # Run it with too little space.
        resize(disk, used(disk) + size)
        full = subprocess.run(command, capture_output=True, text=True)
        # A line of the progress bar is not an error.
        lines = [line for line in full.stderr.splitlines() if "shards/s" not in line]
        left = [path.name for path in disk.rglob(".*.tmp")]
        kept = all((out / name).read_bytes() == text for name, text in before.items())

        # Run it with enough space.
        resize(disk, ROOM)
        again = subprocess.run(command, capture_output=True, text=True)
        equal = again.returncode == 0 and same_arrays(reference, out)
    one_line = full.returncode == 1 and len(lines) == 1 and LINE in lines[0]
    return {
        "free [kB]": size // 1000,
        "exit code": full.returncode,
        "lines": len(lines),
        "last": lines[-1][-160:] if lines else "",
        "left": left,
        "well": one_line and not left and kept and equal,
        "then equal": equal,
    }


# Killed clients


def phase_of(out: Path, objects: int, units: int) -> str:
    """Return the phase of a build's client, judged by its files."""
    if len(list(out.glob("objects/*.plan.h5"))) < objects:
        return "prepare"
    return "simulate" if len(list(out.glob("shards/*/*.h5"))) < units else "assemble"


def kill_in(
    phase: str, command: Sequence[str], out: Path, delay: float, objects: int, units: int
) -> dict[str, Any] | None:
    """Kill a build in a phase, some seconds after the phase begins.

    Returns:
        The phase in which it died, how long its workers lived on [s], and whether the files were in
        one state; None if the build finished earlier.
    """
    since = time.time()
    signs = {
        "prepare": "objects/*.journal",
        "simulate": "shards/*/*.journal",
        "assemble": "build.lock",
    }
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    while not has_newer(out, signs[phase], since) and process.poll() is None:
        time.sleep(0.002)
    time.sleep(delay)
    workers = psutil.Process(process.pid).children()
    process.kill()
    if process.wait() == 0:
        return None

    # The workers must end by themselves.
    died, end = phase_of(out, objects, units), time.monotonic() + ORPHANED
    start = time.monotonic()
    while any(map(runs, workers)) and time.monotonic() < end:
        time.sleep(0.05)
    lived, orphans = time.monotonic() - start, sum(map(runs, workers))
    tidy(out)
    return {
        "died": died,
        "workers": len(workers),
        "lived on [s]": round(lived, 1),
        "orphans": orphans,
        "one state": has_one_state(out),
    }


def has_newer(out: Path, pattern: str, since: float) -> bool:
    """Return whether a file that matches a pattern was changed since a given time [s]."""
    for path in out.glob(pattern):
        try:
            if path.stat().st_mtime >= since:
                return True
        except FileNotFoundError:
            continue
    return False


def has_one_state(out: Path) -> bool:
    """Return whether the files are of one state, or the manifest tells that they are not."""
    there = [out / name for name in DATA if (out / name).exists()]
    states = set()
    for path in there:
        with h5py.File(path) as file:
            states.add((file.attrs["signature"], file.attrs["shards"]))
    whole = len(there) in (0, len(DATA)) and len(states) <= 1
    return whole or not is_assembled(out, read_manifest(out))


def runs(process: psutil.Process) -> bool:
    """Return whether a process is still running."""
    try:
        return bool(process.status() != psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return False


def leftovers(out: Path) -> list[str]:
    """Return the files of a dataset that may exist only while a build is running."""
    patterns = (".*.tmp", "*.journal", "build.lock")
    return sorted(path.name for pattern in patterns for path in out.rglob(pattern))


def kill_round(
    meshes: Path, reference: Path, out: Path, rng: random.Random, times: int = 2
) -> list[dict[str, Any]]:
    """Kill a build several times in each phase, and let it finish; report each kill."""
    command = build_command(meshes, out, workers=2)
    objects, units = (len(list(reference.glob(p))) for p in ("objects/*.plan.h5", "shards/*/*.h5"))
    told: list[dict[str, Any]] = []
    for phase, longest in PHASES.items():
        killed = 0
        while killed < times:
            # Remove the files of the phase, so that it runs again; `assemble` needs all earlier
            # ones.
            if phase == "assemble" and phase_of(out, objects, units) != phase:
                subprocess.run(command, check=True, capture_output=True)
            for path in out.glob(MADE[phase]):
                path.unlink()
            found = kill_in(phase, command, out, rng.uniform(0.0, longest), objects, units)
            if found is None:
                continue  # it had finished
            killed += 1
            told.append({"meant": phase, **found})

    # The same command completes the build.
    last = subprocess.run(command, capture_output=True, text=True)
    well = last.returncode == 0 and same_arrays(reference, out) and not leftovers(out)
    for line in told:
        line["well"] = well and line["one state"] and not line["orphans"]
        line["left"] = leftovers(out)
    return told


# Commands


@click.group(help=__doc__)
def main() -> None:
    """Run the script."""


@main.command()
@click.option("--amounts", default=20, show_default=True)
def disk(amounts: int) -> None:
    """Fill the disk under a build and under `assemble`."""
    wrong = 0
    with references() as (meshes, reference, folder):
        # A build needs space for all of its files; `assemble` for new ones beside the old ones.
        mounted = folder / "disk"
        mounted.mkdir()
        out = mounted / "out"
        needs = {"build": used(reference), "assemble": used(reference, DATA)}
        commands = {"build": build_command(meshes, out), "assemble": [*MAIN, "assemble", str(out)]}
        for kind, command in commands.items():
            content = reference if kind == "assemble" else None
            for number in range(amounts):
                # Sizes from one page to slightly too little.
                size = PAGE + int((needs[kind] - 6 * PAGE) * number / max(1, amounts - 1))
                result = fill_disk(command, reference, mounted, size, content)
                wrong += not result["well"]
                click.echo(json.dumps({"command": kind, **result}))
    click.echo(f"{wrong} wrong")
    sys.exit(bool(wrong))


@main.command()
@click.option("--rounds", default=5, show_default=True, help="Number of rounds of six kills.")
@click.option("--seed", default=0, show_default=True)
def kills(rounds: int, seed: int) -> None:
    """Kill the client of a build."""
    wrong, rng = 0, random.Random(seed)
    with references() as (meshes, reference, folder):
        for number in range(rounds):
            for line in kill_round(meshes, reference, folder / f"out{number}", rng):
                wrong += not line["well"]
                click.echo(json.dumps(line))
    click.echo(f"{wrong} wrong")
    sys.exit(bool(wrong))


@contextmanager
def references() -> Iterator[tuple[Path, Path, Path]]:
    """Yield the folder of the meshes, their dataset, and a folder for other files."""
    os.environ.setdefault("DRAKE_ALLOW_NETWORK", "none")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        meshes, reference = folder / "meshes", folder / "reference"
        write_boxes(meshes)
        subprocess.run(build_command(meshes, reference, 2), check=True, capture_output=True)
        yield meshes, reference, folder


if __name__ == "__main__":
    main()
