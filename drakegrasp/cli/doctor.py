"""Checks whether this machine meets the requirements of drakegrasp, with a remedy for each.

This module imports no library that may be missing: a library that cannot be loaded is a finding,
not an error.
"""

from __future__ import annotations

import ctypes
import os
import platform
import re
import sys
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from drakegrasp.cli.console import say, say_finding
from drakegrasp.runtime.environment import available_cores

PYTHON = (3, 11)
DRAKE = (1, 51, 1)
#: This version segfaults when it creates a renderer on Linux (RobotLocomotion/drake#24421).
BROKEN_DRAKE = (1, 52, 0)
DRAKE_REQUIREMENT = "drake>=1.51.1,!=1.52.0"
EGL_LIBRARY = "libEGL.so.1"
EGL_PACKAGES = "apt-get install libegl1 libgl1-mesa-dri"
#: Memory of a worker, which keeps the scenes of a few objects [B].
BYTES_PER_CORE = 1e9
#: Memory limit of the control group, which a container has.
CGROUP_LIMIT = Path("/sys/fs/cgroup/memory.max")


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One requirement of drakegrasp, and whether this machine meets it.

    Attributes:
        name: Name of the requirement.
        ok: Whether the requirement is met.
        what: Measured state.
        remedy: How to meet the requirement; empty if it is met.
    """

    name: str
    ok: bool
    what: str
    remedy: str = ""


def doctor() -> None:
    """Check that this machine can run drakegrasp.

    The command reports what is missing and how to install it. The exit code is 1 if anything is
    missing.
    """
    # One line per requirement, and a second line with the remedy if it is not met.
    findings = diagnose()
    for finding in findings:
        say_finding(finding.ok, "MISSING", f"{finding.name:<18} {finding.what}")
        if not finding.ok:
            say(f"         -> {finding.remedy}")
    if not all(finding.ok for finding in findings):
        sys.exit(1)


def diagnose() -> list[Finding]:
    """Return a finding for every requirement, met or not."""
    return [
        check_python(),
        check_drake(),
        check_egl(),
        check_image(),
        Finding(name="cores", ok=True, what=str(available_cores())),
        check_memory(),
    ]


def check_python() -> Finding:
    """Return the finding on the version of Python."""
    return _finding(
        "Python",
        sys.version_info[:2] >= PYTHON,
        platform.python_version(),
        f"install Python {'.'.join(map(str, PYTHON))} or newer",
    )


def check_drake() -> Finding:
    """Return whether a working version of Drake is installed."""
    try:
        version = metadata.version("drake")
    except metadata.PackageNotFoundError:
        return _finding("Drake", False, "not installed", f"pip install '{DRAKE_REQUIREMENT}'")
    ok = _numbers(version) >= DRAKE and _numbers(version) != BROKEN_DRAKE
    return _finding("Drake", ok, version, f"pip install '{DRAKE_REQUIREMENT}'")


def check_egl() -> Finding:
    """Return whether EGL, with which Drake renders without a display, can be loaded."""
    try:
        ctypes.CDLL(EGL_LIBRARY)
    except OSError as error:
        return _finding("EGL", False, str(error), EGL_PACKAGES)
    return Finding(name="EGL", ok=True, what=EGL_LIBRARY)


def check_image() -> Finding:
    """Return whether a child process can render a box."""
    from drakegrasp.vision.probe_image import probe_image

    ok, what = probe_image()
    missing = what.startswith("ModuleNotFoundError")
    remedy = f"pip install '{DRAKE_REQUIREMENT}' drakegrasp" if missing else EGL_PACKAGES
    return _finding("test image", ok, what, remedy)


def check_memory() -> Finding:
    """Return whether the memory is sufficient for a worker on every core."""
    total, cores = memory(), available_cores()
    return _finding(
        "memory",
        total >= BYTES_PER_CORE * cores,
        f"{total / 1e9:.1f} GB for {cores} cores",
        f"use fewer workers: drakegrasp build --workers {max(1, int(total / BYTES_PER_CORE))}",
    )


def _finding(name: str, ok: bool, what: str, remedy: str) -> Finding:
    return Finding(name=name, ok=ok, what=what, remedy="" if ok else remedy)


def _numbers(version: str) -> tuple[int, ...]:
    """Return the leading numbers of a version: `1.52.0.post1` is (1, 52, 0)."""
    match = re.match(r"\d+(\.\d+)*", version)
    return tuple(int(part) for part in match[0].split(".")) if match else ()


def memory() -> int:
    """Return the memory [B] of this machine or its container."""
    machine = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    try:
        return min(machine, int(CGROUP_LIMIT.read_text()))
    except (OSError, ValueError):  # no file, or "max", which means no limit
        return machine
