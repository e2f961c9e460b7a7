"""The attempts of a dataset's directory, read once when its pages are first asked for.

A `Snapshot` has in memory what filtering and sorting need, about seventy bytes per attempt. Images
and poses stay in the files, which must not change meanwhile.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from drakegrasp.config import Config, parse_stored
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.paths import TRIALS_FILE, model_path
from drakegrasp.dataset.quality import COLUMNS, PARTS, anomaly
from drakegrasp.dataset.rejections import AttemptKey
from drakegrasp.dataset.trials import Trials
from drakegrasp.errors import DataError
from drakegrasp.foreign_files import is_name, parse_json
from drakegrasp.hand.folder import carried_hand
from drakegrasp.outcomes import Outcome
from drakegrasp.table import AnyArray, Table, join

#: Quantities for sorting: the anomaly score, and its parts.
FEATURES = ("anomaly", *(part.name for part in PARTS))
#: Columns that identify an attempt.
IDENTITY = ("object", "candidate", "standoff_index")
#: Columns that the table of attempts copies, and their types.
_KEPT: dict[str, type[np.generic]] = {
    "object": np.int32,
    "candidate": np.int32,
    "standoff_index": np.uint8,
    "outcome": np.uint8,
    "removal": np.uint8,
    "split": np.uint8,
    "precision": np.bool_,
    "stable": np.bool_,
}


def read_attempts(trials: Trials) -> Table:
    """Return the columns of attempts for memory (n,), in the order of the dataset's rows.

    They are those of _KEPT, `lifted`, and FEATURES as float32, NaN if an attempt ended before, and
    infinite if a contact has no normal. `removal` is NONE for an attempt that is not a success,
    `split` is NONE for one that is not a sample.

    Raises:
        DataError: If a file cannot be read.
    """
    names = dict.fromkeys((*_KEPT, *COLUMNS))
    return join([_columns_of(block) for block in trials.blocks(list(names))])


def _columns_of(columns: Mapping[str, AnyArray]) -> Table:
    """Return the columns of a block of attempts for memory."""
    # Most attempts never close the hand; only those that do have features.
    closed = np.isfinite(columns["time_close"])
    few = {name: values[closed] for name, values in columns.items()}
    doubts = anomaly(few)
    found = {"anomaly": doubts.score}

    # A value that a contact without a normal lacks counts as the largest part, so it is infinite.
    found |= {
        name: np.where(np.isnan(v) & np.isfinite(doubts.shares[name]), np.inf, v)
        for name, v in doubts.values.items()
    }
    features = {name: np.full(len(closed), np.nan, np.float32) for name in found}
    for name, values in found.items():
        features[name][closed] = values
    kept = {name: columns[name].astype(dtype) for name, dtype in _KEPT.items()}
    return Table(kept | features, lifted=kept["outcome"] == Outcome.SUCCESS)


@dataclass(frozen=True, kw_only=True, eq=False)
class Snapshot:
    """The attempts of a dataset.

    Attributes:
        out: Directory of the dataset.
        config: Configuration of the dataset.
        names, classes: Names and classes of the objects, by number.
        trials: The attempts in trials.hdf5.
        table: Columns of the attempts in memory, see `read_attempts`.
    """

    out: Path
    config: Config
    names: tuple[str, ...]
    classes: tuple[str, ...]
    trials: Trials
    table: Table

    def key(self, i: int) -> AttemptKey:
        """Return the identity of an attempt by its row."""
        number, *rest = (int(self.table[name][i]) for name in IDENTITY)
        return AttemptKey(self.names[number], *rest)

    def find(self, key: AttemptKey) -> int | None:
        """Return the row of a success by its identity, or None if it does not exist."""
        number = self.names.index(key.object) if key.object in self.names else -1
        return self._successes.get((number, key.candidate, key.standoff_index))

    @cached_property
    def _successes(self) -> dict[tuple[int, ...], int]:
        """The rows of the successes by their identities."""
        rows = np.flatnonzero(self.table.lifted).tolist()
        identities = zip(*(self.table[name][rows].tolist() for name in IDENTITY), strict=True)
        return dict(zip(identities, rows, strict=True))


def find_model(out: Path, name: str) -> Path | None:
    """Return the file of an object's meshes, or None if it does not exist.

    An untrusted dataset may contain names that are not valid names of files; they are only shown.
    """
    path = model_path(out, name) if is_name(name) else None
    return path if path is not None and path.is_file() else None


def read_snapshot(out: Path) -> Snapshot:
    """Return the attempts of a dataset, of which only trials.hdf5 is required.

    Raises:
        DataError: If the directory holds no dataset, or one whose build has not ended, or if the
            file cannot be read.
    """
    if not os.path.lexists(out / TRIALS_FILE):  # a link that leads nowhere is damage
        read_manifest(out)  # what is no dataset at all gets another message
        raise DataError(
            f"{out}: must be a finished dataset, got one without {TRIALS_FILE}; finish it first, "
            "with the same command that began to build it"
        )
    trials = Trials(out)
    try:
        config = parse_stored(parse_json(trials.attributes["config"]))
    except ValueError as error:
        path = out / TRIALS_FILE
        raise DataError(f"{path}: attribute config must be one, got {error}") from None
    versions = json.loads(str(trials.attributes.get("versions", "{}")))
    carried = carried_hand(out, config.hand, str(versions.get("hand", "")))
    names, classes = (tuple(trials.objects[key].tolist()) for key in ("name", "class_name"))

    return Snapshot(
        out=out,
        config=config.with_hand(config.hand, carried),
        names=names,
        classes=classes,
        trials=trials,
        table=read_attempts(trials),
    )
