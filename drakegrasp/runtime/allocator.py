"""jemalloc instead of the C library's allocator: trials run faster, and no bit changes.

A process keeps the allocator that it starts with: the loader loads jemalloc before the C library if
LD_PRELOAD names it. Processes that `cluster` starts get it by `dask_setup` on the machine on which
they start, since each machine may have the library or not; commands that simulate restart
themselves with it. The loader itself finds the library by its name, so it may be anywhere in the
system.
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
#: Arrays up to 4 MiB are kept for the next array of their size. Otherwise jemalloc would return the
#: pages of each large array of zeros to the system, and the screen would take a fifth longer.
TUNING = "lg_tcache_max:22"
#: Time limit of the trial with the library [s], for a busy machine.
TRIAL_SECONDS = 30.0
#: Program that the trial runs.
_CHILD = "from drakegrasp.runtime.allocator import allocator; print(allocator())"


class _Place(ctypes.Structure):
    """`Dl_info`: the library to which an address belongs."""

    _fields_ = (
        ("file", ctypes.c_char_p),
        ("base", ctypes.c_void_p),
        ("symbol", ctypes.c_char_p),
        ("address", ctypes.c_void_p),
    )


def allocator() -> str:
    """Return the file name of the library that allocates this process's memory."""
    if sys.platform != "linux":
        return "unknown"
    process, place = ctypes.CDLL(None), _Place()
    # Not `malloc`: its address is in the program itself if that is not position-independent.
    if not process.dladdr(process.malloc_usable_size, ctypes.byref(place)):
        return "unknown"
    return Path(os.fsdecode(place.file)).name


def has_jemalloc() -> bool:
    """Return whether jemalloc allocates this process's memory."""
    return allocator().startswith("libjemalloc")


def jemalloc_environment() -> dict[str, str]:
    """Return the variables with which a process starts with jemalloc; empty if it cannot.

    Libraries that the user preloads stay, and stay in front: if one is an allocator, it is used.
    """
    if sys.platform != "linux":
        return {}
    mine, theirs = os.environ.get(PRELOAD, ""), os.environ.get(SETTINGS, TUNING)
    preload = mine if "libjemalloc" in mine else ":".join(filter(None, (mine, LIBRARY)))
    return {PRELOAD: preload, SETTINGS: theirs} if _serves(preload, theirs) else {}


@cache
def _serves(preload: str, settings: str) -> bool:
    """Return whether a process with these variables uses jemalloc, by starting one."""
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
    return child.stdout.startswith("libjemalloc")  # the loader only warns of a missing library


def restart_with_jemalloc() -> None:
    """Restart this program with jemalloc, if it is installed and another allocator is in use."""
    if has_jemalloc() or "libjemalloc" in os.environ.get(PRELOAD, ""):
        return
    found = jemalloc_environment()
    if found:
        restart(found)


def restart(variables: Mapping[str, str]) -> None:
    """Restart this program as it was called, with Python's own options.

    Call this before anything is opened or started: nothing of this process remains except its
    number.
    """
    os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:]], {**os.environ, **variables})


@contextmanager
def kept_variables(*names: str) -> Iterator[None]:
    """Restore variables of the environment to their previous values when the block ends."""
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
    """Let a nanny start its worker with jemalloc; Dask calls this on the nanny's machine."""
    nanny.pre_spawn_env.update(jemalloc_environment())
