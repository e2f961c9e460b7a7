"""One build at a time in a directory.

In: a dataset's directory. Out: `build.lock` in it, a line of JSON that says which process
builds there, held by the kernel's lock (flock) while the process lives and removed when the
build ends. Of two builds the second refuses and names the first. A dead one's lock is free,
because the kernel let go of it: it is taken over and named.

Between machines this is as good as the file system's locks: NFS and Lustre (mounted with
`flock`) have them for all machines. Where there are none, the line decides: a process of
this machine that is gone is taken over, one of another machine is believed to be alive, and
the message says which file to remove if it is not.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from datetime import datetime
from io import FileIO
from pathlib import Path

from drakegrasp.errors import DataError
from drakegrasp.runtime.processes import Process, lock_file, this_process

FILE_NAME = "build.lock"


@dataclass(frozen=True, kw_only=True)
class Holder:
    """Who builds in a directory.

    Attributes:
        process: Which process.
        since: When it began to, in ISO 8601.
        command: Its command line.
    """

    process: Process
    since: str
    command: tuple[str, ...]

    def __str__(self) -> str:
        return f"process {self.process.pid} on {self.process.host}, since {self.since}"


#: Directories that this process holds, so that a step of a build may ask for what it has,
#: and who held them before and died.
_held: dict[Path, Holder | None] = {}


@contextmanager
def build_lock(out: Path) -> Iterator[Holder | None]:
    """Hold a directory while the block runs; again within it is allowed.

    Yields who held it before and died, if anybody did.

    Args:
        out: The directory; made if it is not there, and removed again if it stays empty.

    Raises:
        DataError: If another process builds in it, or it cannot be written.
    """
    path = out.resolve()
    if path in _held:
        yield _held[path]
        return
    made = _make_directory(out)
    file, before = _take(out / FILE_NAME)
    try:
        _held[path] = before
        yield before
    finally:
        del _held[path]
        (out / FILE_NAME).unlink(missing_ok=True)
        file.close()
        if made:
            with suppress(OSError):  # something was built
                out.rmdir()


def _make_directory(out: Path) -> bool:
    try:
        made = not out.exists()
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _unwritable(out, error) from None
    return made


def _unwritable(out: Path, error: OSError) -> DataError:
    return DataError(f"{out}: must be a directory that can be written, got: {error.strerror}")


def _take(path: Path) -> tuple[FileIO, Holder | None]:
    """Return the open lock file, now ours, and who left it behind, if anybody did."""
    while True:
        try:
            file = FileIO(os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666), "r+")
        except OSError as error:
            raise _unwritable(path.parent, error) from None
        try:
            locked = lock_file(file)
            before = _read(file)
            if locked is False or (
                locked is None and before and before.process.runs() is not False
            ):
                raise _refusal(path, before, certain=locked is False)
            if _is_at(path, file):
                _write(file)
                return file, before
        except BaseException:
            file.close()
            raise
        file.close()  # its holder removed it between our opening and locking: once more


def _is_at(path: Path, file: FileIO) -> bool:
    try:
        return os.path.samestat(path.stat(), os.fstat(file.fileno()))
    except FileNotFoundError:
        return False


def _read(file: FileIO) -> Holder | None:
    try:
        content = json.loads(os.pread(file.fileno(), 1 << 16, 0))
        return Holder(
            process=Process(**content["process"]),
            since=str(content["since"]),
            command=tuple(content["command"]),
        )
    except (KeyError, TypeError, ValueError):
        return None  # empty: its holder died before it wrote, or has not written yet


def _write(file: FileIO) -> None:
    now = datetime.now().astimezone().isoformat(timespec="seconds")
    holder = Holder(process=this_process(), since=now, command=tuple(sys.argv))
    file.truncate(0)
    os.pwrite(file.fileno(), json.dumps(asdict(holder)).encode() + b"\n", 0)


def _refusal(path: Path, holder: Holder | None, *, certain: bool) -> DataError:
    who = "another process" if holder is None else str(holder)
    mend = "wait for it or choose another --out"
    if not certain:
        mend = f"wait for it, or remove {path.name} there if it is dead"
    return DataError(f"{path.parent}: must be built by one process at a time, got {who}; {mend}")
