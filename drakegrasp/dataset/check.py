"""`drakegrasp check`: are the files of a dataset as they were written, and of one state?

Input: a dataset's directory, or one of the files grasping_oto.hdf5, grasping_otm.hdf5, trials.hdf5
and scenes.hdf5. Output: a list of violations, empty for a valid dataset. The seal of a file proves
that it is intact. Besides, attributes, layout and rows are compared with the schema, and samples
with their trials and meshes. An `Executor` does the work in tasks, each of which reads a file or a
range of rows. Does not import Drake.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from drakegrasp.config import CarriedHand
from drakegrasp.dataset.assemble import file_attributes
from drakegrasp.dataset.assembly.survey import headers_by_object, known_homes, shards_sha256
from drakegrasp.dataset.card import card_counts
from drakegrasp.dataset.check_rows import RowsTask, Violation, check_rows
from drakegrasp.dataset.hdf5 import open_hdf5
from drakegrasp.dataset.manifest import Manifest, ObjectEntry, read_manifest
from drakegrasp.dataset.opening import (
    DATA_TABLES,
    OF_CAMERA,
    OF_SCENES,
    ORIGIN,
    SCENE_TABLES,
    TRIAL_TABLES,
    Kind,
    Tables,
    attribute_mistakes,
    differences,
    open_samples,
)
from drakegrasp.dataset.paths import (
    CARD_FILES,
    DATA_FILES,
    FILE_NAME,
    SCENES_FILE,
    TRIALS_FILE,
    model_path,
    plan_path,
    recorded_model,
    refuse_changed_model,
)
from drakegrasp.dataset.schema import SPLITS, refuse_other_schema
from drakegrasp.dataset.shards import ShardHeader, open_shard
from drakegrasp.dataset.trials import Trials, stamp
from drakegrasp.errors import DataError, DrakegraspError, first_line
from drakegrasp.filters import Removal
from drakegrasp.foreign_files import read_json
from drakegrasp.hand.folder import HAND_FOLDER, hand_digest
from drakegrasp.objects.model import load_object
from drakegrasp.runtime.executor import Executor, in_order, run_here
from drakegrasp.runtime.files import refuse_broken_seal
from drakegrasp.runtime.progress import Report, silent

__all__ = ["Violation", "check_dataset"]

#: Number of rows in a task: some 20 MB.
TASK_ROWS = 1024
#: Attributes and fields of a file, by the group that only it has.
KINDS: Mapping[str, tuple[Mapping[str, Kind], Tables]] = {
    "train": (OF_CAMERA, DATA_TABLES),
    "trials": (ORIGIN, TRIAL_TABLES),
    "views": (OF_SCENES, SCENE_TABLES),
}
#: Attributes of the state of a dataset that a file is of, a cause of other differences first;
#: scenes have the first two.
STATE = (
    *("signature", "shards", "camera", "split_by", "versions", "fingers", "joints"),
    *("config_hash", "seed", "K", "near", "far"),
)

#: A part of the check that runs in any process.
Task = Callable[[], list[Violation]]


def check_dataset(
    path: str | Path, *, execute: Executor = run_here, progress: Report = silent
) -> list[Violation]:
    """Return every broken invariant of a dataset or of one of its files.

    Args:
        path: Directory of a dataset, or one of its HDF5 files. For a single file, all rules that
            need no other file are checked.
        execute: Executor of the tasks; the result does not depend on it.
        progress: Called with the number of finished tasks and the number of all tasks.

    Raises:
        DataError: If the path is neither, cannot be read, or has another schema. In a directory, a
            file that cannot be read is a violation, and the other files are still checked.
    """
    path = Path(path)
    found, tasks = _look_at_dataset(path) if path.is_dir() else _look_at_one(path)
    for done, more in enumerate(in_order(execute)(_run, tasks), start=1):
        found += more
        progress(done, len(tasks))
    if path.is_dir() and not found:
        found += _card(path)  # with other violations, it would differ for the same cause
    return _joined(found)


def _run(task: Task) -> list[Violation]:
    return task()


def _joined(found: Iterable[Violation]) -> list[Violation]:
    """Return one violation for each rule and group, with the number of all rows that break it."""
    joined = dict[tuple[str, str, str], Violation]()
    for each in found:
        first = joined.setdefault((each.file, each.group, each.what), each)
        if first is not each:
            more = first.more + each.more + 1
            joined[each.file, each.group, each.what] = replace(first, more=more)
    return list(joined.values())


# Files


@dataclass(frozen=True, kw_only=True)
class _Look:
    """What the header of a file says.

    Attributes:
        path: Path of the file.
        tables: Fields of each group.
        counts: Number of rows of each group whose layout is that of the schema.
        attributes: Attributes of the file.
        found: Violations of the layout and of the attributes.
    """

    path: Path
    tables: Tables
    counts: Mapping[str, int]
    attributes: Mapping[str, Any]
    found: list[Violation]

    def tasks(self, known: Mapping[str, int], dataset: Manifest | None = None) -> Iterator[Task]:
        """Yield the tasks of the file: its seal, and its rows.

        Args:
            known: Number of rows of groups of other files.
            dataset: See `RowsTask`.
        """
        yield partial(_seal, self.path)
        now = stamp(self.path)
        for group, count in self.counts.items():
            for start in range(0, count, TASK_ROWS):
                task = RowsTask(
                    path=self.path,
                    stamp=now,
                    group=group,
                    rows=slice(start, min(start + TASK_ROWS, count)),
                    fields=self.tables[group],
                    attributes=self.attributes,
                    counts={**known, **self.counts},
                    dataset=dataset,
                )
                yield partial(check_rows, task)


def _look_at(path: Path, file: h5py.File, kind: str) -> _Look:
    """Check the attributes and the layout of a file; no row is read."""
    kinds, tables = KINDS[kind]
    mistakes = list(attribute_mistakes(file, kinds))
    # A group with an invalid column is not read; without sound attributes, nothing is.
    layout = list(differences(file, tables))
    broken = {*tables} if mistakes else {each.path[1:].split("/")[0] for each in layout}
    return _Look(
        path=path,
        tables=tables,
        counts={g: len(file[g][tables[g][0].name]) for g in tables if g not in broken},
        attributes=dict(file.attrs),
        found=[
            Violation(file=path.name, group=each.path, what=each.what, got=each.got)
            for each in (*mistakes, *layout)
        ],
    )


def _look_at_one(path: Path) -> tuple[list[Violation], list[Task]]:
    """Return the violations in the header of a single file, and the tasks of its content."""
    try:
        with open_hdf5(path) as file:
            # The groups tell which of the files it is, whatever its name.
            kind = next((kind for kind in KINDS if kind in file), None)
            if kind is None:
                raise DataError(
                    f"{path}: must be a data file or the trials of a dataset, got another HDF5 file"
                )
            refuse_other_schema(path, file.attrs.get("schema_version"))
            look = _look_at(path, file, kind)
    except OSError as error:
        raise DataError(
            f"{path}: must be the directory of a dataset or one of its HDF5 files, "
            f"got one that cannot be read ({first_line(error)})"
        ) from None
    return look.found, [*look.tasks({})]


def _look_at_dataset(out: Path) -> tuple[list[Violation], list[Task]]:
    """Return what a dataset's manifest and the headers of its files show, and all tasks."""
    manifest, looks = read_manifest(out), dict[str, _Look]()
    found, other, seals = check_hand(manifest), list[Violation](), ""
    with _reported(found, FILE_NAME, "objects of one group must be in one split"):
        known_homes(manifest)

    # Headers, and the state that each file is of. A missing shard is found with its object.
    with suppress(DataError):
        seals = shards_sha256(out, manifest)
    cameras = {name: camera for camera, name in DATA_FILES.items()}
    kinds = {TRIALS_FILE: "trials", **dict.fromkeys(cameras, "train")}
    kinds |= {SCENES_FILE: "views"} if (out / SCENES_FILE).exists() else {}
    for name, kind in kinds.items():
        what = "the file must be there, readable and of this schema"
        with _reported(found, name, what), open_hdf5(out / name) as file:
            refuse_other_schema(out / name, file.attrs.get("schema_version"))
            look = looks[name] = _look_at(out / name, file, kind)
            due = file_attributes(manifest, seals, cameras.get(name, ""))
            other += _other_state(look, due)
            found += look.found

    # Samples are compared with trials and meshes of the same state.
    trials = looks.get(TRIALS_FILE)
    known = {} if trials is None or trials.found or other else trials.counts
    tasks: list[Task] = [
        partial(_check_object, out, entry, headers)
        for entry, headers in zip(manifest.objects, headers_by_object(manifest), strict=True)
    ]
    for name, look in looks.items():
        if known and name in cameras:
            tasks += [partial(_samples, look.path), *look.tasks(known, manifest)]
        else:
            tasks += look.tasks({})
    return found + other, tasks


