"""Giving memory back that is not used any more.

Diagrams and meshes are megabytes in C++ and NumPy: Python does not count the one, and the C
library keeps what is freed of both for later, in the arenas of each of a worker's threads.
"""

from __future__ import annotations

import ctypes
import gc


def release_memory() -> None:
    """Collect what sits in reference cycles, and have glibc return what is free to the system."""
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:  # other C libraries decide for themselves
        trim(0)
