"""Starting, awaiting and stopping the servers of a test, also of Dask."""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from distributed import LocalCluster

#: How long a server may take to start or to stop [s].
PATIENCE = 60.0


def free_port() -> int:
    """Return a TCP port of this machine that nobody listens on now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def daemon(
    command: Sequence[str | Path], log: Path, env: dict[str, str] | None = None
) -> Iterator[subprocess.Popen[bytes]]:
    """Run a server that stays in the foreground while the block runs; then stop it."""
    with log.open("wb") as output:
        process = subprocess.Popen(
            [str(word) for word in command], stdout=output, stderr=subprocess.STDOUT, env=env
        )
    try:
        yield process
    finally:
        process.terminate()
        try:
            process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def wait_until(ready: Callable[[], bool], what: str, log: Path) -> None:
    """Wait until a server is ready.

    Raises:
        TimeoutError: If it is not in time; with the end of its log.
    """
    end = time.monotonic() + PATIENCE
    while not ready():
        if time.monotonic() > end:
            tail = log.read_text(errors="replace")[-2000:] if log.exists() else ""
            raise TimeoutError(f"{what} must be ready within {PATIENCE:g} s; its log ends: {tail}")
        time.sleep(0.2)


def small_cluster(workers: int, threads: int = 1) -> LocalCluster:
    """Return a Dask cluster in this process."""
    there = {"processes": False, "dashboard_address": "127.0.0.1:0"}
    return LocalCluster(n_workers=workers, threads_per_worker=threads, **there)


@contextmanager
def dask_scheduler(
    folder: Path, *options: str, env: dict[str, str] | None = None
) -> Iterator[tuple[subprocess.Popen[bytes], list[str]]]:
    """Run a Dask scheduler and one worker of one thread in processes of their own.

    Yields the scheduler, and the command of a further worker; its file is `scheduler.json`.

    Args:
        folder: For their files.
        *options: Of both.
        env: Their environment.
    """
    file, log = folder / "scheduler.json", folder / "dask.log"
    common = [*options, "--scheduler-file", str(file)]
    address = ["--host", "127.0.0.1", "--port", "0", "--dashboard-address", "127.0.0.1:0"]
    command = [sys.executable, "-m", "distributed.cli.dask_scheduler", *address, *common]
    join = [sys.executable, "-m", "distributed.cli.dask_worker", *common]
    with daemon(command, log, env) as scheduler:
        wait_until(file.exists, "the scheduler", log)
        with daemon([*join, "--nthreads", "1"], folder / "worker.log", env):
            yield scheduler, join
