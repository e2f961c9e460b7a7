"""Checks whether this machine meets every need of drakegrasp, and says how to meet it.

This module imports no library that might be missing: a library that cannot be loaded is a
finding, not an error. A child process renders the test image, because a broken OpenGL kills
its process, and because the first thread that renders in a process owns its GL context.
"""

from __future__ import annotations

import ctypes
import os
import platform
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from drakegrasp.runtime.environment import available_cores

PYTHON = (3, 11)
#: Drake's wheels are built for this C library (manylinux_2_34).
GLIBC = (2, 34)
DRAKE = (1, 51, 1)
#: Segfaults when it makes a renderer on Linux (RobotLocomotion/drake#24421).
BROKEN_DRAKE = (1, 52, 0)
#: With the last Drake for Python 3.11, which is 1.51.1, attempts take up to a tenth longer.
FAST_DRAKE, FAST_PYTHON = (1, 58, 0), (3, 12)
DRAKE_REQUIREMENT = "drake>=1.51.1,!=1.52.0"
EGL_LIBRARY = "libEGL.so.1"
EGL_PACKAGES = "apt-get install libegl1 libgl1-mesa-dri"
JEMALLOC_PACKAGE = "apt-get install libjemalloc2"
#: Time for the test image [s]: the first one may compile shaders on a slow file system.
IMAGE_SECONDS = 60.0
#: Room for about 3,500 successes: two images of 128 x 128 pixels of 17 bytes, uncompressed [B].
FREE_BYTES = 2e9
#: Memory of a worker, which holds the scenes of a few objects [B].
BYTES_PER_CORE = 1e9
#: Memory limits of the control group, version 2 and 1; containers have one of them.
CGROUP_LIMITS = (
    Path("/sys/fs/cgroup/memory.max"),
    Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"),
)
MEMINFO = Path("/proc/meminfo")

#: The test box's edge and its front's distance from the camera [m].
BOX_EDGE, BOX_DISTANCE = 0.1, 0.25
#: What the child process runs; its last line of output is `object pixels, expected pixels`.
_CHILD = "from drakegrasp.cli.doctor import render_test_image; print(*render_test_image())"


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One need of drakegrasp and whether this machine meets it.

    Attributes:
        name: Name of the need.
        ok: Whether it is met.
        what: What was measured.
        remedy: How to meet it; empty if it is met.
    """

    name: str
    ok: bool
    what: str
    remedy: str = ""


def diagnose(directory: Path | None = None) -> list[Finding]:
    """Return a finding on every need, met or not.

    Args:
        directory: Where datasets will be written; the current directory if None. If it does
            not exist, its nearest existing parent is checked.
    """
    place = _existing(Path.cwd() if directory is None else Path(directory))
    return [
        check_python(),
        check_glibc(),
        check_drake(),
        check_allocator(),
        check_egl(),
        check_image(),
        check_writing(place),
        check_disk(place),
        check_cores(),
        check_memory(),
    ]


def check_python() -> Finding:
    """Return whether Python is new enough."""
    return _finding(
        "Python",
        sys.version_info[:2] >= PYTHON,
        platform.python_version(),
        f"install Python {_dotted(PYTHON)} or newer",
    )


def check_glibc() -> Finding:
    """Return whether the C library can load Drake's wheels."""
    if sys.platform != "linux":
        return Finding(name="glibc", ok=True, what=f"not needed on {sys.platform}")
    library, version = platform.libc_ver()
    return _finding(
        "glibc",
        library == "glibc" and _numbers(version) >= GLIBC,
        f"{library} {version}".strip() or "another C library",
        f"use a system or container with glibc {_dotted(GLIBC)} or newer, such as Ubuntu 22.04",
    )


def check_drake() -> Finding:
    """Return whether a Drake that works is installed."""
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


def check_allocator() -> Finding:
    """Return which allocator the workers have; any will do, but jemalloc is the fastest."""
    from drakegrasp.runtime.allocator import LIBRARY, allocator, jemalloc_environment

    if jemalloc_environment():
        return Finding(name="allocator", ok=True, what=f"{LIBRARY} for workers, bench and verify")
    what = f"{allocator()}: works; with jemalloc a build is a tenth faster: {JEMALLOC_PACKAGE}"
    return Finding(name="allocator", ok=True, what=what)


def check_egl() -> Finding:
    """Return whether EGL, with which Drake renders without a display, can be loaded."""
    if sys.platform != "linux":
        return Finding(name="EGL", ok=True, what=f"not needed on {sys.platform}")
    try:
        ctypes.CDLL(EGL_LIBRARY)
    except OSError as error:
        return _finding("EGL", False, str(error), EGL_PACKAGES)
    return Finding(name="EGL", ok=True, what=EGL_LIBRARY)


