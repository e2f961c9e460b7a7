"""Files of a folder that are replaced together: all are the old ones, or all the new ones.

Each new file is written under a temporary name. When all are complete and synced, a list of them
appears, `replacement.json`: from then on the new files count. Each gets its name, and the list
goes. A process that dies before there is a list leaves the old files. One that dies later leaves
the list, and `complete_replacement` does the rest; until then nobody may read in the folder.
"""

from __future__ import annotations

import json
import stat
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from drakegrasp.errors import DataError
from drakegrasp.runtime.files import is_temporary_of, sync, temporary_name, write_atomic
from drakegrasp.runtime.json_text import read_json

#: The list of files that are being replaced.
LIST_NAME = "replacement.json"
#: How long a reader waits for a process that is just replacing files [s]; it takes milliseconds.
PATIENCE = 2.0


@contextmanager
def replaced_together(folder: Path) -> Iterator[Callable[[str], Path]]:
    """Yield a function that gives the path under which to write a file; it takes its name.

    The files appear in the folder when the block ends well. One process at a time may do this.

    Args:
        folder: Of the files.

    Raises:
        OSError: If the disk is full or the folder cannot be written; the old files stay.
    """
    temporary: dict[str, Path] = {}

    def begin(name: str) -> Path:
        temporary[name] = temporary_name(folder / name)
        return temporary[name]

    try:
        yield begin

        # On the disk before the list is, or a power cut could leave a list of empty files.
        for path in temporary.values():
            sync(path)
        listed = {name: path.name for name, path in temporary.items()}
        write_atomic(folder / LIST_NAME, json.dumps(listed, indent=1).encode() + b"\n")
    except BaseException:
        # The list first: a list of files that are gone must not stay.
        for path in (folder / LIST_NAME, *temporary.values()):
            path.unlink(missing_ok=True)
        raise
    complete_replacement(folder)


def complete_replacement(folder: Path) -> bool:
    """Give the files in a folder's list their names; return whether there was a list.

    Raises:
        DataError: If the list is of something else.
        OSError: If the folder cannot be written.
    """
    path = folder / LIST_NAME
    try:
        listed = _read_list(path)
    except FileNotFoundError:
        return False

    # What is no longer there has its name already.
    for name, temporary in listed.items():
        new = folder / temporary
        try:
            if not stat.S_ISREG(new.lstat().st_mode):
                raise _no_list(path, f"{temporary!r}, which is no file")
        except FileNotFoundError:
            continue
        new.replace(folder / name)

    sync(folder)
    path.unlink(missing_ok=True)
    sync(folder)
    return True


def refuse_half_replaced(folder: Path) -> None:
    """Refuse to read in a folder some of whose files are old and some new.

    Raises:
        DataError: If the list stays for `PATIENCE`: the process that wrote it is dead.
    """
    end = time.monotonic() + PATIENCE
    while (folder / LIST_NAME).exists():
        if time.monotonic() > end:
            raise DataError(
                f"{folder}: must hold files of one state, got some that were being replaced when a "
                f"process died; `drakegrasp stats {folder}` completes this"
            )
        time.sleep(0.05)


def _read_list(path: Path) -> dict[str, str]:
    """Return the names in the folder by which names they shall get.

    Raises:
        FileNotFoundError: If there is no list.
        DataError: If it names anything but files of its folder that were written for it.
    """
    try:
        content = read_json(path)
    except FileNotFoundError:
        raise
    except (OSError, ValueError) as error:
        raise _no_list(path, f"a broken one ({error})") from None
    if not isinstance(content, dict):
        raise _no_list(path, "something else")
    for name, temporary in content.items():
        if "/" in name or not isinstance(temporary, str) or not is_temporary_of(temporary, name):
            raise _no_list(path, f"{temporary!r} for {name!r}")
    return content


def _no_list(path: Path, got: str) -> DataError:
    return DataError(f"{path}: must be a list of files that are being replaced, got {got}")
