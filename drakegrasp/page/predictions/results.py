"""The verdicts of a result file, beside the rows of the dataset that they are for.

In: the HDF5 file that `drakegrasp verify --out` writes, and a snapshot of the dataset. Out:
`Predictions`: what filters and sorting need, in memory. All else of a verdict is read when a page
shows it. A field that the file lacks reads as without a value.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import norm
from drakegrasp.dataset.opening import Difference, opened, read_codes, refuse_first
from drakegrasp.dataset.predicted_rows import PredictedRows, read_predicted_rows
from drakegrasp.dataset.schema import VERIFICATION_FIELDS, Field, Shown, refuse_other_schema
from drakegrasp.dataset.trial_files import Stamp, stamp
from drakegrasp.errors import DataError
from drakegrasp.outcomes import Outcome
from drakegrasp.page.catalog import Snapshot

#: Group of the verdicts in a result file.
GROUP = "grasps"
FIELDS: Mapping[str, Field] = {field.name: field for field in VERIFICATION_FIELDS}
#: What a verdict cannot do without.
NEEDED = ("object", "outcome", "p_OQ", "nhat_Q_O")
#: Numbers of a prediction that can be filtered and sorted by, as people read them; of several
#: contacts the largest.
QUANTITIES = {
    "error": Shown("asked to reached", "mm"),
    "normal_error": Shown("asked to reached normal", "°"),
    "true_error": Shown("asked to true", "mm"),
    "surface": Shown("asked to surface", "mm"),
    "slip": Shown("slip", "mm"),
    "turn": Shown("turn", "°"),
    "friction": Shown("least friction", digits=2),
}
#: Words of a verdict on a grasp that is held; and all, to filter by.
WORDS = ("held", "success", "precision", "stable", "sample")
VERDICTS = ("fails", *WORDS, "held_any")
#: Those that are columns of the file.
_MEASURED = {
    "contact_error": "error",
    "normal_error": "normal_error",
    "surface_distance": "surface",
    "slip": "slip",
    "turn": "turn",
    "smallest_friction": "friction",
}
Bools = npt.NDArray[np.bool_]
Array = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Predictions:
    """n predictions, in the order of the result file.

    Attributes:
        path: The result file.
        stamp: Of the file when it was read.
        snapshot: State of the dataset.
        rows: The rows that they are for.
        outcome: (n,) uint8, `Outcome`.
        words: By the names of VERDICTS, (n,) bool; those that the file tells.
        features: By the names of QUANTITIES, (n,), in SI; NaN where a verdict has none.
    """

    path: Path
    stamp: Stamp
    snapshot: Snapshot
    rows: PredictedRows
    outcome: npt.NDArray[np.uint8]
    words: Mapping[str, Bools]
    features: Mapping[str, Array]

    def __len__(self) -> int:
        return len(self.outcome)

    @property
    def places(self) -> npt.NDArray[np.int64]:
        """Places (n,) of their rows in the table of the snapshot."""
        return self.rows.trial_id

    @cached_property
    def objects(self) -> npt.NDArray[np.int32]:
        """Numbers (n,) of their objects."""
        return self.snapshot.table.object[self.places]

    def label(self, i: int) -> str:
        """Return the name of a prediction in addresses: its number in the file."""
        return str(i)

    def find(self, label: str) -> int | None:
        """Return the number of the prediction of a label, or None if there is none."""
        there = label.isascii() and label.isdecimal() and len(label) < 10
        return int(label) if there and int(label) < len(self) else None

    def read(self, numbers: Sequence[int], names: Iterable[str] = FIELDS) -> list[dict[str, Any]]:
        """Return fields of some predictions; None for a field that the file lacks.

        Args:
            numbers: Of the predictions.
            names: Of the fields.

        Raises:
            DataError: If the file was replaced meanwhile, or is damaged.
        """
        rows, back = np.unique(np.asarray(numbers, dtype=np.int64), return_inverse=True)
        with opened(self.path, "a result file of drakegrasp verify", again=True) as file:
            if stamp(self.path) != self.stamp:
                raise DataError(f"{self.path}: must stay while it is read, got another; load again")
            columns = {name: _column(file[GROUP], FIELDS[name], rows) for name in names}
        return [{n: None if v is None else v[k] for n, v in columns.items()} for k in back]


class ResultFile:
    """A result file, read again when it or the dataset changes.

    Args:
        path: The file; with the name that `--out` was given, or that of its JSON lines, the HDF5
            file of the same name is read.
    """

    def __init__(self, path: Path) -> None:
        beside = path.with_suffix(".h5")
        lines = path.suffix.lower() in (".jsonl", ".json") or not path.is_file()
        self.path = beside if lines and beside.is_file() else path
        self._lock = threading.Lock()
        self._known: Predictions | None = None

    def current(self, snapshot: Snapshot) -> Predictions:
        """Return the predictions beside a state of the dataset.

        Raises:
            DataError: If the file cannot be read, or is not of this dataset.
        """
        with self._lock:
            known, now = self._known, stamp(self.path)
            if known is None or known.snapshot is not snapshot or known.stamp != now:
                self._known = known = _read_predictions(self.path, now, snapshot)
            return known


def _read_predictions(path: Path, read_at: Stamp, snapshot: Snapshot) -> Predictions:
    with opened(path, "a result file of drakegrasp verify") as file:
        group = file.get(GROUP)
        if not isinstance(group, h5py.Group) or not all(name in group for name in NEEDED):
            raise DataError(f"{path}: must be a result file of drakegrasp verify, got another")
        refuse_other_schema(path, file.attrs.get("schema_version"))
        count = len(group["outcome"])
        refuse_first(path, _mistakes(group, count))
        rows = _matched(path, file, snapshot, group["object"].asstr()[:].tolist())
        outcome = read_codes(group["outcome"], list(Outcome))

        # What the words and numbers are made of.
        told = [name for name in VERDICTS if name in group and name != "held"]
        words = {name: group[name][:] for name in told}
        values = {name: group[name][:] if name in group else None for name in _MEASURED}
        p_OQ = group["p_OQ"][:]
    held = outcome == Outcome.SUCCESS
    true = snapshot.trials[rows.trial_id.tolist()]["closed_p_OQ"]
    # Another hand may have another number of fingers.
    apart = norm(p_OQ - true) if p_OQ.shape == true.shape else None
    features = {name: _largest(values[column], count) for column, name in _MEASURED.items()}
    features["true_error"] = _largest(apart, count)
    return Predictions(
        path=path,
        stamp=read_at,
        snapshot=snapshot,
        rows=rows,
        outcome=outcome,
        words={"fails": ~held, "held": held, **words},
        features=features,
    )


def _matched(path: Path, file: h5py.File, snapshot: Snapshot, names: list[str]) -> PredictedRows:
    """Return the rows of the dataset that a result file is for.

    Raises:
        DataError: If it does not say so, or they are those of another dataset.
    """
    again = "give the predictions to drakegrasp verify --dataset again"
    rows = read_predicted_rows(file)
    if rows is None:
        raise DataError(f"{path}: must say which rows of a dataset it is for, got none; {again}")
    if not snapshot.assembled or rows.shards != snapshot.trials.attributes.get("shards"):
        raise DataError(f"{path}: must be for {snapshot.out} as it is now, got another; {again}")

    # Rows that exist, of the objects that the verdicts name.
    ids = rows.trial_id
    there = len(ids) == len(rows.row) == len(names) and bool(
        ((ids >= 0) & (ids < len(snapshot.table))).all()
    )
    if not there or [snapshot.names[k] for k in snapshot.table.object[ids]] != names:
        raise DataError(f"{path}: must be for rows of {snapshot.out}, got others; {again}")
    return rows


def _mistakes(group: h5py.Group, count: int) -> list[Difference]:
    """Return what is wrong with the types and shapes of the fields that are there."""
    shape = group["p_OQ"].shape
    sizes = {"k": shape[1] if len(shape) == 3 else 0, "j": 0}
    if isinstance(joints := group.get("closed_q"), h5py.Dataset) and joints.ndim == 2:
        sizes["j"] = joints.shape[1]
    mistakes = []
    for name in FIELDS.keys() & group.keys():
        field, found = FIELDS[name], group[name]
        text = field.dtype == "str"
        right = isinstance(found, h5py.Dataset) and (
            found.shape == (count, *field.row_shape(sizes))
            and (h5py.check_string_dtype(found.dtype) is not None) == text
            and (text or found.dtype.kind == np.dtype(field.dtype).kind)
        )
        if not right:
            got = getattr(found, "shape", "a group")
            must = f"{GROUP}/{name} must be (n, {field.shape}) of {field.dtype}"
            mistakes.append(Difference(what=must, got=str(got)))
    return mistakes


def _column(group: h5py.Group, field: Field, rows: npt.NDArray[np.int64]) -> Any:
    """Return rows of a field; None if the file lacks it."""
    if field.name not in group:
        return None
    column = group[field.name]
    return (column.asstr(errors="replace") if field.dtype == "str" else column)[rows]


def _largest(values: Any, count: int) -> Array:
    """Return the largest value (n,) of each row; NaN where it has none."""
    if values is None:
        return np.full(count, np.nan)
    flat = np.asarray(values, dtype=np.float64).reshape(count, -1)
    largest = np.fmax.reduce(flat, axis=1)
    return np.asarray(largest)
