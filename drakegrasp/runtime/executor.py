"""How tasks are run: the protocol of executors, the plain loop, and processes of this machine.

`run_here` is the plain loop; `processes` provides an executor for work for which no cluster is
started; `drakegrasp.cluster.executor` has the executor on Dask.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import islice
from multiprocessing import resource_tracker
from multiprocessing.connection import wait as wait_for
from pathlib import Path
from typing import Protocol, Self, TypeVar, runtime_checkable

from drakegrasp.errors import ConfigError, MachineError
from drakegrasp.runtime.environment import available_cores

T = TypeVar("T")
R = TypeVar("R")

#: Maximum number of workers; a larger number is a typing error.
MOST_PROCESSES = 10_000
#: Work that ends within this time [s] starts no processes, since starting them takes seconds.
ALONE_SECONDS = 5.0


class Executor(Protocol):
    """Runs a function on items in any process, and yields the results in any order."""

    def __call__(self, function: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
        """Yield function(item) for every item; items are taken only when workers become free."""


@runtime_checkable
class FileTask(Protocol):
    """A task that works on files of a dataset; a worker that does not see them gets copies.

    A place is a file's path within a directory, with slashes.
    """

    def reads(self) -> dict[str, Path]:
        """Return the existing input files of the task, keyed by place."""

    def writes(self) -> tuple[str, ...]:
        """Return the places of the files that the task writes or removes."""

    def moved(self, folder: Path) -> Self:
        """Return the task in a directory that holds the files at their places."""


@dataclass
class WorkerPool:
    """The worker processes of an executor; a worker that dies is started again.

    Attributes:
        size: Current number of workers.
    """

    size: int = 0


def run_here(function: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
    """Run in this process, one item after the other, for tests and debuggers."""
    return (function(item) for item in items)


def in_order(execute: Executor) -> Executor:
    """Return an executor that yields the results in the order of the items.

    Results that arrive early wait in memory.
    """

    def run(function: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
        early: dict[int, R] = {}
        due = 0
        results = execute(partial(_numbered, function), enumerate(items))
        try:
            for number, result in results:
                early[number] = result
                while due in early:
                    yield early.pop(due)
                    due += 1
        finally:
            # Closing this iterator ends the work as well.
            close = getattr(results, "close", None)
            if close is not None:
                close()

    return run


def _numbered(function: Callable[[T], R], item: tuple[int, T]) -> tuple[int, R]:
    """Return the number of an item and its result."""
    number, argument = item
    return number, function(argument)


def count_workers(workers: int | None, name: str = "workers") -> int:
    """Return how many processes of this machine to start; one per core if None.

    Args:
        workers: The number.
        name: Name of the number, for the error message.

    Raises:
        ConfigError: If the number is not valid.
    """
    if workers is not None and workers < 1:
        raise ConfigError(f"{name} must be at least 1, got {workers}")
    if workers is not None and workers > MOST_PROCESSES:
        raise ConfigError(f"{name} must be at most {MOST_PROCESSES:,}, got {workers}")
    return available_cores() if workers is None else workers


def validate_can_start_processes() -> None:
    """Raise an error if processes cannot be started here.

    Raises:
        MachineError: If this process may not have children, or if its script is not a file, which
            each process that Python starts would import.
    """
    if multiprocessing.current_process().daemon:
        raise MachineError(
            "workers must be started by a process that may have children, got one of a "
            "multiprocessing Pool or a Dask worker: make the call outside of it, under "
            'if __name__ == "__main__":'
        )
    main = sys.modules["__main__"]
    script = getattr(main, "__file__", None)
    if getattr(main, "__spec__", None) is None and script and not os.path.isfile(script):
        raise MachineError(
            f"a script that starts workers must be a file, as each of them imports it, got "
            f'{script}: save it, with the call under if __name__ == "__main__":'
        )


@contextmanager
def processes(workers: int | None = None) -> Iterator[Executor]:
    """Run tasks in processes of this machine while the block runs; one worker is this process.

    Args:
        workers: Number of processes. If None, there is one per core, and this process does the work
            of the first `ALONE_SECONDS`: small datasets need no other process.

    Raises:
        ConfigError: If the number of processes is not valid.
    """
    count = count_workers(workers)
    if count == 1:
        yield run_here
        return

    # A forked process could hang, since this process may have threads.
    context = multiprocessing.get_context("spawn")
    resource_tracker.ensure_running()  # starting it clears the signal mask of the calling thread
    pool = ProcessPoolExecutor(count, mp_context=context, initializer=_begin_worker)
    try:
        alone = ALONE_SECONDS if workers is None else 0.0
        yield _PoolExecutor(pool, 2 * count, time.monotonic() + alone)
    finally:
        pool.shutdown(cancel_futures=True)


@dataclass(frozen=True)
class _PoolExecutor:
    """An `Executor` on a pool of processes.

    Attributes:
        pool: The pool.
        in_flight: Number of tasks that run or wait for a process.
        alone_until: Time by the monotonic clock until which this process does the work [s].
    """

    pool: ProcessPoolExecutor
    in_flight: int
    alone_until: float

    def __call__(self, function: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
        """Yield function(item) for every item as soon as it is done.

        Raises:
            MachineError: If a process died or cannot start.
            Exception: What the function raised.
        """
        remaining, pending = iter(items), set[Future[R]]()
        while time.monotonic() < self.alone_until and (first := list(islice(remaining, 1))):
            yield function(first[0])
        try:
            while True:
                for item in islice(remaining, self.in_flight - len(pending)):
                    # The first submission starts the processes.
                    validate_can_start_processes()
                    with _interrupts_blocked():
                        pending.add(self.pool.submit(function, item))
                if not pending:
                    return
                done, pending = wait(pending, return_when=FIRST_COMPLETED)
                for future in done:
                    yield future.result()
        except BrokenProcessPool:
            raise MachineError(
                "a worker process died; if memory is short, fewer --workers need less"
            ) from None
        finally:
            # Tasks that have begun are finished, so that nothing is written after this call.
            for future in pending:
                future.cancel()
            wait(pending)


@contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Keep Ctrl-C from processes that start within the block, and from this one until it ends.

    A terminal sends Ctrl-C to every process; a process that has just started would print a
    traceback.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _begin_worker() -> None:
    """Leave Ctrl-C to the parent process, and end when it ends, whatever the reason."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def end() -> None:
        wait_for([parent.sentinel])
        os._exit(1)

    threading.Thread(target=end, daemon=True).start()
