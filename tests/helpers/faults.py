"""Faults that tests cause in a process that prepares an object or runs a work unit.

A fault is `KIND:OBJECT:CANDIDATE:STANDOFF` for an attempt, `KIND:OBJECT` for preparing an object,
`KIND:OBJECT:distances` for its distance field, `KIND:OBJECT:predict` for the screen; several faults
are separated by blanks.
"""

from __future__ import annotations

import ctypes
import os

from drakegrasp.errors import BlankImageError
from drakegrasp.runtime.journal import VARIABLE


def environment(faults: str) -> dict[str, str]:
    """Return the environment of a process in which these faults happen."""
    return {**os.environ, VARIABLE: setting(faults)}


def setting(faults: str) -> str:
    """Return the value of the variable for these faults."""
    return f"{os.path.abspath(__file__)};{faults}"


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
        BlankImageError: For the kind `blank`.
    """
    # The process ends.
    if kind == "crash":
        ctypes.string_at(0)  # a segmentation fault
    elif kind == "abort":
        os.abort()
    elif kind == "exit":
        os._exit(3)

    # It never returns.
    elif kind == "hang":
        while True:  # in C, without the interpreter's lock, like a simulation
            ctypes.CDLL(None).pause()
    elif kind == "freeze":
        ctypes.PyDLL(None).pause()  # in C, with the interpreter's lock
    elif kind == "spin":
        while True:  # computes; the others only wait
            pass

    # An error of Python.
    elif kind == "memory":
        raise MemoryError
    elif kind == "blank":
        raise BlankImageError("a blank image, by fault injection")
    else:
        raise ValueError(f"a fault must be of a known kind, got {kind!r}")
