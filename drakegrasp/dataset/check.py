"""`drakegrasp check`: are the files of a dataset as they were written, and of one state?

Input: a dataset's directory. Output: a list of violations, empty for a valid dataset. The seal of a
file proves that it is intact. Besides, attributes, layout and rows are compared with the schema,
and samples with their trials and meshes. An `Executor` does the work in tasks, each of which reads
a file or a range of rows.

The rules of rows come in stages, and a row that breaks a rule is left out of later stages: so the
check reports a cause, and not everything that follows from it. Does not import Drake.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from drakegrasp.arithmetic import multiply
from drakegrasp.config import CarriedHand
from drakegrasp.dataset.assemble import file_attributes, object_columns, shards_sha256
from drakegrasp.dataset.hdf5 import (
    CLUTTER_REACH,
    REACH,
    SAMPLES,
    SCENES,
    TRIALS,
    AnyArray,
    Layout,
    mistakes,
    open_hdf5,
    open_samples,
    open_trials,
    read_columns,
    says_damage,
)
from drakegrasp.dataset.manifest import Manifest, ObjectEntry, read_manifest
from drakegrasp.dataset.paths import (
    CLUTTER_FILE,
    CLUTTER_FOLDER,
    DATA_FILES,
    MANIFEST_FILE,
    SCENES_FILE,
    TRIALS_FILE,
    model_path,
    plan_path,
    reach_names,
    reach_path,
    read_model_file,
    recorded_model,
)
from drakegrasp.dataset.scenes import TRIED
from drakegrasp.dataset.schema import (
    CAMERAS,
    HITS_NOTHING,
    NO_OBJECT,
    NOT_TRIED,
    OBJECT_FIELDS,
    POSITIVE,
    ROW_NUMBERS,
    SPLITS,
    Field,
    validate_schema_version,
)
from drakegrasp.dataset.shards import ShardHeader, open_shard
from drakegrasp.dataset.trials import Stamp, Trials, reopened, stamp
from drakegrasp.errors import DataError, DrakegraspError, MeshError, first_line, printable
from drakegrasp.filters import Removal
from drakegrasp.frames import (
    X_WT,
    Array,
    invert_pose,
    pack_pose,
    rotate_vectors,
    transform_points,
    unpack_pose,
)
from drakegrasp.grasp import unused_fingers
from drakegrasp.hand.folder import HAND_FOLDER, hand_digest
from drakegrasp.objects.model import fit_contacts, load_object
from drakegrasp.outcomes import Outcome, Stage
from drakegrasp.runtime.executor import Executor, in_order, run_here
from drakegrasp.runtime.files import validate_seal
from drakegrasp.runtime.progress import Report, silent
from drakegrasp.table import Table
from drakegrasp.vision.camera import project

#: Number of rows in a task: some 20 MB.
TASK_ROWS = 1024
#: Layouts of the files; all others are of arms.
FILES: Mapping[str, Layout] = {
    TRIALS_FILE: TRIALS,
    **dict.fromkeys(DATA_FILES.values(), SAMPLES),
    SCENES_FILE: SCENES,
    CLUTTER_FILE: SCENES,
}
#: Files that a dataset may lack, and the commands that write them.
ON_REQUEST: Mapping[str, str] = {SCENES_FILE: "scenes", CLUTTER_FILE: "clutter"}
#: Attributes that identify the state of a dataset that a file is of.
STATE = ("signature", "shards")

#: float32 rounds points within one or two metres by 1e-7 m; this leaves room for products.
POSITION_TOLERANCE = 1e-5  # [m]
#: float32 rounds unit vectors and rotations by 2e-7; this leaves room for products.
UNIT_TOLERANCE = 1e-5
#: How far a number may be from the number derived again, in units in the last place of the row's
#: largest value: the last bit may differ between machines.
LAST_PLACES = 2
#: A contact on the object's outline may be rounded to a pixel beside the mask, and the collision
#: mesh and `filters.max_surface_distance` allow it to be off the full mesh.
MASK_TOLERANCE = 2.0  # [px]
#: Columns of codes, by their group and name.
CODES: Mapping[tuple[str, str], list[int]] = {
    ("trials", "outcome"): [each.value for each in Outcome if not each.verification_only],
    ("grasps", "outcome"): [
        *(each.value for each in Outcome if not each.verification_only),
        NOT_TRIED,
    ],
    ("successes", "removal"): [each.value for each in Removal],
}
#: Groups whose rows have a value in every field from its stage on.
COMPLETE = ("trials", *SPLITS, "scenes", "views")


@dataclass(frozen=True, kw_only=True)
class Violation:
    """One broken invariant.

    Attributes:
        file: Path within the dataset's directory.
        group: Group or split within the file, e.g. `/train`; empty for the whole file.
        row: First row of the group that breaks the invariant; None for all of it.
        more: Number of further rows that break it.
        what: The invariant in words, with its unit.
        got: The value of the first row.
    """

    file: str
    group: str = ""
    row: int | None = None
    more: int = 0
    what: str
    got: str

    def __str__(self) -> str:
        place = f"{self.file} {self.group}".strip()
        row = "" if self.row is None else f" row {self.row}"
        more = f" and {self.more:,} more" if self.more else ""
        return f"{place}{row}{more}: {self.what}, got {self.got}"


#: A part of the check that runs in any process.
Task: TypeAlias = Callable[[], list[Violation]]


def check_dataset(
    out: str | Path, *, execute: Executor = run_here, progress: Report = silent
) -> list[Violation]:
    """Return every broken invariant of a dataset.

    Args:
        out: Directory of the dataset.
        execute: Executor of the tasks; the result does not depend on it.
        progress: Called with the number of finished tasks and the number of all tasks.

    Raises:
        DataError: If there is no dataset, or its manifest cannot be read. Any other file that
            cannot be read is a violation, and the other files are still checked.
    """
    found, tasks = _look_at(Path(out))
    for done, more in enumerate(in_order(execute)(_run, tasks), start=1):
        found += more
        progress(done, len(tasks))

    # One violation for each rule and group, with the number of all rows that break it.
    joined = dict[tuple[str, str, str], Violation]()
    for each in found:
        first = joined.setdefault((each.file, each.group, each.what), each)
        if first is not each:
            more_rows = first.more + each.more + 1
            joined[each.file, each.group, each.what] = replace(first, more=more_rows)
    return list(joined.values())


def _run(task: Task) -> list[Violation]:
    return task()


# Files


@dataclass(frozen=True, kw_only=True, eq=False)
class _Header:
    """What a file says of itself.

    Attributes:
        attributes: Attributes of the file.
        counts: Number of rows of each group whose layout is that of the schema; none if attributes
            are broken.
        mistakes: Whether attributes or layout differ from the schema.
        other: Whether the file is of another state than the manifest and the shards.
    """

    attributes: Mapping[str, Any]
    counts: Mapping[str, int]
    mistakes: bool
    other: bool


def _look_at(out: Path) -> tuple[list[Violation], list[Task]]:
    """Return what a dataset's manifest and the headers of its files show, and all tasks."""
    manifest, seals, headers = read_manifest(out), "", dict[str, _Header]()
    found = check_hand(manifest)
    with _reported(found, MANIFEST_FILE, "objects of one group must be in one split"):
        manifest.homes()
    with suppress(DataError):  # a missing shard is found with its object
        seals = shards_sha256(out, manifest)
    cameras = {name: camera for camera, name in DATA_FILES.items()}
    arms, in_scenes = _files_of_arms(out, clutter=False), _files_of_arms(out, clutter=True)
    for name in (*FILES, *arms, *in_scenes):
        if name in ON_REQUEST and not (out / name).exists():
            continue
        with _reported(found, name, "the file must be there, readable and of this schema"):
            due = file_attributes(manifest, seals, cameras.get(name, ""))
            known = {key: value for key, value in due.items() if key != "shards" or seals}
            if name in in_scenes and (among := headers.get(CLUTTER_FILE)):
                known["clutter"] = among.attributes.get("clutter")
            headers[name] = _header(out / name, name, known, found)

    units = zip(manifest.objects, manifest.headers_by_object(), strict=True)
    tasks: list[Task] = [partial(_check_object, out, entry, own) for entry, own in units]
    # Samples are compared with trials and meshes of the same state.
    trials = headers.get(TRIALS_FILE)
    sound = trials is not None and not trials.mistakes
    sound = sound and not any(header.other for header in headers.values())
    for name, header in headers.items():
        compared = sound and (name in cameras or name in arms) and not header.mistakes
        if compared and name in cameras:
            tasks.append(partial(_samples, out / name))
        if name == TRIALS_FILE and sound:
            tasks.append(partial(_objects, out))
        tasks.append(partial(_seal, out / name, name))
        refers = headers.get(CLUTTER_FILE) if name in in_scenes else trials if compared else None
        rows = _Rows(
            path=out / name,
            name=name,
            stamp=stamp(out / name),
            attributes=header.attributes,
            counts={**(refers.counts if refers else {}), **header.counts},
            max_distance=manifest.config.filters.max_surface_distance if compared else None,
        )
        tasks += [
            partial(_check_rows, replace(rows, group=group, start=start, stop=start + TASK_ROWS))
            for group, count in header.counts.items()
            for start in range(0, count, TASK_ROWS)
        ]
    return found, tasks


