"""Files at an address, as s3://, gs://, hf://, https:// and all others that fsspec knows.

Input: a path or an address. Output: the path of a local file. A file at an address is downloaded
once into a cache folder, and again when the store has another version of it. fsspec is loaded for
addresses only; the packages for each store are in the extra `[remote]`.
"""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import Any

from drakegrasp.errors import DataError, MachineError, one_line
from drakegrasp.foreign_files import ADDRESS

#: The variable that names the cache folder.
CACHE_VARIABLE = "DRAKEGRASP_CACHE"


def local_file(path: str | Path) -> Path:
    """Return the absolute path of a file, which is downloaded if `path` is an address.

    Raises:
        DataError: If there is no such file, or the download breaks off.
        MachineError: If a package is missing that the address needs.
    """
    scheme = ADDRESS.match(str(path))
    if scheme is None or Path(path).exists():
        return Path(path).absolute()
    address = path if isinstance(path, str) else f"{scheme[1]}://{str(path)[scheme.end() :]}"
    try:
        return _downloaded(address)
    except DataError:
        raise
    except ImportError as error:
        extra = "pip install 'drakegrasp[remote]'"
        raise MachineError(f"{address} needs a package: {extra} ({one_line(error)})") from None
    except Exception as error:  # each store has its own exceptions
        got = f"{type(error).__name__}: {one_line(error)}"
        raise DataError(f"{address}: must be a file that can be read, got none ({got})") from None


def cache_folder() -> Path:
    """Return the folder of downloaded files."""
    above = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(os.environ.get(CACHE_VARIABLE) or Path(above) / "drakegrasp")


def _downloaded(address: str) -> Path:
    """Return the path of the cached copy of a file."""
    from fsspec.core import url_to_fs

    from drakegrasp.runtime.files import atomic_path

    store, name = url_to_fs(address)
    info: dict[str, Any] = store.info(name)
    if info.get("type") != "file":
        raise DataError(f"{address}: must be a file, got a {info.get('type')}")

    # A new version has another key. Not every store has the size and the tag in its own key.
    size = info.get("size")
    version = address, store.ukey(name), size, info.get("ETag")
    key = hashlib.sha256(repr(version).encode()).hexdigest()[:16]
    cached = cache_folder() / key / Path(name).name
    if not cached.is_file():
        with atomic_path(cached) as part:
            store.get_file(name, str(part))
            if size is not None and (got := part.stat().st_size) != size:
                raise DataError(f"{address}: must have {size:,} bytes, got {got:,}: download again")
    return cached.absolute()
