"""This process: its identity, cores, memory, time, and Drake's ban on the network.

Diagrams and meshes take megabytes of C++ and NumPy memory. Python's garbage collector does not see
the C++ part, and the allocator keeps freed memory for later use, separately for each thread.

Workers run with `DRAKE_ALLOW_NETWORK=none`. Drake (1.51 to 1.58) then refuses to create some
objects even if they would not use the network; `allow_network` relaxes the ban for these.
"""

from __future__ import annotations

import ctypes
import gc
import os
import re
import resource
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache, wraps
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from drakegrasp.errors import MachineError

P = ParamSpec("P")
R = TypeVar("R")

#: Minimum time between two releases of free memory [s]; one takes about 20 ms.
TRIM_SECONDS = 5.0
#: Smallest limit of virtual memory with which an image is rendered [byte]: with 1.0 GB OpenGL ends
#: in a segmentation fault; 1.5 GB are enough for `figures`.
RENDER_MEMORY = 1.5e9

_trimmed = -TRIM_SECONDS
_VARIABLE = "DRAKE_ALLOW_NETWORK"


def is_running(pid: int) -> bool:
    """Return whether this machine runs a process with a number; a zombie counts as dead."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    with suppress(OSError):
        # The preceding name is in parentheses and may contain blanks.
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[:1] != ["Z"]
    return True


def host_label() -> str:
    """Return this machine's name in a form for names of files: short, without dots."""
    return re.sub(r"[^A-Za-z0-9-]", "-", socket.gethostname())[:20] or "-"


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def require_mujoco(*modules: str) -> None:
    """Raise an error if libraries of the extra `[peer]` are missing.

    Args:
        modules: `mujoco`, `coacd` or both.

    Raises:
        MachineError: If a library is missing.
    """
    for module in modules:
        if find_spec(module) is None:
            raise MachineError(f"{module} must be installed: pip install 'drakegrasp[peer]'")


def prepare_rendering() -> None:
    """Prepare this process for OpenGL; called before each renderer is made.

    Raises:
        MachineError: If the limit of memory is so small that OpenGL would crash.
    """
    # Software OpenGL would start its own threads beside the one process per core.
    os.environ.setdefault("LP_NUM_THREADS", "0")
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit != resource.RLIM_INFINITY and limit < RENDER_MEMORY:
        raise MachineError(
            f"the limit of memory must be at least {RENDER_MEMORY / 1e9:g} GB to render, got "
            f"{limit / 1e9:.2g} GB: raise `ulimit -v`"
        )

    # torch's optimizers import Triton. Triton and software OpenGL each have their own LLVM, and
    # Triton ends in a segmentation fault if it is loaded second.
    if find_spec("triton") is not None:
        with suppress(Exception):  # what is broken may not be needed
            import_module("triton")


def release_memory() -> None:
    """Collect reference cycles, and return free memory to the system."""
    gc.collect()
    _trim()


def trim_memory() -> None:
    """Return free memory to the system, unless that was done less than `TRIM_SECONDS` ago."""
    if time.monotonic() - _trimmed > TRIM_SECONDS:
        _trim()


def _trim() -> None:
    global _trimmed
    _trimmed = time.monotonic()
    process = ctypes.CDLL(None)
    if hasattr(process, "malloc_trim"):  # other C libraries decide for themselves
        process.malloc_trim(0)


@contextmanager
def allow_network(kind: str) -> Iterator[None]:
    """Allow Drake one kind of network use while the block runs, e.g. `package_map`."""
    before = os.environ.get(_VARIABLE)
    os.environ[_VARIABLE] = kind
    try:
        yield
    finally:
        if before is None:
            del os.environ[_VARIABLE]
        else:
            os.environ[_VARIABLE] = before


def one_thread(function: Callable[P, R]) -> Callable[P, R]:
    """Return a function whose linear algebra runs in one thread of the process.

    OpenBLAS divides large products among its threads and adds up in a different order for each
    number of threads, so the last bits differ. With one thread, workers and callers' own processes
    compute the same bits on any number of cores.
    """

    @wraps(function)
    def limited(*args: P.args, **kwargs: P.kwargs) -> R:
        with _libraries().limit(limits=1, user_api="blas"):
            return function(*args, **kwargs)

    return limited


@cache
def _libraries() -> Any:
    import scipy.linalg  # noqa: F401  # loads SciPy's own BLAS, so that threadpoolctl finds it
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


@contextmanager
def timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    """Add the duration of the block to a stage's total, even if the block raises an error.

    Args:
        seconds: Total by stage [s]; updated in place.
        stage: Name of the stage.
    """
    start = time.perf_counter()
    try:
        yield
    finally:
        seconds[stage] = seconds.get(stage, 0.0) + time.perf_counter() - start