def _files_of_arms(out: Path, *, clutter: bool) -> list[str]:
    """Return the files of arms by their paths within a dataset, see `reach_path`."""
    paths = (reach_path(out, name, clutter=clutter) for name in reach_names(out, clutter=clutter))
    return [path.relative_to(out).as_posix() for path in paths]


def _header(path: Path, name: str, due: Mapping[str, Any], found: list[Violation]) -> _Header:
    """Check the attributes and the layout of a file; no row is read.

    Args:
        path: Path of the file.
        name: The same within the dataset.
        due: The attributes that the file would be written with now, as far as they are known.
        found: Gets the violations.
    """
    layout = _layout(name)
    with open_hdf5(path) as file:
        validate_schema_version(path, file.attrs.get("schema_version"))
        wrong = list(mistakes(file, layout))
        # A group with an invalid column is not read; without sound attributes, nothing is.
        broken = {each.path[1:].split("/")[0] for each in wrong}
        read = layout.tables.keys() - broken if "" not in broken else ()
        counts = {g: len(file[g][layout.tables[g][0].name]) for g in layout.tables if g in read}
        attributes = dict(file.attrs)
    for each in wrong:
        found.append(Violation(file=name, group=each.path, what=each.what, got=each.got))

    # The first other attribute is the cause of the others. Verdicts may get other settings, which
    # are in `config`; scenes and arms have their own attributes.
    keys, command = [*dict.fromkeys((*STATE, *due))], "assemble"
    if name in ON_REQUEST:
        keys, command = [*STATE], ON_REQUEST[name]
    elif name not in FILES:
        keys, command = ["config_hash", "shards", "signature", "clutter"], "reach"
    told = [key for key in keys if key in due and key in attributes and key != "config"]
    other = next((key for key in told if not np.array_equal(attributes[key], due[key])), "")
    if other:
        known = {"shards": "the shards that are there", "clutter": CLUTTER_FILE}
        of = known.get(other, MANIFEST_FILE)
        again = f"another; run `drakegrasp {command}` again"
        what = f"attribute {other} must be that of {of}"
        found.append(Violation(file=name, what=what, got=again))
    return _Header(attributes=attributes, counts=counts, mistakes=bool(wrong), other=bool(other))


