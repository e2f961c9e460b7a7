"""A work unit's journal: it records the current step, so that we know in which step a process died.

While a unit runs, a small file in the folder of its shard names the current step: building the
scene, an attempt, rendering its images. Each step overwrites one record of fixed size. A native
crash and a step that exceeds its time limit leave a mark after the record, which Python's
`faulthandler` writes without the interpreter; SIGKILL leaves no mark. The file is removed when
the unit is done. A file that exists when a unit starts shows that an earlier run died, and in which
step:

* a step that exceeded its time limit `HUNG_DEATHS` times in a row is not tried again;
* a step in which the process crashed `NATIVE_DEATHS` times in a row is not tried again;
* a step in which the process vanished `SILENT_DEATHS` times in a row (the kernel or the nanny kills
  a process that takes too much memory) is not tried again; preparing a mesh gets fewer tries,
  `PREPARE_DEATHS`, because each of them takes longer.

Unresolved steps, in which a process died but not often enough, run first: a failing step then costs
one start of the process instead of the whole unit, and a step that succeeds is cleared. A process
must vanish eight times in a row in the very same step; a machine that is switched off, or a random
SIGKILL, does not cause that.

The limit of a step is computing time: a process that is suspended, or shares its core with many
others, computes little while hours pass. A step that hangs without computing (it waits forever)
exceeds a longer limit of wall-clock time. A long suspension also exceeds that limit, so a step gets
a second chance.

The file is text: a line of JSON with the unit's identity and the previous deaths, the record, and
the output of faulthandler.
"""

from __future__ import annotations

import faulthandler
import json
import os
import runpy
import signal
import sys
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from enum import Enum
from io import FileIO
from pathlib import Path
from typing import Any

from filelock import lock_descriptor

from drakegrasp.errors import MachineError
from drakegrasp.foreign_files import LARGEST_TEXT, validate_regular
from drakegrasp.runtime.files import temporary_name

#: Number of successive crashes in one step after which the step is not tried again: one crash may
#: be the machine's fault.
NATIVE_DEATHS = 2
#: Number of successive exceeded time limits in one step after which the step is not tried again:
#: one may be due to a suspended process.
HUNG_DEATHS = 2
#: The wall-clock limit of a step is this multiple of its limit of computing time, for a machine
#: with far more work than cores, but exceeds it by at most this much [s].
WALL_FACTOR, WALL_SECONDS = 10.0, 3600.0
#: Number of successive deaths without a mark in one step after which the step is not tried again.
SILENT_DEATHS = 8
#: The same number for preparing a mesh, which is one step.
PREPARE_DEATHS = 5
#: Number of deaths of a unit since the last verdict after which it is in a crash loop.
GIVE_UP_DEATHS = 20
#: Size of the record [bytes].
_RECORD_SIZE = 32
#: Beginnings of faulthandler's text for a crash, and for an exceeded limit of either time.
_CRASH_MARK, _TIME_MARKS = b"Fatal Python error", (b"Timeout (", b"hread 0x")
#: Beginning of the names of steps that are attempts; name of the step that prepares a mesh.
ATTEMPT, PREPARE = "try", "prepare"
#: Step in the record before the first step.
_START = "start"
#: Variable with the Python file of a test, whose function `cause` is called at each place, and with
#: what that function gets: `FILE;FAULTS`.
VARIABLE = "DRAKEGRASP_TEST_FAULT"


class Verdict(Enum):
    """Why a step is not tried again."""

    HUNG = "passed its time limit"
    CRASHED = "crashed its process"
    VANISHED = "was at work whenever its process vanished, as for lack of memory"


