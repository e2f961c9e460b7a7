"""Reading the attempts of a dataset, whatever their outcome. Imports only h5py and NumPy.

>>> lifted = Trials("OUT").where(outcome="success", object_name="mug")   # doctest: +SKIP
>>> lifted["slip"].max(), lifted.contacts(frame="table").points.shape  # doctest: +SKIP
(0.0093, (27, 3, 3))
"""

from __future__ import annotations

import copy
import operator
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, overload

import h5py
import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import multiply
from drakegrasp.dataset.hdf5 import (
    AnyArray,
    open_samples,
    open_trials,
    opened,
    read_codes,
    read_columns,
    read_texts,
    validate_codes,
)
from drakegrasp.dataset.paths import DATA_FILES, TRIALS_FILE
from drakegrasp.dataset.schema import CAMERAS, OBJECT_FIELDS, SPLITS, TRIAL_FIELDS
from drakegrasp.errors import DataError
from drakegrasp.filters import Removal
from drakegrasp.frames import X_WT, Frame, invert_pose, unpack_pose
from drakegrasp.outcomes import Outcome
from drakegrasp.table import Table

#: Frames in which contacts can be returned.
FRAMES = (Frame.OBJECT, Frame.TABLE, Frame.PALM, Frame.WORLD)
#: Code of a removal or a split that an attempt does not have.
NONE = 255
#: Number of rows that are read at once: 8 chunks of a column.
BLOCK = 16_384
#: Columns besides those of `/trials`: name and class of the row's object, why a success is not a
#: sample (`removal` in the schema), and the split of a sample (index into SPLITS). `removal` and
#: `split` are NONE for all other attempts.
DERIVED = ("object_name", "class_name", "removal", "split")
#: The fields of `/trials` by name.
FIELDS = {f.name: f for f in TRIAL_FIELDS}
#: File status that changes when a file is replaced; None if the file does not exist.
Stamp = tuple[int, ...] | None


