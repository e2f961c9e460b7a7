"""What a check works with: files with any content, their rows, rules, and violations.

Input: an open HDF5 file. Output: a description of the file, as plain data with which any process
can open it; batches of its rows; violations of rules in these rows. A rule does not get rows that
broke an earlier rule, so the check reports a cause and not everything that follows from it. The
rules here apply to the fields of any group: they check each value against the schema.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from drakegrasp.config import Config, parse_stored
from drakegrasp.dataset.assembly.survey import lens_attributes
from drakegrasp.dataset.hdf5 import open_hdf5, sizes_in
from drakegrasp.dataset.manifest import Manifest
from drakegrasp.dataset.opening import (
    DATA_TABLES,
    OF_CAMERA,
    OF_SCENES,
    ORIGIN,
    SCENE_TABLES,
    TRIAL_TABLES,
    Difference,
    attribute_mistakes,
    differences,
)
from drakegrasp.dataset.paths import model_path
from drakegrasp.dataset.schema import (
    CAMERAS,
    CONVENTIONS,
    OTHER_SCHEMA,
    POSITIVE,
    SCHEMA_VERSION,
    Field,
    is_readable,
)
from drakegrasp.dataset.trials import stamp
from drakegrasp.errors import DataError, first_line
from drakegrasp.foreign_files import parse_json
from drakegrasp.frames import Array, unpack_pose
from drakegrasp.objects.model import ObjectModel, load_object
from drakegrasp.outcomes import Stage
from drakegrasp.runtime.executor import Executor, in_order
from drakegrasp.runtime.progress import Report

AnyArray = npt.NDArray[Any]
Rows = npt.NDArray[np.int64]
#: Number of rows listed per broken invariant and group; further rows are only counted.
MAX_LISTED = 20
#: float32 rounds points within one or two metres by 1e-7 m; this leaves room for products.
POSITION_TOLERANCE = 1e-5  # [m]
#: float32 rounds unit vectors and rotations by 2e-7; this leaves room for products.
UNIT_TOLERANCE = 1e-5
#: How far a stored number may be from the number derived again, in units in the last place of the
#: row's largest value: the last bit may differ between machines.
LAST_PLACES = 2
#: K, near and far are float64 copies of the configuration's values.
CAMERA_TOLERANCE = 1e-9
#: Key of scenes.hdf5 among the checked files; the key of the trials is "".
SCENES = "scenes"
#: Number of objects whose meshes, with their search trees, stay in memory during a task; samples
#: are ordered by object.
KEPT_OBJECTS = 4


# Violations


@dataclass(frozen=True, kw_only=True)
class Violation:
    """One broken invariant.

    Attributes:
        file: Path within the dataset's directory.
        group: Group or split within the file, e.g. `/train`; empty for the whole file.
        row: Row of the group; None for all of it.
        what: The invariant in words, with its unit.
        got: The value that breaks it.
    """

    file: str
    group: str = ""
    row: int | None = None
    what: str
    got: str

    def __str__(self) -> str:
        place = " ".join(p for p in (self.file, self.group) if p)
        row = "" if self.row is None else f" row {self.row}"
        return f"{place}{row}: {self.what}, got {self.got}"


def of_file(file: str, what: str, got: object, group: str = "") -> Violation:
    """Return a violation that affects a whole file, or a whole group in the file."""
    return Violation(file=file, group=group, what=what, got=str(got))


@dataclass
class Findings:
    """The violations of a check, up to MAX_LISTED per invariant and group, and the bad rows."""

    _listed: dict[tuple[str, str, str], list[Violation]] = field(default_factory=dict)
    _more: Counter[tuple[str, str, str]] = field(default_factory=Counter)
    _bad: dict[tuple[str, str], set[int]] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return bool(self._listed)

    def add(self, violations: Iterable[Violation]) -> set[int]:
        """Collect violations; return the rows that have a violation."""
        rows = set()
        for violation in violations:
            key = (violation.file, violation.group, violation.what)
            listed = self._listed.setdefault(key, [])
            if len(listed) < MAX_LISTED:
                listed.append(violation)
            else:
                self._more[key] += 1
            if violation.row is not None:
                rows.add(violation.row)
                self.mark(violation.file, violation.group, [violation.row])
        return rows

    def merge(self, other: Findings) -> None:
        """Add the findings of a task."""
        for listed in other._listed.values():
            self.add(listed)
        self._more.update(other._more)
        for (file, group), rows in other._bad.items():
            self.mark(file, group, rows)

    def mark(self, file: str, group: str, rows: Iterable[int]) -> None:
        """Record rows of a group that break a rule or cannot be read."""
        self._bad.setdefault((file, group), set()).update(rows)

    def bad(self, file: str, group: str) -> Rows:
        """Return the rows (n,) of a group that break a rule or cannot be read, in order."""
        return np.array(sorted(self._bad.get((file, group), ())), dtype=np.int64)

    def of_rows(self, file: str, group: str, start: int, stop: int) -> Findings:
        """Return the findings for a task that judges a range of rows: the rows already bad."""
        rows = self.bad(file, group)
        known = rows[(rows >= start) & (rows < stop)].tolist()
        return Findings(_bad={(file, group): set(known)})

    def violations(self) -> list[Violation]:
        """Return the listed violations, with one line for those that were only counted."""
        result = []
        for (file, group, what), listed in self._listed.items():
            result += listed
            if more := self._more[file, group, what]:
                result.append(of_file(file, what, f"{more} more rows that break it", group))
        return result


# Files


@dataclass(frozen=True, kw_only=True, eq=False)
class CheckedFile:
    """Description of a checked file: plain data, which is sent with a task.

    Attributes:
        path: Path of the file.
        stamp: Stamp that distinguishes the file from another file at the same path.
        name: Name of the file in violations.
        camera: `oto` or `otm`; SCENES for the scenes; empty for the trials.
        attributes: Attributes of the file that are valid by themselves.
        config: Configuration of the file, if it is valid.
        fields: Fields of each group.
        counts: Number of rows of each group whose layout is valid.
    """

    path: str
    stamp: tuple[int, ...] | None
    name: str
    camera: str
    attributes: Mapping[str, Any]
    config: Config | None
    fields: Mapping[str, tuple[Field, ...]]
    counts: Mapping[str, int]

    @contextmanager
    def opened(self) -> Iterator[h5py.File]:
        """Open the file while the block runs.

        Raises:
            DataError: If the path now has another file.
            OSError: If it cannot be opened.
        """
        with open_hdf5(Path(self.path), again=True) as file:
            if stamp(Path(self.path)) != self.stamp:
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
            OSError, UnicodeDecodeError: If the file is damaged at these rows.
        """
        # HDF5 reads a slice far faster than the same rows as a list.
        dense = len(rows) > 0 and rows[-1] - rows[0] + 1 == len(rows)
        choice = slice(int(rows[0]), int(rows[-1]) + 1) if dense else rows
        own, columns = file[group], {}
        for f in self.fields[group]:
            if names is not None and f.name not in names:
                continue
            if f.name in own or not f.optional:
                columns[f.name] = (own[f.name].asstr() if f.dtype == "str" else own[f.name])[choice]
            else:
                columns[f.name] = f.empty(len(rows), sizes_in(own, self.fields[group]))
        # Older files lack some derived fields of a trial, which are derived here.
        for f in self.fields[group]:
            if f.derive is not None and f.name not in own and {*f.needs} <= {*columns}:
                columns[f.name] = f.derive(columns)
        return Batch(of=self, group=group, rows=rows, columns=columns)

    def batches(
        self,
        file: h5py.File,
        group: str,
        rows: Rows,
        size: int,
        findings: Findings,
        names: Sequence[str] | None = None,
    ) -> Iterator[Batch]:
        """Yield the good rows of a group in batches of `size`; unreadable rows become findings."""
        place = f"/{group}"
        for first in range(0, len(rows), size):
            own = rows[first : first + size]
            good = own[~np.isin(own, findings.bad(self.name, place))]
            try:
                if len(good):
                    yield self.read(file, group, good, names)
            except (OSError, UnicodeDecodeError) as error:
                what = f"rows {own[0]} to {own[-1]} must be readable"
                findings.add([of_file(self.name, what, first_line(error), place)])
                findings.mark(self.name, place, own.tolist())


