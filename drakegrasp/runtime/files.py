"""Files that are complete or absent, and whose damage is detected.

A file is written under a temporary name in its own folder, closed, synced and renamed. A reader
never sees half a file, and a crash leaves only a temporary file. A seal reveals any changed bit: it
is the SHA-256 of all other bytes, in the user block that HDF5 leaves free at a file's start.

Files of a folder that belong together are all complete before the first of them gets its name, and
they get their names in order. The manifest of a dataset is the last: it is new only if all files
are, and it tells files of another state, because each file has the signature of its manifest.
"""

from __future__ import annotations

import errno
import hashlib
import os
import re
import secrets
import shutil
import stat
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from io import BufferedRandom, BufferedReader, BytesIO, FileIO
from pathlib import Path
from typing import TYPE_CHECKING

import h5py

from drakegrasp.errors import DataError, DiskFullError
from drakegrasp.foreign_files import LARGEST_SEALED, validate_regular
from drakegrasp.runtime.environment import host_label, is_running

if TYPE_CHECKING:
    from typing_extensions import Buffer

#: Size of the user block that holds the seal [B]; HDF5 demands a power of two.
SEAL_SIZE = 512
#: Format of HDF5 files. Unlike HDF5's first format it has checksums of the positions of values, and
#: a small column takes a quarter of the bytes. Every HDF5 since 1.10 reads it.
FORMAT = ("v110", "v110")
#: Suffix of a file that is being written; after a crash such a file may be deleted.
TEMPORARY_SUFFIX = ".tmp"
#: End of the name of such a file: the machine and the process that write it.
_TEMPORARY = re.compile(r"\.(?P<host>[A-Za-z0-9-]+)~(?P<pid>\d+)~[0-9a-f]{12}\.tmp")
#: Age after which another machine's temporary file counts as left by a dead process [s].
STALE_SECONDS = 3600.0
#: Error numbers for a lack of room: on the disk, in the quota, or by a limit on the size of files.
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Provide a temporary path for the block to write; it becomes `path` if the block succeeds.

    Args:
        path: Path of the file. Its folder is created if it is missing; an older file is replaced.

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


