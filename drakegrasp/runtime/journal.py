"""A work unit's journal: which of its steps runs now, so that a death has a name.

While a unit runs, a small file beside its shard says which step it is at: building the
scene, an attempt, its images. Before each step one fixed-size record is overwritten. A
native crash and a step that passes its time limit leave a mark behind the record, written
by Python's `faulthandler` without the interpreter; SIGKILL leaves none. When the unit is
done the file goes. One that is found at a unit's start is what an earlier run died of, and
the step that it names is judged:

* one that passed its time limit is not tried again;
* one in which the process crashed `NATIVE_DEATHS` times in a row is not tried again;
* an attempt in which the process vanished `SILENT_DEATHS` times in a row (the kernel's or
  the nanny's answer to too little memory) is not tried again.

Steps under suspicion run first, so a failing one costs a start of the process and not the
unit, and an innocent one is cleared by passing. Silent deaths must hit the very same step
eight times in a row: a machine that is switched off, or a random SIGKILL, does not.

The file is text: a line of JSON with the unit's identity and the deaths before, the
record, and what faulthandler wrote.
"""

from __future__ import annotations

import faulthandler
import json
import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from enum import Enum
from io import FileIO
from pathlib import Path
from typing import Any

from drakegrasp.runtime.files import temporary_name
from drakegrasp.runtime.processes import lock_file

#: Crashes in a row of one step after which it is not tried again: one may be the machine's.
NATIVE_DEATHS = 2
#: Unmarked deaths in a row of one step after which it is not tried again.
SILENT_DEATHS = 8
#: Deaths of a unit since it last learned something, after which it is not tried again.
GIVE_UP_DEATHS = 20
#: Bytes of the record.
_RECORD_SIZE = 32
#: What faulthandler writes first, by what happened.
_CRASH_MARK, _TIME_MARK = b"Fatal Python error", b"Timeout ("
#: How the steps that are attempts begin.
ATTEMPT = "try"


class Verdict(Enum):
    """Why a step is not tried again."""

    HUNG = "passed its time limit"
    CRASHED = "crashed its process"
    VANISHED = "was at work whenever its process vanished, as for lack of memory"


@dataclass(frozen=True)
class Deaths:
    """Deaths in a row of one step: crashes, unmarked ones, and whether it hung."""

    native: int = 0
    silent: int = 0
    hung: bool = False


@dataclass
class _History:
    """What earlier runs of a unit died of: by step, and their number since the last verdict."""

    deaths: dict[str, Deaths] = field(default_factory=dict)
    crash_loop: int = 0

    def verdict(self, step: str) -> Verdict | None:
        found = self.deaths.get(step, Deaths())
        if found.hung:
            return Verdict.HUNG
        if found.native >= NATIVE_DEATHS:
            return Verdict.CRASHED
        # Long steps would be hit by chance, and an object is not given up for that.
        vanished = found.silent >= SILENT_DEATHS and step.startswith(ATTEMPT)
        return Verdict.VANISHED if vanished else None

    def unresolved(self) -> list[str]:
        return [step for step in self.deaths if self.verdict(step) is None]

    def add(self, step: str, passed: int, marks: bytes) -> None:
        """Take in that a run died at a step; bit i of `passed` clears the i-th suspect."""
        for i, suspect in enumerate(self.unresolved()):
            if passed >> i & 1:
                del self.deaths[suspect]
        before = self.deaths.get(step, Deaths())
        if _TIME_MARK in marks:
            now = replace(before, hung=True)
        elif _CRASH_MARK in marks:
            now = replace(before, native=before.native + 1)
        else:
            now = replace(before, silent=before.silent + 1)
        self.deaths[step] = now
        self.crash_loop = 0 if self.verdict(step) else self.crash_loop + 1


