"""Rows of a file that is checked, the rules that judge them, and the tasks that do so.

In: what is known of a file, plain data that any process can open. Out: batches of its rows;
violations of the rules in them. A rule is given no row that broke one before: so the check reports
a cause, and not all that follows from it.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import h5py
import numpy as np
import numpy.typing as npt

from drakegrasp.config import Config
from drakegrasp.dataset.checks.findings import Findings, Violation, of_file
from drakegrasp.dataset.hdf5 import open_hdf5
from drakegrasp.dataset.schema import Field
from drakegrasp.errors import DataError, first_line
from drakegrasp.frames import X_WT, Array, invert_pose, unpack_pose
from drakegrasp.runtime.executor import Executor, in_order
from drakegrasp.runtime.progress import Report

AnyArray = npt.NDArray[Any]
Rows = npt.NDArray[np.int64]
#: float32 rounds unit vectors and rotations by 2e-7; this leaves room for products.
UNIT_TOLERANCE = 1e-5
#: float32 rounds points within a metre or two by 1e-7 m; this leaves room for products.
POSITION_TOLERANCE = 1e-5  # [m]
#: How far a number may be from the same derived again, in units in the last place of its row's
#: largest value: a last bit may differ between machines.
LAST_PLACES = 2


# Rows and rules


@dataclass(frozen=True, kw_only=True, eq=False)
class Batch:
    """Some rows of one group.

    Attributes:
        file: Path within the dataset's directory.
        group: Group of the file, e.g. `/train`.
        rows: (n,), numbers of the rows in the group.
        columns: Values by field, (n, ...) each.
    """

    file: str
    group: str
    rows: Rows
    columns: Mapping[str, AnyArray]

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, name: str) -> AnyArray:
        return self.columns[name]

    def pose(self, name: str) -> Array:
        """Return the poses (n, 4, 4) in a field."""
        return unpack_pose(self.columns[name])

    def frame(self, name: str) -> Array:
        """Return the poses (n, 4, 4) of a frame of `object_props`."""
        return self.pose(f"object_props/frame_{name}")

    def object_in_camera(self, camera: str) -> Array:
        """Return X_CO (n, 4, 4) of the object in a camera's frame."""
        return self.frame(f"cam2work_{camera}") @ invert_pose(X_WT) @ self.frame("world2obj")

    def contacts(self, name: str = "grasps") -> tuple[Array, Array]:
        """Return p_CQ [m] and nhat_Q_C of `grasps` or `grasps_held`, (n, k, 3) each."""
        vectors = self.columns[name].astype(float).reshape(len(self), 2, -1, 3)
        return vectors[:, 0], vectors[:, 1]

    def where(self, keep: AnyArray) -> Batch:
        """Return the rows where `keep` (n,) is true."""
        if keep.all():
            return self
        columns = {name: values[keep] for name, values in self.columns.items()}
        return Batch(file=self.file, group=self.group, rows=self.rows[keep], columns=columns)

    def broken(
        self, what: str, bad: AnyArray, got: Callable[[int], str] | AnyArray
    ) -> Iterator[Violation]:
        """Yield a violation for each row where `bad` (n,) is true.

        Args:
            what: The invariant in words.
            bad: (n,) bool.
            got: The values (n,) that break it, or their text by index into the batch.
        """
        for i in np.flatnonzero(bad).tolist():
            figure = got(i) if callable(got) else f"{got[i].item():.6g}"
            yield Violation(
                file=self.file, group=self.group, row=int(self.rows[i]), what=what, got=figure
            )

    def follows(
        self, name: str, due: AnyArray, what: str, tolerance: float | None = None
    ) -> Iterator[Violation]:
        """Yield a violation for each row of a field whose values are not those that are due.

        Args:
            name: Of the field.
            due: (n, ...), the values derived again, NaN where there are none.
            what: From what they follow, in words.
            tolerance: How far a number may be off; `LAST_PLACES` of rounding if None.
        """
        values = self.columns[name]
        due = np.asarray(due).astype(values.dtype, copy=False).reshape(values.shape)
        if values.dtype.kind != "O" and values.tobytes() == due.tobytes():
            return  # mostly
        bad, off = ~all_per_row(values == due), np.zeros(len(self))
        if values.dtype.kind == "f":
            apart = np.where(np.isnan(values) & np.isnan(due), 0.0, np.abs(values - due))
            off, size = (v.reshape(len(v), -1).max(axis=1) for v in (apart, np.abs(due)))
            with np.errstate(invalid="ignore"):
                limit = LAST_PLACES * np.spacing(size) if tolerance is None else tolerance
                bad &= ~(off <= np.where(np.isnan(limit), 0.0, limit))
        yield from self.broken(
            f"{name} must follow from {what}",
            bad,
            lambda i: f"a difference of {off[i]:.4g}" if off[i] > 0.0 else str(values[i])[:60],
        )