@dataclass
class _History:
    """How earlier runs of a unit died.

    Attributes:
        deaths: Number of deaths by step, and by the name of the verdict to which they lead.
        crash_loop: Number of deaths since the last verdict.
    """

    deaths: dict[str, Counter[str]] = field(default_factory=dict)
    crash_loop: int = 0

    def verdict(self, step: str) -> Verdict | None:
        # A process that dies before its first step does not die because of the unit.
        if step == _START or step not in self.deaths:
            return None
        most = {
            Verdict.HUNG: HUNG_DEATHS,
            Verdict.CRASHED: NATIVE_DEATHS,
            Verdict.VANISHED: PREPARE_DEATHS if step == PREPARE else SILENT_DEATHS,
        }
        return next((v for v in Verdict if self.deaths[step][v.name] >= most[v]), None)

    def unresolved(self) -> list[str]:
        return [step for step in self.deaths if self.verdict(step) is None]

    def add(self, step: str, passed: int, marks: bytes) -> None:
        """Record that a run died in a step.

        Args:
            step: The step.
            passed: Mask of the unresolved steps that succeeded, bit i for the i-th; these are
                cleared.
            marks: Output of faulthandler.
        """
        for i, cleared in enumerate(self.unresolved()):
            if passed >> i & 1:
                del self.deaths[cleared]
        manner = Verdict.VANISHED
        if _CRASH_MARK in marks:
            manner = Verdict.CRASHED
        elif any(mark in marks for mark in _TIME_MARKS):
            manner = Verdict.HUNG
        self.deaths.setdefault(step, Counter())[manner.name] += 1
        self.crash_loop = 0 if self.verdict(step) else self.crash_loop + 1


class Journal:
    """The journal of a run in this process; see `open_journal`."""

    def __init__(self, file: FileIO | None, start: int, history: _History) -> None:
        self._file, self._start, self._history = file, start, history
        self._passed = 0

    @property
    def unresolved(self) -> list[str]:
        """Steps in which a process died, still without a verdict; run these first, in order."""
        return self._history.unresolved()

    def validate_no_loop(self, work: str) -> None:
        """Give up work that killed its process many times without a verdict on any step.

        Args:
            work: What the work is, for the message.

        Raises:
            MachineError: If it did.
        """
        if self._history.crash_loop >= GIVE_UP_DEATHS:
            raise MachineError(
                f"{work}: the worker died {GIVE_UP_DEATHS} times in a row; is there enough memory? "
                "The same command continues from here"
            )

    def verdict(self, step: str) -> Verdict | None:
        """Return why a step must not be tried again; None if it may be tried."""
        return self._history.verdict(step)

    @contextmanager
    def step(self, name: str, seconds: float | None = None) -> Iterator[None]:
        """Record that a step runs while the block runs.

        Args:
            name: Name of the step, up to 14 ASCII characters.
            seconds: Computing time [s] after which this process ends itself, whatever it is doing;
                it also ends after `wall_limit` of this by the wall clock. None for a step that
                cannot hang.
        """
        if self._file is None:
            yield
            return

        # Before the step: write its record, and set an alarm.
        os.pwrite(self._file.fileno(), _record(name, self._passed), self._start)
        if seconds is not None:
            # Both alarms are in C: they also end a process that never returns to Python.
            signal.setitimer(signal.ITIMER_PROF, seconds)
            faulthandler.dump_traceback_later(wall_limit(seconds), exit=True, file=self._file)
        try:
            yield
        except MemoryError:
            # End as if the kernel had killed the process: a new one starts with free memory.
            os._exit(1)
        finally:
            if seconds is not None:
                signal.setitimer(signal.ITIMER_PROF, 0.0)
                faulthandler.cancel_dump_traceback_later()

        # The next record clears the step.
        if name in self.unresolved:
            self._passed |= 1 << self.unresolved.index(name)


def wall_limit(seconds: float) -> float:
    """Return the wall-clock limit [s] of a step with a limit of computing time [s]."""
    return min(WALL_FACTOR * seconds, seconds + WALL_SECONDS)


#: The journal of a process that is not restarted when it dies: it records nothing.
NO_JOURNAL = Journal(None, 0, _History())


