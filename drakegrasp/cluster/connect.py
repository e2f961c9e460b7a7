"""Connects to Dask: to a running scheduler, or to workers on this machine that only we can use.

All users of a machine can reach the ports of its loopback address, and whoever connects to a Dask
process can run any program in it. So all connections need a certificate, which this process creates
and sends to its workers through a pipe. Dask's HTTP servers do not require certificates, so they
are not started.
"""

from __future__ import annotations

import importlib.util
import logging
import multiprocessing
import os
import shutil
import signal
import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from multiprocessing import resource_tracker
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypedDict

import dask
from distributed import Client, Nanny, Scheduler, SpecCluster, Worker
from distributed.security import Security
from distributed.utils import LoopRunner
from tornado.ioloop import IOLoop

from drakegrasp.errors import ConfigError, MachineError
from drakegrasp.foreign_files import read_json
from drakegrasp.generation.prepare import PREPARE_SECONDS
from drakegrasp.runtime.executor import count_workers, validate_can_start_processes
from drakegrasp.runtime.journal import wall_limit

#: Address that only this machine can reach.
LOOPBACK = "127.0.0.1"
#: How long to wait for a scheduler to answer [s].
CONNECT_SECONDS = 10
#: Number of tasks that the scheduler sends to a worker per thread. If a running task kills the
#: worker, Dask would also blame a task that waits behind it.
SATURATION = 1.0
#: Time without a heartbeat after which the scheduler gives up a worker [s]. It is longer than the
#: limit of every step (see `runtime.journal`), because a step that holds the interpreter prevents
#: heartbeats, and the journal detects a hang better than the scheduler. A lost connection is
#: noticed at once.
SILENCE_SECONDS = 2.0 * wall_limit(PREPARE_SECONDS)
#: Environment variable that chooses the kernel of OpenBLAS; it is read when the library is loaded.
BLAS_KERNEL = "OPENBLAS_CORETYPE"
#: Environment variables of every worker, on this machine and on others. They prevent software
#: OpenGL and BLAS from starting threads in addition to the one process per core, and programs from
#: using the network, which workers do not need.
WORKER_ENVIRONMENT = {
    "LP_NUM_THREADS": "0",
    "DRAKE_ALLOW_NETWORK": "none",
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
}


# Certificates, which are created for one run or given by the user. Certificates for processes on
# other machines are files that only this user can read.


def make_certificates(folder: Path) -> tuple[Path, Path, Path]:
    """Write an authority, a certificate and its key as ca.pem, cert.pem and key.pem to a folder.

    Any user who can read these files can use the cluster, so the folder must be private.
    """
    security = Security.temporary()
    paths = folder / "ca.pem", folder / "cert.pem", folder / "key.pem"
    texts = security.tls_ca_file, security.tls_worker_cert, security.tls_worker_key
    for path, text in zip(paths, texts, strict=True):
        path.touch(mode=0o600)
        path.write_text(text, encoding="ascii")
    return paths


def chosen_security(
    tls: bool, files: tuple[Path, Path, Path] | None, *, elsewhere: bool
) -> Security | None:
    """Return the certificates that a caller gives; None if the caller gives none.

    Args:
        tls: Whether connections need a certificate.
        files: Authority, certificate and private key.
        elsewhere: Whether workers or scheduler are not started on this machine.

    Raises:
        ConfigError: If the choice contradicts itself.
    """
    if not tls and not elsewhere:
        raise ConfigError(
            "--no-tls (tls=False) must not be given for workers on this machine: every user of it "
            "could run programs as you"
        )
    if not tls and files is not None:
        raise ConfigError("--no-tls (tls=False) must not be given with certificates")
    return None if files is None else security_of(files)


def security_of(files: tuple[Path, Path, Path]) -> Security:
    """Return Dask's security settings, which use the same certificate for every role."""
    ca, cert, key = (str(path.absolute()) for path in files)
    options: dict[str, Any] = {"require_encryption": True, "tls_ca_file": ca}
    for role in ("client", "scheduler", "worker"):
        options |= {f"tls_{role}_cert": cert, f"tls_{role}_key": key}
    return Security(**options)