def _layout(name: str) -> Layout:
    """Return the layout of a file, by its path within the dataset."""
    return FILES.get(name) or (CLUTTER_REACH if CLUTTER_FOLDER in Path(name).parts else REACH)


def _seal(path: Path, name: str) -> list[Violation]:
    """Return a violation if a file is not as it was written."""
    found = list[Violation]()
    with _reported(found, name, "the file must be as it was written"):
        validate_seal(path, "file", None)
    return found


def _objects(out: Path) -> list[Violation]:
    """Return a violation if the objects of trials.hdf5 are not those of the manifest."""
    found, due = list[Violation](), object_columns(read_manifest(out))
    with _reported(found, TRIALS_FILE, f"the objects must be those of {MANIFEST_FILE}"):
        with open_trials(out / TRIALS_FILE) as file:
            stored = read_columns(file["objects"], OBJECT_FIELDS)
        if stored.count != len(due["name"]):
            raise DataError(f"they must be {len(due['name'])}, got {stored.count}")
        for name, values in due.items():
            if (bad := _differs(stored[name], values)).any():
                raise DataError(f"{name} must be as there, got another in row {np.argmax(bad)}")
    return found


def _samples(path: Path) -> list[Violation]:
    """Return a violation if the samples of a data file are not the kept successes, each once."""
    found, what = list[Violation](), "the samples must be the successes that no filter removes"
    try:
        kept = np.flatnonzero(Trials(path.parent)["removal"] == Removal.KEPT)
    except DataError:
        return []  # trials.hdf5 has a violation of its own
    with _reported(found, path.name, what):
        with open_samples(path) as file:
            ids = np.concatenate([file[split]["trial_id"][:] for split in SPLITS])
        if not np.array_equal(np.sort(ids), kept):
            raise DataError(f"they must be {len(kept)}, got {len(ids)}, some of them others")
    return found