def look_at(name: str, file: h5py.File, camera: str, findings: Findings) -> CheckedFile:
    """Check the attributes and the layout of a file; no row is read.

    Args:
        name: Name of the file, for the violations.
        file: The file.
        camera: `oto` or `otm`; SCENES for the scenes; empty for the trials.
        findings: Takes the violations.
    """
    kinds = {"": (ORIGIN, TRIAL_TABLES), SCENES: (OF_SCENES, SCENE_TABLES)}
    rules, fields = kinds.get(camera, (OF_CAMERA, DATA_TABLES))
    config, attributes, counts = None, dict[str, Any](), dict[str, int]()

    # A different schema version has a different layout, so only the version is reported.
    if not is_readable(version := file.attrs.get("schema_version", "none")):
        what = f"attribute schema_version must be {SCHEMA_VERSION}"
        findings.add([of_file(name, what, f"{version}; {OTHER_SCHEMA}")])
    else:
        # Attributes that are valid by themselves are compared with the configuration.
        mistakes = attribute_mistakes(file, rules)
        attributes = {key: value for key, value in file.attrs.items() if key not in mistakes}
        try:
            config = parse_stored(parse_json(str(file.attrs["config"])))
            mistakes.pop("config", None)
        except (KeyError, ValueError) as error:  # none, no JSON, or no configuration
            got = "none" if isinstance(error, KeyError) else f"another ({first_line(error)})"
            must = "attribute config must be a configuration of drakegrasp"
            mistakes["config"] = Difference(what=must, got=got)
        findings.add(of_file(name, each.what, each.got) for each in mistakes.values())
        findings.add(_attributes(name, attributes, config, camera))

        # The layout: a group with an invalid column is not read.
        image, broken = None if config is None else config.camera.size, set()
        for found in differences(file, fields, image=image, thorough=True):
            findings.add([of_file(name, found.what, found.got, found.path)])
            if not found.text_only:
                broken.add(found.path[1:].split("/")[0])
        sound = [group for group in fields if group in file and group not in broken]
        counts = {group: len(file[group][fields[group][0].name]) for group in sound}
    return CheckedFile(
        path=file.filename,
        stamp=stamp(Path(file.filename)),
        name=name,
        camera=camera,
        attributes=attributes,
        config=config,
        fields=fields,
        counts=counts,
    )


