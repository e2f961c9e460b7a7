"""From shards to trials.hdf5, grasping_oto.hdf5, grasping_otm.hdf5 and their data card.

Input: a directory whose work units are all done. Output: the three files, all or none, and their
card. An `Executor` runs the work in tasks: `assembly.survey` reads the shards of an object,
`assembly.pack` compresses the chunks of a range of rows. This process decides which successes
become samples, and writes the chunks to the files. It keeps a few numbers per success, whatever the
number of attempts. It does not import Drake.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np

from drakegrasp.dataset.assembly.pack import (
    PackTask,
    pack_rows,
    pack_tasks,
    sample_texts,
    unpack_rows,
)
from drakegrasp.dataset.assembly.survey import (
    Survey,
    decide,
    file_attributes,
    keys_of,
    number_rows,
    object_columns,
    survey_object,
    survey_tasks,
)
from drakegrasp.dataset.card import card_files, content_of
from drakegrasp.dataset.hdf5 import AnyArray, create_field, write_field
from drakegrasp.dataset.lock import build_lock
from drakegrasp.dataset.manifest import (
    Manifest,
    manifest_text,
    read_manifest,
    with_postprocessing,
)
from drakegrasp.dataset.opening import open_samples, open_trials, read_codes
from drakegrasp.dataset.paths import DATA_FILES, FILE_NAME, TRIALS_FILE
from drakegrasp.dataset.rejections import AttemptKey, find_keys
from drakegrasp.dataset.schema import (
    DATA_FIELDS,
    OBJECT_FIELDS,
    SPLITS,
    SUCCESS_FIELDS,
    TRIAL_FIELDS,
    Field,
    stored_fields,
)
from drakegrasp.errors import DataError
from drakegrasp.filters import Removal
from drakegrasp.runtime.executor import Executor, in_order, run_here
from drakegrasp.runtime.files import disk_full_named, new_hdf5, replaced_together, sweep_temporary
from drakegrasp.runtime.progress import Report, silent


@dataclass(frozen=True, kw_only=True)
class Assembly:
    """Numbers of rows in the files of a dataset.

    Attributes:
        trials: Number of attempts.
        grasps: Number of successes.
        removed: Number of successes for each reason of removal; the key `Removal.KEPT` counts the
            samples.
        samples: Number of samples in each split.
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
        overrides: `key=value` strings that change the filters or the split of the dataset. If the
            split changes, all objects are drawn anew.
        rejected: Trials that an inspection rejects, as ids or identities; they do not become
            samples.
        execute: Executor of the tasks; the files do not depend on it.
        progress: Called with the number of finished tasks and the number of all tasks.

    Raises:
        ConfigError: If an override cannot be used; nothing is changed.
        DataError: If a shard is missing or damaged, if a rejected trial is not a success, or if
            another process is building in the directory; the old files and filters are left
            unchanged.
        DiskFullError: If the disk is full; the old files and filters are left unchanged.
    """
    # The lock would create a missing directory.
    if not out.is_dir():
        read_manifest(out)
    with build_lock(out):
        manifest = with_postprocessing(read_manifest(out), overrides)
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
        manifest: Manifest of the dataset; its filters and split may differ from those on disk.
        rejected: As for `assemble`; if None, the rejections of the manifest that are successes.
        execute: As for `assemble`.
        progress: As for `assemble`.
    """
    sweep_temporary(out)
    with disk_full_named(out), replaced_together(out) as new:
        # Survey the shards: the number of rows, and what the filters need of each success.
        shards = number_rows(_survey_all(out, manifest, execute, progress), manifest)

        # Decide which successes become samples, and in which split.
        if rejected is not None:
            known = keys_of(manifest, shards.successes)
            manifest = replace(manifest, rejected=find_keys(rejected, known, out))
        decisions = decide(manifest, shards)
        manifest = decisions.manifest
        repeats = manifest.config.robustness.repeats > 0

        # Write the small tables, and allocate all rows.
        paths = {camera: new(name) for camera, name in {"": TRIALS_FILE, **DATA_FILES}.items()}
        with ExitStack() as stack:
            files = {
                c: stack.enter_context(new_hdf5(path, sealed=True)) for c, path in paths.items()
            }
            for camera, file in files.items():
                file.attrs.update(file_attributes(manifest, shards.seals, camera))
                counts = {split: len(ids) for split, ids in decisions.ids.items()}
                fields = stored_fields(DATA_FIELDS if camera else TRIAL_FIELDS, repeats=repeats)
                for name, count in (counts if camera else {"trials": shards.count}).items():
                    group = file.create_group(name)
                    for f in fields:
                        create_field(group, f, f.row_shape(shards.sizes), count)
            _write_table(files[""], "objects", OBJECT_FIELDS, object_columns(manifest))
            _write_table(files[""], "successes", SUCCESS_FIELDS, decisions.columns())

            # Rows are packed in any order, and each chunk is written at its own position.
            tasks = list(pack_tasks(out, decisions, repeats=repeats))
            texts = sample_texts(manifest)
            surveyed = len({piece.object for piece in shards.slices})
            for done, task in enumerate(_packed(execute, tasks), start=1):
                unpack_rows(task, files, texts)
                progress(surveyed + done, surveyed + len(tasks))

        # The card describes the files in words and numbers. The manifest, with filters, split and
        # rejections, changes together with the files.
        content = content_of(manifest, paths[""], paths["oto"])
        for name, text in card_files(content).items():
            new(name).write_bytes(text)
        new(FILE_NAME).write_bytes(manifest_text(manifest))
    return summarise(out)


def _survey_all(out: Path, manifest: Manifest, execute: Executor, progress: Report) -> list[Survey]:
    """Return the surveys of all objects with a palm pose, in the order of /objects.

    Raises:
        DataError: If a shard is missing or damaged, or no object has a palm pose.
    """
    surveys = []
    for survey in in_order(execute)(survey_object, survey_tasks(out, manifest)):
        surveys.append(survey)
        progress(len(surveys), 2 * len(manifest.objects))
    if not surveys:
        raise DataError(f"{out}: no object has a palm pose to try")
    return surveys


def _packed(execute: Executor, tasks: Sequence[PackTask]) -> Iterator[PackTask]:
    """Yield the tasks whose parts are written, in order; remove the remaining parts at the end."""
    try:
        # Closing this generator first closes the one of the tasks, so no task writes any more.
        yield from in_order(execute)(pack_rows, tasks)
    finally:
        for task in tasks:
            Path(task.part).unlink(missing_ok=True)


def summarise(out: Path) -> Assembly:
    """Return the numbers of rows in the files of a dataset.

    Raises:
        DataError: If the files are missing or damaged.
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


def _write_table(
    file: h5py.File, name: str, fields: Sequence[Field], columns: Mapping[str, AnyArray]
) -> None:
    """Write a group all of whose rows are known."""
    group = file.create_group(name)
    for field in fields:
        write_field(group, field, columns[field.name])
