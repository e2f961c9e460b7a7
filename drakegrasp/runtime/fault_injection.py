"""Fault injection: crashes and hangs at a chosen place, to test that they are contained.

In: the environment variable DRAKEGRASP_TEST_FAULT, which only tests set:
`KIND:OBJECT:CANDIDATE:STANDOFF` for an attempt, `KIND:OBJECT` for preparing an object,
`KIND:OBJECT:distances` for its distance field, `KIND:OBJECT:predict` for the screen; several
separated by blanks. Without it nothing happens.
"""

from __future__ import annotations

import ctypes
import os

from drakegrasp.errors import BlankImageError

VARIABLE = "DRAKEGRASP_TEST_FAULT"


def inject_fault(*place: str | int) -> None:
    """Cause the fault that the environment asks for at a place, if any.

    Args:
        place: An object's name; for an attempt also its candidate and its standoff, for other
            steps what they do.

    Raises:
        MemoryError: For the kind `memory`.
        BlankImageError: For the kind `blank`.
    """
    faults = os.environ.get(VARIABLE)
    if faults is None:
        return
    label = ":".join(map(str, place))
    for fault in faults.split():
        kind, _, target = fault.partition(":")
        if target == label:
            _cause(kind)


def _cause(kind: str) -> None:
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
        raise ValueError(f"{VARIABLE}: must name a known kind of fault, got {kind!r}")
