"""Who does the work: the plain loop, and what any other way to run tasks looks like.

`run_here` is the plain loop; `drakegrasp.cluster.executor` has the one on Dask.
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
        """Yield function(item) of every item; items are taken as there is room for them."""


@dataclass
class Crew:
    """The worker processes of an executor: each is started again when it dies.

    Attributes:
        size: Their number now.
        on_change: Called with the addresses of those that joined and of those that left.
        on_none: Called once when there is none for long, and the work waits for one.
    """

    size: int = 0
    on_change: Callable[[set[str], set[str]], None] = lambda joined, lost: None
    on_none: Callable[[], None] = lambda: None


def run_here(function: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
    """Run in this process, one after the other: for tests and debuggers."""
    return (function(item) for item in items)
