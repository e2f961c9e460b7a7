"""Actions of a person on a page: deciding, and running an attempt again.

Input: the directory of a dataset. Output: `reject.json`, which is always up to date on disk, and
recordings in a folder that is removed at the end.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from filelock import FileLock, Timeout

from drakegrasp.dataset.rejections import (
    FILE_NAME,
    AttemptKey,
    Decisions,
    read_decisions,
    write_decisions,
)
from drakegrasp.errors import DataError

#: A process that writes `reject.json` locks this file, and removes it when the decision is written.
LOCK_NAME = f".{FILE_NAME}.lock"
#: Time [s] that a decision waits for those of other inspections, each of which takes milliseconds.
PATIENCE = 10.0


class Step(NamedTuple):
    """A change of the decision on an attempt."""

    key: AttemptKey
    before: str
    after: str


class DecisionFile:
    """`reject.json` of a dataset, rewritten with every decision.

    The file is read before each change, and locked until the change is written, so that no decision
    of another inspection or a person is lost.

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
            decision: `rejected`, `kept`, or empty text to withdraw the decision.

        Raises:
            ValueError: If the text is not a decision.
            DataError: If the file is no longer a list of rejections.
            OSError: If the file cannot be written.
        """
        with self._lock, _held(self._path.with_name(LOCK_NAME)):
            decisions = self.read()
            before, changed = decisions.of(key), decisions.with_decision(key, decision)
            if decision == before:
                return decisions
            write_decisions(self._path, changed)
            self._last = Step(key, before, decision)
            return changed

    def undo(self) -> Step | None:
        """Withdraw the last decision and return it; None if there is none.

        If another inspection has decided differently since, that decision stays.

        Raises:
            DataError: If the file is no longer a list of rejections.
            OSError: If the file cannot be written.
        """
        with self._lock, _held(self._path.with_name(LOCK_NAME)):
            last = self._last
            if last is None:
                return None
            decisions = self.read()
            stands = decisions.of(last.key) == last.after
            if stands:
                write_decisions(self._path, decisions.with_decision(last.key, last.before))
            self._last = None
            return last if stands else None


@contextmanager
def _held(path: Path) -> Iterator[None]:
    """Hold the kernel's lock on a file while the block runs, and remove it at the end.

    Raises:
        DataError: If another process holds the lock for a long time.
        OSError: If the file cannot be created.
    """
    try:
        held = FileLock(path).acquire(timeout=PATIENCE, poll_interval=0.002)
    except Timeout:
        raise DataError(
            f"{path}: must be held for a moment only, got a process that holds it for "
            f"{PATIENCE:.0f} s"
        ) from None
    with held:
        try:
            yield
        finally:
            path.unlink(missing_ok=True)


#: Time limit of a replay [s].
TIMEOUT = 300.0


class Rerun(NamedTuple):
    """Result of running an attempt again.

    Attributes:
        same: Whether each value equals the stored one, bit for bit.
        text: Output of `replay`, one line per value that differs.
    """

    same: bool
    text: str


class Recordings:
    """Recordings of this inspection, in a folder that is removed at its end.

    A replay runs in its own process, so its memory and its crashes do not affect the server.

    Args:
        out: Directory of the dataset.
    """

    def __init__(self, out: Path) -> None:
        self._out = out
        self._folder: Path | None = None
        self._lock = threading.Lock()
        self._found: dict[str, Rerun] = {}

    def make(self, label: str, trial: int) -> Rerun:
        """Run a trial again, store its recording, and return how its values compare.

        Args:
            label: Label of the attempt.
            trial: Row of the attempt in trials.hdf5.

        Raises:
            DataError: If the trial cannot be run again; the reason is the last line of `replay`.
        """
        code = "from drakegrasp.cli.main import run; run()"
        # -P: a module in the current folder must not replace one of Python's.
        arguments = ["replay", "--trial", str(trial)]
        command = [sys.executable, "-P", "-c", code, *arguments]
        # One at a time, since each takes a core for some seconds.
        with self._lock:
            if self._folder is None:
                self._folder = Path(tempfile.mkdtemp(prefix="drakegrasp-inspect-"))
            path = self._path(label)
            if label in self._found:
                return self._found[label]
            try:
                done = subprocess.run(
                    [*command, "--html", str(path), "--", str(self._out)],
                    capture_output=True,
                    text=True,
                    timeout=TIMEOUT,
                    check=False,
                )
            except subprocess.TimeoutExpired:
                raise DataError(f"trial {trial} must replay within {TIMEOUT:.0f} s") from None
            if not path.is_file():
                reason = (done.stderr.strip().splitlines() or ["no recording was written"])[-1]
                raise DataError(f"trial {trial} cannot be run again: {reason}")

            # Exit code 1 with a recording means that values differ; the recording shows the new
            # run. The last line is the recording's path.
            lines = done.stdout.strip().splitlines()[:-1]
            self._found[label] = Rerun(same=done.returncode == 0, text="\n".join(lines))
            return self._found[label]

    def read(self, label: str) -> bytes | None:
        """Return the recording of an attempt, or None if there is none."""
        if self._folder is None:
            return None
        path = self._path(label)
        return path.read_bytes() if path.is_file() else None

    def close(self) -> None:
        """Remove the recordings."""
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)

    def _path(self, label: str) -> Path:
        """Return the path of a recording, whose name consists of the label's safe characters."""
        assert self._folder is not None
        safe = "".join(c for c in label if c in "0123456789abcdef-")
        return self._folder / f"{safe}.html"
