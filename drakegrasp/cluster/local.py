"""Workers on this machine that nobody else on it can use.

Every user of a machine reaches the ports of its loopback address, and whoever connects to a Dask
process can run any program in it. So all connections need a certificate, which this process makes
and hands to its workers through a pipe. HTTP servers ask for none, so they are not started.
"""

from __future__ import annotations

import logging
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker
from typing import Any

from distributed import Nanny, Scheduler, SpecCluster, Worker
from distributed.security import Security
from distributed.utils import LoopRunner
from tornado.ioloop import IOLoop

from drakegrasp.cluster.request import LOOPBACK


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
def undisturbed_loop() -> Iterator[IOLoop]:
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
