"""BLAS kernels: the code for one kind of CPU that OpenBLAS selects when it is loaded.

Kernels add up in different orders, so their results differ in the last bits. All workers use one
kernel, whatever machines they run on: that of the client, so that work gives the same bits here and
there, or, where a worker's CPU does not support that, the fastest that every worker supports.
The environment variable `OPENBLAS_CORETYPE` selects it; it has no effect after NumPy is loaded.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Iterable
from pathlib import Path

VARIABLE = "OPENBLAS_CORETYPE"
#: Kernels of x86-64 CPUs, fastest first, and the CPU flags that each needs (/proc/cpuinfo).
#: Those of other names, such as Cooperlake, are left to OpenBLAS.
KERNELS: dict[str, frozenset[str]] = {
    "SkylakeX": frozenset({"avx512f", "avx512cd", "avx512bw", "avx512dq", "avx512vl"}),
    "Haswell": frozenset({"avx2", "fma"}),
    "Prescott": frozenset(),
}
_CPUINFO = Path("/proc/cpuinfo")


def supported_kernel() -> str | None:
    """Return the fastest of `KERNELS` that this machine's CPU supports.

    Returns:
        Its name; None on a machine that is not Linux on x86-64.
    """
    if platform.machine() != "x86_64":
        return None
    try:
        lines = _CPUINFO.read_text(encoding="utf-8").splitlines()
    except OSError:
        return None
    flags = {flag for line in lines if line.startswith("flags") for flag in line.split()}
    return next(name for name, needed in KERNELS.items() if needed <= flags)


def chosen_kernel() -> str | None:
    """Return the kernel that this process's environment selects; None leaves it to OpenBLAS."""
    return os.environ.get(VARIABLE)


def common_kernel(kernels: Iterable[str | None]) -> str | None:
    """Return the fastest kernel that several machines support.

    Args:
        kernels: `supported_kernel` of each machine.

    Returns:
        The slowest of them; None if there is none, or a machine supports no known kernel.
    """
    order, names = list(KERNELS), set(kernels)
    if not names or None in names:
        return None
    return max((name for name in names if name is not None), key=order.index)


def agreed_kernel(ours: str, running: Iterable[str], supported: Iterable[str | None]) -> str | None:
    """Return the kernel that all workers of a client should run.

    Args:
        ours: What the client's process runs.
        running: What each worker runs now.
        supported: `supported_kernel` of each worker.

    Returns:
        The client's, where every worker runs it or supports it, else the fastest that every worker
        supports; None where that is not known.
    """
    if set(running) <= {ours}:
        return ours
    common, order = common_kernel(supported), list(KERNELS)
    if common is not None and ours in order and order.index(ours) >= order.index(common):
        return ours
    return common
