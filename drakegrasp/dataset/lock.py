"""The lock of a dataset's directory, which allows one build at a time.

A build holds the kernel's lock on `build.lock` in the directory, and removes the file at its end.
The file names the process, so the message of a second build says who builds. The kernel frees the
lock of a process that dies: the next build takes the lock, and finds the name of the dead process.

Between machines the lock is as good as that of the file system: NFS and Lustre (mounted with
`flock`) lock files for all machines.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path

from filelock import FileLock, Timeout

from drakegrasp.errors import DataError, printable
from drakegrasp.runtime.files import open_own, stale_temporary, sweep_temporary

LOCK_FILE = "build.lock"
#: Folders that a build creates in the directory.
FOLDERS = ("builtin", "hand", "objects", "shards")
#: Maximum length of the name of a process in a lock file [bytes].
_LONGEST_NAME = 200


@contextmanager
def build_lock(out: Path) -> Iterator[str | None]:
    """Hold a directory while the block runs.

    Yields the name of the dead process that held it before, or None. One function of each command
    takes the lock, and the functions that it calls rely on it.

    Args:
        out: The directory; created if it is missing, and removed again if it stays empty.

    Raises:
        DataError: If another process builds in the directory, or it cannot be written.
    """
    path = out / LOCK_FILE
    try:
        made = not out.exists()
        out.mkdir(parents=True, exist_ok=True)
        held = FileLock(path).acquire(timeout=0)
    except Timeout:
        raise DataError(
            f"{out}: must be built by one process at a time, got {_name_in(path)}; wait for "
            "it, or use another directory"
        ) from None
    except OSError as error:
        raise unwritable(out, error) from None

    with held:
        dead = _sign(path)
        try:
            _validate_folders(out)
            yield dead
        finally:
            path.unlink(missing_ok=True)
            if made:
                with suppress(OSError):  # not empty: something was built
                    out.rmdir()


def _sign(path: Path) -> str | None:
    """Write this process into a lock file that it holds; return the name that was there.

    Raises:
        DataError: If the file is a link, or has another name elsewhere.
    """
    descriptor = open_own(path, os.O_RDWR)
    try:
        before = os.pread(descriptor, _LONGEST_NAME, 0).decode(errors="replace")
        now = datetime.now().astimezone().isoformat(timespec="seconds")
        name = f"process {os.getpid()} on {socket.gethostname()}, since {now}"
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, name.encode(), 0)
    finally:
        os.close(descriptor)
    return printable(before) or None


def _name_in(path: Path) -> str:
    """Return the name of the process that holds a lock file."""
    with suppress(OSError), path.open("rb") as file:
        return printable(file.read(_LONGEST_NAME).decode(errors="replace")) or "another process"
    return "another process"


def tidy(out: Path) -> None:
    """Remove what a dead process left unfinished in a directory.

    For commands that only read. Nothing happens if a process builds in the directory, or if this
    process may not write there.
    """
    if os.path.lexists(out / LOCK_FILE) or any(stale_temporary(out)):
        with suppress(DataError, OSError), build_lock(out):
            sweep_temporary(out)


def _validate_folders(out: Path) -> None:
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
