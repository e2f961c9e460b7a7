"""Runs tasks on Dask's workers, some of which may die.

Input: a function and items. Output: the results, in any order. A few tasks per worker are in
flight, and a completed task is forgotten, so the memory does not grow with the number of tasks. A
task whose worker died is given to another worker. The items themselves ensure that this ends (see
`drakegrasp.runtime.journal`), so the limit on deaths is generous. A task that rendered a blank
image is retried, because the OpenGL of a single worker may be broken.

When there is no worker, the work waits if other workers may join, from a batch queue or at a
scheduler that somebody else runs. Workers that this process started itself do not come back.

`distributed.as_completed` with `add` would be a similar loop. But its iterator cannot be
interrupted while it waits, so the loss of workers would not be noticed until a task is done.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError
from dataclasses import dataclass
from itertools import islice
from queue import Empty, SimpleQueue
from typing import Any, Generic, TypeVar, cast

from distributed import Client, Future, KilledWorker
from distributed.core import Status
from distributed.deploy import Cluster

from drakegrasp.cluster.connect import PrivateCluster
from drakegrasp.errors import BlankImageError, MachineError
from drakegrasp.runtime.executor import WorkerPool

T = TypeVar("T")
R = TypeVar("R")

#: Number of tasks in flight per worker: one that runs, and one that waits, to keep the worker busy.
IN_FLIGHT = 2
#: Time between two counts of the workers [s].
COUNT_SECONDS = 2.0
#: Time that the transfer of a result may take before the workers are counted again [s].
GATHER_SECONDS = 30.0
#: Time without any worker after which the work stops, if no worker can join by itself [s].
LOST_SECONDS = 300.0
#: Time without any worker after which the user is told [s]; shorter gaps are restarts.
SAY_SECONDS = 60.0
#: How often a task is submitted again after Dask gave up on it (after four deaths each time).
RESUBMISSIONS = 100
#: How often a task may render a blank image.
BLANKS = 3
_CONTINUES = "the same command continues from here"


@dataclass(eq=False)
class _PendingTask(Generic[T]):
    """A task in flight.

    Attributes:
        item: Item with which the function is called.
        future: Future of the task's last submission.
        given_up: Number of times that Dask gave up on the task.
        blank: Number of times that the task rendered a blank image.
    """

    item: T
    future: Future | None = None
    given_up: int = 0
    blank: int = 0


class DaskExecutor:
    """An `Executor` that keeps a few tasks per worker in flight on a Dask cluster.

    Attributes:
        pool: The workers.
    """

    def __init__(self, client: Client, *, resubmissions: int = 0) -> None:
        """Use the workers of a client.

        Args:
            client: Client of the cluster.
            resubmissions: Number of times to submit a task again after Dask gave up on it because
                its workers died.
        """
        self._client, self._resubmissions = client, resubmissions
        self._workers: set[str] = set()
        self._counted = -float("inf")
        self._empty_since: float | None = None
        self._said = False
        self.pool = WorkerPool()

    def __call__(self, function: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
        """Yield function(item) for every item, in the order in which they are done.

        Raises:
            MachineError: If an item kills its workers repeatedly, or all workers or the scheduler
                are lost.
            Exception: The error that the function raised.
        """
        remaining = iter(items)
        done: SimpleQueue[str] = SimpleQueue()
        pending: dict[str, _PendingTask[T]] = {}

        while True:
            # Keep a few tasks per worker in flight; take items only when they can be submitted.
            self._count_workers()
            room = IN_FLIGHT * max(1, len(self._workers)) - len(pending)
            for item in islice(remaining, max(0, room)):
                self._submit(function, _PendingTask(item), pending, done)
            if not pending:
                return

            # Wait for a task. If it failed because of its worker, submit it again.
            task = pending.pop(self._next_done(done))
            try:
                result: R = self._gather(cast(Future, task.future))
            except (KilledWorker, BlankImageError) as error:
                self._count_failure(task, error)
                self._submit(function, task, pending, done)
            else:
                yield result

    def _submit(
        self,
        function: Callable[[T], R],
        task: _PendingTask[T],
        pending: dict[str, _PendingTask[T]],
        done: SimpleQueue[str],
    ) -> None:
        """Submit a task; its key goes into `done` when it ends."""
        # A task writes files, so Dask must not reuse the result of an earlier equal task.
        future = self._client.submit(function, task.item, pure=False)
        task.future, pending[future.key] = future, task
        future.add_done_callback(lambda ended: done.put(ended.key))

    def _next_done(self, done: SimpleQueue[str]) -> str:
        """Wait for a task to end, and return its key.

        Raises:
            MachineError: If there is no worker for a long time.
        """
        while True:
            try:
                return done.get(timeout=COUNT_SECONDS)
            except Empty:
                self._count_workers()

    def _gather(self, future: Future) -> Any:
        """Return the result of a task that has ended, or raise its error."""
        while not future.cancelled():
            try:
                return future.result(timeout=GATHER_SECONDS)
            except (CancelledError, TimeoutError):
                if future.status == "error":
                    raise
                self._count_workers()
        raise _scheduler_lost("its tasks are cancelled")

    def _count_failure(self, task: _PendingTask[Any], error: Exception) -> None:
        """Check that a failed task may be submitted again.

        Raises:
            MachineError: If the task killed its workers too often.
            BlankImageError: If the task rendered too many blank images.
        """
        if isinstance(error, BlankImageError):
            task.blank += 1
            if task.blank == BLANKS:
                raise error
            return
        task.given_up += 1
        if task.given_up > self._resubmissions:
            raise MachineError(f"workers died again and again: {error}") from None

    def _count_workers(self) -> None:
        """Count the workers, unless they were counted less than `COUNT_SECONDS` ago.

        Raises:
            MachineError: If the scheduler is lost, or there is no worker for a long time.
        """
        now = time.monotonic()
        if now - self._counted < COUNT_SECONDS:
            return
        self._counted = now
        try:
            workers = set(self._client.nthreads())
        except (OSError, RuntimeError, TimeoutError) as error:
            raise _scheduler_lost(str(error)) from None

        self._workers, self.pool.size = workers, len(workers)
        if isinstance(self._client.cluster, PrivateCluster):
            self._client.cluster.loop.add_callback(_reopen, self._client.cluster)
        self._check_empty(now)

    def _check_empty(self, now: float) -> None:
        """Report if there has been no worker for a long time.

        Raises:
            MachineError: If no worker can join either.
        """
        if self._workers:
            self._empty_since = None
            return
        if self._empty_since is None:
            self._empty_since, self._said = now, False
        seconds = now - self._empty_since
        if seconds > LOST_SECONDS and not _may_come(self._client.cluster):
            raise MachineError(f"there has been no worker for {LOST_SECONDS:g} s; {_CONTINUES}")
        if seconds > SAY_SECONDS and not self._said:
            self._said = True
            sys.stderr.write("there is no worker: waiting for one\n")


def _scheduler_lost(reason: str) -> MachineError:
    return MachineError(f"the scheduler was lost: {reason}; {_CONTINUES}")


def _may_come(cluster: Cluster | None) -> bool:
    """Return whether workers may join by themselves, at a user's scheduler or from a queue."""
    return cluster is None or hasattr(cluster, "job_script")


def _reopen(cluster: PrivateCluster) -> None:
    """Replace the nannies that gave up, in a cluster on this machine.

    A nanny gives up when its worker dies during the start, and Dask drops a nanny whose worker is
    lost for a long time. Call this in the cluster's event loop.
    """
    for name, nanny in list(cluster.workers.items()):
        if nanny.status in (Status.closed, Status.failed):
            del cluster.workers[name]
    if cluster.workers.keys() != cluster.worker_spec.keys():
        cluster.scale(len(cluster.worker_spec))
