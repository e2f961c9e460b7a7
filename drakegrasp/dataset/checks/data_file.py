"""The order of the rules for grasping_oto.hdf5 and grasping_otm.hdf5.

In: a data file and, if there is one, the dataset around it. Out: tasks that judge its samples; the
rules of its splits.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from drakegrasp.dataset.assembly.split import split_samples
from drakegrasp.dataset.checks import images as image_rules
from drakegrasp.dataset.checks import samples as sample_rules
from drakegrasp.dataset.checks.attempts import Dataset, LoadModel
from drakegrasp.dataset.checks.findings import Findings, Violation, of_file
from drakegrasp.dataset.checks.images import Lens
from drakegrasp.dataset.checks.rows import Batch, CheckedFile
from drakegrasp.dataset.manifest import ObjectEntry
from drakegrasp.dataset.schema import DATA_FIELDS, SPLITS
from drakegrasp.outcomes import Outcome

#: Samples in a batch: some 20 MB of images.
SAMPLE_ROWS = 64
#: Samples in a task.
TASK_ROWS = 4 * SAMPLE_ROWS


@dataclass(frozen=True, kw_only=True, eq=False)
class SamplesTask:
    """Samples to judge.

    Attributes:
        files: The data file, by its camera.
        split: Name of the split.
        start, stop: Rows of the split.
        dataset: The dataset around the file, if there is one.
        trials: trials.hdf5, where the samples are to be compared with it; their shards tell more.
    """

    files: Mapping[str, CheckedFile]
    split: str
    start: int
    stop: int
    dataset: Dataset | None
    trials: CheckedFile | None

    @property
    def size(self) -> int:
        """Number of rows."""
        return self.stop - self.start

    def judge(self, findings: Findings) -> None:
        """Apply every rule: first to numbers by themselves, then to what follows from others."""
        ((camera, data),) = self.files.items()
        assert data.config is not None
        config, lens = data.config, Lens.of(camera, data.config)
        load = None if self.dataset is None else self.dataset.loader()
        rows = np.arange(self.start, self.stop)
        with data.opened() as file:
            for batch in data.batches(file, self.split, rows, SAMPLE_ROWS, findings):
                own = data.judge(batch, findings, sample_rules.finite)
                own = data.judge(
                    own,
                    findings,
                    sample_rules.directions,
                    partial(image_rules.image_values, lens=lens),
                    image_rules.mask_values,
                    sample_rules.mass_properties,
                    sample_rules.fixed_frames,
                    partial(sample_rules.hold, filters=config.filters),
                )
                own = data.judge(
                    own,
                    findings,
                    sample_rules.camera_pair,
                    partial(image_rules.image_frames, lens=lens),
                )

                if self.trials is not None:
                    own = data.judge(own, findings, partial(_copies_trial, trials=self.trials))

                # What the images show, which needs right frames.
                own = image_rules.without_noise(own, lens, config.camera)
                own = data.judge(
                    own,
                    findings,
                    partial(image_rules.contacts_in_image, lens=lens),
                    partial(image_rules.table_pixels, lens=lens),
                )
                if load is not None:
                    _judge_by_mesh(data, own, lens, load, findings)


def _copies_trial(batch: Batch, trials: CheckedFile) -> Iterator[Violation]:
    """A sample is of a success, and repeats its numbers."""
    ids = batch["trial_id"]
    unknown = (ids < 0) | (ids >= trials.counts["trials"])
    yield from batch.broken("trial_id must be a row of /trials", unknown, ids)

    # Trials that break a rule are a finding already.
    known = batch.where(~unknown & ~np.isin(ids, trials.bad_rows("trials")))
    rows, position = np.unique(known["trial_id"], return_inverse=True)
    if not len(rows):
        return
    copied = {f.name: f.of for f in DATA_FIELDS if f.of and f.name in batch.columns}
    with trials.opened() as file:
        own = trials.read(file, "trials", rows, ["outcome", *copied.values()])
    failed = own["outcome"][position] != Outcome.SUCCESS
    yield from known.broken("trial_id must be that of a success", failed, known["trial_id"])
    known, position = known.where(~failed), position[~failed]
    for name, of in copied.items():
        yield from known.follows(name, own[of][position], "its trial")


def _judge_by_mesh(
    data: CheckedFile, batch: Batch, lens: Lens, load: LoadModel, findings: Findings
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
            batch.where(names == name),
            findings,
            partial(image_rules.object_pixels, lens=lens, model=model),
            partial(
                sample_rules.contacts_on_mesh, camera=lens.camera, model=model, max_distance=limit
            ),
        )


def samples_tasks(
    data: CheckedFile, camera: str, dataset: Dataset | None, trials: CheckedFile | None
) -> Iterator[SamplesTask]:
    """Yield the tasks that judge all samples of a file; none if its lens is not known.

    Args:
        data: The file.
        camera: `oto` or `otm`.
        dataset: As of a task.
        trials: As of a task.
    """
    for split, count in data.counts.items() if data.config is not None else ():
        for start in range(0, count, TASK_ROWS):
            stop = min(start + TASK_ROWS, count)
            yield SamplesTask(
                files={camera: data.for_task(split, start, stop)},
                split=split,
                start=start,
                stop=stop,
                dataset=dataset,
                trials=trials,
            )


def splits(data: CheckedFile, entries: Mapping[str, ObjectEntry]) -> Iterator[Violation]:
    """A trial is one sample, and the test split has the objects that the seed draws.

    Args:
        data: The data file.
        entries: The objects by name, as far as they are known.
    """
    # Each trial once; meanwhile gather the objects and their classes by split.
    seen: dict[int, str] = {}
    objects: dict[str, dict[str, str]] = {}
    with data.opened() as file:
        for split in data.counts:
            for row, number in enumerate(file[split]["trial_id"][:].tolist()):
                if seen.setdefault(number, f"{split} row {row}") != f"{split} row {row}":
                    what = "trial_id must be unique in all splits"
                    got = f"{number}, which is in /{seen[number]} too"
                    group = f"/{split}"
                    yield Violation(file=data.name, group=group, row=row, what=what, got=got)
            keys = ("object_name", "class_name")
            names, classes = (file[split][f"object_props/{key}"].asstr()[:] for key in keys)
            objects[split] = dict(zip(names.tolist(), classes.tolist(), strict=True))

    # By object: no object in two splits, nor another one of its mesh.
    if data.attributes.get("split_by") == "object":
        home: dict[str, str] = {}
        for split, members in objects.items():
            for group in sorted({_group(entries, name) for name in members}):
                if home.setdefault(group, split) != split:
                    what = "an object and its group must be in one split"
                    yield of_file(data.name, what, f"{group}, in /{home[group]} too", f"/{split}")
        return
    if data.config is None or len(objects) < len(SPLITS):
        return

    # By class: the draw depends on nothing but the objects, of which one or all are tested.
    kinds = {name: kind for members in objects.values() for name, kind in members.items()}
    names = sorted(kinds)
    meshes = [entries[name].mesh_name if name in entries else name for name in names]
    config = data.config.split.model_copy(update={"by": "class"})
    tested = split_samples(
        np.arange(len(names), dtype=np.int32),
        meshes,
        [kinds[name] for name in names],
        meshes,
        config,
        data.config.seed,
    )["test"]
    due = {names[i] for i in tested.tolist()}
    for split, members in objects.items():
        for name in sorted(members):
            if (name in due) != (split == "test"):
                what = f"{name} of class {kinds[name]} must be in "
                what += "/test" if name in due else "no test split"
                yield of_file(data.name, what, "another split", f"/{split}")


def _group(entries: Mapping[str, ObjectEntry], name: str) -> str:
    entry = entries.get(name)
    return name if entry is None else entry.group or entry.mesh_name
