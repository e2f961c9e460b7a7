"""What the machine that runs the tests can do."""

from __future__ import annotations

import ctypes
import sys

import pytest


def has_egl() -> bool:
    try:
        ctypes.CDLL("libEGL.so.1")
    except OSError:
        return False
    return True


needs_egl = pytest.mark.skipif(
    sys.platform == "linux" and not has_egl(), reason="rendering needs libEGL.so.1"
)