# Objects and the hand


def _check_object(out: Path, entry: ObjectEntry, headers: Iterable[ShardHeader]) -> list[Violation]:
    """Return the violations of an object's files: its meshes, its plan and its shards.

    Args:
        out: Directory of the dataset.
        entry: The object.
        headers: The object's work units.
    """
    found, model, plan = list[Violation](), model_path(out, entry.name), plan_path(out, entry.name)
    names = {path: path.relative_to(out).as_posix() for path in (model, plan)}
    content = None
    with _reported(found, names[plan], "the plan must be as it was written"):
        expected = recorded_model(out, entry.name)
        with _reported(found, names[model], "the meshes must be as they were written"):
            content = read_model_file(out, entry.name, expected)
    with _reported(found, names[model], f"the meshes must be those of {MANIFEST_FILE}"):
        if (sha256 := load_object(model, content).mesh_sha256) != entry.mesh_sha256:
            raise DataError(f"mesh_sha256 must be {entry.mesh_sha256}, got {sha256}")
    for header in headers:
        path = header.path(out)
        what = "the shard must be there, whole and of its work unit"
        with _reported(found, path.relative_to(out).as_posix(), what), open_shard(path, header):
            pass
    return found


def check_hand(manifest: Manifest) -> list[Violation]:
    """Return a violation if the hand in a dataset is not the one that it was built with."""
    source, found = manifest.config.hand_source, list[Violation]()
    if isinstance(source, CarriedHand):  # else the dataset does not contain its hand
        with _reported(found, HAND_FOLDER, f"the hand must be that of {MANIFEST_FILE}"):
            if (digest := hand_digest(source)) != source.digest:
                raise DataError(f"it must be {source.digest}, got {digest}")
    return found


@contextmanager
def _reported(found: list[Violation], name: str, what: str) -> Iterator[None]:
    """Turn an error in the block into a violation of the file or folder of this name."""
    try:
        yield
    except (DrakegraspError, OSError) as error:
        got = first_line(error).rpartition(", got ")[2]
        found.append(Violation(file=name, what=what, got=got))


# Rows


@dataclass(frozen=True, kw_only=True, eq=False)
class _Rows:
    """Some rows to check, in any process.

    Attributes:
        path: Path of the file, whose layout is that of the schema.
        name: The same within the dataset.
        stamp: State of the file, see `drakegrasp.dataset.trials.stamp`.
        attributes: Attributes of the file.
        counts: Number of rows of the groups that the group's rows refer to, as far as known.
        max_distance: Largest distance of a contact from the object's mesh [m]; None if samples are
            not to be compared with their trials and meshes.
        group: Name of the group.
        start, stop: Range of the rows; the group may end before.
    """

    path: Path
    name: str
    stamp: Stamp
    attributes: Mapping[str, Any]
    counts: Mapping[str, int]
    max_distance: float | None
    group: str = ""
    start: int = 0
    stop: int = 0

    @property
    def fields(self) -> tuple[Field, ...]:
        """Fields of the group."""
        return _layout(self.name).tables[self.group]


