"""Connecting to Dask: a running scheduler, or workers on this machine that nobody else can use.

Every user of a machine reaches the ports of its loopback address, and whoever connects to a Dask
process can run any program in it. So all connections need a certificate, which this process makes
and hands to its workers through a pipe. HTTP servers ask for none, so they are not started.
"""

from __future__ import annotations

import importlib.util
import json
import logging
import multiprocessing
import os
import signal
import sys
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from multiprocessing import resource_tracker
from pathlib import Path
from time import monotonic, sleep
from typing import Any, TypedDict

import dask
from distributed import Client, Nanny, Scheduler, SpecCluster, Worker
from distributed.security import Security
from distributed.utils import LoopRunner
from tornado.ioloop import IOLoop

from drakegrasp.cluster.certificates import chosen_security
from drakegrasp.errors import ConfigError, MachineError
from drakegrasp.generation.prepare import PREPARE_SECONDS
from drakegrasp.runtime.allocator import PRELOAD, SETTINGS, kept_variables
from drakegrasp.runtime.executor import count_workers, refuse_to_start_workers
from drakegrasp.runtime.journal import wall_limit

#: Address that only this machine can reach.
LOOPBACK = "127.0.0.1"
#: How long to wait for a scheduler to answer, and how long it may take to write its file [s].
CONNECT_SECONDS, WRITE_SECONDS = 10, 2
#: Module that a nanny loads before it starts its worker: it chooses the worker's allocator.
NANNY_PRELOAD = "drakegrasp.runtime.allocator"
#: Tasks that the scheduler gives to a worker, per thread: a task that waits behind another would
#: be blamed as well, when that one kills the worker.
SATURATION = 1.0
#: Time without a sign of life after which the scheduler gives a worker up [s]: longer than the
#: limits of every step (see `runtime.journal`). A step that holds the interpreter gives none, and
#: its journal tells more than the scheduler knows. A lost connection is noticed at once.
SILENCE_SECONDS = 2.0 * wall_limit(PREPARE_SECONDS)
#: The variable that chooses a kernel of OpenBLAS, read when the library is loaded.
BLAS_KERNEL = "OPENBLAS_CORETYPE"
#: The environment variables that every worker gets, on this machine and on others. Software OpenGL
#: and BLAS would start threads beside the one process per core, and nothing that a worker does
#: needs the network.
WORKER_ENVIRONMENT = {
    "LP_NUM_THREADS": "0",
    "DRAKE_ALLOW_NETWORK": "none",
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
}


class Workers(TypedDict, total=False):
    """Where a public call has its work done if it is given no client; see `connect`."""

    workers: int | None
    scheduler: str | None
    scheduler_file: str | Path | None
    tls: bool
    tls_files: tuple[Path, Path, Path] | None


def start_environment() -> dict[str, str]:
    """Return the environment variables of workers that we start.

    Which kernel OpenBLAS runs is left to each machine, unless the caller's environment says it: the
    last bits of a lift depend on it (`docs/explanation/determinism.md`).
    """
    kernel = {name: os.environ[name] for name in (BLAS_KERNEL,) if name in os.environ}
    return {**WORKER_ENVIRONMENT, **kernel}


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


def dask_variables(settings: Mapping[str, Any]) -> dict[str, str]:
    """Return settings of Dask as environment variables of a process that inherits nothing."""
    return {
        "DASK_" + key.upper().replace(".", "__").replace("-", "_"): repr(value)
        for key, value in settings.items()
    }


def dashboard_line(client: Client) -> str:
    """Return the link to the dashboard of a client's cluster, or how to install one."""
    if not has_dashboard():
        return "dashboard: none; pip install 'drakegrasp[dashboard]'"
    return f"dashboard: {client.dashboard_link}"


def has_dashboard() -> bool:
    """Return whether Dask can serve its dashboard in this environment."""
    return importlib.util.find_spec("bokeh") is not None