@contextmanager
def made_or_given(
    tls: bool, files: tuple[Path, Path, Path] | None, out: Path
) -> Iterator[Security | None]:
    """Yield the certificates that a caller gives, or new ones that are removed afterwards.

    Args:
        tls: Whether connections need a certificate; if not, None is yielded.
        files: Authority, certificate and private key; None for new ones.
        out: Directory that all machines see, for new ones. Those of killed clients are removed,
            because the caller holds the lock of the directory.
    """
    given = chosen_security(tls, files, elsewhere=True)
    if given is not None or not tls:
        yield given
        return
    out.mkdir(parents=True, exist_ok=True)
    for leftover in out.glob(".tls-*"):
        shutil.rmtree(leftover, ignore_errors=True)
    with TemporaryDirectory(prefix=".tls-", dir=out) as folder:  # only this user can enter it
        yield security_of(make_certificates(Path(folder)))


# Connections.


class Workers(TypedDict, total=False):
    """Workers of a public call that is given no client; see `connect`."""

    workers: int | None
    scheduler: str | None
    scheduler_file: str | Path | None
    tls: bool
    tls_files: tuple[Path, Path, Path] | None


def start_environment() -> dict[str, str]:
    """Return the environment variables of workers that we start.

    The kernel of OpenBLAS is that of the caller's environment, because the last bits of a lift
    depend on it (`docs/explanation/determinism.md`). If the caller chooses none, each machine does.
    """
    kernel = {name: os.environ[name] for name in (BLAS_KERNEL,) if name in os.environ}
    return {**WORKER_ENVIRONMENT, **kernel}


def dask_settings() -> dict[str, Any]:
    """Return the Dask settings for every scheduler, nanny and worker that we start."""
    return {
        # A forked process hangs if its parent has rendered an image.
        "distributed.worker.multiprocessing-method": "spawn",
        # Ctrl-C reaches every process of a terminal, but the client stops its workers itself.
        "distributed.worker.preload": [
            "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"
        ],
        # The profiler costs time.
        "distributed.worker.profile.enabled": False,
        "distributed.scheduler.worker-saturation": SATURATION,
        "distributed.scheduler.worker-ttl": f"{SILENCE_SECONDS:g}s",
        "distributed.nanny.pre-spawn-environ": start_environment(),
        # On a busy machine a worker restarts slowly, and Dask would close its nanny.
        "distributed.deploy.lost-worker-timeout": "60 s",
        "distributed.worker.memory.target": False,
        "distributed.worker.memory.spill": False,
        # A paused worker has no other task that could free memory, so it would wait forever.
        "distributed.worker.memory.pause": False,
    }


def dashboard_line(client: Client) -> str:
    """Return a line with the link to the cluster's dashboard; empty if there is none.

    Dask needs bokeh to serve it, and workers on this machine have none.
    """
    there = client.dashboard_link and importlib.util.find_spec("bokeh") is not None
    return f"dashboard: {client.dashboard_link}\n" if there else ""


def connect(
    workers: int | None = None,
    scheduler: str | None = None,
    scheduler_file: str | Path | None = None,
    *,
    tls: bool = True,
    tls_files: tuple[Path, Path, Path] | None = None,
    memory: str | None = None,
) -> AbstractContextManager[Client]:
    """Return a context manager that yields a Dask client, for any number of calls.

    >>> with connect(workers=8) as client:                                  # doctest: +SKIP
    ...     verdicts = verify_grasps(grasps, on=data, client=client)

    Args:
        workers: Number of processes to start on this machine; one per core if None.
        scheduler: Address of a running Dask scheduler to use instead.
        scheduler_file: JSON file of a running scheduler, instead of its address.
        tls: Whether the scheduler must require a certificate.
        tls_files: Certificate authority, certificate and private key (PEM). Without them, new
            certificates are created for workers on this machine, and those of Dask's settings
            (`distributed.comm.tls`) are used for a running scheduler.
        memory: Memory limit per process on this machine, e.g. "2GB"; if None, an equal part of the
            machine's memory.

    Raises:
        ConfigError: If the number of workers is below one or given with a scheduler, the address
            is empty, the choice of TLS contradicts itself, or the scheduler requires no certificate
            although `tls` is set.
        MachineError: If there is no scheduler at the address.
    """
    # Python imports the script into each process that it starts, so a call that is not under
    # `if __name__ == "__main__"` would run there as well.
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
        with dask.config.set(dask_settings()):
            if elsewhere:
                address = scheduler or _address_in(Path(str(scheduler_file)))
                cluster = _connect_remote(address, security, tls)
            else:
                cluster = _start_local(count, security, memory or "auto")
            with cluster as client:
                yield client

    return connected()