def check_image() -> Finding:
    """Return whether a child process can render a box."""
    # The child imports from the same paths, but not from its working directory.
    paths = os.pathsep.join(str(Path(p).resolve()) for p in sys.path if p)
    try:
        child = subprocess.run(
            [sys.executable, "-P", "-c", _CHILD],
            env={**os.environ, "PYTHONPATH": paths},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=IMAGE_SECONDS,
        )
    except subprocess.TimeoutExpired:
        return _bad_image(f"no image within {IMAGE_SECONDS:g} s")
    except OSError as error:
        return _bad_image(f"no child process: {error}")

    # A signal, an error and unexpected output have remedies of their own.
    if child.returncode < 0:
        return _bad_image(f"the renderer crashed with {_signal_name(-child.returncode)}")
    lines = (child.stderr if child.returncode else child.stdout).strip().splitlines()
    last = lines[-1] if lines else "nothing"
    if child.returncode:
        missing = last.startswith("ModuleNotFoundError")
        return _bad_image(last, f"pip install '{DRAKE_REQUIREMENT}' drakegrasp" if missing else "")
    match = re.fullmatch(r"(\d+) (\d+)", last)
    if match is None:
        return _bad_image(f"the renderer must print two numbers, got {last!r}")

    # An edge of the mask may be off by a pixel at either end.
    seen, expected = int(match[1]), int(match[2])
    what = f"{seen} pixels of a box that has {expected}"
    if not 0.9 * expected <= seen <= 1.1 * expected:
        return _bad_image(what if seen else f"blank image: {what}")
    return Finding(name="test image", ok=True, what=what)


def check_writing(directory: Path) -> Finding:
    """Return whether a file can be written in a directory, by writing one."""
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
    """Return whether a directory's disk has room for a small dataset."""
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


def check_cores() -> Finding:
    """Return how many cores this process may use; any number will do."""
    return Finding(name="cores", ok=True, what=str(available_cores()))


def check_memory() -> Finding:
    """Return whether there is memory for a worker on every core."""
    total, cores = _memory(), available_cores()
    if total is None:
        return Finding(name="memory", ok=True, what="unknown")
    return _finding(
        "memory",
        total >= BYTES_PER_CORE * cores,
        f"{total / 1e9:.1f} GB for {cores} cores",
        f"use fewer workers: drakegrasp build --workers {max(1, int(total / BYTES_PER_CORE))}",
    )


def render_test_image() -> tuple[int, int]:
    """Render a box from above; return how many pixels show it, and how many should.

    Call it in a process of its own: it needs Drake and may crash.
    """
    import numpy as np
    import trimesh

    from drakegrasp.config import CameraConfig
    from drakegrasp.frames import make_pose
    from drakegrasp.objects.model import ObjectModel
    from drakegrasp.vision.camera import intrinsics
    from drakegrasp.vision.rendering import build_renderer, render

    # A cube of 1 kg.
    config = CameraConfig()
    box = trimesh.creation.box((BOX_EDGE,) * 3)
    model = ObjectModel(
        name="box",
        class_name="box",
        mesh_sha256="",
        visual_vertices=box.vertices,
        visual_faces=box.faces,
        collision_vertices=box.vertices,
        collision_faces=box.faces,
        mass=1.0,
        p_OOcm=np.zeros(3),
        I_OOcm_O=np.eye(3) * BOX_EDGE**2 / 6.0,
        collision_error=0.0,
    )

    # It stands on the table, and the camera looks straight down on it.
    X_TO = make_pose(np.eye(3), [0.0, 0.0, BOX_EDGE / 2.0])
    X_TC = make_pose(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, BOX_EDGE + BOX_DISTANCE])
    seen = render(build_renderer(model, config), X_TO, X_TC)
    edge = intrinsics(config)[0, 0] * BOX_EDGE / BOX_DISTANCE
    return int(seen.mask.sum()), round(edge**2)


def _finding(name: str, ok: bool, what: str, remedy: str) -> Finding:
    return Finding(name=name, ok=ok, what=what, remedy="" if ok else remedy)


def _bad_image(what: str, remedy: str = "") -> Finding:
    return _finding("test image", False, what, remedy or EGL_PACKAGES)


def _existing(directory: Path) -> Path:
    """Return the path itself or its nearest parent that exists, which may be a file."""
    path = directory.absolute()
    while not os.path.lexists(path) and path != path.parent:
        path = path.parent
    return path


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "of unknown version"


def _numbers(version: str) -> tuple[int, ...]:
    """Return the leading numbers of a version: `1.52.0.post1` is (1, 52, 0)."""
    match = re.match(r"\d+(\.\d+)*", version)
    return tuple(int(part) for part in match[0].split(".")) if match else ()


def _dotted(version: tuple[int, ...]) -> str:
    return ".".join(map(str, version))


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


def _memory() -> int | None:
    """Return the memory [B] that this machine, or its container, has; None if unknown."""
    limits = []
    try:
        match = re.search(r"^MemTotal:\s*(\d+) kB", MEMINFO.read_text(), re.MULTILINE)
        limits += [int(match[1]) * 1024] if match else []
    except OSError:
        pass
    for path in CGROUP_LIMITS:
        # "max", or a number near 2^63, is no limit.
        try:
            limits.append(int(path.read_text()))
        except (OSError, ValueError):
            continue
    return min(limits, default=None)
