"""`log.jsonl`: what happened in a build and when, a line of JSON per event.

In: events. Out: lines at the end of the file, for people, their tools, and the plan of the
rest; no data come from it, and it is the one file of a dataset that has the clock in it.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
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


def read_log(out: Path) -> Iterator[dict[str, Any]]:
    """Yield the events of a directory's builds, oldest first; none if there is no log.

    A line that is cut off, by a full disk, is passed over.
    """
    try:
        file = (out / FILE_NAME).open(encoding="utf-8")
    except OSError:
        return
    with file:
        for line in file:
            try:
                event = json.loads(line)
            except ValueError:
                continue
            if isinstance(event, dict):
                yield event
