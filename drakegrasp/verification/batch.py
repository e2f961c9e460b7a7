"""Verifying many placed grasps: in this process or on workers, with results in order.

In: `PlacedGrasp`s and an executor. Out: a `Verification` per grasp, in the order in which the
caller gave the grasps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import groupby, islice
from typing import TypeAlias, cast

from drakegrasp.runtime.executor import Executor
from drakegrasp.runtime.progress import Report
from drakegrasp.simulation.placement import PlacedObject
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
    *,
    together: int = 1,
) -> list[Verification]:
    """Return the results of grasps in the caller's order.

    Args:
        grasps: With indices 0 to n - 1, in any order; those of one object stand together.
        execute: Runs the verifications.
        report: Is told how many are done and how many succeed.
        on_result: Is called with each result in the caller's order, once all earlier ones exist.
        together: Most grasps of one object that are one task: they share its meshes on the way to
            a worker, and what a worker derives from them.
    """
    objects = {g.index: (g.placed, *(placed for placed, _ in g.others)) for g in grasps}
    results: dict[int, Verification] = {}
    delivered = holding = 0
    report(0, len(grasps), holding=holding)
    for verdicts in execute(_verify_together, _tasks(grasps, together)):
        for index, result in verdicts:
            results[index] = replace(result, placed=objects[index][result.stand])
            holding += result.success

        # Deliver these results, and later ones that were waiting for them.
        while delivered in results:
            on_result(delivered, results[delivered])
            delivered += 1
        report(len(results), len(grasps), holding=holding)
    return [results[i] for i in range(len(grasps))]


def _tasks(grasps: Sequence[PlacedGrasp], together: int) -> Iterator[list[PlacedGrasp]]:
    """Yield the grasps in lists of at most so many, of one object each."""
    for _, same in groupby(grasps, key=lambda grasp: id(grasp.placed)):
        # `itertools.batched` is newer than Python 3.11.
        while task := list(islice(same, together)):
            yield task


def _verify_together(grasps: Sequence[PlacedGrasp]) -> list[tuple[int, Verification]]:
    """Return the indices of grasps with their results, without the object: the caller has it."""
    nothing = cast(PlacedObject, None)
    return [(g.index, replace(verify_placed(g), placed=nothing)) for g in grasps]
