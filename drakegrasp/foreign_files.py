"""Reading files of unknown origin: nothing is waited for, has no end, or fills the memory.

In: a path, and the most bytes that such a file may have. Out: its bytes, or an `OSError` that says
what is there instead, as for any file that cannot be read. A link is followed: a dataset from a hub
consists of links into its cache.
"""

from __future__ import annotations

import stat
from pathlib import Path

from drakegrasp.errors import DataError

#: Most bytes of a text (JSON, YAML, CSV), and of arrays or a mesh that are read at once.
LARGEST_TEXT, LARGEST_CONTENT = 2**28, 2**30
#: Most bytes of a file that is read in parts, and of one that is hashed whole: a shard is built in
#: memory.
LARGEST_PARTS, LARGEST_SEALED = 2**40 - 1, 2**32
#: What a path may be instead of a file, in words.
_KINDS = {
    stat.S_IFIFO: "a pipe",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFSOCK: "a socket",
    stat.S_IFDIR: "a folder",
}


def refuse_irregular(path: Path, largest: int = LARGEST_PARTS) -> None:
    """Refuse what is no regular file, or is larger than such a file can be.

    Raises:
        OSError: If it is, or is not there.
    """
    status = path.stat()
    if not stat.S_ISREG(status.st_mode):
        raise _refusal(_KINDS.get(stat.S_IFMT(status.st_mode), "no regular file"))
    if status.st_size > largest:
        raise _refusal(f"a file of {status.st_size:,} byte, more than {largest:,}")


def refuse_link(folder: Path) -> None:
    """Refuse a link where a command writes into a dataset: it may lead anywhere.

    Raises:
        DataError: If it is one.
    """
    if folder.is_symlink():
        raise DataError(f"{folder}: must be a folder of the dataset to write to, got a link")


def read_content(path: Path, largest: int = LARGEST_CONTENT) -> bytes:
    """Return the bytes of a file, see `refuse_irregular`."""
    refuse_irregular(path, largest)
    return path.read_bytes()


def read_text(path: Path, encoding: str = "utf-8") -> str:
    """Return the text of a file, see `refuse_irregular`.

    Raises:
        OSError: If it cannot be read.
        UnicodeDecodeError: If it is no text in this encoding.
    """
    refuse_irregular(path, LARGEST_TEXT)
    return path.read_text(encoding=encoding)


def _refusal(what: str) -> OSError:
    """Return an error whose `strerror` is its message: those of the system have both."""
    error = OSError(what)
    error.strerror = what
    return error
