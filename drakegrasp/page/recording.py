"""Recordings of attempts that are run again, made when a person asks for one."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
import threading
from pathlib import Path
from typing import NamedTuple

from drakegrasp.errors import DataError

#: Longest time that a replay may take [s].
TIMEOUT = 300.0


class Rerun(NamedTuple):
    """What running an attempt again gave.

    Attributes:
        same: Whether each value is the stored one, bit for bit.
        text: What `replay` says of it, a line per value that differs.
    """

    same: bool
    text: str


class Recordings:
    """Recordings of this inspection, in a folder that is removed at its end.

    A replay runs in a process of its own: its memory and its crashes are not the server's.

    Args:
        out: Directory of the dataset.
    """

    def __init__(self, out: Path) -> None:
        self._out = out
        self._folder: Path | None = None
        self._lock = threading.Lock()
        self._found: dict[str, Rerun] = {}

    def make(self, label: str, trial: int) -> Rerun:
        """Run a trial again, keep its recording, and return how it compares.

        Args:
            label: Of the attempt.
            trial: Its row in trials.hdf5.

        Raises:
            DataError: If it cannot be run again; the reason is the last line of `replay`.
        """
        code = "from drakegrasp.cli.main import run; run()"
        # -P: a module in the current folder must not stand for one of Python's.
        arguments = ["replay", "--trial", str(trial)]
        command = [sys.executable, "-P", "-c", code, *arguments]
        # One at a time: each takes a core for some seconds.
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

            # Exit code 1 with a recording: values differ, and the recording shows what is now. The
            # last line is the recording's path.
            lines = done.stdout.strip().splitlines()[:-1]
            self._found[label] = Rerun(same=done.returncode == 0, text="\n".join(lines))
            return self._found[label]

    def read(self, label: str) -> bytes | None:
        """Return the recording of an attempt, or None if none was made."""
        if self._folder is None:
            return None
        path = self._path(label)
        return path.read_bytes() if path.is_file() else None

    def close(self) -> None:
        """Remove the recordings."""
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)

    def _path(self, label: str) -> Path:
        """Return the path of a recording; only labels are names."""
        assert self._folder is not None
        safe = "".join(c for c in label if c in "0123456789abcdef-")
        return self._folder / f"{safe}.html"