def joined(client: Client | None, workers: Workers) -> AbstractContextManager[Client]:
    """Return a context manager of the caller's client, or of a client of the requested workers.

    Raises:
        ConfigError: If both are given, or as for `connect`.
    """
    if client is None:
        return connect(**workers)
    if workers:
        raise ConfigError(f"{next(iter(workers))} must not be given with a client, got both")
    return nullcontext(client)


def validate_tls(address: str, tls: bool) -> None:
    """Reject the address of a scheduler that wants no certificate, unless `tls` is False.

    Raises:
        ConfigError: If it is such an address.
    """
    if tls and not address.startswith("tls://"):
        raise ConfigError(
            f"scheduler must have an address that begins with tls://, got {address}: anybody who "
            "reaches its port can run programs as you; --no-tls (tls=False) connects all the same"
        )


def _connect_remote(address: str, security: Security | None, tls: bool) -> Client:
    validate_tls(address, tls)
    try:
        return _RemoteClient(address, timeout=CONNECT_SECONDS, security=security)
    except (OSError, RuntimeError, TypeError, ValueError) as error:
        raise MachineError(
            f"{address}: must be a running Dask scheduler, got none ({error})"
        ) from None


def _address_in(file: Path) -> str:
    """Return the address in a scheduler's file.

    Raises:
        MachineError: If the file has none.
    """
    with suppress(OSError, ValueError, LookupError, TypeError):
        return str(read_json(file)["address"])
    raise MachineError(f"{file}: must be the file of a running Dask scheduler, got none")


class _RemoteClient(Client):
    """A client that closes at once if it cannot start.

    Dask leaves this to the garbage collector. If the collector runs while the next client starts,
    it waits forever for the lock that the next client holds (distributed 2026.8,
    `LoopRunner.stop`).
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
    """Close a cluster when the block ends; do not wait for a worker that takes long to end."""
    try:
        yield
    finally:
        # A worker that does not end within Dask's limit on a busy machine ends with this process.
        with suppress(TimeoutError):
            cluster.close()


@contextmanager
def _start_local(workers: int, security: Security | None, memory: str) -> Iterator[Client]:
    validate_can_start_processes()
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
    """A scheduler without an HTTP server, which Dask has no option to disable (2026.8)."""

    def start_http_server(self, *_: Any, **__: Any) -> None:
        """Open no port."""


class _QuietWorker(Worker):
    """A worker without an HTTP server."""

    def start_http_server(self, *_: Any, **__: Any) -> None:
        """Open no port."""


class PrivateCluster(SpecCluster):
    """A scheduler in this process, and workers with one thread, each under a nanny.

    The start may be interrupted. Dask cannot close a cluster that has not started, and would print
    a traceback at the end of the program (distributed 2026.8). The processes of the cluster end
    with this process in any case.
    """

    def __init__(
        self, workers: int, *, loop: IOLoop, security: Security | None = None, memory: str
    ) -> None:
        """Start the cluster.

        Args:
            workers: Number of processes.
            loop: Event loop in which the scheduler and the nannies run.
            security: Certificates; if None, they are created for this cluster, only in memory.
            memory: Memory limit per process, e.g. "2GB"; "auto" for equal parts of the memory.
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
        scheduler = {"cls": _QuietScheduler, "options": {**server, "port": 0, "dashboard": False}}
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
            # Do not log that a nanny's worker did not start.
            loop.asyncio_loop.set_exception_handler(lambda *_: None)  # type: ignore[attr-defined]
            raise


@contextmanager
def _undisturbed_loop() -> Iterator[IOLoop]:
    """Run an event loop in a thread that Ctrl-C does not interrupt, nor the processes it starts.

    At a terminal, Ctrl-C goes to every process, and a worker that has just begun to start would
    print a traceback. So workers ignore it, and the client stops them.
    """
    # Start the resource tracker here. Otherwise the first process that the thread starts would
    # start it, which clears the thread's signal mask.
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
