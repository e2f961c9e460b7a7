"""`drakegrasp check`: every rule on every row of a dataset, or of one of its files.

In: a dataset's directory, or grasping_oto.hdf5, grasping_otm.hdf5 or trials.hdf5 alone. Out:
a list of violations, empty for a sound dataset. Rows are read in batches, so memory is
bounded whatever the size of the dataset. Here is only which rule sees which rows, and in
which order: a row that breaks a rule is not shown to the rules that build on it, so what is
reported is the cause, not all that follows from it. Needs no Drake.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

import h5py
import numpy as np

from drakegrasp.dataset.checks import consistency as dataset_rules
from drakegrasp.dataset.checks import images as image_rules
from drakegrasp.dataset.checks import samples as sample_rules
from drakegrasp.dataset.checks import trials as trial_rules
from drakegrasp.dataset.checks.findings import Batch, Findings, Violation, of_file
from drakegrasp.dataset.checks.images import Lens
from drakegrasp.dataset.checks.open_file import OpenFile, Rule, first_line, open_file
from drakegrasp.dataset.manifest import Manifest, read_manifest
from drakegrasp.dataset.paths import (
    DATA_FILES,
    FILE_NAME,
    TRIALS_FILE,
    model_path,
    refuse_changed_object,
)
from drakegrasp.dataset.schema import CAMERAS, DATA_FIELDS, SPLITS
from drakegrasp.dataset.shards import read_shard
from drakegrasp.errors import DataError, MeshError
from drakegrasp.objects.model import ObjectModel, load_object
from drakegrasp.outcomes import Outcome
from drakegrasp.runtime.progress import Report, silent

__all__ = ["Violation", "check_dataset"]

#: Rows that are looked at together: some 20 MB of images, some 10 MB of trials.
SAMPLE_ROWS = 64
TRIAL_ROWS = 8192
#: Objects whose meshes, with their search trees, are kept; samples are ordered by object.
KEPT_OBJECTS = 4
#: The fields of a trial that a sample is compared with.
COMPARED = ("object", "outcome", "X_TO", "X_OG", "closed_p_OQ", "closed_nhat_Q_O")


@dataclass(frozen=True, kw_only=True, eq=False)
class _Dataset:
    """What a check of a whole directory knows besides the file that it looks at."""

    out: Path
    manifest: Manifest
    trials: OpenFile | None
    model: Callable[[str], ObjectModel | None]

    @property
    def names(self) -> list[str]:
        """Names of the objects."""
        return [entry.name for entry in self.manifest.objects]


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
            f"got one that cannot be read ({first_line(error)})"
        ) from None
    camera = str(file.attrs.get("camera", ""))
    if camera in CAMERAS:
        opened = open_file(path.name, file, camera, findings)
        _check_data(opened, camera, None, findings, _Steps(report, _rows(opened)))
    elif "trials" in file:
        opened = open_file(path.name, file, "", findings)
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
            got = first_line(error) if (out / name).exists() else "none; `drakegrasp assemble`"
            findings.add([of_file(name, "the file must be there and readable", got)])
            continue
        files[camera] = open_file(name, file, camera, findings)
    steps = _Steps(report, sum(map(_rows, files.values())) + manifest.units)
    findings.add(dataset_rules.same_configuration(files.values(), manifest))
    trials = files.pop("", None)
    models = lru_cache(KEPT_OBJECTS)(partial(_load_model, out, manifest, findings))
    dataset = _Dataset(out=out, manifest=manifest, trials=trials, model=models)
    _check_objects(dataset, findings)
    _check_shards(dataset, findings, steps)
    if trials is not None:
        _check_trials(trials, dataset, findings, steps)
    for camera, data in files.items():
        _check_data(data, camera, dataset, findings, steps)
        if trials is not None:
            _add(findings, data, dataset_rules.kept_are_samples(data, trials))
    if len(files) == len(CAMERAS) and all(data.config for data in files.values()):
        _check_pair(files[CAMERAS[0]], files[CAMERAS[1]], findings)


# Data files


def _check_data(
    data: OpenFile, camera: str, dataset: _Dataset | None, findings: Findings, steps: _Steps
) -> None:
    if data.config is None:
        return  # already found; without a lens no image can be judged
    lens = Lens.of(camera, data.config.camera)
    _add(findings, data, dataset_rules.splits(data))
    for split in data.groups:
        for whole in data.batches(split, SAMPLE_ROWS, findings):
            batch = data.judge(whole, findings, sample_rules.finite)
            batch = data.judge(
                batch,
                findings,
                sample_rules.normals,
                partial(image_rules.image_values, lens=lens),
                image_rules.mask_values,
                sample_rules.frames,
                sample_rules.work_frame,
                sample_rules.mass_properties,
            )
            batch = data.judge(batch, findings, sample_rules.inverse_frames)
            batch = data.judge(
                batch,
                findings,
                sample_rules.camera_pair,
                partial(image_rules.image_frames, lens=lens),
            )
            if dataset is not None:
                batch = _judge_by_trial(data, batch, camera, dataset, findings)
            batch = data.judge(
                batch,
                findings,
                partial(image_rules.contacts_in_image, lens=lens),
                partial(image_rules.table_pixels, lens=lens),
            )
            if dataset is not None:
                _judge_by_mesh(data, batch, lens, dataset, findings)
            steps.add(len(whole))


def _judge_by_trial(
    data: OpenFile, batch: Batch, camera: str, dataset: _Dataset, findings: Findings
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
        sample_rules.same_as_trial,
        trials={name: values[still] for name, values in rows.items()},
        camera=camera,
        config=data.config.camera,
    )
    like = data.judge(like, findings, compare)
    return batch.without(set(fit.rows.tolist()) - set(like.rows.tolist()))


def _judge_by_mesh(
    data: OpenFile, batch: Batch, lens: Lens, dataset: _Dataset, findings: Findings
) -> None:
    """Compare samples with the meshes of their objects."""
    assert data.config is not None
    camera, limit = lens.camera, data.config.filters.max_surface_distance
    names = batch["object_props/object_name"]
    for name in dict.fromkeys(names.tolist()):
        model = dataset.model(name)
        if model is not None:
            data.judge(
                batch.without(set(batch.rows[names != name].tolist())),
                findings,
                partial(sample_rules.object_values, model=model),
                partial(image_rules.object_pixels, lens=lens, model=model),
                partial(
                    sample_rules.contacts_on_mesh, camera=camera, model=model, max_distance=limit
                ),
            )


def _load_model(out: Path, manifest: Manifest, findings: Findings, name: str) -> ObjectModel | None:
    path = model_path(out, name)
    file = str(path.relative_to(out))
    try:
        model = load_object(path)
    except MeshError as error:
        findings.add([of_file(file, "the object must be readable", str(error))])
        return None
    hashes = {entry.name: entry.mesh_sha256 for entry in manifest.objects}
    if hashes.get(name) != model.mesh_sha256:
        what = f"mesh_sha256 must be that of {FILE_NAME}"
        findings.add([of_file(file, what, model.mesh_sha256)])
    return model


def _check_pair(oto: OpenFile, otm: OpenFile, findings: Findings) -> None:
    """The two data files hold the same samples; what is wrong in one is found already."""
    names = [f.name for f in DATA_FIELDS if not f.sample]
    for split in [s for s in SPLITS if s in oto.groups and s in otm.groups]:
        count = oto.count(split)
        if otm.count(split) != count:
            what = f"number of rows must be that of {oto.name}, {count}"
            findings.add([of_file(otm.name, what, str(otm.count(split)), f"/{split}")])
            continue
        good = np.setdiff1d(np.arange(count), oto.bad(split) + otm.bad(split))
        for start in range(0, len(good), TRIAL_ROWS):
            rows = good[start : start + TRIAL_ROWS]
            one, other = (file.read(split, rows, names) for file in (oto, otm))
            findings.add(sample_rules.same_properties(one, other))


# Trials


def _check_trials(
    trials: OpenFile, dataset: _Dataset | None, findings: Findings, steps: _Steps
) -> None:
    if dataset is not None:
        _add(findings, trials, dataset_rules.same_objects(trials, dataset.manifest))
    if not {"objects", "trials"} <= set(trials.groups):
        return  # found as a broken layout; trials mean nothing without their objects
    candidates = [entry.candidates for entry in dataset.manifest.objects] if dataset else None
    standoffs = len(trials.config.candidates.standoffs) if trials.config else None
    successes = []
    for whole in trials.batches("trials", TRIAL_ROWS, findings):
        successes.append(whole["trial_id"][whole["outcome"] == Outcome.SUCCESS])
        numbers = partial(
            trial_rules.numbers,
            objects=trials.count("objects"),
            candidates=candidates,
            standoffs=standoffs,
        )
        batch = trials.judge(whole, findings, numbers)
        batch = trials.judge(batch, findings, trial_rules.stages)
        checks: list[Rule] = [trial_rules.verdicts, trial_rules.contacts, trial_rules.poses]
        if dataset is not None and trials.count("objects") == len(dataset.manifest.objects):
            poses = [entry.X_TO for entry in dataset.manifest.objects]
            checks.append(partial(trial_rules.resting_poses, X_TO=poses))
        trials.judge(batch, findings, *checks)
        steps.add(len(whole))
    if "successes" in trials.groups:
        expected = np.concatenate([np.zeros(0, dtype=np.int64), *successes])
        _add(findings, trials, dataset_rules.successes(trials, expected))


# The directory


def _check_objects(dataset: _Dataset, findings: Findings) -> None:
    """Every object's files are as they were written: the plan is sealed and vouches for both."""
    for name in dataset.names:
        try:
            refuse_changed_object(dataset.out, name)
        except DataError as error:
            path, _, got = str(error).partition(": ")
            where = str(Path(path).relative_to(dataset.out))
            findings.add([of_file(where, "an object's file must be as it was written", got)])


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
            got = str(error).rpartition(", got ")[2] if path.exists() else "none"
            findings.add([of_file(str(path.relative_to(dataset.out)), what, got)])
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


def _rows(opened: OpenFile) -> int:
    return sum(opened.count(g) for g in opened.groups if g not in ("objects", "successes"))


def _add(findings: Findings, file: OpenFile, violations: Iterator[Violation]) -> None:
    """Take violations of a file as a whole, whose columns may turn out to be unreadable."""
    try:
        findings.add(violations)
    except (OSError, UnicodeDecodeError) as error:
        findings.add([of_file(file.name, "all columns must be readable", first_line(error))])
