"""How tasks are run: the protocol of executors, and the plain loop.

`run_here` is the plain loop; `drakegrasp.cluster.executor` has the executor on Dask.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Protocol, TypeVar

T = TypeVar("T")
R = TypeVar("R")


class Executor(Protocol):
    """Runs a function on items, somewhere, and yields the results in any order."""

    def __call__(self, function: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
        """Yield function(item) of every item; items are taken only as workers become free."""


@dataclass
class WorkerPool:
    """The worker processes of an executor; each is started again when it dies.

    Attributes:
        size: Number of workers now.
        kernel: BLAS kernel that the workers run; None if they have none in common.
        on_change: Called with the addresses of workers that joined and of those that left.
        on_none: Called once when there has been no worker for long, and the work waits for one.
    """

    size: int = 0
    kernel: str | None = None
    on_change: Callable[[set[str], set[str]], None] = lambda joined, left: None
    on_none: Callable[[], None] = lambda: None


def run_here(function: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
    """Run in this process, one item after the other: for tests and debuggers."""
    return (function(item) for item in items)
