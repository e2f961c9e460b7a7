"""The attempts of a dataset as columns in memory: what filters and sorting need.

In: `Trials`. Out: an `AttemptTable`, some twenty bytes per attempt and fifty more where the hand
closed. Images and poses stay in the files.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import norm
from drakegrasp.dataset.suspicion import COLUMNS, PARTS, suspicion
from drakegrasp.dataset.trials import Trials
from drakegrasp.outcomes import Outcome

AnyArray = npt.NDArray[Any]
#: Quantities that can be filtered and sorted by, besides the parts of the suspicion.
EXTRA = ("suspicion", "force", "p_hold")
FEATURES = (*EXTRA, *(part.name for part in PARTS))
#: Further columns that features follow from.
_READ = ("closed_f_Q_O", "p_hold_samples", "p_hold_repeats")
#: Columns that a table has as they are, and their types.
_KEPT: dict[str, type[np.generic]] = {
    "object": np.int32,
    "candidate": np.int32,
    "standoff_index": np.uint8,
    "child": np.int32,
    "outcome": np.uint8,
    "removal": np.uint8,
    "split": np.uint8,
    "precision": np.bool_,
    "stable": np.bool_,
}


@dataclass(frozen=True, kw_only=True, eq=False)
class AttemptTable:
    """Columns of n attempts, in the order of the dataset's rows.

    Attributes:
        object: (n,) int32, number of the object.
        candidate, standoff_index: (n,), which of the object's palm poses, and of the stand-offs.
        child: (n,) int32, number in the family of that attempt, see the schema.
        outcome: (n,) uint8, `Outcome`.
        removal: (n,) uint8, `Removal` of a success; NONE for others, or where none is decided.
        split: (n,) uint8, index into SPLITS; NONE for what is no sample.
        precision, stable: (n,) bool, see the schema.
        closed: (m,) int32, places of the attempts whose hand closed, in rising order.
        features: By the names of FEATURES, (m,) float32, of these; the others have no values. NaN
            where an attempt did not get so far, infinite where a contact has no normal.
    """

    object: npt.NDArray[np.int32]
    candidate: npt.NDArray[np.int32]
    standoff_index: npt.NDArray[np.uint8]
    child: npt.NDArray[np.int32]
    outcome: npt.NDArray[np.uint8]
    removal: npt.NDArray[np.uint8]
    split: npt.NDArray[np.uint8]
    precision: npt.NDArray[np.bool_]
    stable: npt.NDArray[np.bool_]
    closed: npt.NDArray[np.int32]
    features: Mapping[str, npt.NDArray[np.float32]]

    def __len__(self) -> int:
        return len(self.outcome)

    def feature(self, name: str) -> npt.NDArray[np.float32]:
        """Return a feature of all attempts (n,); NaN where an attempt has no value."""
        values = np.full(len(self), np.nan, dtype=np.float32)
        values[self.closed] = self.features[name]
        return values

    def value(self, name: str, i: int) -> float:
        """Return a feature of one attempt; NaN if it has no value."""
        k = int(np.searchsorted(self.closed, i))
        there = k < len(self.closed) and self.closed[k] == i
        return float(self.features[name][k]) if there else float("nan")

    def find(self, object_: int, candidate: int, standoff_index: int, child: int = 0) -> int | None:
        """Return the place of an attempt, or None if it is not there."""
        (found,) = np.nonzero(
            (self.object == object_)
            & (self.candidate == candidate)
            & (self.standoff_index == standoff_index)
            & (self.child == child)
        )
        return int(found[0]) if len(found) else None


def read_table(trials: Trials) -> AttemptTable:
    """Return the table of attempts, which is read block by block.

    Raises:
        DataError: If a file cannot be read.
    """
    # Splits are not known before the files are assembled.
    names = dict.fromkeys((*_KEPT, *COLUMNS, *_READ))
    return join([_table(block) for block in trials.blocks(list(names))])


def join(tables: Sequence[AttemptTable]) -> AttemptTable:
    """Return tables, one at least, one after the other as one."""
    starts = np.cumsum([0, *(len(table) for table in tables)], dtype=np.int32)
    closed = [table.closed + start for table, start in zip(tables, starts, strict=False)]
    return AttemptTable(
        **{name: np.concatenate([getattr(table, name) for table in tables]) for name in _KEPT},
        closed=np.concatenate(closed),
        features={
            name: np.concatenate([table.features[name] for table in tables]) for name in FEATURES
        },
    )


def first_rows(table: AttemptTable, wanted: int | None) -> tuple[AttemptTable, int | None]:
    """Return the attempts of a shard that an object needs, and how many grasps it wants after it.

    Assembly takes the same rows: with `max_grasps` they end with the last wanted grasp.

    Args:
        table: Attempts of the shard.
        wanted: Number of grasps that the object still wants; None for all.
    """
    if wanted is None:
        return table, None
    (hits,) = np.nonzero(table.outcome == Outcome.SUCCESS)
    if len(hits) < wanted:
        return table, wanted - len(hits)
    count = int(hits[wanted - 1]) + 1 if wanted else 0
    few = int(np.searchsorted(table.closed, count))
    kept: dict[str, Any] = {name: getattr(table, name)[:count] for name in _KEPT}
    features = {name: values[:few] for name, values in table.features.items()}
    return AttemptTable(**kept, closed=table.closed[:few], features=features), 0


def _table(columns: Mapping[str, AnyArray]) -> AttemptTable:
    """Return the table of a block of attempts."""
    # Most attempts never close the hand: only those that do have numbers.
    (closed,) = np.nonzero(np.isfinite(columns["time_close"]))
    few = {name: values[closed] for name, values in columns.items()}
    doubts = suspicion(few)

    # The largest force of a fingertip, after the lift if there was one.
    lifted = np.isfinite(few["time_lift"])[:, None, None]
    forces = np.where(lifted, few["lifted_f_Q_O"], few["closed_f_Q_O"])
    repeats = few["p_hold_repeats"]
    extra = {
        "suspicion": doubts.score,
        "force": norm(forces).max(axis=1, initial=-np.inf),
        "p_hold": np.where(repeats > 0, few["p_hold_samples"] / np.maximum(repeats, 1), np.nan),
    }

    # What a contact without a normal has no value of counts as the largest share: as infinite.
    values = {
        name: np.where(np.isnan(v) & np.isfinite(doubts.shares[name]), np.inf, v)
        for name, v in doubts.values.items()
    }
    kept: dict[str, Any] = {name: columns[name].astype(dtype) for name, dtype in _KEPT.items()}
    return AttemptTable(
        **kept,
        closed=closed.astype(np.int32),
        features={name: v.astype(np.float32) for name, v in (extra | values).items()},
    )
