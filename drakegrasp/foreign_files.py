"""Reads files and names of unknown origin without waiting, endless reading or filling the memory.

Input: a path, and the maximum size of such a file. Output: its bytes, or an `OSError` that states
what is there instead, as for any file that cannot be read. Links are followed, because a dataset
from a hub consists of links into its cache.

Every mistake in JSON is a `ValueError`, and no text has two readings. Python's own reader accepts
NaN and keeps the last of two equal keys. It raises other errors for bytes that are not text, for
values that are nested too deeply and for numbers of thousands of digits.
"""

from __future__ import annotations

import json
import re
import stat
from io import BytesIO
from pathlib import Path
from typing import Any, NoReturn
from zipfile import ZipFile

from drakegrasp.errors import DataError

#: Longest name of an object [bytes]; file systems allow 255, and we append to it.
MAX_NAME = 200
#: Requirement for a name, in error messages.
NAME_RULE = (
    "printable, not empty, without slashes, not begin with a dot, and have at most "
    f"{MAX_NAME} bytes"
)
#: Maximum size of a text (JSON, YAML, CSV), and of arrays or a mesh that are read at once [bytes].
LARGEST_TEXT, LARGEST_CONTENT = 2**28, 2**30
#: Maximum size of a file that is hashed as a whole [bytes]; a shard is built in memory.
LARGEST_SEALED = 2**32
#: Of a file that is larger than this [bytes] and read in parts, at least this fraction must be on
#: the disk. A sparse file takes no room, but hours to read. File systems that compress save less.
LARGE, SOLID = 2**36, 1e-3
#: How the address of a file in a store begins; `Path` makes one slash of several.
ADDRESS = re.compile(r"([a-z][a-z0-9+.-]+):/+")
#: Names of what a path may be instead of a file.
_KINDS = {
    stat.S_IFIFO: "a pipe",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFSOCK: "a socket",
    stat.S_IFDIR: "a folder",
}


def validate_regular(path: Path, largest: int | None = None) -> None:
    """Reject a path that is not a regular file, or a file that is too large.

    Args:
        path: Path of the file.
        largest: Maximum size [bytes]; None for a file that is read in parts, which must not be
            sparse.

    Raises:
        OSError: If the path is rejected, or does not exist.
    """
    status = path.stat()
    if not stat.S_ISREG(status.st_mode):
        raise _refusal(_KINDS.get(stat.S_IFMT(status.st_mode), "no regular file"))
    size, stored = status.st_size, 512 * status.st_blocks
    if largest is not None and size > largest:
        raise _refusal(f"a file of {size:,} byte, more than {largest:,}")
    if largest is None and size > LARGE and stored < SOLID * size:
        raise _refusal(f"a file of {size:,} byte, of which only {stored:,} are on the disk")


def validate_local(path: str | Path) -> None:
    """Reject an address, e.g. s3://, which would be a folder `s3:` here.

    Raises:
        DataError: If the path is an address.
    """
    if ADDRESS.match(str(path)):
        raise DataError(f"{path}: must be a path of this machine, got an address")


def validate_no_link(folder: Path) -> None:
    """Reject a symbolic link as a folder to write to: it may lead out of the dataset.

    Raises:
        DataError: If the folder is a link.
    """
    if folder.is_symlink():
        raise DataError(f"{folder}: must be a folder of the dataset to write to, got a link")


def read_content(path: Path, largest: int = LARGEST_CONTENT) -> bytes:
    """Return the bytes of a file, see `validate_regular`."""
    validate_regular(path, largest)
    return path.read_bytes()


def read_npz(source: Path | BytesIO, largest: int = LARGEST_CONTENT) -> dict[str, Any]:
    """Return the arrays of a .npz file by their names.

    Args:
        source: The file, or its content.
        largest: Maximum size of the file and of its arrays [bytes]; a small file can unpack to
            terabytes.

    Raises:
        OSError: If the file cannot be read, or is larger.
        Exception: Of any kind, if it is another file.
    """
    import numpy as np

    if isinstance(source, Path):
        validate_regular(source, largest)
    with source.open("rb") if isinstance(source, Path) else source as file:
        with ZipFile(file) as packed:
            size = sum(item.file_size for item in packed.infolist())
        if size > largest:
            raise _refusal(f"arrays of {size:,} byte, more than {largest:,}")
        file.seek(0)
        with np.load(file, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}


def read_text(path: Path, encoding: str = "utf-8") -> str:
    """Return the text of a file, see `validate_regular`.

    Raises:
        OSError: If the file cannot be read.
        UnicodeDecodeError: If the file is not text in this encoding.
    """
    validate_regular(path, LARGEST_TEXT)
    return path.read_text(encoding=encoding)


def _refusal(what: str) -> OSError:
    """Return an error whose `strerror` is its message, because system errors have both."""
    error = OSError(what)
    error.strerror = what
    return error


def read_json(path: Path) -> Any:
    """Return the content of a JSON file.

    Raises:
        OSError: If the file cannot be read.
        ValueError: As for `parse_json`.
    """
    return parse_json(read_content(path, LARGEST_TEXT))


def parse_json(text: str | bytes) -> Any:
    """Return the content of a JSON text.

    Raises:
        ValueError: If the text is not JSON in UTF-8, is nested too deeply, or has a repeated key or
            an invalid number; the message has the reason.
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
    """Return whether a text is allowed as the name of an object or a class."""
    bad = any(c in "/\\" or not c.isprintable() for c in text) or text.startswith(".")
    return bool(text.strip()) and not bad and len(text.encode()) <= MAX_NAME
