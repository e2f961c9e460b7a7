"""The process: memory that is given back, and Drake's ban of the network.

Diagrams and meshes are megabytes in C++ and NumPy: Python does not count the one, and the
allocator keeps what is freed of both for later, in the arenas of each of a worker's threads.

`DRAKE_ALLOW_NETWORK=none`, as our workers run, is a ban that Drake (1.51 to 1.58) applies
already when some objects are made, whether or not they would use a network: it is eased for the
few things that need none.
"""

from __future__ import annotations

import ctypes
import gc
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager

from drakegrasp.runtime.allocator import has_jemalloc

#: Time between two returns of free memory [s]; one takes some 20 ms.
TRIM_SECONDS = 5.0
#: What jemalloc is told: forget what this thread keeps, and return the free pages of every arena
#: (4096 is its MALLCTL_ARENAS_ALL).
_PURGE = (b"thread.tcache.flush", b"arena.4096.purge")

_trimmed = -TRIM_SECONDS


_VARIABLE = "DRAKE_ALLOW_NETWORK"


def release_memory() -> None:
    """Collect what sits in reference cycles, and return what is free to the system."""
    gc.collect()
    _trim()


def trim_memory() -> None:
    """Return what is free to the system, unless that was done a moment ago."""
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
    """Allow one of Drake's kinds of network use, e.g. `package_map`, while the block runs."""
    allowed = os.environ.get(_VARIABLE)
    os.environ[_VARIABLE] = kind
    try:
        yield
    finally:
        if allowed is None:
            del os.environ[_VARIABLE]
        else:
            os.environ[_VARIABLE] = allowed