def _attributes(
    name: str, attributes: Mapping[str, Any], config: Config | None, camera: str
) -> Iterator[Violation]:
    """The attributes agree with the configuration, and all conventions exist."""
    for key in CONVENTIONS:
        if not str(attributes.get(f"convention_{key}", "")).strip():
            yield of_file(name, f"attribute convention_{key} must be there", "none")

    due: dict[str, Any] = {"camera": camera} if camera in CAMERAS else {}
    if config is not None:
        due |= {"config_hash": config.simulation_hash(), "seed": config.seed}
        lens = lens_attributes(config.camera)
        due |= {k: getattr(config.scenes, k) for k in ("near", "far")} if camera == SCENES else lens
    for key in due.keys() & attributes.keys():
        value, expected = attributes[key], due[key]
        same = value == expected
        if not isinstance(expected, str | int):
            same = np.allclose(value, expected, rtol=CAMERA_TOLERANCE, atol=CAMERA_TOLERANCE)
        if not same:
            expected = expected.tolist() if isinstance(expected, np.ndarray) else expected
            yield of_file(name, f"attribute {key} must be {expected}", value)


#: Returns an object by its name, or None if its file is broken, which is already a finding.
LoadModel = Callable[[str], ObjectModel | None]


@dataclass(frozen=True, kw_only=True)
class Dataset:
    """The dataset around a checked file.

    Attributes:
        out: Directory of the dataset.
        manifest: Manifest of the dataset.
        readable: Names of the objects whose meshes can be read.
    """

    out: Path
    manifest: Manifest
    readable: frozenset[str]

    def loader(self) -> LoadModel:
        """Return a function that loads objects and caches some, for the time of a task."""
        out, readable = self.out, self.readable

        def load(name: str) -> ObjectModel | None:
            return load_object(model_path(out, name)) if name in readable else None

        return lru_cache(KEPT_OBJECTS)(load)


# Rows and rules


