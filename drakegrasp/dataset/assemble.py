"""From shards to trials.hdf5, grasping_oto.hdf5 and grasping_otm.hdf5, and their data card.

In: a directory whose work units are all done. Out: the three files, all or none, and their card.
The work is done in tasks, by an `Executor`: `assembly.survey` reads the shards of an object,
`assembly.pack` makes the compressed chunks of some rows. This process decides which successes are
samples, and puts the chunks into the files. It keeps a few numbers per success, whatever the
number of attempts. Imports no Drake.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np
import numpy.typing as npt

from drakegrasp.dataset.assembly.pack import (
    TASK_ROWS,
    PackTask,
    Part,
    ShardSlice,
    pack_rows,
    unpack_rows,
)
from drakegrasp.dataset.assembly.samples import TEXTS, SampleRows
from drakegrasp.dataset.assembly.split import split_samples
from drakegrasp.dataset.assembly.survey import (
    Survey,
    headers_by_object,
    join_seals,
    join_successes,
    survey_object,
    survey_tasks,
)
from drakegrasp.dataset.assembly.weights import weigh_samples
from drakegrasp.dataset.card.content import content_of
from drakegrasp.dataset.card.text import card_files
from drakegrasp.dataset.filters import Successes, judge_successes
from drakegrasp.dataset.hdf5 import AnyArray, create_field, write_field
from drakegrasp.dataset.layout.opening import open_samples, open_trials, read_codes
from drakegrasp.dataset.lock import build_lock
from drakegrasp.dataset.manifest import (
    Manifest,
    manifest_text,
    read_manifest,
    refuse_older,
    with_postprocessing,
    write_origin,
)
from drakegrasp.dataset.paths import DATA_FILES, FILE_NAME, TRIALS_FILE
from drakegrasp.dataset.rejections import AttemptKey, find_keys
from drakegrasp.dataset.schema import OBJECT_FIELDS, SPLITS, SUCCESS_FIELDS, TRIAL_FIELDS
from drakegrasp.errors import DataError
from drakegrasp.frames import Array
from drakegrasp.outcomes import Removal
from drakegrasp.runtime.executor import Executor, in_order, run_here
from drakegrasp.runtime.file_set import replaced_together
from drakegrasp.runtime.files import disk_full_named, new_hdf5, sweep_temporary, temporary_name
from drakegrasp.runtime.progress import Report, silent
from drakegrasp.vision.camera import intrinsics


@dataclass(frozen=True, kw_only=True)
class Assembly:
    """What the files of a dataset hold.

    Attributes:
        trials: Number of attempts.
        grasps: Number of successes.
        removed: Number of successes by reason of removal; `Removal.KEPT` are the samples.
        samples: Number of samples by split.
    """

    trials: int
    grasps: int
    removed: dict[Removal, int]
    samples: dict[str, int]


def assemble(
    out: Path,
    *,
    overrides: Sequence[str] = (),
    rejected: Sequence[int | AttemptKey] = (),
    execute: Executor = run_here,
    progress: Report = silent,
) -> Assembly:
    """Write the three files of a dataset whose work units are all done.

    Args:
        out: Directory of the dataset.
        overrides: `key=value` texts that change the filters or the split of the dataset.
        rejected: Trials that an inspection rejects, by id or identity; they become no samples.
        execute: Does the work; the files do not depend on it.
        progress: Called with the number of tasks that are done and to do.

    Raises:
        ConfigError: If an override cannot be used; nothing is changed.
        DataError: If a shard is missing or damaged, what is rejected is no success, or another
            process builds in the directory; the old files and filters stay.
        DiskFullError: If there is no room; the old files and filters stay.
    """
    # The lock would make a missing directory.
    if not out.is_dir():
        read_manifest(out)
    with build_lock(out):
        manifest = read_manifest(out)
        refuse_older(manifest, out)
        manifest = with_postprocessing(manifest, overrides)
        return assemble_locked(out, manifest, rejected=rejected, execute=execute, progress=progress)


def assemble_locked(
    out: Path,
    manifest: Manifest,
    *,
    rejected: Sequence[int | AttemptKey] | None = None,
    execute: Executor = run_here,
    progress: Report = silent,
) -> Assembly:
    """Write the three files, their card and the manifest; the caller holds the lock.

    Args:
        out: Directory of the dataset.
        manifest: Of the dataset; it may have other filters or another split than the one there.
        rejected: As for `assemble`; those of the manifest if None, as far as they are successes.
        execute: As for `assemble`.
        progress: As for `assemble`.
    """
    sweep_temporary(out)
    with disk_full_named(out), replaced_together(out) as new:
        # Survey the shards: how many rows, and of each success what the filters need.
        surveys = _survey_all(out, manifest, execute, progress)
        slices, successes = _number_rows(surveys, manifest)

        # Decide which successes are samples, and in which split.
        known = _keys(manifest, successes)
        if rejected is not None:
            manifest = replace(manifest, rejected=find_keys(rejected, known, out))
        ids_rejected = [known[key] for key in manifest.rejected if key in known]
        removal = judge_successes(successes, manifest.config.filters, ids_rejected)
        splits = _split_successes(manifest, successes, removal)
        _remove_refined_tests(splits, successes, removal)
        weights = _weights(manifest, successes, removal)
        ids = {split: successes.trial_id[rows] for split, rows in splits.items()}

        # Write what is small, and room for all rows.
        seals = join_seals({survey.object: survey.seals for survey in surveys})
        origin = {"signature": manifest.signature(), "shards": seals}
        sizes = surveys[0].sizes
        paths = {name: new(name) for name in (TRIALS_FILE, *DATA_FILES.values())}
        with ExitStack() as stack:
            trials = stack.enter_context(new_hdf5(paths[TRIALS_FILE]))
            _write_objects(trials, manifest)
            group, count = trials.create_group("trials"), slices[-1].first + slices[-1].rows
            columns = [create_field(group, f, f.row_shape(sizes), count) for f in TRIAL_FIELDS]
            _write_removal(trials, successes, removal)
            _write_attributes(trials, manifest, origin)
            rows = {}
            for camera, name in DATA_FILES.items():
                file = stack.enter_context(new_hdf5(paths[name]))
                own = {"camera": camera, "split_by": manifest.split_rule}
                _write_attributes(file, manifest, {**origin, **own})
                for split in SPLITS:
                    rows[split, camera] = SampleRows(
                        file, split, len(ids[split]), sizes, _texts(manifest)
                    )

            # Rows are packed in any order, and put into the files in theirs.
            own_weights = {split: weights[rows] for split, rows in splits.items()}
            tasks = list(_pack_tasks(out, slices, ids, own_weights, sizes))
            for done, part in enumerate(_packed(execute, tasks), start=1):
                unpack_rows(part, columns, rows)
                progress(len(surveys) + done, len(surveys) + len(tasks))
            for split_rows in rows.values():
                split_rows.flush()

        # What the files hold, in words and numbers. Filters, split and rejections change with the
        # files that they made.
        content = content_of(manifest, paths[TRIALS_FILE], paths[DATA_FILES["oto"]])
        for name, text in card_files(content).items():
            new(name).write_bytes(text)
        new(FILE_NAME).write_bytes(manifest_text(manifest))
    return summarise(out)


def _survey_all(out: Path, manifest: Manifest, execute: Executor, progress: Report) -> list[Survey]:
    """Return the surveys of all objects with a palm pose, by their rows of /objects.

    Raises:
        DataError: If a shard is missing or damaged, or there is none.
    """
    surveys = []
    for survey in in_order(execute)(survey_object, survey_tasks(out, manifest)):
        surveys.append(survey)
        progress(len(surveys), 2 * len(manifest.objects))
    if not surveys:
        raise DataError(f"{out}: no object has a palm pose to try")
    return surveys


def _number_rows(
    surveys: Sequence[Survey], manifest: Manifest
) -> tuple[list[ShardSlice], Successes]:
    """Return the rows of each shard, and all successes with their trials' ids."""
    headers = headers_by_object(manifest)
    first, slices, parts = 0, list[ShardSlice](), []
    for survey in surveys:
        parts.append(replace(survey.successes, trial_id=survey.successes.trial_id + first))
        # Shards behind the last wanted grasp give no rows.
        for header, rows in zip(headers[survey.object], survey.rows, strict=False):
            slices.append(ShardSlice(header=header, object=survey.object, first=first, rows=rows))
            first += rows
    return slices, join_successes(parts)


