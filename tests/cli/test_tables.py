"""Tables as a reader sees them."""

from __future__ import annotations

from io import StringIO

import numpy as np
from rich.console import Console

from drakegrasp.cli.tables import hold_table
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
    )
    text = StringIO()
    Console(width=80, file=text).print(hold_table(funnel))
    lines = [line.split() for line in text.getvalue().splitlines()]
    assert ["1_mug", "1,200", "20", "12", "9", "45%", "12"] in lines
    assert ["2_[box]", "7", "0", "0", "0", "-", "0"] in lines
    assert ["all", "1,207", "20", "12", "9", "45%", "12"] in lines