@dataclass(frozen=True, kw_only=True, eq=False)
class Batch:
    """Some rows of one group.

    Attributes:
        of: The file of the rows.
        group: Name of the group, e.g. `train`.
        rows: (n,), numbers of the rows in the group.
        columns: Values by field, (n, ...) each.
    """

    of: CheckedFile
    group: str
    rows: Rows
    columns: Mapping[str, AnyArray]

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, name: str) -> AnyArray:
        return self.columns[name]

    @property
    def config(self) -> Config:
        """Configuration of the file, which must be valid."""
        assert self.of.config is not None
        return self.of.config

    @property
    def fields(self) -> Iterator[Field]:
        """The fields of the group that were read."""
        return (f for f in self.of.fields[self.group] if f.name in self.columns)

    def pose(self, name: str) -> Array:
        """Return the poses (n, ..., 4, 4) in a field."""
        return unpack_pose(self.columns[name])

    def where(self, keep: AnyArray) -> Batch:
        """Return the rows where `keep` (n,) is true."""
        if keep.all():
            return self
        columns = {name: values[keep] for name, values in self.columns.items()}
        return replace(self, rows=self.rows[keep], columns=columns)

    def judge(self, findings: Findings, *stages: Sequence[Rule]) -> Batch:
        """Apply rules in stages, each to the rows that broke none before; return what is left."""
        batch = self
        for rules in stages:
            if len(batch):
                bad = set[int]().union(*(findings.add(rule(batch)) for rule in rules))
                batch = batch.where(~np.isin(batch.rows, sorted(bad))) if bad else batch
        return batch

    def broken(
        self, what: str, bad: AnyArray, got: Callable[[int], str] | AnyArray | str
    ) -> Iterator[Violation]:
        """Yield a violation for each row where `bad` (n,) is true.

        Args:
            what: The invariant in words.
            bad: (n,) bool.
            got: The values (n,) that break it, a function from an index in the batch to a text, or
                one text.
        """
        for i in np.flatnonzero(bad).tolist():
            if isinstance(got, str):
                said = got
            else:
                said = got(i) if callable(got) else f"{got[i].item():.6g}"
            row, place = int(self.rows[i]), f"/{self.group}"
            yield Violation(file=self.of.name, group=place, row=row, what=what, got=said)

    def follows(
        self, name: str, due: AnyArray, what: str, tolerance: float | None = None
    ) -> Iterator[Violation]:
        """Yield a violation for each row in which a field differs from the expected values.

        Args:
            name: Name of the field.
            due: (n, ...), the values derived again; NaN if a row has no value.
            what: What the values follow from, in words.
            tolerance: Maximum difference of a number; `LAST_PLACES` of rounding if None.
        """
        values = self.columns[name]
        due = np.asarray(due).astype(values.dtype, copy=False).reshape(values.shape)
        if values.dtype.kind != "O" and values.tobytes() == due.tobytes():
            return  # the usual case
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

    def follow(self, columns: Mapping[str, AnyArray], what: str) -> Iterator[Violation]:
        """Yield the violations of all fields of the batch that must equal a given column."""
        for name, due in columns.items():
            if name in self.columns:
                yield from self.follows(name, due, what)


Rule = Callable[[Batch], Iterator[Violation]]


def all_per_row(values: AnyArray) -> AnyArray:
    """Return for each row (n,) whether all of its values (n, ...) are true."""
    return np.asarray(values.all(axis=tuple(range(1, values.ndim))))


# Rules of the schema, for any group


def complete(
    batch: Batch, stage: AnyArray | Stage = Stage.LIFTED, **contacts: AnyArray
) -> Iterator[Violation]:
    """Fields of numbers have values from their stage on, and no values before it.

    Args:
        batch: Rows of a group.
        stage: (n,), the stage that each row reached.
        contacts: (n, k), the fingers that have a contact, by instant: `closed`, `lifted`.
    """
    stage = np.broadcast_to(np.asarray(stage), len(batch))
    for f in batch.fields:
        if f.derive is not None:
            continue  # see `derived`
        values, reached, late = batch[f.name], stage >= f.stage, f.stage is not Stage.PLACED
        of_grasp, since = f.axes == ("6k",), f.stage.name.lower()

        # What a value must be depends on its kind.
        if not f.dtype.startswith("float"):
            if not late:
                continue
            bad = ~reached & ~all_per_row(values == 0)
            what = f"{f.name} must be 0 before the stage {since}"
        elif f.some:
            bad = ~reached & ~np.isnan(values)
            what = f"{f.name} must be NaN before the stage {since}"
        elif f.per_finger or of_grasp:
            there = contacts["lifted" if "lifted" in f.name or "held" in f.name else "closed"]
            there = reached[:, None] & there
            there = np.tile(np.repeat(there, 3, axis=1), 2) if of_grasp else there
            bad = _is_not_as_due(values, there)
            what = f"{f.name} must be finite where the finger touches and NaN elsewhere"
        else:
            bad = _is_not_as_due(values, reached)
            what = f"{f.name} must be finite"
            what += f" from the stage {since} on and NaN before" if late else ""
        yield from batch.broken(what, bad, "the contrary")


