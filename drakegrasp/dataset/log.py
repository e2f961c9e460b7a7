"""`log.jsonl`: the events of a dataset's builds, with their times, a line of JSON each.

People, their tools and the estimate of the remaining time read it. No data come from it, and it
is the only file of a dataset that depends on the clock.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from drakegrasp.foreign_files import parse_json, refuse_irregular
from drakegrasp.runtime.files import open_own

FILE_NAME = "log.jsonl"


class BuildLog:
    """The log of a directory's builds.

    Args:
        out: Directory of the dataset.
    """

    def __init__(self, out: Path) -> None:
        self._path = out / FILE_NAME

    def __call__(self, event: str, **facts: Any) -> None:
        """Append an event in one write, so that a crash leaves whole lines.

        Args:
            event: Name of the event, e.g. "unit done".
            facts: Its details, as JSON types.

        Raises:
            OSError: If the file cannot be written.
            DataError: If it is a link.
        """
        now = datetime.now(UTC).isoformat(timespec="milliseconds")
        line = json.dumps({"time": now, "event": event, **facts}, ensure_ascii=False)

        # Other alphabets stay readable; what would steer a terminal becomes its code.
        line = "".join(c if c.isprintable() else json.dumps(c)[1:-1] for c in line) + "\n"
        descriptor = open_own(self._path, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
        try:
            os.write(descriptor, line.encode())
        finally:
            os.close(descriptor)


def read_log(out: Path) -> Iterator[dict[str, Any]]:
    """Yield the events of a directory's builds, oldest first; none if there is no log.

    A line that is no event is skipped, such as one that a full disk has cut off.
    """
    try:
        refuse_irregular(out / FILE_NAME)
        file = (out / FILE_NAME).open("rb")
    except OSError:
        return
    with file:
        for line in file:
            try:
                event = parse_json(line)
            except ValueError:
                continue
            if isinstance(event, dict) and isinstance(event.get("event"), str):
                yield event
