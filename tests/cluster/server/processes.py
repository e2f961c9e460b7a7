"""Starting, awaiting and stopping the servers of a test."""

from __future__ import annotations

import socket
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

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
) -> Iterator[None]:
    """Run a server that stays in the foreground while the block runs; then stop it."""
    with log.open("wb") as output:
        process = subprocess.Popen(
            [str(word) for word in command], stdout=output, stderr=subprocess.STDOUT, env=env
        )
    try:
        yield
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
