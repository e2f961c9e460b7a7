"""The linear algebra of this process: one thread.

OpenBLAS divides large products among its threads and adds up in another order for each number of
them, so the last bits differ. With one thread, workers and callers' own processes compute the same
bits on any number of cores.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, wraps
from typing import ParamSpec, TypeVar

import scipy.linalg  # noqa: F401  # loads SciPy's own BLAS, so that threadpoolctl finds it
from threadpoolctl import ThreadpoolController

P = ParamSpec("P")
R = TypeVar("R")


def one_thread(function: Callable[P, R]) -> Callable[P, R]:
    """Return a function whose linear algebra runs in one thread of the process."""

    @wraps(function)
    def limited(*args: P.args, **kwargs: P.kwargs) -> R:
        with _libraries().limit(limits=1, user_api="blas"):
            return function(*args, **kwargs)

    return limited


@cache
def _libraries() -> ThreadpoolController:
    return ThreadpoolController()
