"""Predictions and their verdicts on the page, with the rows of the dataset that they are for.

Input: the HDF5 file that `drakegrasp verify --out` writes, and a snapshot of the dataset. A field
that the file lacks is read as without a value.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import h5py
import numpy as np

from drakegrasp.arithmetic import multiply, norm
from drakegrasp.dataset.hdf5 import differences, opened, raise_first_mistake, read_codes
from drakegrasp.dataset.reader import PredictedRows, read_predicted_rows
from drakegrasp.dataset.schema import (
    CAMERAS,
    TRIAL_FIELDS,
    VERIFICATION_FIELDS,
    Field,
    Shown,
    validate_schema_version,
)
from drakegrasp.errors import DataError
from drakegrasp.frames import Array, unpack_pose
from drakegrasp.outcomes import Outcome
from drakegrasp.page.attempts import words_of
from drakegrasp.page.gallery import Gallery, Places, Query
from drakegrasp.page.renders import (
    THUMBNAIL,
    Dot,
    HandView,
    contact_dots,
    contacts_of,
    hand_states,
    make_scene,
    read_rows,
)
from drakegrasp.page.snapshot import Snapshot
from drakegrasp.table import Table

#: Group of the verdicts in a result file, and their fields.
GROUP = "grasps"
FIELDS: Mapping[str, Field] = {field.name: field for field in VERIFICATION_FIELDS}
#: Fields that a verdict must have; a file may lack any other field.
NEEDED = ("object", "outcome", "p_OQ", "nhat_Q_O")
_MAY_LACK = tuple(replace(field, optional=field.name not in NEEDED) for field in FIELDS.values())
#: Numbers of a verdict with their display; for several contacts the largest is shown.
NUMBERS = {field.name: field.shown for field in FIELDS.values() if field.shown is not None}
#: Numbers that the dataset's own trial has as well.
_BOTH = {field.name for field in TRIAL_FIELDS if field.shown == NUMBERS.get(field.name, 0)}
#: Numbers of a prediction for sorting.
QUANTITIES = {
    "contact_error": NUMBERS["contact_error"],
    "normal_error": NUMBERS["normal_error"],
    "true_error": Shown("requested to true", "mm"),
    **{
        name: NUMBERS[name]
        for name in ("surface_distance", "slip", "turn", "confidence", "epsilon")
    },
}
#: Quantities on cards.
_CARD = ("contact_error", "true_error", "slip", "turn", "confidence")
#: Words of a verdict on a lifted grasp; and all words, for filtering.
WORDS = ("lifted", "matches", "precision", "stable", "kept")
VERDICTS = ("fails", *WORDS, "lifted_any")
#: Kinds of contacts, and the columns of a verdict that contain them.
_CONTACTS = {"requested": ("p_OQ", "nhat_Q_O"), "reached": ("closed_p_OQ", "closed_nhat_Q_O")}
#: The largest force of a fingertip.
_FORCE = Shown("largest force after closing", "N")


class Predictions(Gallery):
    """The n predictions of a result file, in order.

    Args:
        path: The result file.
        snapshot: State of the dataset.

    Raises:
        DataError: If the file cannot be read, or belongs to another dataset.
    """

    HOME, ROW, NOUN = "/predictions", "prediction", "prediction"
    CHOICES: ClassVar = {
        "verdict": VERDICTS,
        "outcome": tuple(outcome.label for outcome in Outcome),
    }
    SELECTS: ClassVar = {name: name for name in ("verdict", "outcome", "class", "object")}
    QUANTITIES = QUANTITIES
    SORTS: ClassVar = {
        "worst": "worst verdict",
        **{name: quantity.title for name, quantity in QUANTITIES.items()},
        "row": "row of the dataset",
    }

    def __init__(self, path: Path, snapshot: Snapshot) -> None:
        self._path, self.snapshot = path, snapshot
        with opened(path, "a result file of drakegrasp verify") as file:
            group = file.get(GROUP)
            if not isinstance(group, h5py.Group) or not all(name in group for name in NEEDED):
                raise DataError(f"{path}: must be a result file of drakegrasp verify, got another")
            validate_schema_version(path, file.attrs.get("schema_version"))
            raise_first_mistake(path, differences(file, {GROUP: _MAY_LACK}))
            names = group["object"].asstr()[:].tolist()
            self.rows = _matched(path, file, snapshot, names)
            outcome = read_codes(group["outcome"], list(Outcome))
            self._columns = {name: _column(group, field) for name, field in FIELDS.items()}

        # The largest value of the contacts; different hands may have different numbers of fingers.
        columns, lifted = dict(self._columns), outcome == Outcome.SUCCESS
        self._places = self.rows.trial_id
        true, p_OQ = snapshot.trials[self._places.tolist()]["closed_p_OQ"], columns["p_OQ"]
        columns["true_error"] = norm(p_OQ - true) if p_OQ.shape == true.shape else None
        largest = {name: _largest(columns[name], len(lifted)) for name in QUANTITIES}
        words = {name: columns[name] for name in VERDICTS if columns.get(name) is not None}

        # The worst predictions are those that fail, and among these those whose hand reached no
        # contact; then the distance of predicted from reached contacts decides, mapped to below 1.
        error = largest["contact_error"]
        share = np.where(np.isnan(error), 1.0, error / (1.0 + error))
        self.table = Table(
            largest | {name: values for name, values in words.items() if name != "lifted"},
            object=snapshot.table.object[self._places],
            outcome=outcome,
            fails=~lifted,
            lifted=lifted,
            worst=np.where(lifted, share, 2.0 + share),
            row=self.rows.row,
        )

    def verdict(self, i: int) -> dict[str, Any]:
        """Return the fields of a prediction; None for a field that the file lacks."""
        return {name: None if v is None else v[i] for name, v in self._columns.items()}

    # Contents of pages.

    def identity(self, i: int) -> dict[str, Any]:
        """Return how people name a prediction: its number, object and row."""
        row = f"row {self.rows.row[i]} of {self.rows.split}"
        return {**super().identity(i), "number": f"prediction {i}", "row": row}

    def summary(self, query: Query, chosen: Places) -> dict[str, Any]:
        """Return the content of the gallery besides its cards."""
        out = self.snapshot.out
        return {
            "title": self._path.name,
            "dataset": out.name or str(out),
            "split": self.rows.split,
            "rows": len(np.unique(self.rows.row)),
            "lifted": int(np.count_nonzero(self.table.lifted[chosen])),
        }

    def cards(self, shown: Places) -> list[dict[str, Any]]:
        """Return the content of the cards of predictions."""
        snapshot, camera = self.snapshot, self.rows.camera
        places, cards = self._places[shown].tolist(), []
        rows = read_rows(snapshot, places, THUMBNAIL)
        # A number that no prediction has, as a confidence, is left out.
        there = [name for name in _CARD if not np.isnan(self.table[name]).all()]

        for i, at, row in zip(shown.tolist(), places, rows, strict=True):
            verdict = self.verdict(i)
            cards.append(
                {
                    "strip": f"/strip/{at}-{camera}.png",
                    "marks": self._marks(verdict, row, camera),
                    "size": snapshot.config.camera.size,
                    "verdict": self._verdict(i),
                    "reason": verdict["reason"] or "",
                    "numbers": [
                        (QUANTITIES[n].title, QUANTITIES[n].text(self.table[n][i])) for n in there
                    ],
                }
            )
        return cards

    def row(self, i: int, hand: HandView) -> dict[str, Any]:
        """Return the content of a prediction's page."""
        # The verdict, the row, and where both cameras see the contacts, first the file's camera.
        snapshot, at = self.snapshot, int(self._places[i])
        verdict, (row,) = self.verdict(i), read_rows(snapshot, [at])
        views = []
        for camera in sorted(CAMERAS, key=lambda name: name != self.rows.camera):
            strip = f"/strip/{at}-{camera}.png"
            marks = self._marks(verdict, row, camera)
            views.append({"camera": camera, "strip": strip, "marks": marks})

        return {
            "verdict": self._verdict(i),
            "reason": verdict.get("reason") or "",
            "hints": verdict.get("hints") or "",
            "trial": f"trial {at}",
            "row_words": [_outcome(row["outcome"]), *words_of(snapshot, at)],
            "row_page": f"/grasp/{at}",
            "views": views,
            "numbers": self._numbers(i, verdict, row),
            "scene": self._scene(i, verdict, row, hand),
        }

    def _verdict(self, i: int) -> list[tuple[str, str]]:
        """Return the words of a verdict, each with its style class."""
        words = {word for word in VERDICTS if word in self.table and self.table[word][i]}
        if "lifted" in words:
            return [("lifted", word) for word in WORDS if word in words]
        by_another = [("", "lifted by another wrist pose")] if "lifted_any" in words else []
        return [("failed", _outcome(self.table.outcome[i])), *by_another]

    def _marks(
        self, verdict: Mapping[str, Any], row: dict[str, Any], camera: str
    ) -> dict[str, list[Dot]]:
        """Return where a camera sees the contacts of each kind."""
        marks = {"true": contact_dots(self.snapshot, row, camera)}
        for kind, names in _CONTACTS.items():
            points, normals = (verdict[name] for name in names)
            there = points is not None and normals is not None
            contacts = (points, normals)
            marks[kind] = (
                contact_dots(self.snapshot, row, camera, contacts=contacts) if there else []
            )
        return marks

    def _numbers(
        self, i: int, verdict: Mapping[str, Any], row: Mapping[str, Any]
    ) -> list[tuple[str, str, str | None]]:
        """Return lines of title, the prediction's value, and the row's value or None."""
        lines: list[tuple[str, str, str | None]] = []
        for name, shown in (QUANTITIES | NUMBERS).items():
            other = shown.text(row[name]) if name in _BOTH else None
            known = self.table[name][i] if name in QUANTITIES else _largest(verdict.get(name))[0]
            lines.append((shown.title, shown.text(known), other))
        forces = (_lengths(source.get("closed_f_Q_O")) for source in (verdict, row))
        own, other = (_FORCE.text(float(_largest(values)[0])) for values in forces)
        return [*lines, (_FORCE.title, own, other)]

    def _scene(
        self, i: int, verdict: Mapping[str, Any], row: Mapping[str, Any], hand: HandView
    ) -> dict[str, Any]:
        """Return the 3D view: the hand as it was tried, and the dataset's own grasp."""
        # Everything is shown with the object in the resting pose of the row.
        X_TO = unpack_pose(row["X_TO"])
        marks = [
            *contacts_of(row, "closed_", X_TO, "true"),
            *contacts_of(verdict, "", X_TO, "requested"),
            *contacts_of(verdict, "closed_", X_TO, "reached"),
        ]

        # The hand in the stages that the trial reached, and the hand of the dataset's grasp.
        # One that ended before closing is shown as it began.
        states, X_OG = hand_states(verdict, X_TO, hand, "force"), verdict.get("X_OG")
        if not states and X_OG is not None and np.isfinite(X_OG).all():
            X_TG = multiply(X_TO, unpack_pose(X_OG))
            links = hand.poses(X_TG, None, float(np.nan_to_num(verdict["spread"])))
            states["start"] = {"links": links, "contacts": []}
        states["dataset's grasp"] = hand_states(row, X_TO, hand, "force")["closed"]
        for state in states.values():
            state["contacts"] = [*marks, *state["contacts"]]
        return make_scene(self.snapshot, int(self.table.object[i]), X_TO, states, hand)