@contextmanager
def open_journal(
    path: Path, identity: Mapping[str, Any], *, restartable: bool = True
) -> Iterator[Journal]:
    """Keep a journal while the block runs, including what is known of earlier runs that died.

    It is removed when the block ends, even with an exception, because the caller then learns how
    the unit ended. Only a death leaves the journal behind.

    Args:
        path: Path of the journal.
        identity: Identifies the unit, as JSON types; a journal of another unit is ignored.
        restartable: Whether this process is started again when it dies; if not, nothing is
            recorded.

    Raises:
        OSError: If the file cannot be written.
    """
    history = None
    if restartable:
        path.parent.mkdir(parents=True, exist_ok=True)
        history = _read_history(path, identity)
    if history is None:
        # Or another process also runs this unit: both will write the same shard.
        yield NO_JOURNAL
        return

    # The first line has the history; the record and faulthandler's text follow.
    line = json.dumps(
        {"unit": dict(identity), "deaths": history.deaths, "crash_loop": history.crash_loop},
        ensure_ascii=False,
    ).encode()
    start = len(line) + 1

    # The file gets its name when it is complete and locked. This is not `atomic_path`, since the
    # file stays open and is not synced.
    temporary = temporary_name(path)
    try:
        temporary.write_bytes(line + b"\n" + _record(_START, 0))
        with temporary.open("r+b", buffering=0) as file:
            _lock(file.fileno())
            file.seek(0, os.SEEK_END)  # faulthandler writes here
            temporary.replace(path)
            with _crashes_marked(file):
                yield Journal(file, start, history)
    finally:
        path.unlink(missing_ok=True)
        temporary.unlink(missing_ok=True)


def _record(step: str, passed: int) -> bytes:
    return f"{passed:016x} {step}".encode("ascii").ljust(_RECORD_SIZE - 1) + b"\n"


def _lock(descriptor: int) -> bool:
    """Take the kernel's lock on a journal; return whether no other process has it."""
    try:
        return lock_descriptor(descriptor, blocking=False)
    except OSError:
        return True  # on a file system without locks, nobody is known to hold one


def _read_history(path: Path, identity: Mapping[str, Any]) -> _History | None:
    """Return how earlier runs died, or None if one of them is still running."""
    history = _History()
    if path.is_symlink():
        return history  # it will be replaced
    try:
        validate_regular(path, LARGEST_TEXT)
        with path.open("r+b") as file:  # NFS locks only files that are open for writing
            if not _lock(file.fileno()):
                return None
            head, _, rest = file.read().partition(b"\n")
        content = json.loads(head)
        if content["unit"] != dict(identity):
            return _History()

        # The deaths of earlier runs, and the step in which the last one ended.
        for step, deaths in content["deaths"].items():
            history.deaths[step] = Counter(deaths)
        history.crash_loop = int(content["crash_loop"])
        passed, step = rest[:_RECORD_SIZE].decode("ascii").split(maxsplit=1)
        history.add(step.strip(), int(passed, 16), rest[_RECORD_SIZE:])
    except (FileNotFoundError, KeyError, TypeError, ValueError):
        return _History()  # there was no run, or another version wrote the file
    return history


@contextmanager
def _crashes_marked(file: FileIO) -> Iterator[None]:
    """Mark native crashes and exceeded limits of this process in a file while the block runs."""
    before = faulthandler.is_enabled()
    faulthandler.enable(file=file, all_threads=False)
    # The alarm of computing time: it writes a mark to the file, then the signal ends the process.
    faulthandler.register(signal.SIGPROF, file=file, all_threads=True, chain=True)
    try:
        yield
    finally:
        faulthandler.unregister(signal.SIGPROF)
        faulthandler.disable()
        if before and sys.__stderr__ is not None:
            with suppress(OSError, ValueError):  # stderr may not be a real file
                faulthandler.enable(file=sys.__stderr__)


def inject_fault(*place: str | int) -> None:
    """Let a test cause a fault at a place; nobody else sets the variable.

    Args:
        place: An object's name; for an attempt also its candidate and its stand-off, for other
            steps what they do.
    """
    text = os.environ.get(VARIABLE)
    if text is not None:
        script, _, faults = text.partition(";")
        runpy.run_path(script)["cause"](faults, ":".join(map(str, place)))
