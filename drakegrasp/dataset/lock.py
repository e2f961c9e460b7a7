"""The lock of a dataset's directory, which allows one build at a time, and the log of its builds.

`build.lock` in the directory holds one line of JSON that names the process that builds there. The
process holds the kernel's lock (flock) on the file and removes the file at the end of the build. A
second build is rejected with a message that names the first. The kernel frees the lock of a process
that dies: the next build takes over the file and names the dead process.

Between machines the lock is as good as that of the file system: NFS and Lustre (mounted with
`flock`) lock files for all machines. On a file system without locks the line of JSON decides: if
its process ran on this machine and has ended, the next build takes over the file. A process of
another machine counts as alive; the message says which file to remove if that process is dead.

The library filelock cannot replace this module: its flock does not name the holder, so the message
of a rejected build could not say who builds, and a build could not report whose lock it took over.

`log.jsonl` lists the events of the builds with their times, one line of JSON each. People and their
tools read it. No data are derived from it, and it is the only file of a dataset that depends on the
clock.
"""

from __future__ import annotations

import json
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from io import FileIO
from pathlib import Path
from typing import Any

from drakegrasp.errors import DataError
from drakegrasp.runtime.environment import Process, this_process
from drakegrasp.runtime.files import (
    LIST_NAME,
    complete_replacement,
    lock_file,
    open_own,
    stale_temporary,
    sweep_temporary,
)

LOCK_FILE = "build.lock"
#: Folders that a build creates in the directory.
FOLDERS = ("builtin", "hand", "objects", "shards")
#: Directories that a thread of this process holds, and the lock that guards this set.
_held: set[str] = set()
_claiming = threading.Lock()


@dataclass(frozen=True, kw_only=True)
class Holder:
    """The process that holds a directory.

    Attributes:
        process: The process.
        since: Time at which the process took the lock, in ISO 8601.
        command: Command line of the process.
    """

    process: Process
    since: str
    command: tuple[str, ...]

    def __str__(self) -> str:
        return f"process {self.process.pid} on {self.process.host}, since {self.since}"


@contextmanager
def build_lock(out: Path) -> Iterator[Holder | None]:
    """Hold a directory while the block runs.

    Yields the dead holder whose lock was taken over, or None. Files that the dead holder was
    replacing are then all new. One function of each command takes the lock, and the functions that
    it calls rely on it.

    Args:
        out: The directory; created if it is missing, and removed again if it stays empty.

    Raises:
        DataError: If another process builds in the directory, or it cannot be written.
    """
    # A directory that is created here is removed again if it stays empty.
    try:
        made = not out.exists()
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise unwritable(out, error) from None

    # First among the threads of this process, then among all processes.
    key = _claim(out)
    try:
        file, before = _take(out / LOCK_FILE)
    except BaseException:
        _held.discard(key)
        raise
    try:
        _refuse_linked_folders(out)
        complete_replacement(out)
        yield before
    finally:
        (out / LOCK_FILE).unlink(missing_ok=True)
        file.close()
        _held.discard(key)
        if made:
            with suppress(OSError):  # not empty: something was built
                out.rmdir()


def _claim(out: Path) -> str:
    """Take a directory for one thread of this process; return the key that `_held` has for it.

    On network file systems the kernel's lock belongs to a process with all its threads.

    Raises:
        DataError: If a thread of this process already holds the directory.
    """
    key = os.path.realpath(out)
    with _claiming:
        if key in _held:
            raise _refusal(
                out / LOCK_FILE, None, certain=True, who="this process, which has it already"
            )
        _held.add(key)
    return key


def tidy(out: Path) -> None:
    """Finish or remove what a dead process left unfinished in a directory.

    For commands that only read. Nothing happens if a process builds in the directory, or if this
    process may not write there.
    """
    leftovers = (out / LOCK_FILE, out / LIST_NAME)
    if any(map(os.path.lexists, leftovers)) or any(stale_temporary(out)):
        with suppress(DataError, OSError), build_lock(out):
            sweep_temporary(out)