class Trials:
    """Attempts of a dataset as columns and rows; a selection of them is again a `Trials`.

    Columns are read when they are requested, so a large dataset needs memory only for these. A file
    that was rewritten in the meantime is rejected, because its rows may differ.

    Args:
        out: Directory of an assembled dataset, or its trials.hdf5.

    Attributes:
        path: The directory of the dataset, or its trials.hdf5, as an absolute path.
        objects: Columns of `/objects` by the names of the schema; texts are str.
        attributes: Attributes of trials.hdf5, e.g. `config` as JSON.

    Raises:
        DataError: If the file is missing, damaged or differs from the schema.
    """

    def __init__(self, out: str | Path) -> None:
        self.path = Path(out).absolute()
        path = self.path if self.path.is_file() else self.path / TRIALS_FILE
        with open_trials(path) as file:
            group = file["objects"]
            self.objects: Mapping[str, AnyArray] = {
                f.name: np.array(read_texts(group[f.name]), dtype=object)
                if f.dtype == "str"
                else group[f.name][:]
                for f in OBJECT_FIELDS
            }
            self._count = len(file["trials/outcome"])
            self.attributes: Mapping[str, Any] = dict(file.attrs)
        self._file, self._stamp = path, stamp(path)
        # The selected rows (None: all), and what `_of_all` has read, which all selections share.
        self._rows: npt.NDArray[np.int64] | None = None
        self._known: dict[str, npt.NDArray[np.uint8]] = {}

    def _chosen(self, rows: npt.NDArray[np.int64]) -> Trials:
        """Return the attempts at given rows of all attempts."""
        trials = copy.copy(self)
        trials._rows = rows
        return trials

    def __len__(self) -> int:
        return self._count if self._rows is None else len(self._rows)

    def __repr__(self) -> str:
        return f"Trials({str(self.path)!r}): {len(self):,} attempts"

    @property
    def trial_ids(self) -> npt.NDArray[np.int64]:
        """Rows (n,) of the attempts in trials.hdf5."""
        return np.arange(self._count) if self._rows is None else self._rows

    @overload
    def __getitem__(self, key: str) -> AnyArray: ...

    @overload
    def __getitem__(self, key: int) -> dict[str, Any]: ...

    @overload
    def __getitem__(self, key: slice | npt.NDArray[Any] | Sequence[int]) -> Trials: ...

    def __getitem__(self, key: Any) -> AnyArray | dict[str, Any] | Trials:
        """Return a column by its name, one attempt by its index, or a selection of attempts.

        Args:
            key: Name of a column, see `columns`; an index, which counts from the end if it is
                negative; or a slice, indices, or a mask (n,), as NumPy takes them.

        Raises:
            DataError: If there is no such column, or a file was replaced.
            IndexError: If the index is out of range.
        """
        if isinstance(key, str):
            return self.columns([key])[key]
        if isinstance(key, slice | np.ndarray | list | tuple | range):
            if not isinstance(key, slice):
                key = np.asarray(key) if len(key) else np.zeros(0, dtype=np.int64)
            return self._chosen(self.trial_ids[key])
        index = operator.index(key)
        if not -len(self) <= index < len(self):
            raise IndexError(f"index must be below {len(self)}, got {index}")
        return {name: values[0] for name, values in self[[index]].columns().items()}

    def trial(self, trial_id: int) -> dict[str, Any]:
        """Return an attempt by its row in trials.hdf5, in the form of `trials[index]`.

        Raises:
            DataError: If there is no such row.
        """
        if not 0 <= trial_id < self._count:
            last = self._count - 1
            raise DataError(f"{self._file}: trial must be 0 to {last}, got {trial_id}")
        return self._chosen(np.array([trial_id]))[0]

    def where(
        self,
        *,
        outcome: Outcome | str | Sequence[Outcome | str] | None = None,
        object_name: str | None = None,
        class_name: str | None = None,
        kept: bool | None = None,
    ) -> Trials:
        """Return the attempts that meet all given conditions.

        Args:
            outcome: One or several outcomes, as `Outcome` or by their labels, e.g. "success".
            object_name: Name of the object.
            class_name: Name of the object's class.
            kept: Whether the attempt is a sample of the dataset.

        Raises:
            DataError: If there is no such outcome, object or class.
        """
        mask = np.ones(len(self), dtype=np.bool_)
        if outcome is not None:
            wanted = [outcome] if isinstance(outcome, str | Outcome) else outcome
            mask &= np.isin(self["outcome"], [_outcome(each) for each in wanted])
        names = {"object_name": object_name, "class_name": class_name}
        for key, name in names.items():
            if name is not None:
                own = self.objects["name" if key == "object_name" else key] == name
                if not own.any():
                    raise DataError(f"{key} must be one of the dataset's, got {name!r}")
                mask &= own[self["object"]]
        if kept is not None:
            removal = self._of_all("removal")[self.trial_ids]
            mask &= (removal == Removal.KEPT) == kept
        return self[mask]

    def columns(self, names: Sequence[str] | None = None) -> dict[str, AnyArray]:
        """Return columns (n, ...) of the attempts by their names.

        Args:
            names: Fields of `/trials`, or DERIVED ones; if None, all except `split`, which is read
                from the data files. A field that the file lacks, or whose stage an attempt did not
                reach, is NaN, 0 or False.

        Raises:
            DataError: If there is no such column, or a file was replaced.
        """
        names = [*FIELDS, *DERIVED[:-1]] if names is None else names
        if not self._is_rising():
            rows, back = np.unique(self.trial_ids, return_inverse=True)
            columns = self._chosen(rows).columns(names)
            return {name: values[back] for name, values in columns.items()}
        blocks = list(self.blocks(names))
        return {name: np.concatenate([block[name] for block in blocks]) for name in names}

    def _is_rising(self) -> bool:
        """Return whether the attempts are in the order of the file, without repetition."""
        return self._rows is None or bool((np.diff(self._rows) > 0).all())

    def blocks(self, names: Sequence[str]) -> Iterator[dict[str, AnyArray]]:
        """Yield columns of the attempts in blocks of some thousand; they must be in rising order.

        At least one block is yielded, so that columns without attempts have a type and a shape.

        Args:
            names: See `columns`.

        Raises:
            DataError: See `columns`, or if the attempts are in another order.
        """
        if not self._is_rising():
            raise DataError("attempts must be in rising order to be read in blocks, got another")
        for name in names:
            if name not in FIELDS and name not in DERIVED:
                known = ", ".join([*FIELDS, *DERIVED])
                raise DataError(f"column must be one of {known}, got {name!r}")
        rows = self.trial_ids
        with reopened(self._file, self._stamp, "the trials of a dataset") as file:
            # The first block may be empty.
            for block in np.split(rows, np.flatnonzero(np.diff(rows // BLOCK)) + 1):
                yield self._read(file, block, names)

    def contacts(
        self, when: Literal["closed", "lifted"] = "closed", *, frame: str = Frame.OBJECT
    ) -> Table:
        """Return the contacts of the n attempts, of k fingers, in one frame.

        Columns: `touching` (n, k) bool, whether the fingertip touches the object; `points` (n, k,
        3) [m], contact points; `normals` (n, k, 3), unit normals out of the object; both are NaN
        for a finger that does not touch; `forces` (n, k, 3) [N], forces of the fingertips on the
        object.

        Args:
            when: `closed` for the instant after closing, `lifted` for that after the lift.
            frame: Frame of the result: "object", "table", "palm" or "world"; after the lift,
                object and palm are at their poses of that instant.

        Raises:
            DataError: If there is no such moment or frame.
        """
        if when not in ("closed", "lifted"):
            raise DataError(f"when must be closed or lifted, got {when!r}")
        if frame not in FRAMES:
            raise DataError(f"frame must be one of {', '.join(FRAMES)}, got {frame!r}")

        # Contacts in {O}, and the poses of object and palm at that moment.
        lifted = "_lifted" if when == "lifted" else ""
        keys = [f"{when}_{name}" for name in ("touching", "p_OQ", "nhat_Q_O", "f_Q_O")]
        poses = [f"X_TO{lifted}", f"X_OG{lifted}"]
        columns = self.columns([*keys, *poses])
        X_TO, X_OG = (unpack_pose(columns[name]) for name in poses)
        touching, points, normals, forces = (columns[key] for key in keys)

        # Transform them to the requested frame.
        if frame == Frame.OBJECT:
            return Table(touching=touching, points=points, normals=normals, forces=forces)
        X_FO = {"table": X_TO, "palm": invert_pose(X_OG), "world": multiply(X_WT, X_TO)}[frame]
        R_OF = np.swapaxes(X_FO[:, :3, :3], -1, -2)
        return Table(
            touching=touching,
            points=multiply(points, R_OF) + X_FO[:, None, :3, 3],
            normals=multiply(normals, R_OF),
            forces=multiply(forces, R_OF),
        )

    # Files

    def _read(
        self, file: h5py.File, rows: npt.NDArray[np.int64], names: Sequence[str]
    ) -> dict[str, AnyArray]:
        """Return columns of rows that are close together."""
        near = slice(int(rows[0]), int(rows[-1]) + 1) if len(rows) else slice(0, 0)
        stored = {name for name in names if name in FIELDS}
        stored |= {"object"} if {"object_name", "class_name"} & {*names} else set()
        table = read_columns(file["trials"], TRIAL_FIELDS, stored, near)
        for name, codes in (("outcome", list(Outcome)), ("object", len(self.objects["name"]))):
            if name in stored:
                place = f"/trials/{name}"
                validate_codes(self._file, place, table[name], codes, near.start)
        columns = dict(table[rows - near.start])
        for name in ("removal", "split"):
            if name in names:
                columns[name] = self._of_all(name)[rows]
        for name in ("object_name", "class_name"):
            if name in names:
                columns[name] = self.objects[name.removeprefix("object_")][columns["object"]]
        return {name: columns[name] for name in names}

    def _of_all(self, name: str) -> npt.NDArray[np.uint8]:
        """Return `removal` or `split` of all attempts; NONE for attempts without a decision."""
        if name not in self._known:
            values = np.full(self._count, NONE, dtype=np.uint8)
            if name == "removal":
                with reopened(self._file, self._stamp, "the trials of a dataset") as file:
                    success = read_codes(file["successes/trial_id"], self._count)
                    values[success] = read_codes(file["successes/removal"], list(Removal))
            else:
                for number, ids in enumerate(sample_ids(self.path).values()):
                    values[ids[ids < len(values)]] = number
            self._known[name] = values
        return self._known[name]


def _outcome(outcome: Outcome | str) -> Outcome:
    labels = {each.label: each for each in Outcome}
    if isinstance(outcome, str) and outcome not in labels:
        raise DataError(f"outcome must be one of {', '.join(labels)}, got {outcome!r}")
    return labels[outcome] if isinstance(outcome, str) else outcome


def sample_ids(out: Path) -> dict[str, npt.NDArray[np.int64]]:
    """Return the trial ids of the samples by split, in rising order; empty without data files.

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
    """Return a file status that changes when a file is replaced; None if there is no file."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_ino, status.st_size, status.st_mtime_ns


@contextmanager
def reopened(path: Path, known: Stamp, what: str) -> Iterator[h5py.File]:
    """Open a file that was read before, while the block runs; `known` is its stamp.

    Raises:
        DataError: If the path now has another file.
    """
    with opened(path, what, again=True) as file:
        if stamp(path) != known:
            raise DataError(f"{path}: must stay while it is read, got another; open it again")
        yield file
