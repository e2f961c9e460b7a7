"""jemalloc in place of the C library's allocator, which makes trials faster and no bit different.

A process has the allocator it starts with: the loader puts jemalloc before the C library where
LD_PRELOAD names it. What `cluster` starts gets it by `dask_setup` on the machine where
it starts, as each may have the library or not; commands that simulate start again with it. The
library is found by its name, by the loader itself, so it may be wherever the system has it.
"""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

LIBRARY = "libjemalloc.so.2"
PRELOAD, SETTINGS = "LD_PRELOAD", "MALLOC_CONF"
#: Arrays up to 4 MiB are kept for the next of their size. Without, jemalloc hands the pages of
#: each large array of zeros back to the system, and the screen takes a fifth longer.
TUNING = "lg_tcache_max:22"
#: How long the trial with the library may take on a busy machine [s].
TRIAL_SECONDS = 30.0
#: What the trial runs.
_CHILD = "from drakegrasp.runtime.allocator import allocator; print(allocator())"


class _Place(ctypes.Structure):
    """`Dl_info`: where an address is from."""

    _fields_ = (
        ("file", ctypes.c_char_p),
        ("base", ctypes.c_void_p),
        ("symbol", ctypes.c_char_p),
        ("address", ctypes.c_void_p),
    )


def allocator() -> str:
    """Return the file name of the library from which this process has its memory."""
    if sys.platform != "linux":
        return "unknown"
    process, place = ctypes.CDLL(None), _Place()
    # Not `malloc`, whose address is the program's own where it is not position-independent.
    if not process.dladdr(process.malloc_usable_size, ctypes.byref(place)):
        return "unknown"
    return Path(os.fsdecode(place.file)).name


def has_jemalloc() -> bool:
    """Return whether this process has its memory from jemalloc."""
    return allocator().startswith("libjemalloc")


def jemalloc_environment() -> dict[str, str]:
    """Return the variables with which a process starts with jemalloc; none where it cannot.

    What the user preloads stays, and stays before it: an allocator there is the one that serves.
    """
    if sys.platform != "linux":
        return {}
    mine, theirs = os.environ.get(PRELOAD, ""), os.environ.get(SETTINGS, TUNING)
    preload = mine if "libjemalloc" in mine else ":".join(filter(None, (mine, LIBRARY)))
    return {PRELOAD: preload, SETTINGS: theirs} if _serves(preload, theirs) else {}


@cache
def _serves(preload: str, settings: str) -> bool:
    """Return whether a process that starts so has its memory from jemalloc, by starting one."""
    paths = os.pathsep.join(str(Path(p).resolve()) for p in sys.path if p)
    environment = {PRELOAD: preload, SETTINGS: settings, "PYTHONPATH": paths}
    try:
        child = subprocess.run(
            [sys.executable, "-P", "-c", _CHILD],
            env={**os.environ, **environment},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=TRIAL_SECONDS,
        )
    except (OSError, subprocess.TimeoutExpired):
        return False
    return child.stdout.startswith("libjemalloc")  # of what is missing the loader only warns


def restart_with_jemalloc() -> None:
    """Start this program again with jemalloc, where it is there and this process has another."""
    if has_jemalloc() or "libjemalloc" in os.environ.get(PRELOAD, ""):
        return
    found = jemalloc_environment()
    if found:
        restart(found)


def restart(variables: Mapping[str, str]) -> None:
    """Start this program again as it was called, with Python's own options.

    Call it before anything is opened or started: nothing of this process remains but its number.
    """
    os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:]], {**os.environ, **variables})


@contextmanager
def kept_variables(*names: str) -> Iterator[None]:
    """Give variables of the environment their values back when the block ends."""
    before = {name: os.environ.get(name) for name in names}
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def dask_setup(nanny: Any) -> None:
    """Have a nanny start its worker with jemalloc; Dask calls this where the nanny runs."""
    nanny.pre_spawn_env.update(jemalloc_environment())