def _refuse_linked_folders(out: Path) -> None:
    """Raise an error if a subfolder of the dataset is a symbolic link.

    A build therefore never writes outside of the dataset.

    Raises:
        DataError: If a subfolder is a link.
    """
    inner = out / "shards"
    folders = [out / name for name in FOLDERS]
    if inner.is_dir() and not inner.is_symlink():
        with os.scandir(inner) as entries:
            folders += [inner / entry.name for entry in entries if entry.is_symlink()]
    for folder in folders:
        if folder.is_symlink():
            raise DataError(f"{folder}: must be a folder in the dataset, got a link")


def unwritable(out: Path, error: OSError) -> DataError:
    """Return the error for a directory that cannot be written."""
    return DataError(f"{out}: must be a directory that can be written, got: {error.strerror}")


def _take(path: Path) -> tuple[FileIO, Holder | None]:
    """Return the open lock file, which this process now holds, and its dead holder or None.

    Raises:
        DataError: If another process holds the file, or it cannot be written.
    """
    while True:
        try:
            file = FileIO(open_own(path, os.O_RDWR | os.O_CREAT), "r+")
        except OSError as error:
            raise unwritable(path.parent, error) from None
        try:
            # The kernel decides; on a file system without locks (None) the file's content does.
            locked = lock_file(file)
            before = _read(file)
            alive = before is not None and before.process.runs() is not False
            if locked is False or (locked is None and alive):
                raise _refusal(path, before, certain=locked is False)
            if _is_at(path, file):
                _write(file)
                return file, before
        except BaseException:
            file.close()
            raise
        file.close()  # its holder removed it after this process opened it: try again


def _is_at(path: Path, file: FileIO) -> bool:
    """Return whether an open file is still the file at a path."""
    try:
        return os.path.samestat(path.stat(), os.fstat(file.fileno()))
    except FileNotFoundError:
        return False


def _read(file: FileIO) -> Holder | None:
    """Return the holder that a lock file names, or None if it names nobody."""
    try:
        content = json.loads(os.pread(file.fileno(), 1 << 16, 0))
        return Holder(
            process=Process(**content["process"]),
            since=str(content["since"]),
            command=tuple(content["command"]),
        )
    except (KeyError, TypeError, ValueError):
        return None  # empty: its holder died before it wrote its name, or is about to


def _write(file: FileIO) -> None:
    """Write this process into the lock file."""
    now = datetime.now().astimezone().isoformat(timespec="seconds")
    holder = Holder(process=this_process(), since=now, command=tuple(sys.argv))
    file.truncate(0)
    os.pwrite(file.fileno(), json.dumps(asdict(holder)).encode() + b"\n", 0)


def _refusal(
    path: Path, holder: Holder | None, *, certain: bool, who: str = "another process"
) -> DataError:
    who = who if holder is None else str(holder)
    advice = "wait for it or choose another --out"
    if not certain:
        advice = f"wait for it, or remove {path.name} there if it is dead"
    return DataError(f"{path.parent}: must be built by one process at a time, got {who}; {advice}")


LOG_FILE = "log.jsonl"


class BuildLog:
    """The log of a directory's builds.

    Args:
        out: Directory of the dataset.
    """

    def __init__(self, out: Path) -> None:
        self._path = out / LOG_FILE

    def __call__(self, event: str, **facts: Any) -> None:
        """Append an event in a single write, so that a crash leaves only whole lines.

        Args:
            event: Name of the event, e.g. "unit done".
            facts: Details of the event, as JSON types.

        Raises:
            OSError: If the file cannot be written.
            DataError: If the file is a link.
        """
        now = datetime.now(UTC).isoformat(timespec="milliseconds")
        line = json.dumps({"time": now, "event": event, **facts}, ensure_ascii=False)

        # Letters of other alphabets stay readable; control characters become escape codes.
        line = "".join(c if c.isprintable() else json.dumps(c)[1:-1] for c in line) + "\n"
        descriptor = open_own(self._path, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
        try:
            os.write(descriptor, line.encode())
        finally:
            os.close(descriptor)
