"""Verifying many placed grasps: in this process or on workers, with results in order.

In: `PlacedGrasp`s and an executor. Out: a `Verification` per grasp, in the order in which the
caller gave the grasps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeAlias

from drakegrasp.runtime.executor import Executor
from drakegrasp.runtime.progress import Report
from drakegrasp.verification.result import Verification
from drakegrasp.verification.verify import PlacedGrasp, verify_placed

#: Receives results as they come: called with a grasp's index and its result.
ResultCallback: TypeAlias = Callable[[int, Verification], None]


def ignore_result(index: int, result: Verification) -> None:
    """Do nothing with a result; the default `ResultCallback`."""


def verify_batch(
    grasps: Sequence[PlacedGrasp],
    execute: Executor,
    report: Report,
    on_result: ResultCallback = ignore_result,
) -> list[Verification]:
    """Return the results of grasps in the caller's order.

    Args:
        grasps: With indices 0 to n - 1, in any order.
        execute: Runs the verifications.
        report: Is told how many are done and how many hold.
        on_result: Is called with each result in the caller's order, once all earlier ones exist.
    """
    objects = {grasp.index: grasp.placed for grasp in grasps}
    results: dict[int, Verification] = {}
    delivered = holding = 0
    report(0, len(grasps), holding=holding)
    for index, result in execute(_verify_indexed, grasps):
        # A worker returns a copy of the object: keep the caller's.
        results[index] = replace(result, placed=objects[index])
        holding += result.success

        # Deliver this result, and later ones that were waiting for it.
        while delivered in results:
            on_result(delivered, results[delivered])
            delivered += 1
        report(len(results), len(grasps), holding=holding)
    return [results[i] for i in range(len(grasps))]


def _verify_indexed(grasp: PlacedGrasp) -> tuple[int, Verification]:
    """Return a grasp's index with its result: executors return results in any order."""
    return grasp.index, verify_placed(grasp)