def _is_not_as_due(values: AnyArray, due: AnyArray) -> AnyArray:
    """Return (n,) whether a row of values (n, ...) lacks a due value or has an undue one.

    A value is due where `due` is true: it must be finite there, and NaN elsewhere.
    """
    if due.all():
        return ~all_per_row(np.isfinite(values))
    due = due.reshape(*due.shape, *(1,) * (values.ndim - due.ndim))
    return ~all_per_row(np.where(due, np.isfinite(values), np.isnan(values)))


def ranges(batch: Batch) -> Iterator[Violation]:
    """Fields are within the limits of the schema; NaN has no limits."""
    for f in batch.fields if len(batch) else ():
        if f.limits is not None:
            # A limit is rounded as the values are: in float32, pi is above its double value.
            values = batch[f.name].reshape(len(batch), -1)
            low, high = (values.dtype.type(limit) for limit in f.limits)
            positive = f.limits[0] == POSITIVE
            what = f"above 0..{high:.4g}" if positive else f"{low:g}..{high:.4g}"
            bad = (values < low) | (values > high) | (positive & (values <= 0))
            worst = values[range(len(values)), bad.argmax(axis=1)]
            yield from batch.broken(f"{f.name} must be {what}", bad.any(axis=1), worst)


def derived(batch: Batch) -> Iterator[Violation]:
    """Derived fields have the values that the schema derives from other fields."""
    for f in batch.fields:
        if f.derive is not None:
            yield from batch.follows(f.name, f.derive(batch.columns), ", ".join(f.needs))


def rigid(batch: Batch) -> Iterator[Violation]:
    """Poses are rigid motions, and normals have length one; NaN means that there is no value."""
    for f in batch.fields:
        if f.axes[-1:] == (12,):
            yield from _rotation(batch, f.name)
        elif f.axes == ("6k",) or (f.axes == ("k", 3) and "nhat" in f.name):
            # In a grasp the normals come after the points.
            n = batch[f.name].astype(float).reshape(len(batch), -1, 3)
            n = n[:, n.shape[1] // 2 :] if f.axes == ("6k",) else n
            for k, own in enumerate(np.linalg.norm(n, axis=2).T):
                what = f"{f.name} of finger {k + 1} must have length 1 within {UNIT_TOLERANCE:g}"
                yield from batch.broken(what, np.abs(own - 1.0) > UNIT_TOLERANCE, own)


def _rotation(batch: Batch, name: str) -> Iterator[Violation]:
    """The poses of a field have orthonormal rotations with determinant +1."""
    R = batch.pose(name).reshape(len(batch), -1, 4, 4)[..., :3, :3]
    R = np.where(np.isfinite(R).all(axis=(2, 3), keepdims=True), R, np.eye(3))
    skew = np.abs(np.swapaxes(R, 2, 3) @ R - np.eye(3)).max(axis=(1, 2, 3))
    determinant = np.linalg.det(R).min(axis=1)
    yield from batch.broken(
        f"{name} must have an orthonormal rotation with determinant +1",
        (skew > UNIT_TOLERANCE) | (determinant < 0.0),
        lambda i: f"one that is off by {skew[i]:.3g}, with determinant {determinant[i]:.4g}",
    )


# Tasks

#: A number of rows, and a function that judges them in any process.
Task = tuple[int, Callable[[], Findings]]


@dataclass(kw_only=True, eq=False)
class Check:
    """A check while it runs.

    Attributes:
        execute: Executor of the tasks.
        report: Called with two numbers: the finished rows and shards, and all of them.
        total: Number of all rows and shards.
        done: Number of finished rows and shards.
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

    def judge(self, tasks: Iterable[Task]) -> None:
        """Judge rows in tasks."""
        for size, found in in_order(self.execute)(_judge, tasks):
            self.advance(size)
            self.findings.merge(found)

    @contextmanager
    def readable(self, file: CheckedFile) -> Iterator[None]:
        """Let the block read whole columns of a file; an unreadable column is a finding."""
        try:
            yield
        except (OSError, UnicodeDecodeError) as error:
            what = "all columns must be readable"
            self.findings.add([of_file(file.name, what, first_line(error))])


def _judge(task: Task) -> tuple[int, Findings]:
    """Run a task; return its number of rows and its findings."""
    size, judge = task
    return size, judge()
