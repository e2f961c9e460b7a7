"""A program that starts again in UTF-8 mode."""

from __future__ import annotations

import os
import sys

from drakegrasp.runtime.allocator import restart

_UTF8, _STREAMS = "PYTHONUTF8", "PYTHONIOENCODING"


def restart_with_utf8() -> None:
    """Start this program again in Python's UTF-8 mode, where the locale has another encoding.

    Under such a locale Drake cannot be imported, and the files of an object cannot be opened whose
    name it cannot encode. The streams keep the encoding of the terminal.
    """
    if sys.getfilesystemencoding() == "utf-8" or os.environ.get(_UTF8) == "1":
        return
    terminal = getattr(sys.stdout, "encoding", None) or "utf-8"
    restart({_STREAMS: f"{terminal}:replace", **os.environ, _UTF8: "1"})
