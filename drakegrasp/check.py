"""`drakegrasp check`: every invariant of a dataset, or of one of its files.

In: a dataset's directory, or grasping_oto.hdf5, grasping_otm.hdf5 or trials.hdf5 alone. Out:
a list of violations, empty for a sound dataset. Rows are read in batches, so memory is
bounded whatever the size of the dataset. A row that breaks an invariant is not shown to
the invariants that build on it: what is reported is the cause, not all that follows from
it. Needs no Drake.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from drakegrasp import invariants
from drakegrasp.assemble import DATA_FILES, TRIALS_FILE
from drakegrasp.config import Config
from drakegrasp.errors import DataError, MeshError
from drakegrasp.filters import Removal
from drakegrasp.invariants import AnyArray, Batch, Findings, Lens, Violation
from drakegrasp.manifest import FILE_NAME, Manifest, model_path, read_manifest
from drakegrasp.meshes import ObjectModel, load_object
from drakegrasp.outcomes import Outcome
from drakegrasp.progress import Report, silent
from drakegrasp.schema import (
    CAMERAS,
    DATA_FIELDS,
    OBJECT_FIELDS,
    SPLITS,
    SUCCESS_FIELDS,
    TRIAL_FIELDS,
    Field,
)
from drakegrasp.shards import read_shard

__all__ = ["Violation", "check_dataset"]

#: Rows that are looked at together: some 20 MB of images, some 10 MB of trials.
SAMPLE_ROWS = 64
TRIAL_ROWS = 8192
#: Objects whose meshes, with their search trees, are kept; samples are ordered by object.
KEPT_OBJECTS = 4
#: The fields of a trial that a sample is compared with.
COMPARED = ("object", "outcome", "X_TO", "X_OG", "closed_p_OQ", "closed_nhat_Q_O")

Invariant = Callable[[Batch], Iterator[Violation]]


@dataclass(eq=False)
class _File:
    """An open file: its groups by name, none of those whose structure is broken."""

    name: str
    file: h5py.File
    config: Config | None
    fields: Mapping[str, tuple[Field, ...]]
    groups: dict[str, h5py.Group] = field(default_factory=dict)
    bad_rows: dict[str, set[int]] = field(default_factory=dict)

    def count(self, group: str) -> int:
        """Return the number of rows of a group."""
        return len(self.groups[group][self.fields[group][0].name]) if group in self.groups else 0

    def bad(self, group: str) -> list[int]:
        """Return the rows of a group that broke an invariant or cannot be read."""
        return sorted(self.bad_rows.get(group, ()))

    def read(self, group: str, rows: AnyArray, names: Sequence[str] | None = None) -> Batch:
        """Return some rows, in rising order, of a group; of all fields unless some are named."""
        fields = [f for f in self.fields[group] if names is None or f.name in names]
        # A slice is read far faster than the same rows as a list.
        dense = len(rows) > 0 and rows[-1] - rows[0] + 1 == len(rows)
        choice = slice(int(rows[0]), int(rows[-1]) + 1) if dense else rows
        columns = {f.name: _decoded(self.groups[group][f.name], f)[choice] for f in fields}
        return Batch(file=self.name, group=f"/{group}", rows=rows, columns=columns)

    def batches(
        self, group: str, size: int, findings: Findings, names: Sequence[str] | None = None
    ) -> Iterator[Batch]:
        """Yield all rows of a group; rows that cannot be read are a finding."""
        for start in range(0, self.count(group), size):
            rows = np.arange(start, min(start + size, self.count(group)))
            try:
                yield self.read(group, rows, names)
            except (OSError, UnicodeDecodeError) as error:
                what = f"rows {start} to {rows[-1]} must be readable"
                findings.add([_whole(self.name, what, _first_line(error), f"/{group}")])
                self.bad_rows.setdefault(group, set()).update(rows.tolist())

    def judge(self, batch: Batch, findings: Findings, *tests: Invariant) -> Batch:
        """Apply invariants that do not build on each other; return the rows that hold."""
        if not len(batch):
            return batch
        rows: set[int] = set()
        for test in tests:
            rows |= findings.add(test(batch))
        self.bad_rows.setdefault(batch.group[1:], set()).update(rows)
        return batch.without(rows)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Dataset:
    """What a check of a whole directory knows besides the file that it looks at."""

    out: Path
    manifest: Manifest
    trials: _File | None
    model: Callable[[str], ObjectModel | None]

    @property
    def names(self) -> list[str]:
        """Names of the objects."""
        return [entry["name"] for entry in self.manifest.objects]


def check_dataset(path: str | Path, *, progress: Report | None = None) -> list[Violation]:
    """Return every broken invariant of a dataset or of one of its files.

    Args:
        path: Directory of a dataset, or one of its three HDF5 files; a file alone is checked
            for all that needs no other file.
        progress: Called with the number of rows and shards that are done and to do.

    Raises:
        DataError: If the path is neither, or the file cannot be read. In a directory a file
            that cannot be read is a violation, and the others are still checked.
    """
    path, findings, report = Path(path), Findings(), progress or silent
    with ExitStack() as stack:
        if path.is_dir():
            _check_directory(path, stack, findings, report)
        else:
            _check_file(path, stack, findings, report)
    return findings.violations()


def _check_file(path: Path, stack: ExitStack, findings: Findings, report: Report) -> None:
    try:
        file = stack.enter_context(h5py.File(path, "r"))
    except OSError as error:
        raise DataError(
            f"{path}: must be the directory of a dataset or one of its HDF5 files, "
            f"got one that cannot be read ({_first_line(error)})"
        ) from None
    camera = str(file.attrs.get("camera", ""))
    if camera in CAMERAS:
        opened = _open(path.name, file, camera, findings)
        _check_data(opened, camera, None, findings, _Steps(report, _rows(opened)))
    elif "trials" in file:
        opened = _open(path.name, file, "", findings)
        _check_trials(opened, None, findings, _Steps(report, _rows(opened)))
    else:
        raise DataError(
            f"{path}: must be a data file or the trials of a dataset, got another HDF5 file"
        )


def _check_directory(out: Path, stack: ExitStack, findings: Findings, report: Report) -> None:
    manifest = read_manifest(out)
    files = {}
    for camera, name in (*DATA_FILES.items(), ("", TRIALS_FILE)):
        try:
            file = stack.enter_context(h5py.File(out / name, "r"))
        except OSError as error:
            got = _first_line(error) if (out / name).exists() else "none; `drakegrasp assemble`"
            findings.add([_whole(name, "the file must be there and readable", got)])
            continue
        files[camera] = _open(name, file, camera, findings)
    headers = manifest.headers()
    steps = _Steps(report, sum(map(_rows, files.values())) + len(headers))
    trials = files.pop("", None)
    models = lru_cache(KEPT_OBJECTS)(partial(_load_model, out, manifest, findings))
    dataset = _Dataset(out=out, manifest=manifest, trials=trials, model=models)
    findings.add(_same_configuration([*files.values(), *([trials] if trials else [])], manifest))
    _check_shards(dataset, findings, steps)
    if trials is not None:
        _check_trials(trials, dataset, findings, steps)
    for camera, data in files.items():
        _check_data(data, camera, dataset, findings, steps)
        if trials is not None:
            _add(findings, data, _kept_are_samples(data, trials))
    if len(files) == len(CAMERAS):
        _check_pair(files[CAMERAS[0]], files[CAMERAS[1]], findings)


def _open(name: str, file: h5py.File, camera: str, findings: Findings) -> _File:
    """Check what a file says of itself and how it is laid out."""
    config, broken = invariants.read_config(name, file)
    findings.add([*broken, *invariants.attributes(name, file, config, camera)])
    fields = (
        {split: DATA_FIELDS for split in SPLITS}
        if camera
        else {"objects": OBJECT_FIELDS, "trials": TRIAL_FIELDS, "successes": SUCCESS_FIELDS}
    )
    opened = _File(name, file, config, fields)
    broken_groups = set()
    for violation in invariants.structure(name, file, fields, config):
        findings.add([violation])
        if not violation.what.startswith("attribute"):
            broken_groups.add(violation.group[1:].split("/")[0])
    opened.groups = {g: file[g] for g in fields if g in file and g not in broken_groups}
    return opened


# Data files


def _check_data(
    data: _File, camera: str, dataset: _Dataset | None, findings: Findings, steps: _Steps
) -> None:
    if data.config is None:
        return  # already found; without a lens no image can be judged
    lens = Lens.of(camera, data.config.camera)
    _add(findings, data, _splits(data))
    for split in data.groups:
        for whole in data.batches(split, SAMPLE_ROWS, findings):
            batch = data.judge(whole, findings, invariants.finite)
            batch = data.judge(
                batch,
                findings,
                invariants.normals,
                partial(invariants.image_values, lens=lens),
                invariants.mask_values,
                invariants.frames,
                invariants.work_frame,
                invariants.mass_properties,
            )
            batch = data.judge(batch, findings, invariants.inverse_frames)
            batch = data.judge(
                batch,
                findings,
                invariants.camera_pair,
                partial(invariants.image_frames, lens=lens),
            )
            if dataset is not None:
                batch = _judge_by_trial(data, batch, lens, dataset, findings)
            batch = data.judge(
                batch,
                findings,
                partial(invariants.contacts_in_image, lens=lens),
                partial(invariants.table_pixels, lens=lens),
            )
            if dataset is not None:
                _judge_by_mesh(data, batch, lens, dataset, findings)
            steps.add(len(whole))


def _judge_by_trial(
    data: _File, batch: Batch, lens: Lens, dataset: _Dataset, findings: Findings
) -> Batch:
    """Compare samples with their trials; return those that have one and are like it."""
    trials = dataset.trials
    if trials is None or "trials" not in trials.groups or data.config is None:
        return batch
    count = trials.count("trials")
    batch = data.judge(
        batch,
        findings,
        lambda b: b.broken(
            f"trial_id must be a row of {TRIALS_FILE}",
            (b["trial_id"] < 0) | (b["trial_id"] >= count),
            b["trial_id"],
        ),
    )
    if not len(batch):
        return batch
    # A trial that is wrong in itself is found already and says nothing about its sample.
    fit = batch.without(set(batch.rows[np.isin(batch["trial_id"], trials.bad("trials"))].tolist()))
    if not len(fit):
        return batch
    ids, place = np.unique(fit["trial_id"], return_inverse=True)
    found = trials.read("trials", ids, COMPARED).columns
    rows = {name: values[place] for name, values in found.items()}
    names = np.array(dataset.names, dtype=object)[rows["object"]]

    def of_trial(b: Batch) -> Iterator[Violation]:
        wrong = rows["outcome"] != Outcome.SUCCESS
        yield from b.broken("a sample's trial must be a success (0)", wrong, rows["outcome"])
        held = b["object_props/object_name"]
        yield from b.broken(
            "object_name must be that of its trial",
            names != held,
            lambda i: f"{held[i]!r}, not {names[i]!r}",
        )

    like = data.judge(fit, findings, of_trial)
    still = np.isin(fit.rows, like.rows)
    compare = partial(
        invariants.same_as_trial,
        trials={name: values[still] for name, values in rows.items()},
        lens=lens,
        config=data.config.camera,
    )
    like = data.judge(like, findings, compare)
    return batch.without(set(fit.rows.tolist()) - set(like.rows.tolist()))


def _judge_by_mesh(
    data: _File, batch: Batch, lens: Lens, dataset: _Dataset, findings: Findings
) -> None:
    """Compare samples with the meshes of their objects."""
    assert data.config is not None
    limit = data.config.filters.max_surface_distance
    names = batch["object_props/object_name"]
    for name in dict.fromkeys(names.tolist()):
        model = dataset.model(name)
        if model is not None:
            data.judge(
                batch.without(set(batch.rows[names != name].tolist())),
                findings,
                partial(invariants.object_values, model=model),
                partial(invariants.object_pixels, lens=lens, model=model),
                partial(invariants.contacts_on_mesh, lens=lens, model=model, max_distance=limit),
            )


def _load_model(out: Path, manifest: Manifest, findings: Findings, name: str) -> ObjectModel | None:
    path = model_path(out, name)
    file = str(path.relative_to(out))
    try:
        model = load_object(path)
    except MeshError as error:
        findings.add([_whole(file, "the object must be readable", str(error))])
        return None
    hashes = {entry["name"]: entry["mesh_sha256"] for entry in manifest.objects}
    if hashes.get(name) != model.mesh_sha256:
        what = f"mesh_sha256 must be that of {FILE_NAME}"
        findings.add([_whole(file, what, model.mesh_sha256)])
    return model


def _splits(data: _File) -> Iterator[Violation]:
    """A trial is one sample, and a tested object or a class left out is nowhere else."""
    seen: dict[int, str] = {}
    objects: dict[str, dict[str, str]] = {}
    for split, group in data.groups.items():
        for row, number in enumerate(group["trial_id"][:].tolist()):
            if number in seen:
                what = "trial_id must be unique in all splits"
                got = f"{number}, which is in /{seen[number]} too"
                yield Violation(file=data.name, group=f"/{split}", row=row, what=what, got=got)
            seen.setdefault(number, split)
        names, classes = (
            _decoded(group[f"object_props/{key}"], _STR)[:] for key in ("object_name", "class_name")
        )
        objects[split] = dict(zip(names.tolist(), classes.tolist(), strict=True))
    tested = objects.pop("test", {})
    allowed = data.config.split.train_classes if data.config else None
    for split, members in objects.items():
        for name, class_name in sorted(members.items()):
            if name in tested:
                what = "an object of /test must be in no other split"
                yield _whole(data.name, what, f"{name} in both", f"/{split}")
            if allowed is not None and class_name not in allowed:
                what = "a class must be one of split.train_classes"
                yield _whole(data.name, what, class_name, f"/{split}")
    trained = {c for members in objects.values() for c in members.values()}
    if len(data.groups) == len(SPLITS):
        for class_name in sorted(trained):
            count = sum(c == class_name for c in tested.values())
            if count != 1:
                what = f"class {class_name} must have one object in /test, as it has others outside"
                yield _whole(data.name, what, str(count))


def _check_pair(oto: _File, otm: _File, findings: Findings) -> None:
    """The two data files hold the same samples."""
    names = [f.name for f in DATA_FIELDS if not f.sample]
    for split in [s for s in SPLITS if s in oto.groups and s in otm.groups]:
        if oto.count(split) != otm.count(split):
            what = f"number of rows must be that of {oto.name}, {oto.count(split)}"
            findings.add([_whole(otm.name, what, str(otm.count(split)), f"/{split}")])
            continue
        bad = oto.bad_rows.get(split, set()) | otm.bad_rows.get(split, set())
        pairs = (f.batches(split, TRIAL_ROWS, findings, names) for f in (oto, otm))
        for one, other in zip(*pairs, strict=False):
            one, other = one.without(bad), other.without(bad)
            if not len(one):
                continue
            ids = other["trial_id"]
            differs = one["trial_id"] != ids if len(one) == len(other) else np.zeros(0, dtype=bool)
            what = f"trial_id must be that of {oto.name}"
            rows = findings.add(other.broken(what, differs, ids))
            findings.add(invariants.same_grasp(one.without(rows), other.without(rows)))


# Trials


def _check_trials(
    trials: _File, dataset: _Dataset | None, findings: Findings, steps: _Steps
) -> None:
    if dataset is not None:
        _add(findings, trials, _same_objects(trials, dataset.manifest))
    if not {"objects", "trials"} <= set(trials.groups):
        return  # found as a broken layout; trials mean nothing without their objects
    candidates = [entry["candidates"] for entry in dataset.manifest.objects] if dataset else None
    standoffs = len(trials.config.candidates.standoffs) if trials.config else None
    successes = []
    for whole in trials.batches("trials", TRIAL_ROWS, findings):
        successes.append(whole["trial_id"][whole["outcome"] == Outcome.SUCCESS])
        numbers = partial(
            invariants.trial_numbers,
            objects=trials.count("objects"),
            candidates=candidates,
            standoffs=standoffs,
        )
        batch = trials.judge(whole, findings, numbers)
        batch = trials.judge(batch, findings, invariants.trial_stages)
        checks: list[Invariant] = [
            invariants.trial_verdicts,
            invariants.trial_contacts,
            invariants.trial_poses,
        ]
        if dataset is not None and trials.count("objects") == len(dataset.manifest.objects):
            poses = [entry["X_TO"] for entry in dataset.manifest.objects]
            checks.append(partial(invariants.resting_poses, X_TO=poses))
        trials.judge(batch, findings, *checks)
        steps.add(len(whole))
    if "successes" in trials.groups:
        expected = np.concatenate([np.zeros(0, dtype=np.int64), *successes])
        _add(findings, trials, _successes(trials, expected))


def _successes(trials: _File, expected: AnyArray) -> Iterator[Violation]:
    """Every success is in /successes, in order, with a legal reason of removal."""
    group = trials.groups["successes"]
    ids, removal = group["trial_id"][:], group["removal"][:]
    if not np.array_equal(ids, expected):
        odd = sorted(set(ids.tolist()) ^ set(expected.tolist()))
        got = f"differences at trials {odd[:5]}" if odd else "another order"
        yield _whole(trials.name, "trial_id must list the successes of /trials", got, "/successes")
    for row in np.flatnonzero(~np.isin(removal, [r.value for r in Removal])).tolist():
        yield Violation(
            file=trials.name,
            group="/successes",
            row=row,
            what=f"removal must be 0..{max(Removal)}",
            got=str(removal[row]),
        )


def _kept_are_samples(data: _File, trials: _File) -> Iterator[Violation]:
    """The samples are exactly the successes that no filter removed."""
    if len(data.groups) < len(SPLITS) or "successes" not in trials.groups:
        return
    group = trials.groups["successes"]
    kept = set(group["trial_id"][:][group["removal"][:] == Removal.KEPT].tolist())
    ids = {i for split in data.groups.values() for i in split["trial_id"][:].tolist()}
    for what, odd in (
        (f"every success that /successes of {trials.name} keeps must be a sample", kept - ids),
        (f"every sample must be a success that /successes of {trials.name} keeps", ids - kept),
    ):
        if odd:
            yield _whole(data.name, what, f"{len(odd)} otherwise: trials {sorted(odd)[:5]}")


def _same_objects(trials: _File, manifest: Manifest) -> Iterator[Violation]:
    """/objects says the same as the manifest."""
    if "objects" not in trials.groups:
        return
    if trials.count("objects") != len(manifest.objects):
        what = f"number of objects must be that of {FILE_NAME}, {len(manifest.objects)}"
        yield _whole(trials.name, what, str(trials.count("objects")), "/objects")
        return
    for f in OBJECT_FIELDS:
        values = _decoded(trials.groups["objects"][f.name], f)[:].tolist()
        key = {"class_name": "class"}.get(f.name, f.name)
        for row, (value, entry) in enumerate(zip(values, manifest.objects, strict=True)):
            if value != entry[key]:
                what = f"{f.name} must be that of {FILE_NAME}, {entry[key]!r}"
                yield Violation(
                    file=trials.name, group="/objects", row=row, what=what, got=repr(value)
                )


# The directory


def _same_configuration(files: Sequence[_File], manifest: Manifest) -> Iterator[Violation]:
    """All files are of the manifest's configuration."""
    expected = manifest.config.simulation_hash()
    for file in files:
        if file.config is None:
            continue
        found = file.config.simulation_hash()
        if found != expected:
            what = f"configuration must be that of {FILE_NAME}, {expected}"
            yield _whole(file.name, what, found)
        elif file.config != manifest.config:
            what = f"filters, split and limits must be those of {FILE_NAME}"
            yield _whole(file.name, what, "others; run `drakegrasp assemble` again")


