"""The decisions of a person on a page, which are on disk at once.

Input: the directory of a dataset. Output: its `reject.json`.
"""

from __future__ import annotations

import threading
from pathlib import Path
from typing import NamedTuple

from drakegrasp.dataset.rejections import (
    FILE_NAME,
    AttemptKey,
    Decisions,
    read_decisions,
    write_decisions,
)


class Step(NamedTuple):
    """A change of the decision on an attempt."""

    key: AttemptKey
    before: str
    after: str


class DecisionFile:
    """`reject.json` of a dataset, which is read before each change, and written with it.

    Args:
        out: Directory of the dataset.

    Raises:
        DataError: If the file exists and cannot be read.
    """

    def __init__(self, out: Path) -> None:
        self._path = out / FILE_NAME
        self._lock = threading.Lock()
        self._last: Step | None = None
        self.read()

    def read(self) -> Decisions:
        """Return the decisions on disk.

        Raises:
            DataError: If the file cannot be read.
        """
        return read_decisions(self._path)

    def decide(self, key: AttemptKey, decision: str) -> Decisions:
        """Write a decision and return all decisions including it.

        Args:
            key: The attempt.
            decision: `rejected`, or empty text to withdraw that.

        Raises:
            ValueError: If the text is not a decision.
            DataError: If the file is no longer a list of rejections.
            OSError: If the file cannot be written.
        """
        with self._lock:
            decisions = self.read()
            before, changed = decisions.of(key), decisions.with_decision(key, decision)
            if decision != before:
                write_decisions(self._path, changed)
                self._last = Step(key, before, decision)
            return changed

    def undo(self) -> Step | None:
        """Withdraw the last decision and return it; None if there is none, or it stands no more.

        Raises:
            DataError: If the file is no longer a list of rejections.
            OSError: If the file cannot be written.
        """
        with self._lock:
            last, self._last = self._last, None
            decisions = self.read()
            if last is None or decisions.of(last.key) != last.after:
                return None
            write_decisions(self._path, decisions.with_decision(last.key, last.before))
            return last