#: The words of a rule, the rows (n,) that break it, and what they have instead (n, ...).
Finding: TypeAlias = tuple[str, AnyArray, AnyArray]
#: A check of the rows of a task: a table with their columns, without images that have no limits,
#: and the column NUMBER.
RowCheck: TypeAlias = Callable[[Table, _Rows], Iterator[Finding]]
#: Column of the number of each row in its group; no field has this name.
NUMBER = "#"


def _check_rows(task: _Rows) -> list[Violation]:
    """Return the rules that some rows break.

    Raises:
        DataError: If the path now has another file.
    """
    # The seal proves that images are intact, and no rule here is about their colours and depths.
    names = [f.name for f in task.fields if not (f.sample and f.limits is None)]
    violation = partial(Violation, file=task.name, group=f"/{task.group}")
    with reopened(task.path, task.stamp, "a file of a dataset") as file:
        group = file[task.group]
        try:
            own, rows = [n for n in names if n in group], slice(task.start, task.stop)
            t = read_columns(group, task.fields, own, rows)
        except Exception as error:
            if not says_damage(error):
                raise
            last = min(task.stop, task.counts[task.group]) - 1
            what = f"rows {task.start} to {last} must be readable"
            return [violation(what=what, got=first_line(error))]

    t = t.with_columns({NUMBER: task.start + np.arange(t.count)})
    stages: list[list[RowCheck]] = [[_numbers], [_complete, _limits], [_rigid, _derived]]
    if task.group in SPLITS:
        stages += [[_chain], [_in_mask]]
        if task.max_distance is not None:
            stages += [[_as_in_trials], [_on_mesh]]
    elif task.group == "grasps":
        stages += [[_as_labelled]]
    elif task.group in ("reach", "clutter"):
        stages += [[_as_reached]]
        if task.group == "reach" and task.max_distance is not None:
            stages += [[_of_grasp]]
    found = list[Violation]()
    for checks in stages:
        sound = np.ones(t.count, dtype=np.bool_)
        try:
            findings = [each for check in checks if t.count for each in check(t, task)]
        except DataError:
            break  # what it is compared with has a violation of its own
        for what, bad, got in findings:
            if bad.any():
                first, more = int(np.argmax(bad)), int(bad.sum()) - 1
                row, said = int(t[NUMBER][first]), _said(np.asarray(got)[first])
                found.append(violation(row=row, more=more, what=what, got=said))
                sound &= ~bad
        t = t[sound]
    return found


def _said(value: Any) -> str:
    """Return the value of a row in a line."""
    number = isinstance(value, float | np.floating)
    return f"{value:.6g}" if number else printable(" ".join(str(value).split())[:60])


def _any(values: AnyArray) -> AnyArray:
    """Return for each row (n,) whether any of its values (n, ...) is true."""
    return np.asarray(values.any(axis=tuple(range(1, values.ndim))))


def _read_fields(t: Table, task: _Rows) -> Iterator[Field]:
    """Yield the fields that were read."""
    return (f for f in task.fields if t.has(f.name))


# What the table of fields says of any group


def _numbers(t: Table, task: _Rows) -> Iterator[Finding]:
    """Numbers of rows are those of rows, and codes have a meaning."""
    if task.group == "trials":
        values = t["trial_id"]
        yield "trial_id must be the number of the row", values != t[NUMBER], values
    for name, of in ROW_NUMBERS.get(task.group, {}).items():
        values = t[name]
        unknown = (values < 0) | (values >= task.counts.get(of, np.inf))
        if values.ndim > 1:  # a scene may have fewer objects than others
            unknown[:, 1:] &= values[:, 1:] != NO_OBJECT
        bad = _any(unknown)
        yield f"{name} must be one of the rows of /{of}", bad, values
    for (place, name), known in CODES.items():
        if place == task.group:
            what = f"{name} must be one of {', '.join(map(str, known))}"
            yield what, ~np.isin(t[name], known), t[name]


def _stage(t: Table, task: _Rows) -> AnyArray:
    """Return the stage (n,) that each row reached; a sample reached the last one."""
    if task.group != "trials":
        return np.full(t.count, Stage.TRIED.value)
    stages = {outcome.value: outcome.stage.value for outcome in Outcome}
    reached = np.array([stages[outcome] for outcome in t["outcome"].tolist()], dtype=int)
    # The hand can touch the table while it closes, or in the lift.
    late = (t["outcome"] == Outcome.TABLE_CONTACT) & np.isfinite(t["time_lift"])
    return np.where(late, Stage.TRIED.value, reached)


