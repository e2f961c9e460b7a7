"""Checks whether this machine meets the requirements of drakegrasp, with a remedy for each.

This module imports no library that may be missing: a library that cannot be loaded is a finding,
not an error.
"""

from __future__ import annotations

import ctypes
import os
import platform
import re
import shutil
import sys
import tempfile
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from drakegrasp.cli.arguments import Folder
from drakegrasp.cli.console import say, say_finding
from drakegrasp.runtime.environment import available_cores

PYTHON = (3, 11)
#: Drake's wheels are built for this C library (manylinux_2_34).
GLIBC = (2, 34)
DRAKE = (1, 51, 1)
#: This version segfaults when it creates a renderer on Linux (RobotLocomotion/drake#24421).
BROKEN_DRAKE = (1, 52, 0)
#: With Drake 1.51.1, the last version for Python 3.11, attempts take up to a tenth longer.
FAST_DRAKE, FAST_PYTHON = (1, 58, 0), (3, 12)
DRAKE_REQUIREMENT = "drake>=1.51.1,!=1.52.0"
EGL_LIBRARY = "libEGL.so.1"
EGL_PACKAGES = "apt-get install libegl1 libgl1-mesa-dri"
#: Space for about 3,500 successes: two images of 128 x 128 pixels of 17 bytes, uncompressed [B].
FREE_BYTES = 2e9
#: Memory of a worker, which keeps the scenes of a few objects [B].
BYTES_PER_CORE = 1e9
#: Memory limits of the control group, version 2 and 1; containers have one of them.
CGROUP_LIMITS = (
    Path("/sys/fs/cgroup/memory.max"),
    Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"),
)
MEMINFO = Path("/proc/meminfo")


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


def doctor(directory: Folder = Path("."), /) -> None:
    """Check that this machine can run drakegrasp.

    The command reports what is missing and how to install it. The exit code is 1 if anything is
    missing.

    Args:
        directory: Directory in which a dataset would be written.
    """
    # One line per requirement, and a second line with the remedy if it is not met.
    findings = diagnose(directory)
    for finding in findings:
        say_finding(finding.ok, "MISSING", f"{finding.name:<18} {finding.what}")
        if not finding.ok:
            say(f"         -> {finding.remedy}")
    if not all(finding.ok for finding in findings):
        sys.exit(1)


def diagnose(directory: Path | None = None) -> list[Finding]:
    """Return a finding for every requirement, met or not.

    Args:
        directory: Directory for datasets; the current directory if None. If it does not exist, its
            nearest existing parent is checked.
    """
    place = _existing(Path.cwd() if directory is None else Path(directory))
    return [
        check_python(),
        check_glibc(),
        check_drake(),
        check_egl(),
        check_image(),
        check_writing(place),
        check_disk(place),
        Finding(name="cores", ok=True, what=str(available_cores())),
        check_memory(),
    ]


def check_python() -> Finding:
    """Return the finding on the version of Python."""
    return _finding(
        "Python",
        sys.version_info[:2] >= PYTHON,
        platform.python_version(),
        f"install Python {_dotted(PYTHON)} or newer",
    )


def check_glibc() -> Finding:
    """Return whether the C library can load Drake's wheels."""
    library, version = platform.libc_ver()
    return _finding(
        "glibc",
        library == "glibc" and _numbers(version) >= GLIBC,
        f"{library} {version}".strip() or "another C library",
        f"use a system or container with glibc {_dotted(GLIBC)} or newer, such as Ubuntu 22.04",
    )


def check_drake() -> Finding:
    """Return whether a working version of Drake is installed."""
    try:
        version = metadata.version("drake")
    except metadata.PackageNotFoundError:
        return _finding("Drake", False, "not installed", f"pip install '{DRAKE_REQUIREMENT}'")
    ok = _numbers(version) >= DRAKE and _numbers(version) != BROKEN_DRAKE
    what = version
    if ok and _numbers(version) < FAST_DRAKE:
        newer = f"{_dotted(FAST_DRAKE)} on Python {_dotted(FAST_PYTHON)} or newer"
        what += f": works; attempts take up to a tenth longer than with {newer}"
    return _finding("Drake", ok, what, f"pip install '{DRAKE_REQUIREMENT}'")


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


def check_writing(directory: Path) -> Finding:
    """Return whether a file can be written to a directory, by writing one."""
    try:
        with tempfile.TemporaryFile(dir=directory) as file:
            file.write(b"drakegrasp")
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        what = f"{directory}: {error.strerror or error}"
        return _finding("writing", False, what, "choose another --out, or change its permissions")
    return Finding(name="writing", ok=True, what=str(directory))


def check_disk(directory: Path) -> Finding:
    """Return whether the disk of a directory has space for a small dataset."""
    try:
        free = shutil.disk_usage(directory).free
    except OSError as error:
        what = f"{directory}: {error.strerror or error}"
        return _finding("disk", False, what, "choose another --out")
    return _finding(
        "disk",
        free >= FREE_BYTES,
        f"{free / 1e9:.1f} GB free",
        f"free {FREE_BYTES / 1e9:g} GB or choose another --out: a success takes up to 0.6 MB",
    )


def check_memory() -> Finding:
    """Return whether the memory is sufficient for a worker on every core."""
    total, cores = _memory(), available_cores()
    if total is None:
        return Finding(name="memory", ok=True, what="unknown")
    return _finding(
        "memory",
        total >= BYTES_PER_CORE * cores,
        f"{total / 1e9:.1f} GB for {cores} cores",
        f"use fewer workers: drakegrasp build --workers {max(1, int(total / BYTES_PER_CORE))}",
    )


def _finding(name: str, ok: bool, what: str, remedy: str) -> Finding:
    return Finding(name=name, ok=ok, what=what, remedy="" if ok else remedy)


def _existing(directory: Path) -> Path:
    """Return the path or its nearest existing parent, which may be a file."""
    path = directory.absolute()
    while not os.path.lexists(path) and path != path.parent:
        path = path.parent
    return path


def _numbers(version: str) -> tuple[int, ...]:
    """Return the leading numbers of a version: `1.52.0.post1` is (1, 52, 0)."""
    match = re.match(r"\d+(\.\d+)*", version)
    return tuple(int(part) for part in match[0].split(".")) if match else ()


def _dotted(version: tuple[int, ...]) -> str:
    return ".".join(map(str, version))


def _memory() -> int | None:
    """Return the memory [B] of this machine or its container; None if unknown."""
    limits = []
    try:
        match = re.search(r"^MemTotal:\s*(\d+) kB", MEMINFO.read_text(), re.MULTILINE)
        limits += [int(match[1]) * 1024] if match else []
    except OSError:
        pass
    for path in CGROUP_LIMITS:
        # "max", or a number near 2^63, means no limit.
        try:
            limits.append(int(path.read_text()))
        except (OSError, ValueError):
            continue
    return min(limits, default=None)
