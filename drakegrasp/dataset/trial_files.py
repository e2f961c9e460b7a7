"""The files that hold attempts: trials.hdf5, or the shards of a build that has not ended.

In: a path, or shards. Out: `TrialFiles`, which reads columns of rows, block by block.
`dataset.trials.Trials` is the reader for everybody.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from drakegrasp.dataset.hdf5 import AnyArray, read_names, read_texts
from drakegrasp.dataset.opening import (
    open_samples,
    open_trials,
    opened,
    read_codes,
    refuse_other_codes,
)
from drakegrasp.dataset.paths import DATA_FILES, TRIALS_FILE
from drakegrasp.dataset.schema import CAMERAS, OBJECT_FIELDS, SPLITS, TRIAL_FIELDS
from drakegrasp.dataset.shards import ASSEMBLED_FIELDS, ShardHeader, open_shard, trial_columns
from drakegrasp.errors import DataError
from drakegrasp.outcomes import Outcome, Removal

#: Number of a removal or a split that an attempt does not have.
NONE = 255
#: Rows that are read at once: 8 chunks of a column.
BLOCK = 16_384
#: Columns besides those of `/trials`: names of the row's object, why a success is no sample
#: (`removal` in the schema), and the split of a sample (index into SPLITS); NONE for all others.
DERIVED = ("object_name", "class_name", "removal", "split")
#: The fields of `/trials` by name.
FIELDS = {f.name: f for f in TRIAL_FIELDS}
#: Columns whose numbers stand for something, and for what.
_CODES = {"outcome": list(Outcome)}
#: What changes when a file is replaced; None if it is not there.
Stamp = tuple[int, ...] | None


@dataclass(frozen=True, kw_only=True, eq=False)
class TrialPart:
    """The rows of one file: all of trials.hdf5, or the first of a shard while a build runs.

    Attributes:
        path: Of the file.
        count: Number of rows.
        header: Identity of the shard; None for trials.hdf5.
        object: Row of the shard's object among the objects.
    """

    path: Path
    count: int
    header: ShardHeader | None = None
    object: int = 0


@dataclass(frozen=True, kw_only=True, eq=False)
class TrialFiles:
    """The files of all attempts, in the order of the rows.

    Attributes:
        out: Directory of the dataset, or its trials.hdf5.
        objects: See `Trials.objects`.
        parts: The files.
        attributes: Of trials.hdf5.
        stamp: Of trials.hdf5 when it was first opened; None for shards, which never change.
    """

    out: Path
    objects: Mapping[str, AnyArray]
    parts: tuple[TrialPart, ...]
    attributes: Mapping[str, Any] = field(default_factory=dict)
    stamp: Stamp = None

    @property
    def count(self) -> int:
        """Number of attempts."""
        return sum(part.count for part in self.parts)

    def starts(self) -> Iterator[tuple[TrialPart, int]]:
        """Yield each part with the number of rows before it."""
        start = 0
        for part in self.parts:
            yield part, start
            start += part.count

    @contextmanager
    def open(self, part: TrialPart) -> Iterator[h5py.File]:
        """Open a part: the file that was looked at first, or none."""
        if part.header is not None:
            with open_shard(part.path, part.header, verify_seal=False, again=True) as (file, _):
                yield file
            return
        with opened(part.path, "the trials of a dataset", again=True) as file:
            if stamp(part.path) != self.stamp:
                raise DataError(f"{part.path}: must stay while it is read, got another; read again")
            yield file

    def read(
        self, part: TrialPart, start: int, rows: npt.NDArray[np.int64], names: Sequence[str]
    ) -> Iterator[dict[str, AnyArray]]:
        """Yield columns of some rows of a part, which begins with row `start` of all."""
        with self.open(part) as file:
            for block in np.split(rows, np.flatnonzero(np.diff(rows // BLOCK)) + 1):
                yield {
                    name: self._derived(name, file["trials"], part, start, block)
                    if name in (*DERIVED, *ASSEMBLED_FIELDS)
                    else _stored(name, file["trials"], part, block, _CODES.get(name))
                    for name in names
                }

    def _derived(
        self,
        name: str,
        trials: h5py.Group,
        part: TrialPart,
        start: int,
        rows: npt.NDArray[np.int64],
    ) -> AnyArray:
        """Return a column of rows of a part that only the whole dataset knows."""
        if name == "trial_id":
            return start + rows
        if name in ("removal", "split"):
            return (self.removal if name == "removal" else self.split)[start + rows]
        if part.header is not None:
            number = np.full(len(rows), part.object, dtype=np.int32)
        else:
            number = _stored("object", trials, part, rows, len(self.objects["name"]))
        return number if name == "object" else self.objects[name.removeprefix("object_")][number]

    def nothing(self, names: Sequence[str]) -> dict[str, AnyArray]:
        """Return columns of no attempts."""
        sizes = {"k": 0, "j": 0}
        if self.parts:
            with self.open(self.parts[0]) as file:
                touching, q = file["trials/closed_touching"], file["trials/closed_q"]
                sizes = {"k": touching.shape[1], "j": q.shape[1]}
        derived = {"removal": np.uint8, "split": np.uint8}
        return {
            name: FIELDS[name].empty(0, sizes)
            if name in FIELDS
            else np.zeros(0, dtype=derived.get(name, object))
            for name in names
        }

    @cached_property
    def removal(self) -> npt.NDArray[np.uint8]:
        """Why each attempt is no sample, NONE where it is no success or nothing is decided."""
        removal = np.full(self.count, NONE, dtype=np.uint8)
        for part in self.parts:
            if part.header is None:
                with self.open(part) as file:
                    success = read_codes(file["successes/trial_id"], self.count)
                    removal[success] = read_codes(file["successes/removal"], list(Removal))
        return removal

    @cached_property
    def split(self) -> npt.NDArray[np.uint8]:
        """Split of each attempt as an index into SPLITS, NONE if it is no sample."""
        split = np.full(self.count, NONE, dtype=np.uint8)
        if all(part.header is None for part in self.parts):
            for number, ids in enumerate(sample_ids(self.out).values()):
                split[ids[ids < len(split)]] = number
        return split


def _stored(
    name: str,
    trials: h5py.Group,
    part: TrialPart,
    rows: npt.NDArray[np.int64],
    codes: int | list[Outcome] | None = None,
) -> AnyArray:
    """Return a column of rows that lie close together, as it is stored.

    Args:
        name: Of the column.
        trials: The group of the part.
        part: For messages.
        rows: In rising order.
        codes: What its numbers may stand for, see `refuse_other_codes`; None for measured values.
    """
    field, near = FIELDS[name], slice(int(rows[0]), int(rows[-1]) + 1)
    if name not in trials:
        if not field.optional:
            raise DataError(f"{part.path}: /trials/{name} must be there, got none")
        if field.derive is not None:
            return field.derive({name: _stored(name, trials, part, rows) for name in field.needs})
        return field.empty(len(rows), {})
    values = trials[name][near]
    if codes is not None:
        refuse_other_codes(part.path, f"/trials/{name}", values, codes, near.start)
    return np.asarray(values[rows - near.start])


def whole_file(out: Path, any_name: bool) -> TrialFiles:
    """Return the attempts of an assembled dataset, see `Trials`."""
    path = out if out.is_file() else out / TRIALS_FILE
    with open_trials(path) as file:
        group = file["objects"]
        if not any_name:
            read_names(group["name"])
        objects = {
            f.name: np.array(read_texts(group[f.name]), dtype=object)
            if f.dtype == "str"
            else group[f.name][:]
            for f in OBJECT_FIELDS
        }
        part = TrialPart(path=path, count=len(file["trials/outcome"]))
        attributes = dict(file.attrs)
    return TrialFiles(
        out=out, objects=objects, parts=(part,), attributes=attributes, stamp=stamp(path)
    )


def shard_part(
    out: Path, header: ShardHeader, object_: int, names: Sequence[str] | None = None
) -> TrialPart:
    """Return the attempts in a shard; its seal, which takes reading all of it, is not verified.

    Args:
        out: Directory of the dataset.
        header: Of the shard.
        object_: Row of its object among the objects.
        names: Columns that must be there; all that a shard has, and its images, if None.

    Raises:
        DataError: If it is missing, damaged, or another shard.
    """
    path = header.path(out)
    stored = tuple(f for f in trial_columns() if f.name in (*(names or ()), "outcome"))
    tables = None if names is None else {"trials": stored}
    with open_shard(path, header, tables, verify_seal=False) as (file, _):
        count = len(file["trials/outcome"])
    return TrialPart(path=path, count=count, header=header, object=object_)


def sample_ids(out: Path) -> dict[str, npt.NDArray[np.int64]]:
    """Return the trial ids of the samples by split, in rising order; none without data files.

    Args:
        out: Directory of the dataset, or its trials.hdf5.

    Raises:
        DataError: If a data file is damaged.
    """
    folder = out if out.is_dir() else out.parent
    for camera in CAMERAS:
        if os.path.lexists(folder / DATA_FILES[camera]):
            with open_samples(folder / DATA_FILES[camera]) as file:
                return {split: file[split]["trial_id"][:] for split in SPLITS}
    return {split: np.zeros(0, dtype=np.int64) for split in SPLITS}


def stamp(path: Path) -> Stamp:
    """Return what changes when a file is replaced; None if it is not there."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_ino, status.st_size, status.st_mtime_ns
