"""The order of the rules for grasping_oto.hdf5 and grasping_otm.hdf5.

In: an open data file and, if there is one, the dataset around it. Out: its violations, in the
findings of the context.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial

import numpy as np

from drakegrasp.dataset.checks import consistency
from drakegrasp.dataset.checks import hold as hold_rules
from drakegrasp.dataset.checks import images as image_rules
from drakegrasp.dataset.checks import samples as sample_rules
from drakegrasp.dataset.checks.context import (
    Context,
    Dataset,
    LoadModel,
    Rows,
    RowsTask,
    judge_rows,
)
from drakegrasp.dataset.checks.findings import AnyArray, Batch, Findings, Violation, of_file
from drakegrasp.dataset.checks.images import Lens
from drakegrasp.dataset.checks.open_file import FilePlace, OpenFile
from drakegrasp.dataset.paths import TRIALS_FILE
from drakegrasp.dataset.schema import DATA_FIELDS, SHARED_FIELDS, SPLITS
from drakegrasp.outcomes import Outcome

#: Samples in a batch: some 20 MB of images.
SAMPLE_ROWS = 64
#: Samples in a task.
TASK_ROWS = 4 * SAMPLE_ROWS
#: Samples in a batch without images.
PAIR_ROWS = 8192
_CONTACTS = ("p_OQ", "nhat_Q_O", "f_Q_O")
#: Fields of a trial from which a sample follows, or that say whether it may be one.
COMPARED = (
    *("object", "outcome", "X_TO", "X_OG", "X_OG_lifted", "surface_distance", "normal_angle"),
    *(f"{when}_{name}" for when in ("closed", "lifted") for name in _CONTACTS),
    *(field.of for field in DATA_FIELDS if field.of),
)


def check_data_file(data: OpenFile, camera: str, context: Context) -> None:
    """Apply every rule to the samples of a file.

    Args:
        data: The file.
        camera: `oto` or `otm`.
        context: Takes the violations. With a dataset the samples are compared with their trials
            and with the meshes of their objects.
    """
    if data.config is None:
        return  # a finding already; without a lens no image can be judged
    known = context.dataset
    groups, meshes = ({}, {}) if known is None else (known.groups, known.meshes)
    context.add(data, consistency.splits(data, groups, meshes))
    judge_rows(_tasks(data, camera, context.dataset), data, context)


def check_pair(oto: OpenFile, otm: OpenFile, findings: Findings) -> None:
    """Compare the samples of both data files; rows that are a finding already are left out."""
    names = [f.name for f in SHARED_FIELDS]
    for split in [s for s in SPLITS if s in oto.groups and s in otm.groups]:
        count = oto.count(split)
        if otm.count(split) != count:
            what = f"number of rows must be that of {oto.name}, {count}"
            findings.add([of_file(otm.name, what, str(otm.count(split)), f"/{split}")])
            continue
        bad = np.union1d(oto.bad(split), otm.bad(split))
        good = np.setdiff1d(np.arange(count), bad)
        for start in range(0, len(good), PAIR_ROWS):
            rows = good[start : start + PAIR_ROWS]
            batch, other = (file.read(split, rows, names) for file in (oto, otm))
            findings.add(sample_rules.same_properties(batch, other))


def _tasks(data: OpenFile, camera: str, dataset: Dataset | None) -> Iterator[RowsTask]:
    place = data.place({})
    for split in data.groups:
        count = data.count(split)
        for start in range(0, count, TASK_ROWS):
            stop = min(start + TASK_ROWS, count)
            trials = None if dataset is None else dataset.trials
            yield RowsTask(
                judge=partial(_judge_samples, camera=camera),
                file=place,
                group=split,
                start=start,
                stop=stop,
                out=None if dataset is None else dataset.out,
                manifest=None if dataset is None else dataset.manifest,
                trials=None if trials is None else _trials_of(trials, data, split, start, stop),
            )


def _trials_of(trials: OpenFile, data: OpenFile, split: str, start: int, stop: int) -> FilePlace:
    """Return the trials for a task, which need not know of all bad ones.

    Where a trial's number cannot be read, nor can its sample: the task finds that, and compares
    none of them.
    """
    bad = trials.bad("trials")
    try:
        ids = data.groups[split]["trial_id"][start:stop]
    except OSError:
        ids = bad
    return trials.place({"trials": np.intersect1d(ids, bad)})


def _judge_samples(rows: Rows, findings: Findings, *, camera: str) -> AnyArray:
    """Apply every rule to rows of a split; no later step needs any of them."""
    data, dataset = rows.file, rows.dataset
    assert data.config is not None
    filters, lens = data.config.filters, Lens.of(camera, data.config)
    for whole in data.batches(rows.group, rows.start, rows.stop, SAMPLE_ROWS, findings):
        # Values that stand for themselves.
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
            hold_rules.poses,
        )
        batch = data.judge(
            batch, findings, hold_rules.words, partial(hold_rules.limits, filters=filters)
        )

        # The frames of a sample, and its trial.
        batch = data.judge(batch, findings, sample_rules.inverse_frames)
        batch = data.judge(
            batch,
            findings,
            sample_rules.camera_pair,
            partial(image_rules.image_frames, lens=lens),
        )
        if dataset is not None:
            batch = _judge_by_trial(data, batch, camera, dataset, rows.model, findings)

        # What the images show, which needs right frames.
        batch = image_rules.without_noise(batch, lens, data.config.camera)
        batch = data.judge(
            batch,
            findings,
            partial(image_rules.contacts_in_image, lens=lens),
            partial(image_rules.table_pixels, lens=lens),
        )
        if dataset is not None:
            _judge_by_mesh(data, batch, lens, rows.model, findings)
    return np.zeros(0, dtype=np.int64)


def _judge_by_trial(
    data: OpenFile,
    batch: Batch,
    camera: str,
    dataset: Dataset,
    load: LoadModel,
    findings: Findings,
) -> Batch:
    """Compare samples with their trials; return those that agree, or have no sound trial."""
    trials = dataset.trials
    if trials is None or data.config is None or not {"objects", "trials"} <= set(trials.groups):
        return batch  # trials whose objects are broken were not judged

    # A sample needs a trial. A trial that is a finding itself says nothing about its sample.
    count = trials.count("trials")
    batch = data.judge(batch, findings, partial(_has_trial, count=count))
    judged = batch.without(
        set(batch.rows[np.isin(batch["trial_id"], trials.bad("trials"))].tolist())
    )
    if not len(judged):
        return batch

    # The columns of the trials, a row per sample.
    ids, place = np.unique(judged["trial_id"], return_inverse=True)
    unique = trials.read("trials", ids, COMPARED).columns
    columns = {name: values[place] for name, values in unique.items()}

    # Only a success of the same object can be compared in its numbers.
    names = np.array(dataset.names, dtype=object)[columns["object"]]
    agreeing = data.judge(
        judged, findings, partial(_is_success_of, outcomes=columns["outcome"], names=names)
    )
    own = _select(columns, np.isin(judged.rows, agreeing.rows))
    agreeing = data.judge(
        agreeing,
        findings,
        partial(hold_rules.surface_limits, trials=own, filters=data.config.filters),
    )

    # An object whose file is broken is a finding already.
    names = agreeing["object_props/object_name"]
    models = {name: load(name) for name in dict.fromkeys(names.tolist())}
    sound = {name: model for name, model in models.items() if model is not None}
    known = agreeing.without(set(agreeing.rows[~np.isin(names, list(sound))].tolist()))
    derived = data.judge(
        known,
        findings,
        partial(
            sample_rules.follows_from_trial,
            trials=_select(columns, np.isin(judged.rows, known.rows)),
            models=sound,
            camera=camera,
            config=data.config.camera,
        ),
    )
    agreeing = agreeing.without(set(known.rows.tolist()) - set(derived.rows.tolist()))
    return batch.without(set(judged.rows.tolist()) - set(agreeing.rows.tolist()))


def _has_trial(batch: Batch, count: int) -> Iterator[Violation]:
    """The trial of a sample is one of `count` rows."""
    ids = batch["trial_id"]
    what = f"trial_id must be a row of {TRIALS_FILE}"
    yield from batch.broken(what, (ids < 0) | (ids >= count), ids)


def _is_success_of(batch: Batch, outcomes: AnyArray, names: AnyArray) -> Iterator[Violation]:
    """The trial of a sample is a success with its object, given outcome and name by row."""
    yield from batch.broken(
        "a sample's trial must be a success (0)", outcomes != Outcome.SUCCESS, outcomes
    )
    own = batch["object_props/object_name"]
    yield from batch.broken(
        "object_name must be that of its trial",
        names != own,
        lambda i: f"{own[i]!r}, not {names[i]!r}",
    )


def _select(columns: Mapping[str, AnyArray], rows: AnyArray) -> dict[str, AnyArray]:
    return {name: values[rows] for name, values in columns.items()}


def _judge_by_mesh(
    data: OpenFile, batch: Batch, lens: Lens, load: LoadModel, findings: Findings
) -> None:
    """Compare samples with the meshes of their objects."""
    assert data.config is not None
    limit = data.config.filters.max_surface_distance
    names = batch["object_props/object_name"]
    for name in dict.fromkeys(names.tolist()):
        model = load(name)
        if model is None:
            continue  # a finding already
        data.judge(
            batch.without(set(batch.rows[names != name].tolist())),
            findings,
            partial(sample_rules.class_of_object, model=model),
            partial(image_rules.object_pixels, lens=lens, model=model),
            partial(
                sample_rules.contacts_on_mesh, camera=lens.camera, model=model, max_distance=limit
            ),
        )