def connect(
    workers: int | None = None,
    scheduler: str | None = None,
    scheduler_file: str | Path | None = None,
    *,
    tls: bool = True,
    tls_files: tuple[Path, Path, Path] | None = None,
    memory: str | None = None,
) -> AbstractContextManager[Client]:
    """Return what gives a Dask client while a block runs, for any number of calls.

    >>> with connect(workers=8) as client:                                  # doctest: +SKIP
    ...     verdicts = verify_grasps(grasps, on=data, client=client)

    Args:
        workers: Processes on this machine, which are started; one per core if None.
        scheduler: Address of a running Dask scheduler to use instead.
        scheduler_file: Its JSON file, instead of the address.
        tls: Whether the scheduler must want a certificate.
        tls_files: Certificate authority, certificate and private key (PEM). Without them workers
            on this machine get some of their own, and a running scheduler gets those of Dask's
            settings (`distributed.comm.tls`).
        memory: Limit per process on this machine, e.g. "2GB"; an equal share of it if None.

    Raises:
        ConfigError: If the number of workers is below one or given with a scheduler, the address
            is empty, the choice of TLS contradicts itself, or the scheduler wants no certificate
            although `tls` says so.
        MachineError: If there is no scheduler at the address.
    """
    # Python imports a script into each process that it starts: a call that is not under
    # `if __name__ == "__main__"` would begin there as well.
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        sys.exit(1)
    elsewhere = bool(scheduler or scheduler_file)
    if scheduler is not None and not scheduler.strip():
        raise ConfigError(f"scheduler must be an address like tls://host:8786, got {scheduler!r}")
    if workers is not None and elsewhere:
        raise ConfigError("workers must not be given with a scheduler, which has its own")
    count = count_workers(workers)
    security = chosen_security(tls, tls_files, elsewhere=elsewhere)

    @contextmanager
    def connected() -> Iterator[Client]:
        # Dask sets variables here for the workers that it starts here.
        with kept_variables(PRELOAD, SETTINGS), dask.config.set(dask_settings()):
            if elsewhere:
                cluster = _connect_remote(scheduler, scheduler_file, security, tls)
            else:
                cluster = _start_local(count, security, memory or "auto")
            with cluster as client:
                yield client

    return connected()


def joined(client: Client | None, workers: Workers) -> AbstractContextManager[Client]:
    """Return the caller's client, or what connects to the workers that a public call asks for.

    Raises:
        ConfigError: If both are given; as `connect`.
    """
    if client is None:
        return connect(**workers)
    if workers:
        raise ConfigError(f"{next(iter(workers))} must not be given with a client, got both")
    return nullcontext(client)


def _connect_remote(
    scheduler: str | None, scheduler_file: str | Path | None, security: Security | None, tls: bool
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


@contextmanager
def _start_local(workers: int, security: Security | None, memory: str) -> Iterator[Client]:
    refuse_to_start_workers()
    with _undisturbed_loop() as loop:
        try:
            cluster = PrivateCluster(workers, loop=loop, security=security, memory=memory)
        except RuntimeError as error:
            raise MachineError(
                f"worker processes must start, got: {error}; in a script, the call must be under "
                'if __name__ == "__main__":'
            ) from None
        with closing_cluster(cluster), Client(cluster) as client:
            yield client


class _QuietScheduler(Scheduler):
    """A scheduler without an HTTP server; no option of Dask leaves it out (distributed 2026.8)."""

    def start_http_server(self, *_: Any, **__: Any) -> None:
        """Open no port."""


class _QuietWorker(Worker):
    """A worker without an HTTP server."""

    def start_http_server(self, *_: Any, **__: Any) -> None:
        """Open no port."""


class PrivateCluster(SpecCluster):
    """A scheduler in this process, and workers of one thread, each under a nanny.

    Its start may be interrupted. Dask cannot close a cluster that has not started, and at the end
    of the program a traceback would say so (distributed 2026.8). Its processes end with this one
    all the same.
    """

    def __init__(
        self, workers: int, *, loop: IOLoop, security: Security | None = None, memory: str
    ) -> None:
        """Start the cluster.

        Args:
            workers: Number of processes.
            loop: Event loop in which the scheduler and the nannies run.
            security: Certificates; made for this cluster, and in memory only, if None.
            memory: Limit per process, e.g. "2GB"; "auto" for an equal share.
        """
        security = security or Security.temporary()
        server = {"host": LOOPBACK, "protocol": "tls://", "security": security}
        nanny = {
            "cls": Nanny,
            "options": {
                **server,
                "worker_class": _QuietWorker,
                "nthreads": 1,
                "memory_limit": memory,
                "silence_logs": logging.CRITICAL,
            },
        }
        scheduler = {
            "cls": _QuietScheduler,
            "options": {**server, "port": 0, "dashboard": False},
        }
        try:
            super().__init__(
                dict.fromkeys(range(workers), nanny),
                scheduler,
                nanny,
                loop=loop,
                security=security,
                silence_logs=logging.CRITICAL,
            )
        except BaseException:
            self._instances.discard(self)
            # A nanny whose worker did not start would tell this loop's log, which nobody reads.
            loop.asyncio_loop.set_exception_handler(lambda *_: None)  # type: ignore[attr-defined]
            raise


@contextmanager
def _undisturbed_loop() -> Iterator[IOLoop]:
    """Run an event loop in a thread that no Ctrl-C reaches, nor the processes that it starts.

    At a terminal Ctrl-C goes to every process. The client stops then, and its workers with it; one
    that has just begun to start would print a traceback instead.
    """
    # The first process that a thread starts also starts this one, and clears the thread's mask.
    resource_tracker.ensure_running()
    runner = LoopRunner()
    runner.start()
    try:
        runner.run_sync(_block_interrupts)
        yield runner.loop
    finally:
        runner.stop()


async def _block_interrupts() -> None:
    # Threads and processes that this thread starts inherit the mask.
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
