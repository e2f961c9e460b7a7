"""Tables as a reader sees them."""

from __future__ import annotations

import numpy as np

from drakegrasp.cli.tables import funnel_table
from drakegrasp.dataset.statistics import Funnel
from drakegrasp.filters import Removal
from drakegrasp.outcomes import Outcome


def cells(funnel: Funnel) -> dict[str, str]:
    """Return the row of the first object by the heads of the columns."""
    columns = funnel_table(funnel).columns
    return {
        str(column.header).replace("\n", " "): str(next(iter(column.cells))) for column in columns
    }


def test_columns_of_the_funnel_add_up_to_the_attempts() -> None:
    """Each outcome of a build is in one column: here each has another power of two attempts."""
    built = [outcome for outcome in Outcome if not outcome.verification_only]
    outcomes = np.zeros((1, 1 + max(Outcome)), dtype=np.int64)
    outcomes[0, built] = 2 ** np.arange(len(built))
    removals = np.zeros((1, 1 + max(Removal)), dtype=np.int64)
    removals[0, [Removal.OTHER_LINKS, Removal.KEPT]] = 8, outcomes[0, Outcome.SUCCESS]
    none = np.zeros(1, dtype=np.int64)
    funnel = Funnel(
        names=("2_[box]",),
        classes=("box",),
        candidates=none + 1200,
        outcomes=outcomes,
        precision=none + 12,
        stable=none + 9,
        removals=removals,
        elevations=np.zeros((1, 3), dtype=np.int64),
        approach_cells=none,
        in_splits=np.zeros((1, 3), dtype=np.int64),
        distinct_in_splits=np.zeros((1, 3), dtype=np.int64),
    )
    row = cells(funnel)
    assert row["object"] == r"2_\[box]"  # rich prints it without the backslash
    other = {"poses": "1,200", "precision": "12", "stable": "9", "- other links": "8"}
    assert {name: row[name] for name in other} == other
    counts = list(row)[3 : 3 + len(built)]
    assert sorted(int(row[name].replace(",", "")) for name in counts) == [
        2**k for k in range(len(built))
    ]
    assert row["attempts"] == f"{outcomes.sum():,}" and "moved" in counts

    # Without one there is no column of lifts that were ended.
    outcomes[0, Outcome.MOVED] = 0
    assert "moved" not in cells(funnel)
