"""Connecting to Dask: a running scheduler, or a cluster on this machine."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from time import monotonic, sleep
from typing import Any

import dask
from distributed import Client, SpecCluster
from distributed.security import Security

from drakegrasp.cluster.admission import SATURATION, SILENCE_SECONDS, start_environment
from drakegrasp.cluster.local import PrivateCluster, undisturbed_loop
from drakegrasp.errors import ConfigError, MachineError
from drakegrasp.runtime.allocator import PRELOAD, SETTINGS, kept_variables
from drakegrasp.runtime.environment import available_cores
from drakegrasp.runtime.executor import refuse_to_start_workers

#: How long to wait for a scheduler to answer [s].
CONNECT_SECONDS = 10
#: How long a scheduler may take to write its file [s].
WRITE_SECONDS = 2
#: Module that a nanny loads before it starts its worker: it chooses the worker's allocator.
NANNY_PRELOAD = "drakegrasp.runtime.allocator"


def dask_settings() -> dict[str, Any]:
    """Return the settings of Dask that every scheduler, nanny and worker of ours needs."""
    return {
        # A forked process hangs if its parent has rendered an image.
        "distributed.worker.multiprocessing-method": "spawn",
        # Ctrl-C reaches every process of a terminal: the client stops, and then its workers.
        "distributed.worker.preload": [
            "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"
        ],
        # The profiler costs time.
        "distributed.worker.profile.enabled": False,
        "distributed.scheduler.worker-saturation": SATURATION,
        "distributed.scheduler.worker-ttl": f"{SILENCE_SECONDS:g}s",
        "distributed.nanny.pre-spawn-environ": start_environment(),
        "distributed.nanny.preload": [NANNY_PRELOAD],
        # On a busy machine a worker takes long to start again; Dask would close its nanny.
        "distributed.deploy.lost-worker-timeout": "60 s",
        "distributed.worker.memory.target": False,
        "distributed.worker.memory.spill": False,
        # A paused worker has no task whose end would free memory: it would wait for ever.
        "distributed.worker.memory.pause": False,
    }


def dashboard_line(client: Client) -> str:
    """Return the link to the dashboard of a client's cluster, or how to install one."""
    if not has_dashboard():
        return "dashboard: none; pip install 'drakegrasp[dashboard]'"
    return f"dashboard: {client.dashboard_link}"


def has_dashboard() -> bool:
    """Return whether Dask can serve its dashboard in this environment."""
    return importlib.util.find_spec("bokeh") is not None


@contextmanager
def connect(
    workers: int | None = None,
    scheduler: str | None = None,
    scheduler_file: str | Path | None = None,
    *,
    security: Security | None = None,
    tls: bool = True,
    memory: str | None = None,
) -> Iterator[Client]:
    """Connect to a running scheduler, or start a cluster on this machine, while the block runs.

    Args:
        workers: Processes of a cluster on this machine; one per core if None.
        scheduler: Address of a running scheduler.
        scheduler_file: Its JSON file, instead of the address.
        security: Certificates; without them a cluster on this machine makes its own, and a
            running scheduler gets those of Dask's settings (`distributed.comm.tls`).
        tls: Whether a running scheduler must want a certificate.
        memory: Limit per process on this machine, e.g. "2GB"; an equal share of it if None.

    Raises:
        ConfigError: If the scheduler wants no certificate, and should.
        MachineError: If there is no scheduler at the address.
    """
    # Dask sets variables here for the workers that it starts here.
    with kept_variables(PRELOAD, SETTINGS), dask.config.set(dask_settings()):
        if scheduler or scheduler_file:
            cluster = _connect_remote(scheduler, scheduler_file, security, tls)
        else:
            cluster = _start_local(workers, security, memory)
        with cluster as client:
            yield client


def _connect_remote(
    scheduler: str | None,
    scheduler_file: str | Path | None,
    security: Security | None,
    tls: bool,
) -> Client:
    address, file = scheduler, None if scheduler_file is None else str(scheduler_file)
    # Dask waits for a missing file for ever.
    if file is not None and not scheduler:
        if not Path(file).is_file():
            raise MachineError(f"{file}: must be the file of a running Dask scheduler, got none")
        address = _address_of(Path(file))
        if address is None:
            raise MachineError(f"{file}: must be the file of a running Dask scheduler, got another")
    if tls and not str(address).startswith("tls://"):
        raise ConfigError(
            f"scheduler must have an address that begins with tls://, got {address}: anybody who "
            "reaches its port can run programs as you; --no-tls (tls=False) connects all the same"
        )
    try:
        return _RemoteClient(
            scheduler, scheduler_file=file, timeout=CONNECT_SECONDS, security=security
        )
    except (OSError, RuntimeError, TypeError, ValueError) as error:
        raise MachineError(
            f"{scheduler or file}: must be a running Dask scheduler, got none ({error})"
        ) from None


def _address_of(file: Path) -> str | None:
    """Return the address in a scheduler's file; None if it has none.

    A scheduler that starts has made its file before it writes it: half a file is read again, for
    `WRITE_SECONDS`.
    """
    end = monotonic() + WRITE_SECONDS
    while True:
        try:
            content = json.loads(file.read_text(encoding="utf-8"))
        except OSError:
            return None
        except ValueError:
            if monotonic() > end:
                return None
            sleep(0.05)
        else:
            address = content.get("address") if isinstance(content, dict) else None
            return address if isinstance(address, str) else None


@contextmanager
def _start_local(
    workers: int | None, security: Security | None, memory: str | None
) -> Iterator[Client]:
    refuse_to_start_workers()
    with undisturbed_loop() as loop:
        try:
            cluster = PrivateCluster(
                workers or available_cores(), loop=loop, security=security, memory=memory or "auto"
            )
        except RuntimeError as error:
            raise MachineError(
                f"worker processes must start, got: {error}; in a script, the call must be under "
                'if __name__ == "__main__":'
            ) from None
        with closing_cluster(cluster), Client(cluster) as client:
            yield client


class _RemoteClient(Client):
    """A client that closes at once if it cannot start.

    Dask leaves the closing to the garbage collector. If that runs while the next client starts, it
    waits for ever for the lock that this one holds (distributed 2026.8, `LoopRunner.stop`).
    """

    def start(self, **kwargs: Any) -> None:
        """Start the client's loop and connect."""
        try:
            super().start(**kwargs)
        except BaseException:
            self.close()
            raise


@contextmanager
def closing_cluster(cluster: SpecCluster) -> Iterator[None]:
    """Close a cluster when the block ends; ignore a worker that takes long to end."""
    try:
        yield
    finally:
        # On a busy machine a worker may not end within Dask's limit: it ends with this process.
        with suppress(TimeoutError):
            cluster.close()
