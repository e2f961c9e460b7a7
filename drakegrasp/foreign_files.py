"""Files and names of unknown origin: nothing is waited for, has no end, or fills the memory.

In: a path, and the most bytes that such a file may have. Out: its bytes, or an `OSError` that says
what is there instead, as for any file that cannot be read. A link is followed: a dataset from a hub
consists of links into its cache.

Of JSON every mistake is a `ValueError`, and nothing is read in two ways: Python's own reader takes
NaN, keeps the last of two equal keys, and gives up in other ways at bytes that are no text, at
values that are nested too deeply and at numbers of thousands of digits.
"""

from __future__ import annotations

import json
import stat
from pathlib import Path
from typing import Any, NoReturn

from drakegrasp.errors import DataError

#: Longest name of an object [bytes]: file systems allow 255, and we append to it.
MAX_NAME = 200
#: What a name must be, for error messages.
NAME_RULE = (
    "printable, not empty, without slashes, not begin with a dot, and have at most "
    f"{MAX_NAME} bytes"
)
#: Most bytes of a text (JSON, YAML, CSV), and of arrays or a mesh that are read at once.
LARGEST_TEXT, LARGEST_CONTENT = 2**28, 2**30
#: Most bytes of a file that is hashed whole: a shard is built in memory.
LARGEST_SEALED = 2**32
#: A file that is read in parts has so many bytes, or more than this share of them is on the disk: a
#: file of holes takes no room, but hours to read. File systems that compress save less.
LARGE, SOLID = 2**36, 1e-3
#: What a path may be instead of a file, in words.
_KINDS = {
    stat.S_IFIFO: "a pipe",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFSOCK: "a socket",
    stat.S_IFDIR: "a folder",
}


def refuse_irregular(path: Path, largest: int | None = None) -> None:
    """Refuse what is no regular file, or is larger than such a file can be.

    Args:
        path: Of the file.
        largest: Most bytes; None for a file that is read in parts, which must not consist of holes.

    Raises:
        OSError: If it is, or is not there.
    """
    status = path.stat()
    if not stat.S_ISREG(status.st_mode):
        raise _refusal(_KINDS.get(stat.S_IFMT(status.st_mode), "no regular file"))
    size, stored = status.st_size, 512 * status.st_blocks
    if largest is not None and size > largest:
        raise _refusal(f"a file of {size:,} byte, more than {largest:,}")
    if largest is None and size > LARGE and stored < SOLID * size:
        raise _refusal(f"a file of {size:,} byte, of which only {stored:,} are on the disk")


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


def read_json(path: Path) -> Any:
    """Return the content of a JSON file.

    Raises:
        OSError: If it cannot be read.
        ValueError: As for `parse_json`.
    """
    return parse_json(read_content(path, LARGEST_TEXT))


def parse_json(text: str | bytes) -> Any:
    """Return the content of a JSON text.

    Raises:
        ValueError: If it is no JSON in UTF-8, is nested too deeply, has a key twice or a number
            that is none, with the reason.
    """
    try:
        text = text if isinstance(text, str) else text.decode("utf-8")
        return json.loads(text, object_pairs_hook=_mapping, parse_constant=_no_number)
    except RecursionError:
        raise ValueError("values nested too deeply") from None
    except ValueError as error:
        if "integer string conversion" in str(error):
            raise ValueError("a number of too many digits") from None
        raise


def _mapping(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        keys = [key for key, _ in pairs]
        twice = next(key for key in keys if keys.count(key) > 1)
        raise ValueError(f"the key {twice!r} twice")
    return found


def _no_number(text: str) -> NoReturn:
    raise ValueError(f"the number {text}")


def is_name(text: str) -> bool:
    """Return whether a text may be the name of an object or a class."""
    bad = any(c in "/\\" or not c.isprintable() for c in text) or text.startswith(".")
    return bool(text.strip()) and not bad and len(text.encode()) <= MAX_NAME
