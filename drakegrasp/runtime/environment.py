"""This process: its cores, its memory, and Drake's ban on the network.

Diagrams and meshes are megabytes of C++ and NumPy memory. Python's garbage collector does not see
the C++ part, and the allocator keeps freed memory for later use, separately for each thread.

Workers run with `DRAKE_ALLOW_NETWORK=none`. Drake (1.51 to 1.58) then refuses to make some
objects even if they would not use the network; `allow_network` eases the ban for these.
"""

from __future__ import annotations

import ctypes
import gc
import os
import resource
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec

from drakegrasp.errors import MachineError
from drakegrasp.runtime.allocator import has_jemalloc, kept_variables

#: Least time between two returns of free memory [s]; one takes about 20 ms.
TRIM_SECONDS = 5.0
#: What jemalloc is told: forget what this thread keeps, and return the free pages of every arena
#: (4096 is its MALLCTL_ARENAS_ALL).
_PURGE = (b"thread.tcache.flush", b"arena.4096.purge")
#: Least limit of virtual memory under which an image is rendered [byte]: with 1.0 GB OpenGL has a
#: segmentation fault, 1.5 GB are enough for `figures`.
RENDER_MEMORY = 1.5e9

_trimmed = -TRIM_SECONDS
_VARIABLE = "DRAKE_ALLOW_NETWORK"


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def require_mujoco(*modules: str) -> None:
    """Refuse work that needs libraries of the extra `[peer]` which are missing.

    Args:
        modules: `mujoco`, `coacd` or both.

    Raises:
        MachineError: If one is missing.
    """
    for module in modules:
        if find_spec(module) is None:
            raise MachineError(f"{module} must be installed: pip install 'drakegrasp[peer]'")


def require_render_memory() -> None:
    """Refuse to render within a limit of memory at which OpenGL would end with a crash.

    Raises:
        MachineError: If it would.
    """
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit != resource.RLIM_INFINITY and limit < RENDER_MEMORY:
        raise MachineError(
            f"the limit of memory must be at least {RENDER_MEMORY / 1e9:g} GB to render, got "
            f"{limit / 1e9:.2g} GB: raise `ulimit -v`"
        )


def release_memory() -> None:
    """Collect reference cycles, and return free memory to the system."""
    gc.collect()
    _trim()


def trim_memory() -> None:
    """Return free memory to the system, unless that was done less than `TRIM_SECONDS` ago."""
    if time.monotonic() - _trimmed > TRIM_SECONDS:
        _trim()


def _trim() -> None:
    global _trimmed
    _trimmed = time.monotonic()
    process = ctypes.CDLL(None)
    if has_jemalloc():
        for order in _PURGE:
            process.mallctl(order, None, None, None, ctypes.c_size_t(0))
    elif hasattr(process, "malloc_trim"):  # other C libraries decide for themselves
        process.malloc_trim(0)


@contextmanager
def allow_network(kind: str) -> Iterator[None]:
    """Allow Drake one kind of network use, e.g. `package_map`, while the block runs."""
    with kept_variables(_VARIABLE):
        os.environ[_VARIABLE] = kind
        yield
