"""Runs tasks on workers that do not see the files of the dataset, by sending the files.

Input: an executor on Dask, and tasks that name the files that they read and write (`FileTask`).
Output: the results, and the written files, which the client writes to the dataset.

The client sends the content of a file to the scheduler once, and the scheduler keeps it while tasks
in flight need it. A worker gets missing files from the scheduler, and keeps the files of its last
tasks in its own directory. A task runs in a separate process, in a folder with copies of
the files. If the process dies, the worker survives and starts another process. The journal of the
task is in this folder, so a step that kills its process is identified in the same way as on workers
that see the dataset. If a worker is lost, another worker runs its task from the beginning. If the
client is killed, the scheduler forgets its files when the connection ends, and workers remove their
copies with the next tasks. Several clients may use the same workers at the same time.

Functions whose items are not such tasks read files that only this machine has, so they run here.
"""

from __future__ import annotations

import hashlib
import pickle
import secrets
import shutil
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import chain, count, islice
from pathlib import Path
from typing import Any, TypeVar, cast

import dask
from distributed import Client, Scheduler, Variable, Worker, get_worker
from distributed.diagnostics.plugin import SchedulerPlugin
from distributed.utils import sync

from drakegrasp.cluster.apart import ApartError, ProcessApart
from drakegrasp.errors import MachineError
from drakegrasp.runtime.executor import Executor, FileTask
from drakegrasp.runtime.files import write_atomic

T = TypeVar("T")
R = TypeVar("R")

#: Number of last tasks whose files a worker keeps.
KEPT_TASKS = 8
#: Time for which the scheduler looks for a file [s]. It has the files of a task before the task, so
#: one that it does not have was forgotten with its task, and a worker that waits is blocked.
FETCH_SECONDS = 1
#: Number of deaths in one task after which the machine must be the cause.
MOST_DEATHS = 400
#: Dask's setting for the fraction of its memory that a worker, with the process beside it, may use.
_TERMINATE = "distributed.worker.memory.terminate"


@dataclass(frozen=True, kw_only=True)
class Parcel:
    """A task that is sent to a worker.

    Attributes:
        number: Number of the task.
        build: Identifier of the build, which is the folder of its files on a worker.
        call: Pickled function and item.
        files: Names at the scheduler of the files that the task reads, by their relative paths. A
            name ends with the SHA-256 of the file.
        writes: Relative paths of the files that the task writes or removes.
    """

    number: int
    build: str
    call: bytes
    files: Mapping[str, str]
    writes: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Delivery:
    """The answer of a worker.

    Attributes:
        number: Number of the task.
        result: Pickled result.
        files: Content of the files that the task wrote, by their relative paths.
    """

    number: int
    result: bytes
    files: Mapping[str, bytes]


# Here


@contextmanager
def by_wire(execute: Executor, client: Client, out: Path) -> Iterator[Executor]:
    """Yield an executor whose tasks work on copies of a dataset's files.

    Args:
        execute: Runs tasks on workers.
        client: Client of these workers.
        out: Directory of the dataset, which only this process sees.
    """
    build = secrets.token_hex(8)
    client.register_plugin(ForgetFiles())
    try:
        yield _Wire(execute, client, out, build)
    finally:
        with suppress(Exception):  # the workers may be gone
            client.run(leave, build)


