"""Files that are whole or absent, and show any change of a single bit.

A file is written under a temporary name in its own folder, closed, synced and renamed, so
a reader never sees half of one and a crash leaves nothing but a temporary file. A seal, the
SHA-256 of all other bytes in the user block that HDF5 leaves free at a file's start, shows any
change.
"""

from __future__ import annotations

import errno
import hashlib
import os
import re
import secrets
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import BufferedRandom, BufferedReader, BytesIO
from pathlib import Path

import h5py

from drakegrasp.errors import DataError, DiskFullError
from drakegrasp.runtime.processes import host_label, is_running

#: Bytes of the user block at a shard's start that holds the seal; HDF5 wants a power of two.
SEAL_SIZE = 512
#: Suffix of a file that is being written; what is left of one after a crash may be deleted.
TEMPORARY_SUFFIX = ".tmp"
#: How it ends: which process, of which machine, writes it.
_TEMPORARY = re.compile(r"\.(?P<host>[A-Za-z0-9-]+)~(?P<pid>\d+)~[0-9a-f]{12}\.tmp")
#: Age after which another machine's temporary file is one of a dead process [s].
STALE_SECONDS = 3600.0
#: What the system says where there is no room: disk, quota, or a limit on a file's size.
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Give the block a temporary path to write; it becomes `path` when the block ends well.

    Args:
        path: Of the file. Its folder is made if it is missing; an older file is replaced.

    Raises:
        OSError: If the disk is full or the folder cannot be written; nothing is left behind.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = temporary_name(path)
    try:
        yield temporary
        sync_and_rename(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_atomic(path: Path, content: bytes) -> None:
    """Write a file of these bytes, see `atomic_path`."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


@contextmanager
def atomic_hdf5(path: Path, *, sealed: bool = False) -> Iterator[h5py.File]:
    """Open a new HDF5 file that appears at `path` when the block ends well, see `atomic_path`.

    Args:
        path: Of the file.
        sealed: Whether to leave room for a seal and set it, see `seal`. Such a file is built in
            memory: a full disk is then the error of one write, and HDF5 stays usable.

    Raises:
        OSError: If the disk is full or the folder cannot be written; nothing is left behind.
    """
    with atomic_path(path) as temporary:
        if sealed:
            content = BytesIO()
            with h5py.File(content, "w", userblock_size=SEAL_SIZE) as file:
                yield file
            temporary.write_bytes(content.getbuffer())
            seal(temporary)
        else:
            with h5py.File(temporary, "w") as file:
                yield file


def seal(path: Path) -> None:
    """Write the hash of a file's bytes behind the seal into the seal."""
    with path.open("r+b") as file:
        text = _seal_of(file)
        file.seek(0)
        file.write(text)


def refuse_broken_seal(path: Path, what: str = "shard") -> None:
    """Refuse a sealed file of which any bit has changed.

    Raises:
        DataError: If it has, or the file is missing.
    """
    try:
        with path.open("rb") as file:
            found = file.read(SEAL_SIZE)
            intact = found == _seal_of(file)
    except OSError as error:
        raise DataError(f"{path}: must be a complete {what}, got none ({error.strerror})") from None
    if not intact:
        raise DataError(f"{path}: must be a complete {what}, got one that is damaged or cut off")


def _seal_of(file: BufferedReader | BufferedRandom) -> bytes:
    file.seek(SEAL_SIZE)
    digest = hashlib.file_digest(file, "sha256").hexdigest()
    return f"drakegrasp, sha256 of the rest: {digest}\n".encode().ljust(SEAL_SIZE, b"\0")


def sync_and_rename(temporary: Path, path: Path) -> None:
    """Make a finished file durable and give it its name, in one step for readers."""
    _sync(temporary)
    temporary.replace(path)
    _sync(path.parent)


def temporary_name(path: Path) -> Path:
    """Return a name beside a file under which it may be written, unlike any other process's."""
    writer = f"{host_label()}~{os.getpid()}~{secrets.token_hex(6)}"
    return path.with_name(f".{path.name}.{writer}{TEMPORARY_SUFFIX}")


def probe_folder(folder: Path) -> None:
    """Create a file in a folder and remove it again.

    Raises:
        OSError: If the folder cannot be written.
    """
    probe = temporary_name(folder / "probe")
    probe.touch()
    probe.unlink()


def sweep_temporary(out: Path) -> list[Path]:
    """Remove what dead processes left half-written in a dataset's directory; return its names.

    Another machine's processes cannot be asked: their files go when they are old.
    """
    return [path for path in _temporary_files(out) if _is_stale(path) and _remove(path)]


def _temporary_files(out: Path) -> Iterator[Path]:
    for pattern in ("", "objects", "shards/*"):
        for folder in out.glob(pattern) if pattern else [out]:
            with suppress(FileNotFoundError, NotADirectoryError), os.scandir(folder) as entries:
                for entry in entries:
                    if entry.name.startswith(".") and entry.name.endswith(TEMPORARY_SUFFIX):
                        yield Path(entry.path)


def _is_stale(path: Path) -> bool:
    found = _TEMPORARY.search(path.name)
    if found is not None and found["host"] == host_label():
        return not is_running(int(found["pid"]))
    try:
        return time.time() - path.stat().st_mtime > STALE_SECONDS
    except FileNotFoundError:
        return False


def _remove(path: Path) -> bool:
    try:
        path.unlink()
    except FileNotFoundError:
        return False
    return True


@contextmanager
def disk_full_named(out: Path) -> Iterator[None]:
    """Turn the system's word for a full disk, within the block, into one line.

    Raises:
        DiskFullError: If there is no room for what the block writes.
    """
    try:
        yield
    except (OSError, RuntimeError) as error:
        if not _is_no_room(error):
            raise
        _silence_repetitions()
        raise DiskFullError(
            f"{out}: must have room for what is written, got a full disk or quota "
            f"({os.strerror(_NO_ROOM[0])}); make room, and the same command goes on from here"
        ) from None


def _silence_repetitions() -> None:
    """Drop what HDF5 says of a full disk again, whenever one of the file's handles is freed."""
    before = sys.unraisablehook

    def hook(unraisable: sys.UnraisableHookArgs) -> None:
        if unraisable.exc_value is None or not _is_no_room(unraisable.exc_value):
            before(unraisable)

    sys.unraisablehook = hook


def _is_no_room(error: BaseException) -> bool:
    # HDF5 passes the number on in its own text only.
    text = str(error)
    return getattr(error, "errno", None) in _NO_ROOM or any(
        f"errno = {number}," in text or os.strerror(number) in text for number in _NO_ROOM
    )


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
