"""Tables as a reader sees them."""

from __future__ import annotations

from io import StringIO

import numpy as np
from rich.console import Console
from rich.table import Table

from drakegrasp.cli.tables import funnel_table
from drakegrasp.dataset.statistics import Funnel
from drakegrasp.filters import Removal
from drakegrasp.outcomes import Outcome


def make_funnel(outcomes: np.ndarray, *names: str, **counts: np.ndarray) -> Funnel:
    """Return a funnel of objects by their outcomes (m, ...); what is not said is zero."""
    none, tried = np.zeros(len(names), dtype=np.int64), outcomes.sum(axis=1)
    usual = {
        "precision": none,
        "stable": none,
        "removals": np.zeros((len(names), 1 + max(Removal)), dtype=np.int64),
        "elevations": np.zeros((len(names), 3), dtype=np.int64),
        "approach_cells": none,
    }
    return Funnel(
        names=names,
        classes=("thing",) * len(names),
        candidates=tried,
        outcomes=outcomes,
        **{**usual, **counts},
    )


def printed(table: Table, width: int = 400) -> str:
    text = StringIO()
    Console(width=width, file=text).print(table)
    return text.getvalue()


def cells(text: str) -> list[list[str]]:
    return [line.split() for line in text.splitlines()]


def test_funnel_tells_how_well_the_successes_hold() -> None:
    outcomes = np.zeros((2, 1 + max(Outcome)), dtype=np.int64)
    outcomes[:, Outcome.DROPPED] = 1180, 7
    outcomes[0, Outcome.SUCCESS] = 20
    removals = np.zeros((2, 1 + max(Removal)), dtype=np.int64)
    removals[0, [Removal.OTHER_LINKS, Removal.KEPT]] = 8, 12
    held = {"precision": np.array([12, 0]), "stable": np.array([9, 0])}
    funnel = make_funnel(outcomes, "1_mug", "2_[box]", removals=removals, **held)
    text = printed(funnel_table(funnel))
    assert ["1_mug", "1,200", "1,200", "1,180", "20", "12", "9", "8", "12"] in [
        row[:9] for row in cells(text)
    ]
    assert ["2_[box]", "7", "7", "7", "0", "0", "0", "0", "0"] in [row[:9] for row in cells(text)]
    assert "lower bound" not in text

    # What was ended might have been held.
    outcomes[1, Outcome.MOVED] = 1234
    text = " ".join(printed(funnel_table(funnel)).split())
    assert "lower bound" in text and "1,234 lifts ended early" in text


def test_columns_of_the_funnel_add_up_to_the_attempts() -> None:
    """Each outcome of a build is in one column: here each has another power of two attempts."""
    outcomes = np.zeros((1, 1 + max(Outcome)), dtype=np.int64)
    built = [outcome for outcome in Outcome if not outcome.verification_only]
    outcomes[0, built] = 2 ** np.arange(len(built))
    removals = np.zeros((1, 1 + max(Removal)), dtype=np.int64)
    removals[0, Removal.KEPT] = outcomes[0, Outcome.SUCCESS]
    funnel = make_funnel(outcomes, "1_mug", removals=removals)
    text, count = printed(funnel_table(funnel)), outcomes.sum()
    (row,) = (line for line in cells(text) if "1_mug" in line)
    numbers = [int(cell.replace(",", "")) for cell in row if cell.replace(",", "").isdigit()]
    # The number of grasps is also that of the samples.
    assert sum(set(numbers) - {count}) == count
    assert "moved" in [column.header for column in funnel_table(funnel).columns]
    assert {2**k for k in range(len(built))} <= set(numbers)

    # Without one there is no column of lifts that were ended.
    outcomes[0, Outcome.MOVED] = 0
    assert "moved" not in [column.header for column in funnel_table(funnel).columns]
