"""BLAS kernels: the code for one kind of CPU that OpenBLAS selects when it is loaded.

Kernels add up in different orders, so their results differ in the last bits. All processes of a
build use one kernel, the fastest that every worker's CPU supports, whatever machines they run on.
The environment variable `OPENBLAS_CORETYPE` selects it; it has no effect after NumPy is loaded.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Iterable
from pathlib import Path

VARIABLE = "OPENBLAS_CORETYPE"
#: Kernels of x86-64 CPUs, fastest first, and the CPU flags that each needs (/proc/cpuinfo).
#: OpenBLAS itself would use newer ones (Zen, SkylakeX), but then fewer machines have one in common.
KERNELS: dict[str, frozenset[str]] = {
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
