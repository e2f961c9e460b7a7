"""Recordings of attempts that are run again, made when a person asks for one."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

from drakegrasp.errors import DataError

#: Longest time that a replay may take [s].
TIMEOUT = 300.0


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

    def make(self, label: str, trial: int) -> None:
        """Run a trial again and keep its recording.

        Args:
            label: Of the attempt.
            trial: Its row in trials.hdf5.

        Raises:
            DataError: If it cannot be run again; the reason is the last line of `replay`.
        """
        code = "from drakegrasp.cli.main import run; run()"
        command = [sys.executable, "-c", code, "replay", str(self._out), "--trial", str(trial)]
        # One at a time: each takes a core for some seconds.
        with self._lock:
            if self._folder is None:
                self._folder = Path(tempfile.mkdtemp(prefix="drakegrasp-inspect-"))
            path = self._path(label)
            if path.is_file():
                return
            try:
                done = subprocess.run(
                    [*command, "--html", str(path)],
                    capture_output=True,
                    text=True,
                    timeout=TIMEOUT,
                    check=False,
                )
            except subprocess.TimeoutExpired:
                raise DataError(f"trial {trial} must replay within {TIMEOUT:.0f} s") from None
        # Exit code 1 with a recording: values differ, and the recording shows what it is now.
        if not path.is_file():
            reason = (done.stderr.strip().splitlines() or ["no recording was written"])[-1]
            raise DataError(f"trial {trial} cannot be run again: {reason}")

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
        """Return the path of a recording; a label is three numbers, and nothing else is a name."""
        assert self._folder is not None
        safe = "".join(c for c in label if c in "0123456789-")
        return self._folder / f"{safe}.html"