class _Wire:
    """An `Executor` that sends the files that tasks read, and writes the files that they wrote."""

    def __init__(self, execute: Executor, client: Client, out: Path, build: str) -> None:
        self._execute, self._client, self._out, self._build = execute, client, out, build
        # The digest of each file, by path, inode, size and time; the name of each content at the
        # scheduler, by digest; and the number of tasks in flight that need the content.
        self._digests: dict[tuple[Any, ...], str] = {}
        self._names: dict[str, str] = {}
        self._uses, self._serial = Counter[str](), count()

    def __call__(self, function: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
        """Yield function(item) for every item, after the files of the task are written."""
        items = iter(items)
        first = list(islice(items, 1))
        if not (first and isinstance(first[0], FileTask)):
            yield from map(function, chain(first, items))
            return

        sent, numbers = dict[int, Parcel](), count()

        def parcels() -> Iterator[Parcel]:
            for item in chain(first, items):
                parcel = self._packed(next(numbers), function, item)
                sent[parcel.number] = parcel
                yield parcel

        deliveries = self._execute(do_parcel, parcels())
        try:
            for delivery in deliveries:
                self._write(sent[delivery.number].writes, delivery.files)
                self._release(sent.pop(delivery.number))
                yield pickle.loads(delivery.result)
        finally:
            cast(Any, deliveries).close()
            for parcel in sent.values():
                self._release(parcel)

    def _packed(self, number: int, function: Callable[[T], R], item: T) -> Parcel:
        task = cast(FileTask, item)
        return Parcel(
            number=number,
            build=self._build,
            call=pickle.dumps((function, item)),
            files={place: self._offer(path) for place, path in task.reads().items()},
            writes=task.writes(),
        )

    def _offer(self, path: Path) -> str:
        """Store a file at the scheduler for one more task, and return its name there."""
        status = path.stat()
        key = path, status.st_ino, status.st_size, status.st_mtime_ns
        digest = self._digests.get(key, "")
        if digest not in self._names:
            content = path.read_bytes()
            digest = self._digests[key] = hashlib.sha256(content).hexdigest()
            if digest not in self._names:
                # Dask deletes a variable with a delay, so no name is used again.
                name = f"{_prefix(self._client.id)}{self._build}-{next(self._serial)}-{digest}"
                self._names[digest] = name
                Variable(name, client=self._client).set(content)
        self._uses[self._names[digest]] += 1
        return self._names[digest]

    def _release(self, parcel: Parcel) -> None:
        """Remove the files from the scheduler that no other task in flight needs."""
        for name in parcel.files.values():
            self._uses[name] -= 1
            if not self._uses[name]:
                del self._uses[name], self._names[_digest_in(name)]
                with suppress(OSError):  # the scheduler may have ended
                    Variable(name, client=self._client).delete()

    def _write(self, places: Iterable[str], files: Mapping[str, bytes]) -> None:
        """Write the returned files of a task, and remove those of its files that are missing."""
        for place in places:
            if place in files:
                write_atomic(self._out / place, files[place])
            else:
                (self._out / place).unlink(missing_ok=True)


def _prefix(client: str) -> str:
    """Return how the names of a client's files at the scheduler begin."""
    return f"drakegrasp-{client}-"


def _digest_in(name: str) -> str:
    """Return the SHA-256 in the name of a file at the scheduler."""
    return name.rpartition("-")[2]


# At the scheduler


class ForgetFiles(SchedulerPlugin):  # type: ignore[misc]
    """Removes the files of a client from the scheduler when its connection ends."""

    name, idempotent = "drakegrasp-files", True

    def remove_client(self, scheduler: Scheduler, client: str) -> None:
        """Remove the files; Dask calls this."""
        variables = scheduler.extensions["variables"].variables
        for name in [name for name in variables if name.startswith(_prefix(client))]:
            del variables[name]


# At a worker


class _Copies:
    """A worker's folder with copies of files, and the process that works there."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        # The digest of each file, and the files of the last tasks, by build and relative path.
        self._digests = dict[Path, str]()
        self._recent = deque[Iterable[Path]](maxlen=KEPT_TASKS)
        self._process: ProcessApart | None = None
        self._running, self._left = "", set[str]()

    def do(self, parcel: Parcel, worker: Worker) -> Delivery:
        """Run a task; start the process again if it dies."""
        self._running, here = parcel.build, self._folder / parcel.build
        try:
            here.mkdir(parents=True, exist_ok=True)
            self._bring({Path(parcel.build, place): n for place, n in parcel.files.items()}, worker)
            for _ in range(MOST_DEATHS):
                if parcel.build in self._left:
                    break
                process = self._process = self._process or ProcessApart(self._folder)
                try:
                    result = process.call(parcel.call, here, _memory(worker))
                except ApartError:
                    self._process = None
                    continue
                files = self._taken(parcel)
                return Delivery(number=parcel.number, result=result, files=files)
            raise MachineError("workers died again and again")
        finally:
            self._running = ""

    def _bring(self, files: Mapping[Path, str], worker: Worker) -> None:
        """Get the missing files; remove files that the last tasks did not need."""
        self._recent.append(files)
        for path in self._digests.keys() - set().union(*self._recent):
            (self._folder / path).unlink(missing_ok=True)
            del self._digests[path]
        for path, name in files.items():
            if self._digests.get(path) != _digest_in(name):
                write_atomic(self._folder / path, _fetched(name, worker))
                self._digests[path] = _digest_in(name)

    def _taken(self, parcel: Parcel) -> dict[str, bytes]:
        """Return the files that a task wrote by their relative paths, and remove them."""
        found = {}
        for place in parcel.writes:
            path = self._folder / parcel.build / place
            if path.is_file():
                found[place] = path.read_bytes()
                path.unlink()
            self._digests.pop(Path(parcel.build, place), None)
        return found

    def leave(self, build: str) -> None:
        """Remove the files of a build, and end the process unless another build uses it."""
        self._left.add(build)
        process = self._process
        if process is not None and self._running in ("", build):
            self._process = None
            process.close()
        shutil.rmtree(self._folder / build, ignore_errors=True)


#: Copies on this worker.
_copies: _Copies | None = None


def do_parcel(parcel: Parcel) -> Delivery:
    """Run a task on a worker; call this in the thread of the worker.

    Raises:
        MachineError: If the process beside the worker dies repeatedly, or the scheduler has
            forgotten a file.
        Exception: The error that the function raised.
    """
    global _copies
    worker = get_worker()
    _copies = _copies or _Copies(Path(worker.local_directory) / "drakegrasp")
    return _copies.do(parcel, worker)


def leave(build: str) -> None:
    """Remove the files of a build from this worker."""
    if _copies is not None:
        _copies.leave(build)


def _fetched(name: str, worker: Worker) -> bytes:
    """Return a file by its name at the scheduler."""
    get = worker.scheduler.variable_get
    try:
        found = sync(worker.loop, get, name=name, timeout=FETCH_SECONDS)
    except TimeoutError:
        raise MachineError(f"a file must be at the scheduler, got none ({name})") from None
    content: bytes = found["value"]
    if hashlib.sha256(content).hexdigest() != _digest_in(name):
        raise MachineError(f"a file must come from the scheduler unchanged, got another ({name})")
    return content


def _memory(worker: Worker) -> float:
    """Return the memory that a process beside the worker may use [byte]."""
    limit, share = worker.memory_manager.memory_limit, dask.config.get(_TERMINATE)
    own = worker.monitor.proc.memory_info().rss
    return limit * share - own if limit and share else float("inf")