Rule = Callable[[Batch], Iterator[Violation]]


def all_per_row(values: AnyArray) -> AnyArray:
    """Return for each row (n,) whether all of its values (n, ...) are true."""
    return np.asarray(values.all(axis=tuple(range(1, values.ndim))))


def unit_length(batch: Batch, lengths: Array, what: str) -> Iterator[Violation]:
    """Lengths (n, k) by finger are one."""
    for k in range(lengths.shape[1]):
        yield from batch.broken(
            f"{what} {k + 1} must have length 1 within {UNIT_TOLERANCE:g}",
            np.abs(lengths[:, k] - 1.0) > UNIT_TOLERANCE,
            lengths[:, k],
        )


def rotation(batch: Batch, name: str) -> Iterator[Violation]:
    """The pose of that name has an orthonormal rotation with determinant +1."""
    R = batch.pose(name)[:, :3, :3]
    # Poses that are NaN are none: `trials.stages` says where they must be.
    R = np.where(np.isfinite(R).all(axis=(1, 2), keepdims=True), R, np.eye(3))
    skew = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max(axis=(1, 2))
    determinant = np.linalg.det(R)
    yield from batch.broken(
        f"{name} must have an orthonormal rotation with determinant +1",
        (skew > UNIT_TOLERANCE) | (determinant < 0.0),
        lambda i: f"one that is off by {skew[i]:.3g}, with determinant {determinant[i]:.4g}",
    )


# Files


@dataclass(frozen=True, kw_only=True, eq=False)
class CheckedFile:
    """What is known of a file that is checked: plain data, which a task takes along.

    Attributes:
        path: Of the file.
        identity: What tells it from another file at the same path.
        name: Its name in violations.
        attributes: Its attributes.
        config: Its configuration, if it is sound.
        fields: Fields of each group.
        counts: Number of rows of each group whose layout is sound.
        bad: Rows of each group that break a rule or cannot be read, rising.
    """

    path: str
    identity: tuple[int, int]
    name: str
    attributes: Mapping[str, Any]
    config: Config | None
    fields: Mapping[str, tuple[Field, ...]]
    counts: Mapping[str, int]
    bad: dict[str, Rows] = field(default_factory=dict)

    @contextmanager
    def opened(self) -> Iterator[h5py.File]:
        """Open the file while the block runs.

        Raises:
            DataError: If it is another file by now.
            OSError: If it cannot be opened.
        """
        with open_hdf5(Path(self.path), again=True) as file:
            if identity(file) != self.identity:
                raise DataError(f"{self.path}: must stay while it is checked, got another file")
            yield file

    def read(
        self, file: h5py.File, group: str, rows: Rows, names: Sequence[str] | None = None
    ) -> Batch:
        """Return some rows of a group.

        Args:
            file: The file, opened.
            group: Name of the group.
            rows: (n,), numbers of the rows, rising.
            names: Fields to read; all if None.

        Raises:
            OSError, UnicodeDecodeError: If the file is damaged there.
        """
        fields = [f for f in self.fields[group] if names is None or f.name in names]
        absent = [f for f in fields if f.optional and f.name not in file[group]]
        # HDF5 reads a slice far faster than the same rows as a list.
        dense = len(rows) > 0 and rows[-1] - rows[0] + 1 == len(rows)
        choice = slice(int(rows[0]), int(rows[-1]) + 1) if dense else rows
        own, columns = file[group], {f.name: f.empty(len(rows), {}) for f in absent if not f.shape}
        for f in fields:
            if f in absent:
                continue
            dataset = own[f.name]
            columns[f.name] = (dataset.asstr() if f.dtype == "str" else dataset)[choice]
        # In files made before it a derived number of a trial is derived here.
        for f in absent:
            if f.derive is not None and {*f.needs} <= {*columns}:
                columns[f.name] = f.derive(columns)
        return Batch(file=self.name, group=f"/{group}", rows=rows, columns=columns)

    def batches(
        self,
        file: h5py.File,
        group: str,
        rows: Rows,
        size: int,
        findings: Findings,
        names: Sequence[str] | None = None,
    ) -> Iterator[Batch]:
        """Yield rows of a group that are not bad, of `size` rows each; others become findings."""
        for first in range(0, len(rows), size):
            own = rows[first : first + size]
            good = own[~np.isin(own, self.bad_rows(group))]
            try:
                if len(good):
                    yield self.read(file, group, good, names)
            except (OSError, UnicodeDecodeError) as error:
                what = f"rows {own[0]} to {own[-1]} must be readable"
                findings.add([of_file(self.name, what, first_line(error), f"/{group}")])
                self.mark_bad(group, own)

    def judge(self, batch: Batch, findings: Findings, *rules: Rule) -> Batch:
        """Apply rules that do not build on each other; return the rows that break none."""
        if not len(batch):
            return batch
        rows = set[int]().union(*(findings.add(rule(batch)) for rule in rules))
        self.mark_bad(batch.group[1:], np.array(sorted(rows), dtype=np.int64))
        return batch.where(~np.isin(batch.rows, sorted(rows))) if rows else batch

    def for_task(self, group: str = "", start: int = 0, stop: int = 0) -> CheckedFile:
        """Return the file for a task, which need not know of all bad rows of a group."""
        rows = self.bad_rows(group)
        return replace(self, bad={group: rows[(rows >= start) & (rows < stop)]} if group else {})

    def bad_rows(self, group: str) -> Rows:
        """Return the rows (n,) of a group that break a rule or cannot be read."""
        return self.bad.get(group, np.zeros(0, dtype=np.int64))

    def mark_bad(self, group: str, rows: Rows) -> None:
        """Remember rows (n,) of a group that break a rule or cannot be read."""
        if len(rows):
            self.bad[group] = np.union1d(self.bad_rows(group), rows)


