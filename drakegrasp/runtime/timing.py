"""Adding up how long each stage of some work takes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def timed(
    seconds: dict[str, float], stage: str, clock: Callable[[], float] = time.perf_counter
) -> Iterator[None]:
    """Add the duration of the block to a stage's total, also when the block raises.

    Args:
        seconds: Total by stage [s]; updated in place.
        stage: Name of the stage.
        clock: Returns the time [s]: wall clock by default, `time.process_time` for CPU time.
    """
    start = clock()
    try:
        yield
    finally:
        seconds[stage] = seconds.get(stage, 0.0) + clock() - start