def _check_shards(dataset: _Dataset, findings: Findings, steps: _Steps) -> None:
    """The shards of the manifest are there and whole, each object's up to its last grasp."""
    limit = dataset.manifest.config.max_grasps
    wanted = {name: limit for name in dataset.names}
    for header in dataset.manifest.headers():
        steps.add(1)
        left, path = wanted[header.object_name], header.path(dataset.out)
        if left is not None and left <= 0:
            continue
        try:
            outcome = read_shard(path, header).trials["outcome"]
        except DataError as error:
            what = "the shard must be there, whole and of its work unit"
            got = str(error).removeprefix(f"{path}: ") if path.exists() else "none"
            findings.add([_whole(str(path.relative_to(dataset.out)), what, got)])
            continue
        if left is not None:
            wanted[header.object_name] = left - int((outcome == Outcome.SUCCESS).sum())


# Helpers


@dataclass
class _Steps:
    report: Report
    total: int
    done: int = 0

    def add(self, count: int) -> None:
        self.done += count
        self.report(self.done, self.total)


_STR = next(f for f in DATA_FIELDS if f.dtype == "str")


def _rows(opened: _File) -> int:
    return sum(opened.count(g) for g in opened.groups if g not in ("objects", "successes"))


def _decoded(dataset: h5py.Dataset, field: Field) -> Any:
    return dataset.asstr() if field.dtype == "str" else dataset


def _add(findings: Findings, file: _File, violations: Iterator[Violation]) -> None:
    """Take violations of a file as a whole, whose columns may turn out to be unreadable."""
    try:
        findings.add(violations)
    except (OSError, UnicodeDecodeError) as error:
        findings.add([_whole(file.name, "all columns must be readable", _first_line(error))])


def _whole(file: str, what: str, got: str, group: str = "") -> Violation:
    return Violation(file=file, group=group, what=what, got=got)


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
