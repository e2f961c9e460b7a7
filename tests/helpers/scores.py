"""Predictions with verdicts that a test states, without a simulator."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from drakegrasp.scoring.measures import Grouping, Judged
from drakegrasp.scoring.verdict import Verdict, rank_array
from drakegrasp.simulation.attempts import GraspRows

FAILS = Verdict(
    outcome="dropped",
    matches=False,
    lifted=False,
    precision=False,
    stable=False,
    kept=False,
    clean=False,
    lifted_any=False,
    contact_error=None,
    penetration=None,
    posture=(),
    seconds=1.0,
)
#: What a kept grasp is besides lifted.
KEPT = {"kept": True, "clean": True, "precision": True}


def verdict(word: str, error: float = 0.004, confidence: float = 0.0) -> Verdict:
    """Return a verdict: "kept", "lifted" or "fails"; lifted ones count within 20 mm."""
    if word == "fails":
        return FAILS
    lifted = FAILS.__dict__ | {"outcome": "success", "lifted": True, "lifted_any": True}
    lifted |= {"matches": error <= 0.02, "contact_error": error, "penetration": 0.001}
    return Verdict(**(lifted | (KEPT if word == "kept" else {})))


class Rows:
    """A split of so many rows, of a hand with three fingers."""

    split, path = "test", Path("data.hdf5")

    def __init__(self, length: int) -> None:
        self.length = length

    def __len__(self) -> int:
        return self.length

    def column(self, name: str) -> np.ndarray:
        return np.zeros((self.length, 18))


def ranked_array(name: str, grasps: Any, *, length: int, **stated: Any) -> GraspRows:
    """Return predictions for a split of so many rows, in the order of rows and ranks."""
    return rank_array(name, grasps, Rows(length), **stated)  # type: ignore[arg-type]


def judged(name: str, *seeds: Sequence[Sequence[str]]) -> Judged:
    """Return a set whose seeds state a word for each rank of each row."""
    ranked, verdicts = [], []
    for rows in seeds:
        grasps = np.zeros((len(rows), len(rows[0]), 18))
        ranked.append(ranked_array(name, grasps, length=len(rows)))
        verdicts.append(tuple(verdict(word) for row in rows for word in row))
    return Judged(name=name, ranked=tuple(ranked), verdicts=tuple(verdicts))


def grouping(*objects: int) -> Grouping:
    """Return rows that belong to objects of these numbers; each object is its own class."""
    count = max(objects) + 1
    return Grouping(
        rows=tuple(range(len(objects))),
        objects=np.array(objects),
        names=tuple(f"object {i}" for i in range(count)),
        classes=tuple(f"class {i}" for i in range(count)),
    )


class FakeVerify:
    """Tries nothing: a grasp holds if a function of it says so. Counts what it was asked.

    A grasp that holds leaves its neighbours in place if another function says so.
    """

    def __init__(
        self,
        holds: Callable[[np.ndarray], bool],
        stop_after: int | None = None,
        leaves: Callable[[np.ndarray], bool] = lambda grasp: True,
    ) -> None:
        self.holds, self.asked, self.stop_after, self.leaves = holds, 0, stop_after, leaves

    def __call__(self, grasps: Any, rows: Sequence[int], on_result: Any) -> None:
        for index, grasp in enumerate(grasps.numbers()):
            if self.stop_after is not None and index == self.stop_after:
                raise KeyboardInterrupt
            self.asked += 1
            lifted = self.holds(grasp)
            given = verdict("kept" if lifted else "fails", 0.001)
            on_result(index, replace(given, clean=lifted and self.leaves(grasp)))
