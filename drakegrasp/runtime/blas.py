"""One thread for linear algebra, because with another number its sums are other bits.

OpenBLAS divides large products among as many threads as there are cores, and adds up in
another order for each number of them. What a worker computes, and what a caller's own process
does, must be the same to the last bit on any machine of the same kind.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, wraps
from typing import ParamSpec, TypeVar

import scipy.linalg  # noqa: F401  # brings a BLAS of its own, which must be there to be found
from threadpoolctl import ThreadpoolController

P = ParamSpec("P")
R = TypeVar("R")


def one_thread(function: Callable[P, R]) -> Callable[P, R]:
    """Return a function with its linear algebra done by one thread of the process."""

    @wraps(function)
    def limited(*args: P.args, **kwargs: P.kwargs) -> R:
        with _libraries().limit(limits=1, user_api="blas"):
            return function(*args, **kwargs)

    return limited


@cache
def _libraries() -> ThreadpoolController:
    return ThreadpoolController()