def _pack_tasks(
    out: Path,
    slices: Sequence[ShardSlice],
    ids: Mapping[str, npt.NDArray[np.int64]],
    weights: Mapping[str, Array],
    sizes: Mapping[str, int],
) -> Iterator[PackTask]:
    """Yield the tasks that pack the rows, from the first to the last."""
    count, firsts = slices[-1].first + slices[-1].rows, [piece.first for piece in slices]
    for start in range(0, count, TASK_ROWS):
        stop = min(start + TASK_ROWS, count)
        # From the shard in which the range begins to that in which it ends.
        within = slices[bisect_right(firsts, start) - 1 : bisect_left(firsts, stop)]
        bounds = {split: np.searchsorted(rows, (start, stop)) for split, rows in ids.items()}
        yield PackTask(
            out=str(out),
            part=str(temporary_name(out / f"rows-{start}")),
            start=start,
            stop=stop,
            slices=tuple(within),
            ids={split: ids[split][a:b] for split, (a, b) in bounds.items()},
            weights={split: weights[split][a:b] for split, (a, b) in bounds.items()},
            sizes=sizes,
        )


def _packed(execute: Executor, tasks: Sequence[PackTask]) -> Iterator[Part]:
    """Yield the parts in the order of the tasks; remove those that are left at the end."""
    try:
        # When this generator is closed, that of the tasks is, first: none writes any more.
        yield from in_order(execute)(pack_rows, tasks)
    finally:
        for task in tasks:
            Path(task.part).unlink(missing_ok=True)