def _other_state(look: _Look, due: Mapping[str, Any]) -> Iterator[Violation]:
    """The attributes of a file are those of the manifest and of the shards.

    Args:
        look: The file.
        due: The attributes that the file would be written with now; `shards` is empty if a shard is
            missing.
    """
    scenes, of = "views" in look.tables, {"shards": "the shards that are there"}
    for key in STATE[:2] if scenes else STATE:
        told = key in due and key in look.attributes and (key != "shards" or due[key])
        if told and not np.array_equal(look.attributes[key], due[key]):
            yield Violation(
                file=look.path.name,
                what=f"attribute {key} must be that of {of.get(key, FILE_NAME)}",
                got=f"another; run `drakegrasp {'scenes' if scenes else 'assemble'}` again",
            )
            return  # other differences follow from this one


def _seal(path: Path) -> list[Violation]:
    """Return a violation if a file is not as it was written."""
    found = list[Violation]()
    with _reported(found, path.name, "the file must be as it was written"):
        refuse_broken_seal(path, "file", None)
    return found


def _samples(path: Path) -> list[Violation]:
    """Return a violation if the samples of a data file are not the kept successes, each once."""
    found, what = list[Violation](), "the samples must be the successes that no filter removes"
    with _reported(found, path.name, what):
        with open_samples(path) as file:
            ids = np.concatenate([file[split]["trial_id"][:] for split in SPLITS])
        kept = np.flatnonzero(Trials(path.parent)["removal"] == Removal.KEPT)
        if not np.array_equal(np.sort(ids), kept):
            raise DataError(f"they must be {len(kept)}, got {len(ids)}, some of them others")
    return found


def _card(out: Path) -> Iterator[Violation]:
    """The counts of the data card match the files; a dataset may have no card."""
    path = out / CARD_FILES[0]
    try:
        found = read_json(path)["counts"]
    except FileNotFoundError:
        return
    except (OSError, ValueError, KeyError, TypeError) as error:
        found = first_line(error)
    if found != card_counts(out):
        what = "the data card must count what the files hold"
        got = "others; `drakegrasp assemble` writes it anew"
        yield Violation(file=path.name, what=what, got=got)


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
    with _reported(found, names[plan], "the plan must be as it was written"):
        expected = recorded_model(out, entry.name)
        with _reported(found, names[model], "the meshes must be as they were written"):
            refuse_changed_model(out, entry.name, expected)
    with _reported(found, names[model], f"the meshes must be those of {FILE_NAME}"):
        if (sha256 := load_object(model).mesh_sha256) != entry.mesh_sha256:
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
        with _reported(found, HAND_FOLDER, f"the hand must be that of {FILE_NAME}"):
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