def identity(file: h5py.File) -> tuple[int, int]:
    """Return what tells an open file from others, also from one of the same name."""
    found = os.fstat(file.id.get_vfd_handle())
    return found.st_dev, found.st_ino


# Tasks


class RowsTask(Protocol):
    """Rows that a process judges; it marks the bad ones in the files of the task."""

    @property
    def files(self) -> Mapping[str, CheckedFile]:
        """The files whose rows are judged, by camera; the trials under ""."""

    @property
    def size(self) -> int:
        """Number of rows, for the progress."""

    def judge(self, findings: Findings) -> None:
        """Apply the rules."""


@dataclass(kw_only=True, eq=False)
class Check:
    """A check while it runs.

    Attributes:
        execute: Runs the tasks.
        report: Called with the number of rows and shards that are done and to do.
        total: Number of rows and shards to do.
        done: Number of rows and shards that are done.
        findings: The violations.
    """

    execute: Executor
    report: Report
    total: int = 0
    done: int = 0
    findings: Findings = field(default_factory=Findings)

    def advance(self, count: int) -> None:
        """Report that more rows or shards are done."""
        self.done += count
        self.report(self.done, self.total)

    def judge(self, tasks: Iterable[RowsTask], files: Mapping[str, CheckedFile]) -> None:
        """Judge rows in tasks; their files remember the bad ones."""
        bad: dict[tuple[str, str], list[Rows]] = {}
        for size, found, marked in in_order(self.execute)(_judge, tasks):
            self.advance(size)
            self.findings.merge(found)
            for key, rows in marked.items():
                bad.setdefault(key, []).append(rows)
        for (camera, group), parts in bad.items():
            files[camera].mark_bad(group, np.concatenate(parts))

    @contextmanager
    def readable(self, file: CheckedFile) -> Iterator[None]:
        """Let whole columns of a file be read in the block; that they cannot be is a finding."""
        try:
            yield
        except (OSError, UnicodeDecodeError) as error:
            what = "all columns must be readable"
            self.findings.add([of_file(file.name, what, first_line(error))])


def _judge(task: RowsTask) -> tuple[int, Findings, dict[tuple[str, str], Rows]]:
    """Return the size of a task, its findings, and the bad rows by file and group."""
    findings = Findings()
    task.judge(findings)
    bad = {(c, group): rows for c, file in task.files.items() for group, rows in file.bad.items()}
    return task.size, findings, bad
