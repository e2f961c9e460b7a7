"""Giving memory back that is not used any more.

Diagrams and meshes are megabytes in C++ and NumPy: Python does not count the one, and the C
library keeps what is freed of both for later, in the arenas of each of a worker's threads.
"""

from __future__ import annotations

import ctypes
import gc
import time

#: Time between two returns of free memory [s]; one takes some 20 ms.
TRIM_SECONDS = 5.0

_trimmed = -TRIM_SECONDS


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
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:  # other C libraries decide for themselves
        trim(0)
