"""`log.jsonl`: what happened in a build and when, a line of JSON per event.

In: events. Out: lines at the end of the file, for people and their tools; no part of the
program reads it, and it is the one file of a dataset that has the clock in it.
"""

from __future__ import annotations

import json
import os
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

FILE_NAME = "log.jsonl"


class BuildLog:
    """The log of the builds of a directory."""

    def __init__(self, out: Path) -> None:
        self._path = out / FILE_NAME

    def __call__(self, event: str, **facts: Any) -> None:
        """Add an event, in one write, so that a crash leaves whole lines.

        Args:
            event: What happened, e.g. "unit done".
            facts: More about it, as JSON types.

        Raises:
            OSError: If the file cannot be written.
        """
        now = datetime.now(UTC).isoformat(timespec="milliseconds")
        line = json.dumps({"time": now, "event": event, **facts}, ensure_ascii=False) + "\n"
        descriptor = os.open(self._path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
        try:
            os.write(descriptor, line.encode())
        finally:
            os.close(descriptor)
