"""Faults on purpose: crashes and hangs at a chosen place, for the tests of their containment.

In: the environment variable DRAKEGRASP_TEST_FAULT, which nothing but a test sets, as
`KIND:OBJECT:CANDIDATE:STANDOFF` for an attempt and `KIND:OBJECT` for preparing an object;
several are separated by blanks. Without it nothing happens.
"""

from __future__ import annotations

import ctypes
import os

from drakegrasp.errors import BlankImageError

VARIABLE = "DRAKEGRASP_TEST_FAULT"


def inject_fault(*place: str | int) -> None:
    """Do what the environment asks for at a place: an object, or one of its attempts.

    Raises:
        MemoryError: For the kind `memory`.
        BlankImageError: For the kind `blank`.
    """
    wanted = os.environ.get(VARIABLE)
    if wanted is None:
        return
    here = ":".join(map(str, place))
    for entry in wanted.split():
        kind, _, there = entry.partition(":")
        if there == here:
            _do(kind)


def _do(kind: str) -> None:
    if kind == "crash":
        ctypes.string_at(0)  # a segmentation fault
    elif kind == "abort":
        os.abort()
    elif kind == "exit":
        os._exit(3)
    elif kind == "hang":
        while True:  # in C, without the interpreter's lock, as a simulation
            ctypes.CDLL(None).pause()
    elif kind == "freeze":
        ctypes.PyDLL(None).pause()  # in C, with the interpreter's lock
    elif kind == "memory":
        raise MemoryError
    elif kind == "blank":
        raise BlankImageError("blank on purpose")
    else:
        raise ValueError(f"{VARIABLE}: must name a known kind of fault, got {kind!r}")