def write_atomic(path: Path, content: Buffer) -> None:
    """Write a file with these bytes, see `atomic_path`."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Provide a temporary folder for the block to fill; it becomes `path` if the block succeeds.

    Args:
        path: Path of the folder, which must be missing or empty.

    Raises:
        OSError: If the disk is full or the folder cannot be written; nothing is left behind.
    """
    path = path.absolute()
    path.parent.mkdir(parents=True, exist_ok=True)

    # Remove what a dead process left of the same folder.
    for entry in path.parent.iterdir():
        ours = entry.name.startswith(f".{path.name}.") and _TEMPORARY.search(entry.name)
        if ours and entry.is_dir() and _is_stale(entry):
            shutil.rmtree(entry, ignore_errors=True)

    temporary = temporary_name(path)
    temporary.mkdir()
    try:
        yield temporary
        sync_and_rename(temporary, path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


@contextmanager
def atomic_hdf5(path: Path, *, sealed: bool = False) -> Iterator[h5py.File]:
    """Open a new HDF5 file that appears at `path` if the block succeeds, see `atomic_path`.

    Args:
        path: Path of the file.
        sealed: Whether to set a seal, see `seal`.

    Raises:
        OSError: If the disk is full or the folder cannot be written; nothing is left behind.
    """
    with atomic_path(path) as temporary, new_hdf5(temporary, sealed=sealed) as file:
        yield file


@contextmanager
def new_hdf5(path: Path, *, sealed: bool = False) -> Iterator[h5py.File]:
    """Open a new HDF5 file for the block to write; after an error the file is unusable.

    Args:
        path: Path of the file.
        sealed: Whether to set a seal when the block ends, see `seal`, which reads the file again.

    Raises:
        OSError: If the file exists, the disk is full or the folder cannot be written.
    """
    with _PatientFile(path) as patient:
        try:
            room = SEAL_SIZE if sealed else 0
            with h5py.File(patient, "w", userblock_size=room, libver=FORMAT) as file:
                yield file
        finally:
            # Other errors would follow from this one.
            patient.raise_failure()
    if sealed:
        seal(path)


class _PatientFile(FileIO):
    """A new file whose writes never fail for HDF5, although the disk may be full.

    HDF5 (1.14) repeats a failed write when it frees a handle, and closing the file then ends in a
    segmentation fault. Here the first error is stored and every later write is dropped, so that
    HDF5 can close the broken file without a crash.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path, "x+")
        self._failure: OSError | None = None

    def write(self, content: Buffer, /) -> int:
        """Write bytes, unless an earlier write failed; return the number of bytes."""
        view = memoryview(content).cast("B")
        try:
            done = 0 if self._failure is None else len(view)
            while done < len(view):
                done += super().write(view[done:])
        except OSError as error:
            self._failure = error
        return len(view)

    def readinto(self, buffer: Buffer, /) -> int:
        """Fill a buffer, with zeros for bytes that could not be written."""
        view = memoryview(buffer).cast("B")
        done = super().readinto(view)
        view[done:] = bytes(len(view) - done)
        return len(view)

    def truncate(self, size: int | None = None, /) -> int:
        """Set the size of the file, unless a write failed; return the size."""
        try:
            return (size or 0) if self._failure is not None else super().truncate(size)
        except OSError as error:
            self._failure = error
            return size or 0

    def raise_failure(self) -> None:
        """Raise the error of the first write that failed."""
        if self._failure is not None:
            raise self._failure


def seal(path: Path) -> None:
    """Write the seal of a file: the hash of all bytes after the seal."""
    with path.open("r+b") as file:
        text = _seal_of(file)
        file.seek(0)
        file.write(text)


def write_sealed(path: Path, content: BytesIO) -> bytes:
    """Seal the HDF5 file in a buffer, write it, see `atomic_path`, and return the seal."""
    view = content.getbuffer()
    text = _seal_text(hashlib.sha256(view[SEAL_SIZE:]).hexdigest())
    view[:SEAL_SIZE] = text
    write_atomic(path, view)
    return text


def read_seal(path: Path) -> bytes:
    """Return the seal of a file, which identifies its content; the seal is not verified.

    Raises:
        DataError: If the file cannot be read.
    """
    with open_sealed(path, verify=False) as file:
        return file.read(SEAL_SIZE)


def validate_seal(path: Path, what: str = "shard", largest: int | None = LARGEST_SEALED) -> None:
    """Raise an error if any bit of a sealed file has changed, see `open_sealed`."""
    open_sealed(path, what, largest).close()


def open_sealed(
    path: Path,
    what: str = "shard",
    largest: int | None = LARGEST_SEALED,
    *,
    verify: bool = True,
) -> BufferedReader:
    """Open a sealed file; the caller closes it.

    Args:
        path: Path of the file.
        what: What the file is, for the error message.
        largest: As for `validate_regular`.
        verify: Whether to verify the seal, which reads the whole file.

    Raises:
        DataError: If the file is missing, or a bit of it has changed.
    """
    try:
        validate_regular(path, largest)
        file = path.open("rb")
        if not verify or file.read(SEAL_SIZE) == _seal_of(file):
            file.seek(0)
            return file
    except OSError as error:
        raise DataError(f"{path}: must be a complete {what}, got none ({error.strerror})") from None
    file.close()
    raise DataError(f"{path}: must be a complete {what}, got one that is damaged or cut off")


def _seal_of(file: BufferedReader | BufferedRandom) -> bytes:
    file.seek(SEAL_SIZE)
    return _seal_text(hashlib.file_digest(file, "sha256").hexdigest())


def _seal_text(digest: str) -> bytes:
    return f"drakegrasp, sha256 of the rest: {digest}\n".encode().ljust(SEAL_SIZE, b"\0")


def sync_and_rename(temporary: Path, path: Path) -> None:
    """Make a finished file durable and give it its name, in one step for readers."""
    sync(temporary)
    temporary.replace(path)
    sync(path.parent)


def temporary_name(path: Path) -> Path:
    """Return a temporary name for a file, in the same folder; no other process uses this name."""
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


def validate_writable(out: Path) -> None:
    """Reject a file that cannot be written; no file is left behind.

    Raises:
        DataError: If it is a folder, or the folder of the file cannot be written (if it does not
            exist: the first existing folder above it).
    """
    if out.is_dir():
        raise DataError(f"{out}: must be a file, got a folder; choose another --out")

    # Find the first existing folder above the file.
    folder = out.absolute().parent
    while not os.path.lexists(folder):
        folder = folder.parent
    try:
        probe_folder(folder)
    except OSError:
        raise DataError(
            f"{out}: must be in a folder that can be written, got {folder}; choose another --out"
        ) from None


def open_own(path: Path, flags: int) -> int:
    """Open a file to write it in place, without following links; return its descriptor.

    Args:
        path: Path of the file.
        flags: As for `os.open`; a new file gets the permissions that the umask allows.

    Raises:
        OSError: If the file cannot be opened.
        DataError: If the path is a link, or the file has another name elsewhere or is not regular.
    """
    refusal = DataError(f"{path}: must be a file of its own, got a link or no file")
    try:
        safe = os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
        descriptor = os.open(path, flags | safe, 0o666)
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.ENXIO):
            raise refusal from None
        raise
    status = os.fstat(descriptor)
    if not stat.S_ISREG(status.st_mode) or status.st_nlink > 1:
        os.close(descriptor)
        raise refusal
    return descriptor


def stale_temporary(out: Path) -> Iterator[Path]:
    """Yield the temporary files of dead processes in a dataset's directory.

    It is unknown whether another machine's process still runs, so its files count if they are old.
    """
    return (path for path in _temporary_files(out) if _is_stale(path))


def sweep_temporary(out: Path) -> list[Path]:
    """Remove temporary files of dead processes from a dataset's directory; return their paths."""
    return [path for path in stale_temporary(out) if _remove(path)]


def _temporary_files(out: Path) -> Iterator[Path]:
    for pattern in ("", "objects", "reach", "shards/*"):
        for folder in out.glob(pattern) if pattern else [out]:
            if folder != out and (folder.is_symlink() or folder.parent.is_symlink()):
                continue
            with suppress(FileNotFoundError, NotADirectoryError), os.scandir(folder) as entries:
                for entry in entries:
                    if entry.name.startswith(".") and entry.name.endswith(TEMPORARY_SUFFIX):
                        yield Path(entry.path)


def _is_stale(path: Path) -> bool:
    match = _TEMPORARY.search(path.name)
    if match is not None and match["host"] == host_label():
        return not is_running(int(match["pid"]))
    try:
        return time.time() - path.lstat().st_mtime > STALE_SECONDS
    except FileNotFoundError:
        return False


def _remove(path: Path) -> bool:
    try:
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)  # from `atomic_folder`
        else:
            path.unlink()
    except FileNotFoundError:
        return False
    return True