def _touching(t: Table, task: _Rows, field: Field) -> AnyArray:
    """Return which fingers (n, k) have a contact at the time of a field."""
    if task.group == "trials":
        return t["lifted_touching" if "lifted" in field.name else "closed_touching"]
    return ~unused_fingers(t["grasp_props/unused"], t["grasps"].shape[1] // 6)


def _complete(t: Table, task: _Rows) -> Iterator[Finding]:
    """Fields have values from their stage on, and no values before it."""
    if task.group not in COMPLETE:
        return
    stage = _stage(t, task)
    for f in _read_fields(t, task):
        values, reached, since = t[f.name], stage >= f.stage, f.stage.name.lower()
        if f.derive is not None or f.dtype == "str":
            continue  # see `_derived`

        # What a value must be depends on its kind.
        if not f.dtype.startswith("float"):
            yield (
                f"{f.name} must be 0 before the stage {since}",
                ~reached & _any(values != 0),
                values,
            )
        elif f.some:
            bad = ~reached & _any(~np.isnan(values))
            yield f"{f.name} must be NaN before the stage {since}", bad, values
        else:
            late = f.stage is not Stage.PLACED
            due, where = reached, f"from the stage {since} on and NaN before" if late else "always"
            if f.per_finger or f.axes == ("6k",):
                due = reached[:, None] & _touching(t, task, f)
                where = "where the finger touches and NaN elsewhere"
            if f.axes == ("6k",):
                due = np.tile(np.repeat(due, 3, axis=1), 2)
            due = due.reshape(*due.shape, *(1,) * (values.ndim - due.ndim))
            bad = _any(np.where(due, ~np.isfinite(values), ~np.isnan(values)))
            yield f"{f.name} must be finite {where}", bad, values


def _limits(t: Table, task: _Rows) -> Iterator[Finding]:
    """Values are within the limits of their fields; NaN has no limits."""
    for f in _read_fields(t, task):
        if f.limits is not None:
            # A limit is rounded as the values are: in float32, pi is above its double value.
            values = t[f.name].reshape(t.count, -1)
            low, high = (values.dtype.type(limit) for limit in f.limits)
            positive = f.limits[0] == POSITIVE
            what = f"above 0..{high:.4g}" if positive else f"{low:g}..{high:.4g}"
            bad = (values < low) | (values > high) | (positive & (values <= 0))
            worst = values[range(len(values)), bad.argmax(axis=1)]
            yield f"{f.name} must be {what}", bad.any(axis=1), worst


def _rigid(t: Table, task: _Rows) -> Iterator[Finding]:
    """Poses are rigid motions, and normals have length one; NaN means that there is no value."""
    count = t.count
    for f in _read_fields(t, task):
        if f.axes[-1:] == (12,):
            R = unpack_pose(t[f.name].astype(float)).reshape(count, -1, 4, 4)[..., :3, :3]
            R = np.where(np.isfinite(R).all(axis=(2, 3), keepdims=True), R, np.eye(3))
            off = np.abs(np.swapaxes(R, 2, 3) @ R - np.eye(3)).max(axis=(1, 2, 3))
            bad = (off > UNIT_TOLERANCE) | (np.linalg.det(R).min(axis=1) < 0.0)
            what = f"{f.name} must have an orthonormal rotation with determinant +1"
            yield what, bad, t[f.name].reshape(count, -1)
        elif f.axes == ("6k",) or (f.axes == ("k", 3) and "nhat" in f.name):
            # In a grasp the normals come after the points.
            n = t[f.name].astype(float).reshape(count, -1, 3)
            n = n[:, n.shape[1] // 2 :] if f.axes == ("6k",) else n
            length = np.linalg.norm(n, axis=2)
            bad = (np.abs(length - 1.0) > UNIT_TOLERANCE).any(axis=1)
            yield f"normals in {f.name} must have length 1", bad, length


def _derived(t: Table, task: _Rows) -> Iterator[Finding]:
    """Derived fields have the values that the schema derives from other fields."""
    for f in _read_fields(t, task):
        if f.derive is not None and t.has(*f.needs):
            what = f"{f.name} must follow from {', '.join(f.needs)}"
            yield what, _differs(t[f.name], f.derive(t)), t[f.name]


def _differs(values: AnyArray, due: AnyArray, tolerance: float | None = None) -> AnyArray:
    """Return (n,) whether values (n, ...) differ from the values derived again.

    Args:
        values: The stored values.
        due: The values derived again, of any type.
        tolerance: Maximum difference of a number; `LAST_PLACES` of rounding if None.
    """
    due = due.astype(values.dtype, copy=False).reshape(values.shape)
    if values.dtype.kind != "f":
        return _any(values != due)
    same = (values == due) | (np.isnan(values) & np.isnan(due))
    size = np.abs(np.where(np.isfinite(due), due, 0.0)).reshape(len(due), -1).max(axis=1)
    limit = LAST_PLACES * np.spacing(size) if tolerance is None else np.full(len(due), tolerance)
    with np.errstate(invalid="ignore"):
        near = np.abs(values - due) <= limit.reshape(-1, *(1,) * (values.ndim - 1))
    return _any(~(same | near))


# Grasps in scenes


def _as_labelled(t: Table, task: _Rows) -> Iterator[Finding]:
    """Labels of a grasp do not contradict each other, and its object is in its scene."""
    outcome, success = t["outcome"], t["outcome"] == Outcome.SUCCESS
    what = "lifted must be true exactly where outcome is success"
    yield what, t["lifted"] != success, t["lifted"]
    what = "kept must be false where outcome is not success"
    yield what, t["kept"] & ~success, t["kept"]
    what = "tested must be false where outcome is not that of a lift"
    yield what, t["tested"] & ~np.isin(outcome, TRIED), t["tested"]

    with reopened(task.path, task.stamp, "a file of a dataset") as file:
        objects = file["scenes/object"][:]
    place = np.minimum(t["object"], objects.shape[1] - 1)
    there = (place == t["object"]) & (objects[t["scene"], place] != NO_OBJECT)
    yield "object must be that of an object in its scene", ~there, t["object"]

    # Only among others.
    if t.has("free", "hit", "clean"):
        what = f"free must be true exactly where hit is {HITS_NOTHING}"
        yield what, t["free"] != (t["hit"] == HITS_NOTHING), t["free"]
        yield "clean must be false where the grasp is not kept", t["clean"] & ~t["kept"], t["clean"]


# What an arm can do about grasps


def _as_reached(t: Table, task: _Rows) -> Iterator[Finding]:
    """A grasp is reachable with this outcome, and only then there are joint positions."""
    bad = t["reachable"] != (t["reach_outcome"] == 0)
    yield "reachable must be true exactly where reach_outcome is 0", bad, t["reachable"]
    for name in ("q_approach", "q_grasp", "q_lift", "clearance"):
        values = t[name].reshape(t.count, -1)
        bad = (np.isfinite(values) != t["reachable"][:, None]).any(axis=1)
        yield f"{name} must be finite where the grasp is reachable, and NaN elsewhere", bad, values


def _of_grasp(t: Table, task: _Rows) -> Iterator[Finding]:
    """Rows are of the grasps of their trials."""
    own = Trials(task.path.parent.parent)[t["trial_id"]]
    for name, of in (("object", "object_name"), *((n, n) for n in ("candidate", "standoff_index"))):
        yield f"{name} must be that of the trial", t[name] != own[of], t[name]


# What samples are


def _pose(t: Table, name: str) -> Array:
    """Return the poses (n, 4, 4) in a field of `object_props`."""
    return unpack_pose(t[f"object_props/{name}"].astype(float))


def _X_CW(t: Table, task: _Rows) -> Array:
    """Return the poses (n, 4, 4) of the world in the frame of the file's camera."""
    return _pose(t, f"frame_cam2work_{task.attributes['camera']}") @ invert_pose(X_WT)


def _contacts(t: Table) -> tuple[Array, Array]:
    """Return p_CQ [m] and nhat_Q_C, (n, k, 3) each, of the closed hands."""
    vectors = t["grasps"].astype(float).reshape(t.count, 2, -1, 3)
    return vectors[:, 0], vectors[:, 1]


def _chain(t: Table, task: _Rows) -> Iterator[Finding]:
    """The frames of a sample agree: the table, and both cameras with their inverses."""
    what = f"frame_world2work must be the identity at {X_WT[:3, 3].tolist()} m"
    apart = {what: _pose(t, "frame_world2work") - X_WT}
    for camera in CAMERAS:
        names = f"frame_work2cam_{camera}", f"frame_cam2work_{camera}"
        X_TC, X_CT = (_pose(t, name) for name in names)
        apart[f"{names[0]} times {names[1]} must be the identity"] = X_TC @ X_CT - np.eye(4)
    oto, otm = (_pose(t, f"frame_work2cam_{camera}")[:, :3, 2:] for camera in CAMERAS)
    apart["both cameras must have the same place and view"] = oto - otm
    for what, difference in apart.items():
        off = np.abs(difference).max(axis=(1, 2))
        yield what, off > POSITION_TOLERANCE, off


def _as_in_trials(t: Table, task: _Rows) -> Iterator[Finding]:
    """A sample repeats the numbers of its trial, and its poses follow from those of the trial."""
    copied = {f.name: f.of for f in _read_fields(t, task) if f.of}
    trials = Trials(task.path.parent)[t["trial_id"]]
    own = Table(trials.columns([*copied.values(), "X_TO", "X_OG"]))
    for name, of in copied.items():
        yield f"{name} must follow from its trial", _differs(t[name], own[of]), t[name]

    X_WO = multiply(X_WT, unpack_pose(own["X_TO"]))
    X_CG = _X_CW(t, task) @ X_WO @ unpack_pose(own["X_OG"])
    poses = {"object_props/frame_world2obj": X_WO, "grasp_props/X_CG": X_CG}
    for name, due in poses.items():
        bad = _differs(t[name], pack_pose(due), POSITION_TOLERANCE)
        yield f"{name} must follow from its trial", bad, t[name]


def _in_mask(t: Table, task: _Rows) -> Iterator[Finding]:
    """Contacts are before the camera, and project onto the object in the image."""
    (p_CQ, _), K = _contacts(t), task.attributes["K"]
    off = np.zeros(p_CQ.shape[:2])
    for i, mask in enumerate(t["masks"]):
        used, seen = np.isfinite(p_CQ[i]).all(axis=1), np.argwhere(mask)[:, ::-1]
        apart = np.linalg.norm(project(K, p_CQ[i, used])[:, None] - seen, axis=2)
        off[i, used] = apart.min(axis=1, initial=np.inf)
    off[p_CQ[..., 2] <= 0.0] = np.inf
    what = f"contacts must project within {MASK_TOLERANCE:g} px of the mask"
    yield what, np.any(off > MASK_TOLERANCE, axis=1), off


def _on_mesh(t: Table, task: _Rows) -> Iterator[Finding]:
    """Contacts are on the object's mesh, and their normals point out of it.

    A normal counts as outward if it agrees with either of the faces of `ContactFit.normal_angle`.
    """
    assert task.max_distance is not None
    X_OC = invert_pose(_X_CW(t, task) @ _pose(t, "frame_world2obj"))
    p_CQ, nhat_Q_C = _contacts(t)
    off, angle = np.zeros((2, *p_CQ.shape[:2]))

    # Object by object.
    names = t["object_props/object_name"]
    for name in np.unique(names.astype(str)).tolist():
        try:
            model = load_object(model_path(task.path.parent, name))
        except (DataError, MeshError):
            continue  # a violation of the object's files
        for i in np.flatnonzero(names == name).tolist():
            p_OQ = transform_points(X_OC[i], p_CQ[i])
            fit = fit_contacts(model, p_OQ, rotate_vectors(X_OC[i], nhat_Q_C[i]))
            off[i], angle[i] = fit.distance, np.degrees(fit.normal_angle)

    beyond = off > task.max_distance + POSITION_TOLERANCE
    what = f"contacts must be on the object's mesh within {task.max_distance:g} m"
    yield what, beyond.any(axis=1), off
    what = "normals must point out of the object, within 90 deg of its face's"
    yield what, ((angle > 90.0) & ~beyond).any(axis=1), angle
