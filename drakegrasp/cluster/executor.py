"""Tasks on Dask's workers, some of which die.

In: a function and items. Out: the results, in any order. A few tasks per worker are in
flight, whatever their number, and nothing is kept of those that are done. Items that take
next to no time go several to a task, as each task costs some messages. A task whose
worker died is given to another: that it comes to an end is the items' own business (see
`drakegrasp.runtime.journal`), so the number of deaths is bounded generously. One that got an image
of nothing is tried again, too, as it may be one worker's OpenGL.

Without any worker the work waits where others may come: from SLURM's queue, or to a
scheduler that somebody runs. Those that this process started itself do not come back.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError
from dataclasses import dataclass
from itertools import islice
from queue import Empty, SimpleQueue
from typing import Any, Generic, TypeVar, cast

from distributed import Client, Future, KilledWorker, LocalCluster
from distributed.core import Status
from distributed.deploy import Cluster

from drakegrasp.errors import BlankImageError, MachineError
from drakegrasp.runtime.executor import Crew

T = TypeVar("T")
R = TypeVar("R")

#: Tasks in flight per worker: one that runs, and one so that it never waits.
IN_FLIGHT = 2
#: Items go together until their task takes about so long [s]: many times what its messages do.
TASK_SECONDS = 0.25
#: Most items of a task: the next ones may take far longer than the last ones did.
LARGEST = 4
#: How often the workers are counted [s].
COUNT_SECONDS = 2.0
#: How long a result may take from a worker to here, until the workers are counted again [s].
GATHER_SECONDS = 30.0
#: How long there may be no worker at all where none come by themselves [s].
LOST_SECONDS = 300.0
#: How long until it is said that there is none [s]; shorter gaps are those of restarts.
SAY_SECONDS = 60.0
#: How often a task is given out again after Dask gave it up (after four deaths each time).
RESUBMISSIONS = 100
#: How often a task may get an image of nothing.
BLANKS = 3
_GOES_ON = "the same command goes on from here"


@dataclass(eq=False)
class _Flight(Generic[T]):
    """A task that was given out: some items, one after the other."""

    items: Sequence[T]
    future: Future | None = None
    given_up: int = 0
    blank: int = 0


@dataclass(frozen=True)
class _Landing(Generic[R]):
    """What a task brings back: the results of its first items, one at least."""

    results: list[R]
    seconds: float


def _run_items(function: Callable[[T], R], items: Sequence[T]) -> _Landing[R]:
    """Return the results up to the first item that raises; if that is the first, raise it.

    So an error comes back as Dask sends errors, and costs no results.
    """
    start, results = time.monotonic(), list[R]()
    for item in items:
        try:
            results.append(function(item))
        except Exception:
            if not results:
                raise
            break
    return _Landing(results, time.monotonic() - start)


class DaskExecutor:
    """An `Executor` that keeps a few tasks per worker in flight on a Dask cluster."""

    def __init__(self, client: Client, *, resubmissions: int = 0) -> None:
        """Work through a client.

        Args:
            client: Of the cluster.
            resubmissions: How often a task is given out again that Dask gave up because its
                workers died.
        """
        self._client, self._resubmissions = client, resubmissions
        self._workers: set[str] = set()
        self._counted = -float("inf")
        self._lost: float | None = None
        self._said = False
        self._together = 1
        self.crew = Crew()

    def __call__(self, function: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
        """Yield function(item) of every item as they are done.

        Raises:
            MachineError: If the workers died of an item again and again, or all of them or
                the scheduler are lost.
            Exception: What the function raised.
        """
        waiting, self._together = iter(items), 1
        arrived: SimpleQueue[str] = SimpleQueue()
        flights: dict[str, _Flight[T]] = {}

        def launch(flight: _Flight[T]) -> None:
            # A task writes files, so it is never the same as one that was done before.
            future = self._client.submit(_run_items, function, flight.items, pure=False)
            flight.future, flights[future.key] = future, flight
            future.add_done_callback(lambda done: arrived.put(done.key))

        while True:
            self._count()
            while len(flights) < IN_FLIGHT * max(1, len(self._workers)):
                together = tuple(islice(waiting, self._together))
                if not together:
                    break
                launch(_Flight(together))
            if not flights:
                return
            flight = flights.pop(self._next(arrived))
            try:
                landing: _Landing[R] = self._result(cast(Future, flight.future))
            except (KilledWorker, BlankImageError) as error:
                self._refuse_more(flight, error)
                launch(flight)
                continue
            self._adapt(landing)
            left = flight.items[len(landing.results) :]
            if left:
                launch(_Flight(left))
            yield from landing.results

    def _adapt(self, landing: _Landing[Any]) -> None:
        """Choose how many of the next items go together, by how long the last ones took."""
        fit = TASK_SECONDS * len(landing.results) / max(landing.seconds, 1e-6)
        self._together = int(max(1, min(fit, 2 * self._together, LARGEST)))

    def _result(self, future: Future) -> Any:
        """Return the result of a task that is done, or raise what it raised."""
        while not future.cancelled():
            try:
                return future.result(timeout=GATHER_SECONDS)
            except (CancelledError, TimeoutError):
                if future.status == "error":
                    raise
                self._count()
        raise _scheduler_lost("none any more")

    def _refuse_more(self, flight: _Flight[Any], error: Exception) -> None:
        """Refuse to give a task out again for ever.

        Raises:
            MachineError: If it failed too often in ways that are not its own.
        """
        if isinstance(error, BlankImageError):
            flight.blank += 1
            if flight.blank == BLANKS:
                raise error
            return
        flight.given_up += 1
        if flight.given_up > self._resubmissions:
            raise MachineError(f"the workers must stay alive, got: {error}") from None

    def _next(self, arrived: SimpleQueue[str]) -> str:
        """Return the key of a task that is done, once there is one.

        Raises:
            MachineError: If there is no worker for long.
        """
        while True:
            try:
                return arrived.get(timeout=COUNT_SECONDS)
            except Empty:
                self._count()

    def _count(self) -> None:
        """Count the workers, now and then.

        Raises:
            MachineError: If the scheduler is lost, or all workers are for long.
        """
        now = time.monotonic()
        if now - self._counted < COUNT_SECONDS:
            return
        self._counted = now
        try:
            found = set(self._client.nthreads())
        except (OSError, RuntimeError, TimeoutError) as error:
            raise _scheduler_lost(str(error)) from None
        joined, left = found - self._workers, self._workers - found
        if joined or left:
            self._workers, self.crew.size = found, len(found)
            self.crew.on_change(joined, left)
        if isinstance(self._client.cluster, LocalCluster):
            self._client.cluster.loop.add_callback(_reopen, self._client.cluster)
        self._wait(now)

    def _wait(self, now: float) -> None:
        """Say that there is no worker, if there is none for long.

        Raises:
            MachineError: If none will come either.
        """
        if self._workers:
            self._lost = None
            return
        if self._lost is None:
            self._lost, self._said = now, False
        missed = now - self._lost
        if missed > LOST_SECONDS and not _may_come(self._client.cluster):
            raise MachineError(
                f"there must be a worker, got none for {LOST_SECONDS:g} s; {_GOES_ON}"
            )
        if missed > SAY_SECONDS and not self._said:
            self._said = True
            self.crew.on_none()


def _scheduler_lost(got: str) -> MachineError:
    return MachineError(f"the scheduler must stay, got: {got}; {_GOES_ON}")


def _may_come(cluster: Cluster | None) -> bool:
    """Return whether workers may come by themselves: to a scheduler of others, or from a queue."""
    return cluster is None or hasattr(cluster, "job_script")


def _reopen(cluster: LocalCluster) -> None:
    """Replace the nannies of a cluster on this machine that gave up.

    One does when its worker dies while it starts; Dask drops one whose worker stays away for
    long. To be called in the cluster's event loop.
    """
    for name, nanny in list(cluster.workers.items()):
        if nanny.status in (Status.closed, Status.failed):
            del cluster.workers[name]
    if cluster.workers.keys() != cluster.worker_spec.keys():
        cluster.scale(len(cluster.worker_spec))