def _texts(manifest: Manifest) -> dict[str, list[str]]:
    """Return the texts of samples by object, see `SampleRows`."""
    return {
        name: [getattr(entry, attribute) for entry in manifest.objects]
        for name, attribute in TEXTS.items()
    }


def _keys(manifest: Manifest, successes: Successes) -> dict[AttemptKey, int]:
    """Return the trial id of each success, by its identity."""
    names = ("object", "candidate", "standoff_index", "child", "trial_id")
    rows = zip(*(getattr(successes, name).tolist() for name in names), strict=True)
    return {AttemptKey(manifest.objects[i].name, *key): t for i, *key, t in rows}


def summarise(out: Path) -> Assembly:
    """Return what the files of a dataset hold.

    Raises:
        DataError: If they are missing or damaged.
    """
    with open_trials(out / TRIALS_FILE) as trials, open_samples(out / DATA_FILES["oto"]) as data:
        removal = read_codes(trials["successes/removal"], list(Removal))
        reasons, counts = np.unique(removal, return_counts=True)
        return Assembly(
            trials=len(trials["trials/outcome"]),
            grasps=len(removal),
            removed={Removal(int(r)): int(n) for r, n in zip(reasons, counts, strict=True)},
            samples={split: len(data[split]["trial_id"]) for split in SPLITS},
        )


def _write_attributes(file: h5py.File, manifest: Manifest, origin: Mapping[str, str]) -> None:
    camera = manifest.config.camera
    write_origin(file, manifest.config, manifest.versions, manifest.fingers)
    file.attrs.update(origin)
    file.attrs["K"] = intrinsics(camera)
    file.attrs["near"], file.attrs["far"] = camera.near, camera.far


def _write_objects(file: h5py.File, manifest: Manifest) -> None:
    group = file.create_group("objects")
    for field in OBJECT_FIELDS:
        own = [getattr(entry, field.name) for entry in manifest.objects]
        values = [np.nan if value is None else value for value in own]
        dtype = object if field.dtype == "str" else field.dtype
        write_field(group, field, np.array(values, dtype=dtype))


def _write_removal(file: h5py.File, successes: Successes, removal: AnyArray) -> None:
    """Write /successes: why each success is, or is not, a sample."""
    group = file.create_group("successes")
    for field in SUCCESS_FIELDS:
        values = removal if field.name == "removal" else getattr(successes, field.name)
        write_field(group, field, values)


def _split_successes(
    manifest: Manifest, successes: Successes, removal: AnyArray
) -> dict[str, npt.NDArray[np.int64]]:
    """Return which successes are samples of each split, in rising order."""
    # A first-round attempt and all that was refined from it go to one split.
    kept = np.flatnonzero(removal == Removal.KEPT)
    names = ("object", "candidate", "standoff_index")
    keys = np.column_stack([getattr(successes, name)[kept] for name in names])
    _, first, family = np.unique(keys, axis=0, return_index=True, return_inverse=True)

    split = split_samples(
        successes.object[kept[first]],
        [entry.mesh_name for entry in manifest.objects],
        [entry.class_name for entry in manifest.objects],
        manifest.groups,
        manifest.config.split,
        manifest.config.seed,
    )
    return {name: kept[np.isin(family.ravel(), families)] for name, families in split.items()}


def _remove_refined_tests(
    splits: dict[str, npt.NDArray[np.int64]], successes: Successes, removal: AnyArray
) -> None:
    """Leave first-round attempts alone in the test split: the others are drawn about held ones."""
    refined = successes.child[splits["test"]] > 0
    removal[splits["test"][refined]] = Removal.REFINED_TEST
    splits["test"] = splits["test"][~refined]


def _weights(manifest: Manifest, successes: Successes, removal: AnyArray) -> Array:
    """Return the weight (n,) of each success among the samples; NaN where it is none."""
    kept = np.flatnonzero(removal == Removal.KEPT)
    weights = np.full(len(removal), np.nan)
    numbers, rows = manifest.pose_numbers(), zip(successes.object, successes.resting, strict=True)
    poses = np.array([numbers[i][k] for i, k in rows], dtype=np.int64)[kept]
    weights[kept] = weigh_samples(poses, successes.X_OG[kept])
    return weights
