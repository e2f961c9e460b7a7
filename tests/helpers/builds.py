"""Builds in this process by any executor, and by the command line in processes of their own."""

from __future__ import annotations

import resource
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from helpers import faults

from drakegrasp.config import Config
from drakegrasp.generation import pipeline
from drakegrasp.generation.directory import build_config, open_directory
from drakegrasp.generation.pipeline import BuildReport
from drakegrasp.objects.sources import MeshSource, find_meshes
from drakegrasp.runtime.executor import Executor, WorkerPool, run_here
from drakegrasp.simulation.attempts import GraspTable

#: Six units of half a second for each object, so that none goes with another and a build can be
#: stopped in time; of six attempts one succeeds.
FAST = [
    *("screen.mode=off", "candidates.max=6", "unit_candidates=1"),
    *("candidates.global_x_deg=[0]", "candidates.global_y_deg=[0]"),
    *("candidates.global_z_deg=[0,45,90]", "candidates.local_z_deg=[0,90]"),
    *("settle.drop_height=0.01", "settle.max_linear_speed=0.1", "settle.max_angular_speed=1"),
    *("physics.time_step=0.006", "lift.max_speed=2", "lift.max_acceleration=20"),
    *("lift.hold_time=0.1", "camera.size=32", "filters.outlier_sigma=0"),
]


def build(
    objects: Path | Sequence[MeshSource],
    out: Path,
    config: Config,
    execute: Executor = run_here,
    *,
    postures: GraspTable | None = None,
    pool: WorkerPool | None = None,
    show: bool = False,
) -> BuildReport:
    """Build the dataset of a folder of meshes, or of some of them, in a directory."""
    sources = find_meshes(objects) if isinstance(objects, Path) else objects
    config = build_config(config, postures)
    with open_directory(out, config, [source.name for source in sources]) as directory:
        return pipeline.build(directory, sources, execute, postures=postures, pool=pool, show=show)


def start_build(
    meshes: Path,
    out: Path,
    workers: int,
    *arguments: str,
    fault: str = "",
    largest_file: int = resource.RLIM_INFINITY,
    new_session: bool = False,
) -> subprocess.Popen[str]:
    """Start the command of a build in a process of its own.

    Args:
        meshes: Directory of meshes.
        out: Directory of the dataset.
        workers: Number of workers.
        *arguments: More of them.
        fault: What goes wrong, see `helpers.faults`.
        largest_file: Size of the largest file that can be written [B].
        new_session: Whether it has a terminal of its own, as it were: a group of processes.
    """

    def prepare() -> None:
        # A test that was started in the background of a shell ignores Ctrl-C, and so would this.
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        resource.setrlimit(resource.RLIMIT_FSIZE, (largest_file, largest_file))

    # The defaults, which have no name; a build without a configuration uses the preset fast.
    defaults = out.parent / "defaults.yaml"
    defaults.write_text("seed: 0\n")
    options = ["--objects", meshes, "--out", out, "--workers", workers, "--config", defaults]
    settings = [word for value in FAST for word in ("--set", value)]
    command = [sys.executable, "-c", "from drakegrasp.cli.main import main; main()"]
    command += ["build", "--quiet", *map(str, options), *settings, *arguments]
    environment = faults.environment(fault) if fault else None
    return subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
        preexec_fn=prepare,
        start_new_session=new_session,
    )


def finish(process: subprocess.Popen[str]) -> tuple[str, str]:
    """Return what a build that must succeed says."""
    said, errors = process.communicate(timeout=240)
    assert process.returncode == 0, errors
    return said, errors


def wait_for_shards(out: Path, count: int, patience: float | None = None) -> None:
    """Wait until there are some shards: as long as it takes, or for some seconds at most."""
    end = time.monotonic() + (120.0 if patience is None else patience)
    while len(list(out.glob("shards/*/*.h5"))) < count:
        if time.monotonic() > end:
            assert patience is not None, "the build must go on"
            return
        time.sleep(0.05)


def workers_of(client: int) -> list[int]:
    """Return the worker processes that a build on this machine started."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
            spawned = b"spawn_main" in (folder / "cmdline").read_bytes()
        except (OSError, IndexError):
            continue
        if parent == client and spawned:
            found.append(int(folder.name))
    return found
