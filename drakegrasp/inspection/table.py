"""The attempts of a dataset as columns in memory: what filters and sorting need.

In: trials.hdf5 with the data files, or, while a build runs, the shards that are done. Out: an
`AttemptTable`, some twenty bytes per attempt and fifty more where the hand closed. Images and
poses stay in the files.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import norm
from drakegrasp.dataset.filters import Removal
from drakegrasp.dataset.layout.opening import (
    open_samples,
    open_trials,
    read_codes,
    refuse_other_codes,
)
from drakegrasp.dataset.paths import DATA_FILES
from drakegrasp.dataset.schema import CAMERAS, SPLITS
from drakegrasp.dataset.shards import ShardHeader, read_trials
from drakegrasp.dataset.suspicion import COLUMNS, PARTS, suspicion
from drakegrasp.outcomes import Outcome

AnyArray = npt.NDArray[Any]
#: Number of a removal or a split that an attempt does not have.
NONE = 255
#: Quantities that can be filtered and sorted by, besides the parts of the suspicion.
EXTRA = ("suspicion", "force")
FEATURES = (*EXTRA, *(part.name for part in PARTS))
#: Columns of `/trials` that a table is made from.
READ = (
    *COLUMNS,
    *("candidate", "standoff_index", "child", "precision", "stable", "closed_f_Q_O"),
)
#: Columns of a table with a value per attempt.
_DTYPES: dict[str, type[np.generic]] = {
    "object": np.int32,
    "candidate": np.int32,
    "standoff_index": np.uint8,
    "child": np.int32,
    "outcome": np.uint8,
    "removal": np.uint8,
    "split": np.uint8,
    "precision": np.bool_,
    "stable": np.bool_,
    "source": np.int32,
    "row": np.int32,
}
#: Rows that are read at once: 8 chunks of a column.
BLOCK = 16_384


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
        source, row: (n,) int32, number of the file that holds the attempt, and row in it.
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
    source: npt.NDArray[np.int32]
    row: npt.NDArray[np.int32]
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


def read_trials_table(path: Path) -> AttemptTable:
    """Return the attempts in a trials.hdf5, with the splits of the data file beside it.

    Args:
        path: Of the file.

    Raises:
        DataError: If the file cannot be read.
    """
    # Block by block into arrays for all: the float64 columns of a large file fill the memory.
    with open_trials(path) as file:
        trials, successes = file["trials"], file["successes"]
        count, objects = len(trials["outcome"]), len(file["objects/name"])
        whole = _zeros(count)
        ends = []
        for start in range(0, count, BLOCK):
            rows = slice(start, min(start + BLOCK, count))
            number = trials["object"][rows]
            # Files of an older schema have the first round alone.
            columns = {name: trials[name][rows] for name in READ if name in trials}
            columns.setdefault("child", np.zeros(len(number), np.int32))
            refuse_other_codes(path, "/trials/object", number, objects)
            refuse_other_codes(path, "/trials/outcome", columns["outcome"], list(Outcome))
            place = np.arange(rows.start, rows.stop, dtype=np.int32)
            part = _part(columns, number, 0, place)
            # The only source is 0: memory that is never written costs nothing.
            for name in _DTYPES.keys() - {"source"}:
                whole[name][rows] = getattr(part, name)
            ends.append((part.closed + np.int32(start), part.features))
        removal = read_codes(successes["removal"], list(Removal))
        whole["removal"][read_codes(successes["trial_id"], count)] = removal

    table = _with_features(whole, ends)
    for number, ids in enumerate(read_sample_ids(path.parent).values()):
        table.split[ids[ids < len(table)]] = number
    return table


def read_shard_part(out: Path, header: ShardHeader, number: int, object_: int) -> AttemptTable:
    """Return the attempts in one shard.

    Args:
        out: Directory of the dataset.
        header: Of the shard.
        number: That the shard gets as a source.
        object_: Number of its object.

    Raises:
        DataError: If it is missing or damaged.
    """
    columns = read_trials(header.path(out), header, READ, verify_seal=False, complete=True)
    count = len(columns["outcome"])
    objects = np.full(count, object_, dtype=np.int32)
    return _part(columns, objects, number, np.arange(count, dtype=np.int32))


def read_sample_ids(out: Path) -> dict[str, npt.NDArray[np.int64]]:
    """Return the trial ids of the samples by split, in rising order; none without data files."""
    for camera in CAMERAS:
        if os.path.lexists(out / DATA_FILES[camera]):
            with open_samples(out / DATA_FILES[camera]) as file:
                return {split: file[split]["trial_id"][:] for split in SPLITS}
    return {split: np.zeros(0, dtype=np.int64) for split in SPLITS}


def join(parts: Sequence[AttemptTable]) -> AttemptTable:
    """Return tables one after the other as one."""
    starts = np.cumsum([0, *(len(part) for part in parts)], dtype=np.int32)
    ends = [(p.closed + start, p.features) for p, start in zip(parts, starts, strict=False)]
    none = _zeros(0)
    whole = {
        name: np.concatenate([none[name], *(getattr(part, name) for part in parts)])
        for name in _DTYPES
    }
    return _with_features(whole, ends)


def rows_within(part: AttemptTable, wanted: int | None) -> tuple[AttemptTable, int | None]:
    """Return the attempts of a shard that an object needs, and how many grasps it wants after it.

    Assembly takes the same rows: with `max_grasps` they end with the last wanted grasp.

    Args:
        part: Attempts of the shard.
        wanted: Number of grasps that the object still wants; None for all.
    """
    if wanted is None:
        return part, None
    (hits,) = np.nonzero(part.outcome == Outcome.SUCCESS)
    if len(hits) < wanted:
        return part, wanted - len(hits)
    count = int(hits[wanted - 1]) + 1 if wanted else 0
    few = int(np.searchsorted(part.closed, count))
    plain = {name: getattr(part, name)[:count] for name in _DTYPES}
    features = {name: values[:few] for name, values in part.features.items()}
    return AttemptTable(**plain, closed=part.closed[:few], features=features), 0


def empty_table() -> AttemptTable:
    """Return a table without attempts."""
    return _with_features(_zeros(0), [])


def _zeros(count: int) -> dict[str, AnyArray]:
    """Return the columns with a value per attempt."""
    return {name: np.zeros(count, dtype) for name, dtype in _DTYPES.items()}


def _with_features(
    plain: dict[str, AnyArray],
    parts: Sequence[tuple[npt.NDArray[np.int32], Mapping[str, npt.NDArray[np.float32]]]],
) -> AttemptTable:
    """Return the table of columns with a value per attempt, and of features in parts."""
    none, nothing = np.zeros(0, np.int32), np.zeros(0, np.float32)
    return AttemptTable(
        **plain,
        closed=np.concatenate([none, *(closed for closed, _ in parts)]),
        features={
            name: np.concatenate([nothing, *(features[name] for _, features in parts)])
            for name in FEATURES
        },
    )


def _part(
    columns: Mapping[str, AnyArray],
    objects: AnyArray,
    source: int,
    row: npt.NDArray[np.int32],
) -> AttemptTable:
    """Return the table of some rows of `/trials`."""
    # Most attempts never close the hand: only those that do have numbers.
    count = len(row)
    (closed,) = np.nonzero(np.isfinite(columns["time_close"]))
    few = {name: values[closed] for name, values in columns.items()}
    doubts = suspicion(few)

    # The largest force of a fingertip, after the lift if there was one.
    lifted = np.isfinite(few["time_lift"])[:, None, None]
    forces = np.where(lifted, few["lifted_f_Q_O"], few["closed_f_Q_O"])
    extra = {"suspicion": doubts.score, "force": norm(forces).max(axis=1, initial=-np.inf)}

    # What a contact without a normal has no value of counts as the largest share: as infinite.
    values = {
        name: np.where(np.isnan(v) & np.isfinite(doubts.shares[name]), np.inf, v)
        for name, v in doubts.values.items()
    }
    features = {name: v.astype(np.float32) for name, v in (extra | values).items()}
    return AttemptTable(
        object=objects.astype(np.int32),
        candidate=columns["candidate"].astype(np.int32),
        standoff_index=columns["standoff_index"].astype(np.uint8),
        child=columns["child"].astype(np.int32),
        outcome=columns["outcome"].astype(np.uint8),
        removal=np.full(count, NONE, dtype=np.uint8),
        split=np.full(count, NONE, dtype=np.uint8),
        precision=columns["precision"].astype(bool),
        stable=columns["stable"].astype(bool),
        source=np.full(count, source, dtype=np.int32),
        row=row,
        closed=closed.astype(np.int32),
        features=features,
    )
