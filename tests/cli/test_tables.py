"""Tables as a reader sees them."""

from __future__ import annotations

from io import StringIO

import numpy as np
import pytest
from rich.console import Console

from drakegrasp.cli.tables import funnel_table, hold_table
from drakegrasp.dataset.filters import Removal
from drakegrasp.dataset.statistics import Funnel
from drakegrasp.outcomes import Outcome


def test_hold_table_tells_what_share_of_the_held_ones_is_stable() -> None:
    outcomes = np.zeros((2, 1 + max(Outcome)), dtype=np.int64)
    outcomes[:, Outcome.DROPPED] = 1180, 7
    outcomes[0, Outcome.SUCCESS] = 20
    removals = np.zeros((2, 1 + max(Removal)), dtype=np.int64)
    removals[0, [Removal.OTHER_LINKS, Removal.KEPT]] = 8, 12
    counts = np.array([1200, 7])
    funnel = Funnel(
        names=("1_mug", "2_[box]"),
        classes=("mug", "box"),
        candidates=counts,
        distinct=counts,
        valid=counts,
        outcomes=outcomes,
        precision=np.array([12, 0]),
        stable=np.array([9, 0]),
        removals=removals,
        refined=np.zeros_like(removals[:, :3]),
        audited=np.zeros_like(removals[:, :4]),
    )
    text = StringIO()
    Console(width=80, file=text).print(hold_table(funnel))
    lines = [line.split() for line in text.getvalue().splitlines()]
    assert ["1_mug", "1,200", "20", "12", "9", "45%", "12"] in lines
    assert ["2_[box]", "7", "0", "0", "0", "-", "0"] in lines
    assert ["all", "1,207", "20", "12", "9", "45%", "12"] in lines
    assert "lower bound" not in text.getvalue()

    # What was ended might have been held.
    outcomes[1, Outcome.MOVED] = 1234
    text = StringIO()
    Console(width=400, file=text).print(hold_table(funnel))
    assert "lower bound" in text.getvalue()
    assert "(moved): 1,234" in text.getvalue()


def test_share_of_stable_ones_is_that_of_audited_lifts_where_lifts_were_chosen() -> None:
    outcomes = np.zeros((1, 1 + max(Outcome)), dtype=np.int64)
    outcomes[0, [Outcome.SUCCESS, Outcome.NOT_LIFTED]] = 20, 100
    count = outcomes.sum(axis=1)
    funnel = Funnel(
        names=("1_mug",),
        classes=("mug",),
        candidates=count,
        distinct=count,
        valid=count,
        outcomes=outcomes,
        precision=np.array([12]),
        stable=np.array([9]),
        removals=np.zeros((1, 1 + max(Removal)), dtype=np.int64),
        refined=np.zeros((1, 3), dtype=np.int64),
        audited=np.array([[11, 5, 4, 3]]),
    )
    text = StringIO()
    Console(width=400, file=text).print(hold_table(funnel))
    lines = [line.split() for line in text.getvalue().splitlines()]
    assert ["1_mug", "120", "20", "12", "9", "4", "of", "5,", "80%", "0"] in lines
    assert "flat: 100; of 11" in " ".join(text.getvalue().split())


@pytest.mark.parametrize("compact", [False, True])
def test_columns_of_the_funnel_add_up_to_the_attempts(compact: bool) -> None:
    """Each outcome of a build is in one column: here each has another power of two attempts."""
    outcomes = np.zeros((1, 1 + max(Outcome)), dtype=np.int64)
    built = [outcome for outcome in Outcome if not outcome.verification_only]
    outcomes[0, built] = 2 ** np.arange(len(built))
    count = outcomes.sum(axis=1)
    removals = np.zeros((1, 1 + max(Removal)), dtype=np.int64)
    removals[0, Removal.KEPT] = outcomes[0, Outcome.SUCCESS]
    funnel = Funnel(
        names=("1_mug",),
        classes=("mug",),
        candidates=count,
        distinct=count,
        valid=count,
        outcomes=outcomes,
        precision=removals[:, 0],
        stable=removals[:, 0],
        removals=removals,
        refined=np.zeros_like(removals[:, :3]),
        audited=np.zeros_like(removals[:, :4]),
    )
    text = StringIO()
    Console(width=400, file=text).print(funnel_table(funnel, compact=compact))
    (row,) = (line.split() for line in text.getvalue().splitlines() if "1_mug" in line)
    numbers = [int(cell.replace(",", "")) for cell in row if cell.replace(",", "").isdigit()]
    # The number of grasps is also that of the samples.
    assert sum(set(numbers) - {count[0]}) == count[0]
    assert "moved" in text.getvalue()
    if compact:
        lost = 2 ** built.index(Outcome.DROPPED) + 2 ** built.index(Outcome.SLIPPED)
        assert lost in numbers
    else:
        assert {2**k for k in range(len(built))} <= set(numbers)

    # Without one there is no column of lifts that were ended.
    outcomes[0, Outcome.MOVED] = 0
    text = StringIO()
    Console(width=400, file=text).print(funnel_table(funnel, compact=compact))
    assert "moved" not in text.getvalue()