def result_file(path: Path) -> Path:
    """Return the HDF5 file for the path given to `--out`, or for that of its JSON lines."""
    beside = path.with_suffix(".h5")
    lines = path.suffix.lower() in (".jsonl", ".json") or not path.is_file()
    return beside if lines and beside.is_file() else path


def _matched(path: Path, file: h5py.File, snapshot: Snapshot, names: list[str]) -> PredictedRows:
    """Return the rows of the dataset that a result file is for.

    Raises:
        DataError: If the file does not state its rows, or they belong to another dataset.
    """
    again = "give the predictions to drakegrasp verify --dataset again"
    rows = read_predicted_rows(file)
    if rows is None:
        raise DataError(f"{path}: must say which rows of a dataset it is for, got none; {again}")
    if rows.shards != snapshot.trials.attributes.get("shards"):
        raise DataError(f"{path}: must be for {snapshot.out} as it is now, got another; {again}")

    if rows.camera not in CAMERAS:
        raise DataError(f"{path}: must be for rows of a data file, got views of scenes")

    # The rows must exist, and have the objects that the verdicts name.
    ids = rows.trial_id
    there = len(ids) == len(rows.row) == len(names) and bool(
        ((ids >= 0) & (ids < snapshot.table.count)).all()
    )
    if not there or [snapshot.names[k] for k in snapshot.table.object[ids]] != names:
        raise DataError(f"{path}: must be for rows of {snapshot.out}, got others; {again}")
    return rows


def _column(group: h5py.Group, field: Field) -> Any:
    """Return a field of all predictions; None if the file lacks it."""
    if field.name not in group:
        return None
    column = group[field.name]
    return (column.asstr(errors="replace") if field.dtype == "str" else column)[:]


def _largest(values: Any, count: int = 1) -> Array:
    """Return the largest value (n,) of each row; NaN if a row has no value."""
    if values is None:
        return np.full(count, np.nan)
    flat = np.asarray(values, dtype=np.float64).reshape(count, -1)
    return np.asarray(np.fmax.reduce(flat, axis=1, initial=np.nan))


def _outcome(outcome: int) -> str:
    return Outcome(int(outcome)).label.replace("_", " ")


def _lengths(vectors: Array | None) -> Array | None:
    return None if vectors is None else np.linalg.norm(vectors, axis=-1)
