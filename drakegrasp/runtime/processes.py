"""The identity of a process, whether it still runs, and the kernel's lock on a file.

A process is identified by its machine, the start of the machine, its number and its start: the
kernel reuses numbers. Only the kernel's locks reach other machines, on network file systems that
have them.

psutil is no substitute: it computes the start of a process from the wall clock, which may be
set, so a living process could look like another one. Linux's clock ticks since the machine's
start never change.
"""

from __future__ import annotations

import fcntl
import os
import re
import socket
from dataclasses import dataclass
from pathlib import Path
from typing import IO

#: Where Linux keeps a number that is new at every start of the machine.
_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


@dataclass(frozen=True, kw_only=True)
class Process:
    """A process of some machine.

    Attributes:
        host: Name of the machine.
        pid: Number of the process there.
        began: Clock ticks from the machine's start to the process's; -1 if unknown.
        boot: What tells one start of the machine from the next; empty if unknown.
    """

    host: str
    pid: int
    began: int
    boot: str

    def runs(self) -> bool | None:
        """Return whether the process still runs, or None where this machine cannot know."""
        if self.host != socket.gethostname():
            return None
        if self.boot != _boot() or not is_running(self.pid):
            return False
        return self.began == _began(self.pid)


def this_process() -> Process:
    """Return the process that calls."""
    pid = os.getpid()
    return Process(host=socket.gethostname(), pid=pid, began=_began(pid), boot=_boot())


def is_running(pid: int) -> bool:
    """Return whether this machine runs a process of a number; a zombie is dead."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return _stat(pid)[:1] != ["Z"]


def host_label() -> str:
    """Return this machine's name as it may stand in a file's name: short, without dots."""
    return re.sub(r"[^A-Za-z0-9-]", "-", socket.gethostname())[:20] or "-"


def _boot() -> str:
    try:
        return _BOOT_ID.read_text().strip()
    except OSError:
        return ""


def _began(pid: int) -> int:
    fields = _stat(pid)
    return int(fields[19]) if len(fields) > 19 else -1


def _stat(pid: int) -> list[str]:
    """Return what Linux says of a process, from its state on; empty where it says nothing."""
    try:
        # The name before it stands in parentheses and may hold blanks.
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return []


def lock_file(file: IO[bytes]) -> bool | None:
    """Take the kernel's lock on an open file, which it frees when this process closes it or dies.

    Args:
        file: Open for writing; NFS locks no other.

    Returns:
        Whether it is ours now; None where the file system knows no locks.
    """
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True