@contextmanager
def disk_full_named(out: Path) -> Iterator[None]:
    """Convert the system's errors of a full disk, within the block, to one clear error.

    Raises:
        DiskFullError: If there is no room for what the block writes.
    """
    try:
        yield
    except (OSError, RuntimeError) as error:
        if not is_no_room(error):
            raise
        raise DiskFullError(
            f"{out}: the disk or the quota is full ({os.strerror(_NO_ROOM[0])}); make room, and "
            "the same command continues from here"
        ) from None


def is_no_room(error: BaseException) -> bool:
    """Return whether an error says that there is no room for a file."""
    # HDF5 has the error number only in its message.
    text = str(error)
    return getattr(error, "errno", None) in _NO_ROOM or any(
        f"errno = {number}," in text or os.strerror(number) in text for number in _NO_ROOM
    )


def sync(path: Path) -> None:
    """Make a file, or the names in a folder, durable."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def replaced_together(folder: Path) -> Iterator[Callable[[str], Path]]:
    """Yield a function from a file's name to the path under which to write the file.

    The files appear in the folder if the block succeeds, in the order in which they were begun.
    Only one process at a time may do this.

    Args:
        folder: Folder of the files.

    Raises:
        OSError: If the disk is full or the folder cannot be written; the old files stay.
    """
    temporary: dict[str, Path] = {}

    def begin(name: str) -> Path:
        temporary[name] = temporary_name(folder / name)
        return temporary[name]

    try:
        yield begin
        # Sync all before the first gets its name: a power cut could else leave empty files.
        for path in temporary.values():
            sync(path)
        for name, path in temporary.items():
            path.replace(folder / name)
        sync(folder)
    finally:
        for path in temporary.values():
            path.unlink(missing_ok=True)
