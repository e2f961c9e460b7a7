"""Faults that tests cause in a process that prepares an object or runs a work unit.

A fault is `KIND:OBJECT:CANDIDATE:STANDOFF` for an attempt, `KIND:OBJECT` for preparing an object,
`KIND:OBJECT:distances` for its distance field, `KIND:OBJECT:screen` for the screen; several faults
are separated by blanks.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable

from drakegrasp.runtime.journal import VARIABLE


def environment(faults: str) -> dict[str, str]:
    """Return the environment of a process in which these faults happen."""
    return {**os.environ, VARIABLE: f"{os.path.abspath(__file__)};{faults}"}


def cause(faults: str, place: str) -> None:
    """Cause the fault of a place, if any; `inject_fault` calls this."""
    for fault in faults.split():
        kind, _, target = fault.partition(":")
        if target == place:
            happen(kind)


def happen(kind: str) -> None:
    """Cause a fault.

    Raises:
        MemoryError: For the kind `memory`.
        KeyError: If the kind is not known.
    """
    KINDS[kind]()


def hang() -> None:
    """Never return: in C, without the interpreter's lock, like a simulation."""
    while True:
        ctypes.CDLL(None).pause()


def spin() -> None:
    """Never return, and compute."""
    while True:
        pass


def exhaust() -> None:
    """Find no memory."""
    raise MemoryError


KINDS: dict[str, Callable[[], object]] = {
    "crash": lambda: ctypes.string_at(0),  # a segmentation fault
    "abort": os.abort,
    "exit": lambda: os._exit(3),
    "hang": hang,
    "freeze": lambda: ctypes.PyDLL(None).pause(),  # in C, with the interpreter's lock
    "spin": spin,
    "memory": exhaust,
}