class Journal:
    """The journal of a run in this process; see `open_journal`."""

    def __init__(self, file: FileIO | None, start: int, history: _History) -> None:
        self._file, self._start, self._history = file, start, history
        self._passed = 0

    @property
    def unresolved(self) -> list[str]:
        """The steps to run first, in this order."""
        return self._history.unresolved()

    @property
    def in_crash_loop(self) -> bool:
        """Whether the unit died again and again and nothing was learned from it."""
        return self._history.crash_loop >= GIVE_UP_DEATHS

    def verdict(self, step: str) -> Verdict | None:
        """Return why a step must not be tried again, or None if it may."""
        return self._history.verdict(step)

    @contextmanager
    def step(self, name: str, seconds: float | None = None) -> Iterator[None]:
        """Say that a step runs while the block does.

        Args:
            name: Of the step, up to 14 ASCII characters.
            seconds: Of the wall clock after which this process ends itself, wherever it is,
                or None for a step that cannot hang.
        """
        if self._file is None:
            yield
            return
        os.pwrite(self._file.fileno(), _record(name, self._passed), self._start)
        if seconds is not None:
            # A thread of C, so it also ends a process that never comes back to Python.
            faulthandler.dump_traceback_later(seconds, exit=True, file=self._file)
        try:
            yield
        except MemoryError:
            os._exit(1)  # as if the kernel had done it: a new process has what this one held
        finally:
            if seconds is not None:
                faulthandler.cancel_dump_traceback_later()
        if name in self.unresolved:
            self._passed |= 1 << self.unresolved.index(name)


#: The journal of a run in a process that nobody would start again: it keeps none.
NO_JOURNAL = Journal(None, 0, _History())


@contextmanager
def open_journal(path: Path, identity: Mapping[str, Any]) -> Iterator[Journal]:
    """Keep a journal while the block runs; judge what an earlier run of the same died of.

    It is removed when the block ends, by itself or by an exception: both come back to
    whoever asked for the unit. Only a death leaves it.

    Args:
        path: Of the journal.
        identity: What the unit is of, as JSON types; a journal of anything else is ignored.

    Raises:
        OSError: If the file cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    history = _read_history(path, identity)
    if history is None:  # another process is at this unit: both will write the same shard
        yield NO_JOURNAL
        return
    line = json.dumps(
        {
            "unit": dict(identity),
            "deaths": {step: asdict(deaths) for step, deaths in history.deaths.items()},
            "crash_loop": history.crash_loop,
        },
        ensure_ascii=False,
    ).encode()
    start = len(line) + 1
    temporary = temporary_name(path)
    try:
        temporary.write_bytes(line + b"\n" + _record("start", 0))
        with temporary.open("r+b", buffering=0) as file:
            lock_file(file)
            file.seek(0, os.SEEK_END)  # faulthandler writes here
            temporary.replace(path)
            with _crashes_marked(file):
                yield Journal(file, start, history)
    finally:
        path.unlink(missing_ok=True)
        temporary.unlink(missing_ok=True)


def _record(step: str, passed: int) -> bytes:
    return f"{passed:016x} {step}".encode("ascii").ljust(_RECORD_SIZE - 1) + b"\n"


def _read_history(path: Path, identity: Mapping[str, Any]) -> _History | None:
    """Return what earlier runs died of, or None if one of them is still alive."""
    history = _History()
    try:
        with path.open("r+b") as file:  # NFS locks only what may be written
            # Where the file system knows no locks, nobody holds any.
            if lock_file(file) is False:
                return None
            head, _, rest = file.read().partition(b"\n")
        content = json.loads(head)
        if content["unit"] != dict(identity):
            return _History()
        for step, deaths in content["deaths"].items():
            history.deaths[step] = Deaths(**deaths)
        history.crash_loop = int(content["crash_loop"])
        passed, step = rest[:_RECORD_SIZE].decode("ascii").split(maxsplit=1)
        history.add(step.strip(), int(passed, 16), rest[_RECORD_SIZE:])
    except FileNotFoundError:
        return _History()
    except (KeyError, TypeError, ValueError):
        return _History()  # nothing that this program wrote
    return history


@contextmanager
def _crashes_marked(file: FileIO) -> Iterator[None]:
    """Have native crashes of this process written to a file while the block runs."""
    before = faulthandler.is_enabled()
    faulthandler.enable(file=file, all_threads=False)
    try:
        yield
    finally:
        faulthandler.disable()
        if before and sys.__stderr__ is not None:
            with suppress(OSError, ValueError):  # no file behind it
                faulthandler.enable(file=sys.__stderr__)
