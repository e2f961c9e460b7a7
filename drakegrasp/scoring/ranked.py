"""Ranked predictions: arrays and files come in, one prediction per line goes out.

A file gives m predictions for each row of a split. They are ranked by the stated confidence, or
stand in their order where none is stated.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.errors import GraspError
from drakegrasp.exchange.attempts import digest_of, holds_postures, read_attempts
from drakegrasp.frames import Array, as_numbers
from drakegrasp.hand.description import load_hand
from drakegrasp.simulation.attempts import Attempts
from drakegrasp.verification.placing import dataset_config
from drakegrasp.verification.prediction import ROWS, read_predictions

Rows = npt.NDArray[np.int64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Ranked:
    """Predictions for rows of a split, in the order of rows, and of ranks within a row.

    Attributes:
        name: Of the file, or of what made them.
        grasps: (N, 6k), in the camera's frame; of postures (N, m) all their numbers.
        rows: (N,), the row of each.
        ranks: (N,), 0 for the best of a row.
        confidence: (N,), as stated, -inf for what is no finite number; None if it is not.
        sha256: Of the file, or of the numbers.
        table: The postures; None for grasps of contacts.
    """

    name: str
    grasps: Array
    rows: Rows
    ranks: Rows
    confidence: Array | None = None
    sha256: str
    table: Attempts | None = None

    def of_rows(self, rows: Sequence[int]) -> Ranked:
        """Return the predictions for some rows."""
        kept = np.flatnonzero(np.isin(self.rows, rows))
        return Ranked(
            name=self.name,
            grasps=self.grasps[kept],
            rows=self.rows[kept],
            ranks=self.ranks[kept],
            confidence=None if self.confidence is None else self.confidence[kept],
            sha256=self.sha256,
            table=None if self.table is None else self.table.at(kept.tolist()),
        )


def rank(
    name: str,
    grasps: npt.ArrayLike,
    *,
    length: int,
    rows: npt.ArrayLike | None = None,
    confidence: npt.ArrayLike | None = None,
    sha256: str | None = None,
    table: Attempts | None = None,
) -> Ranked:
    """Return predictions in the order of rows and ranks.

    Args:
        name: What errors and the card call them.
        grasps: (n, 6k), one per row, or (n, m, 6k), m per row. NaN stays: it is a bad prediction,
            not a mistake of the caller.
        length: Rows of the split.
        rows: (n,), the row that each is for; a row may come several times with (n, 6k). All rows of
            the split in order if None.
        confidence: (n,) or (n, m), greater is better.
        sha256: Of the file; that of the numbers if None.
        table: The postures (n,) whose numbers the grasps are.

    Raises:
        GraspError: If shapes do not fit each other, or a row does not exist.
    """
    # One line per prediction.
    array = as_numbers(grasps, f"{name}: grasps must be numbers")
    if array.ndim not in (2, 3) or array.size == 0:
        raise GraspError(
            f"{name}: grasps must be (n, 6k), or (n, m, 6k) for m per row, got {array.shape}"
        )
    count, each = array.shape[0], 1 if array.ndim == 2 else array.shape[1]
    flat = array.reshape(count * each, array.shape[-1])
    line_rows = np.repeat(_rows_of(name, rows, count, length), each)

    # The best first; of equals the one that was given first.
    stated = None
    if confidence is not None:
        stated = as_numbers(confidence, f"{name}: confidence must be numbers")
        if stated.shape != array.shape[:-1]:
            raise GraspError(
                f"{name}: confidence must be {array.shape[:-1]}, one per grasp, got {stated.shape}"
            )
        stated = np.where(np.isfinite(stated), stated, -np.inf).ravel()
    falling = np.zeros(len(flat)) if stated is None else -stated
    order = np.lexsort((np.arange(len(flat)), falling, line_rows))
    ordered = line_rows[order]
    _, starts, counts = np.unique(ordered, return_index=True, return_counts=True)
    return Ranked(
        name=name,
        grasps=flat[order],
        rows=ordered,
        ranks=np.arange(len(flat)) - np.repeat(starts, counts),
        confidence=None if stated is None else stated[order],
        sha256=sha256 or hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest(),
        table=None if table is None else table.at(order.tolist()),
    )


def _rows_of(name: str, rows: npt.ArrayLike | None, count: int, length: int) -> Rows:
    """Return the row (n,) of each entry of an array of predictions."""
    if rows is None and count != length:
        raise GraspError(
            f"{name}: without {ROWS!r} there must be predictions for each of the {length} rows of "
            f"the split, got {count}"
        )
    chosen = np.arange(count) if rows is None else np.asarray(rows)
    if chosen.dtype.kind not in "iu" or chosen.shape != (count,):
        raise GraspError(
            f"{name}: {ROWS} must be one whole number per entry ({count}), "
            f"got {chosen.dtype} of shape {chosen.shape}"
        )
    wrong = chosen[(chosen < 0) | (chosen >= length)]
    if len(wrong):
        raise GraspError(f"{name}: {ROWS} must be 0 to {length - 1}, got {wrong[0]}")
    return chosen.astype(np.int64)


def read_ranked(path: Path, *, length: int, split: str) -> Ranked:
    """Return the predictions of a file.

    Args:
        path: As `read_predictions` reads it; grasps are (n, 6k) or (n, m, 6k).
        length: Rows of the split.
        split: Its name.

    Raises:
        GraspError: If the file holds anything else; the message names it.
        MachineError: If a Parquet file is given and pyarrow is not installed.
    """
    read = read_predictions(path, split=split, axes=3)
    return rank(
        str(path),
        read.grasps,
        length=length,
        rows=read.rows,
        confidence=read.confidence,
        sha256=hashlib.sha256(path.read_bytes()).hexdigest(),
    )


def rank_postures(path: Path, data: GraspDataset) -> Ranked:
    """Return the predicted postures of a file.

    Args:
        path: See `read_attempts`; `confidence` ranks those of a row.
        data: The split.

    Raises:
        GraspError: If the file holds anything else; the message names it.
        ConfigError, HandError, DataError, MachineError: If dataset or hand cannot be used.
    """
    table = read_attempts(path, load_hand(dataset_config(data).hand_source), of=data)
    return rank(
        str(path),
        table.numbers(),
        length=len(data),
        rows=table.of_row,
        confidence=table.confidence,
        sha256=digest_of(path),
        table=table,
    )


def ranked_sets(
    predictions: Any,
    data: GraspDataset,
    *,
    rows: Sequence[int] | None = None,
    confidence: npt.ArrayLike | None = None,
) -> tuple[str, tuple[Ranked, ...]]:
    """Return the name of what is scored, and its predictions by training seed.

    Args:
        predictions: An array, a path, or paths.
        data: The split.
        rows: With an array: the row of each.
        confidence: With an array: of each.

    Raises:
        GraspError: If they cannot be used, or rows or confidence are given with files.
        MachineError: See `read_ranked`.
    """
    # One array.
    single = isinstance(predictions, str | Path)
    try:
        paths = [predictions] if single else list(predictions)
    except TypeError:
        raise GraspError(
            f"predictions must be an array, a file or a list of files, got {predictions!r}"
        ) from None
    if not all(isinstance(path, str | Path) for path in paths):
        one = rank("predictions", predictions, length=len(data), rows=rows, confidence=confidence)
        return one.name, (one,)

    # Files, each of a training seed.
    if rows is not None or confidence is not None:
        raise GraspError("rows and confidence must be in the files if files are given, got them")
    found = tuple(
        rank_postures(Path(path), data)
        if holds_postures(Path(path))
        else read_ranked(Path(path), length=len(data), split=data.split)
        for path in paths
    )
    names = [Path(path).name for path in paths]
    if len(found) < 2:
        return (names or [""])[0], found
    return f"{names[0]} and {len(found) - 1} more", found
