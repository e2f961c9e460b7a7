"""The decisions of a running inspection, on disk at all times."""

from __future__ import annotations

import threading
from pathlib import Path

from drakegrasp.dataset.rejections import (
    FILE_NAME,
    AttemptKey,
    Decisions,
    read_decisions,
    write_decisions,
)


class DecisionFile:
    """`reject.json` of a dataset, written anew with every decision.

    It is read before each change, so that a file edited by hand or by a second inspection is not
    overwritten with old content.

    Args:
        out: Directory of the dataset.

    Raises:
        DataError: If there is such a file that cannot be read.
    """

    def __init__(self, out: Path) -> None:
        self._path = out / FILE_NAME
        self._lock = threading.Lock()
        self._before: list[tuple[AttemptKey, str]] = []
        self.read()

    def read(self) -> Decisions:
        """Return the decisions as they are on disk.

        Raises:
            DataError: If the file cannot be read.
        """
        return read_decisions(self._path)

    def decide(self, key: AttemptKey, decision: str) -> None:
        """Write a decision: `rejected`, `kept`, or empty text to withdraw it.

        Raises:
            ValueError: If the decision is none.
            DataError: If the file is something else by now.
            OSError: If it cannot be written.
        """
        with self._lock:
            decisions = self.read()
            changed = decisions.with_decision(key, decision)
            write_decisions(self._path, changed)
            self._before.append((key, decisions.of(key)))

    def undo(self) -> AttemptKey | None:
        """Withdraw the last decision of this inspection; return its attempt, None if none is left.

        Raises:
            DataError: If the file is something else by now.
            OSError: If it cannot be written.
        """
        with self._lock:
            if not self._before:
                return None
            key, before = self._before[-1]
            write_decisions(self._path, self.read().with_decision(key, before))
            self._before.pop()
            return key
