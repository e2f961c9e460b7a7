"""`drakegrasp check`: every rule on every row of a dataset, or of one of its files.

Input: a dataset's directory, or one of the files grasping_oto.hdf5, grasping_otm.hdf5, trials.hdf5
and scenes.hdf5. Output: a list of violations, empty for a valid dataset. Rows are read in batches,
which bounds the memory, and an `Executor` judges them in tasks. Does not import Drake.

The files of a whole dataset are first compared with what assembling its shards again produces:
samples are derived by the functions that write them, and stored images are compared byte for byte.
All other rules compare values with each other: verdicts, poses, images, meshes. `trials`, `samples`
and `scenes` apply them in stages, see `rows`.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from itertools import zip_longest
from pathlib import Path

import h5py
import numpy as np

from drakegrasp.config import CarriedHand
from drakegrasp.dataset.assembly.pack import (
    TASK_ROWS,
    PackTask,
    pack_tasks,
    read_rows,
    sample_texts,
)
from drakegrasp.dataset.assembly.survey import (
    Decisions,
    Survey,
    SurveyTask,
    decide,
    file_attributes,
    number_rows,
    object_columns,
    survey_object,
    survey_tasks,
)
from drakegrasp.dataset.card import card_counts
from drakegrasp.dataset.checks import scenes
from drakegrasp.dataset.checks.rows import (
    SCENES,
    AnyArray,
    Batch,
    Check,
    CheckedFile,
    Dataset,
    Findings,
    Task,
    Violation,
    look_at,
    of_file,
)
from drakegrasp.dataset.checks.samples import samples_tasks, splits
from drakegrasp.dataset.checks.trials import successes, trial_rules
from drakegrasp.dataset.hdf5 import open_hdf5, unpacked_chunk
from drakegrasp.dataset.manifest import Manifest, ObjectEntry, read_manifest
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
from drakegrasp.dataset.schema import CAMERAS, refuse_other_schema
from drakegrasp.dataset.shards import read_trials
from drakegrasp.errors import DataError, HandError, MeshError, first_line
from drakegrasp.filters import Removal
from drakegrasp.foreign_files import read_json
from drakegrasp.hand.folder import HAND_FOLDER, hand_digest
from drakegrasp.objects.model import load_object
from drakegrasp.runtime.executor import Executor, in_order, run_here
from drakegrasp.runtime.files import refuse_half_replaced
from drakegrasp.runtime.progress import Report, silent

__all__ = ["Violation", "check_dataset"]

#: Attributes that identify the state of a dataset that a file belongs to; a cause of other
#: differences comes first.
ORIGIN = ("config", "split_by", "versions", "fingers", "joints", "shards", "signature")
#: Trials in a batch: about 10 MB.
TRIAL_ROWS = 8192


def check_dataset(
    path: str | Path, *, execute: Executor = run_here, progress: Report | None = None
) -> list[Violation]:
    """Return every broken invariant of a dataset or of one of its files.

    Args:
        path: Directory of a dataset, or one of its HDF5 files. For a single file, all rules that
            need no other file are checked.
        execute: Executor of the tasks; the result does not depend on it.
        progress: Called with two numbers: the finished rows and shards, and all of them.

    Raises:
        DataError: If the path is neither, cannot be read, or has another schema. In a directory, a
            file that cannot be read is a violation, and the other files are still checked.
    """
    check = Check(execute=execute, report=progress or silent)
    if Path(path).is_dir():
        _check_directory(Path(path), check)
    else:
        _check_file(Path(path), check)
    return check.findings.violations()


def _check_file(path: Path, check: Check) -> None:
    """Check a single file."""
    try:
        file = open_hdf5(path)
    except OSError as error:
        raise DataError(
            f"{path}: must be the directory of a dataset or one of its HDF5 files, "
            f"got one that cannot be read ({first_line(error)})"
        ) from None

    # The attributes tell which of the files it is, whatever its name.
    with file:
        camera = str(file.attrs.get("camera", ""))
        if "scenes" in file and "views" in file:
            camera = SCENES
        elif camera not in CAMERAS:
            camera = ""
        if not camera and "trials" not in file:
            raise DataError(
                f"{path}: must be a data file or the trials of a dataset, got another HDF5 file"
            )
        refuse_other_schema(path, file.attrs.get("schema_version"))
        files = {camera: look_at(path.name, file, camera, check.findings)}
    if camera == SCENES:
        scenes.judge(files[SCENES], check, None)
        return
    check.total = _rows(files)
    _check_rows(files, check)


def _check_directory(out: Path, check: Check) -> None:
    """Check the files of a dataset against its objects, its shards and each other."""
    manifest = read_manifest(out)
    names = (*DATA_FILES.items(), ("", TRIALS_FILE))
    looked = {camera: _look_at(out, camera, name, check.findings) for camera, name in names}
    files = {camera: file for camera, file in looked.items() if file is not None}
    check.total = _rows(files) + sum(entry.candidates for entry in manifest.objects)

    # The files that all other files follow from.
    objects, surveys = set[str](), []
    shards = {task.object: task for task in survey_tasks(out, manifest)}
    tasks = ((out, entry, shards.get(i)) for i, entry in enumerate(manifest.objects))
    results = in_order(check.execute)(_check_object, tasks)
    for entry, (found, readable, survey) in zip(manifest.objects, results, strict=True):
        check.findings.merge(found)
        check.advance(entry.candidates)
        objects |= {entry.name} if readable else set()
        surveys += [] if survey is None else [survey]
    check.findings.add(carried_hand_as_built(manifest))
    dataset = Dataset(out=out, manifest=manifest, readable=frozenset(objects))
    sound = len(surveys) == sum(entry.candidates > 0 for entry in manifest.objects)
    sound &= len(surveys) > 0 and len(objects) == len(manifest.objects)
    again = _assemble_again(manifest, surveys, files.get("")) if sound else None

    # Files of another state of the dataset are not compared row by row.
    current = set()
    for camera, file in files.items():
        other = [*_of_another_state(file, manifest, again)]
        check.findings.add(other)
        if file.config is not None and not other:
            current.add(camera)
    if (trials := files.get("")) is not None:
        decided = again if "" in current else None
        with check.readable(trials):
            _objects_and_successes(trials, manifest, decided, check.findings)
    _check_rows(files, check, dataset, again, frozenset(current))
    if (out / SCENES_FILE).exists() and (
        shown := _look_at(out, SCENES, SCENES_FILE, check.findings)
    ):
        # Grasps are not compared with broken trials.
        scenes.judge(shown, check, dataset if "" in current else None)
    if not check.findings:
        _check_card(out, check.findings)  # with other findings, it would differ for the same cause


def _check_rows(
    files: Mapping[str, CheckedFile],
    check: Check,
    dataset: Dataset | None = None,
    again: Decisions | None = None,
    current: frozenset[str] = frozenset(),
) -> None:
    """Judge all rows of some files: first the attempts, then the samples.

    Args:
        files: The files by camera; the trials are under "".
        check: Runs the tasks, and takes the violations.
        dataset: The dataset around the files, if there is one.
        again: The dataset assembled again, if its shards are valid.
        current: Cameras of the files that match the dataset's manifest and shards, "" for the
            trials. These files are compared with the dataset assembled again, or else with each
            other.
    """
    compared = frozenset() if again is None else current
    check.judge(_trials_tasks(files, dataset, again, compared))
    entries = dataset.manifest.objects if dataset else ()
    for camera, file in files.items():
        if camera:
            both = {"", camera} <= current - compared and "trials" in files[""].counts
            trials = files[""] if both else None
            check.judge(samples_tasks(file, dataset, trials, check.findings))
        # Compared files follow from the shards; other files are judged by themselves.
        if camera not in compared:
            with check.readable(file):
                known = {entry.name: entry for entry in entries}
                check.findings.add(splits(file, known) if camera else successes(file))


def _look_at(out: Path, camera: str, name: str, findings: Findings) -> CheckedFile | None:
    """Return the description of a file of a dataset, or None if the file cannot be read."""
    try:
        with open_hdf5(out / name) as file:
            return look_at(name, file, camera, findings)
    except OSError as error:
        got = first_line(error) if (out / name).exists() else "none; `drakegrasp assemble`"
        findings.add([of_file(name, "the file must be there and readable", got)])
    except DataError as error:
        # The file stores values outside of itself. If files are half replaced, this concerns all.
        refuse_half_replaced(out)
        got = first_line(error).rpartition(", got ")[2]
        findings.add([of_file(name, "the file must hold its own values", got)])
    return None


def _check_card(out: Path, findings: Findings) -> None:
    """The counts of the data card match the files; older datasets have no card."""
    path = out / CARD_FILES[0]
    try:
        counts = card_counts(out)
    except (DataError, ValueError, IndexError):
        return  # a file is damaged, which is already a finding
    try:
        found = read_json(path)["counts"]
    except FileNotFoundError:
        return
    except (OSError, ValueError, KeyError, TypeError) as error:
        found = first_line(error)
    if found != counts:
        what = "the data card must count what the files hold"
        findings.add([of_file(path.name, what, "others; `drakegrasp assemble` writes it anew")])


def _rows(files: Mapping[str, CheckedFile]) -> int:
    """Return the number of samples and trials of some files."""
    counts = (item for file in files.values() for item in file.counts.items())
    return sum(count for group, count in counts if group not in ("objects", "successes"))


# Files of objects


def _check_object(
    task: tuple[Path, ObjectEntry, SurveyTask | None],
) -> tuple[Findings, bool, Survey | None]:
    """Verify the files of an object in a dataset's directory.

    Args:
        task: The directory, the object, and the task of its survey; None if the object has no palm
            pose.

    Returns:
        The violations; whether the object's meshes can be read; and the survey of its shards, None
        if a shard is missing or broken, or if there is no shard.
    """
    out, entry, shards = task
    findings, survey = Findings(), None
    findings.add(_meshes(out, entry))
    readable = not findings
    findings.add(_as_written(out, entry.name))
    if shards is not None:
        try:
            survey = survey_object(shards)
        except DataError:
            findings.add(_broken_shards(shards))
    return findings, readable, survey


def carried_hand_as_built(manifest: Manifest) -> Iterator[Violation]:
    """The hand in the dataset's directory is the hand that the dataset was built with."""
    source, what = manifest.config.hand_source, f"the hand must be that of {FILE_NAME}"
    if not isinstance(source, CarriedHand):
        return  # an older dataset does not contain its hand
    try:
        found = hand_digest(source)
    except HandError as error:
        yield of_file(HAND_FOLDER, what, first_line(error).rpartition(", got ")[2])
        return
    if found != source.digest:
        yield of_file(HAND_FOLDER, f"{what}, {source.digest}", found)


def _meshes(out: Path, entry: ObjectEntry) -> Iterator[Violation]:
    """The meshes can be read, and match the manifest."""
    path = model_path(out, entry.name)
    name = str(path.relative_to(out))
    try:
        found = load_object(path).mesh_sha256
    except MeshError as error:
        yield of_file(name, "the object must be readable", error)
        return
    if found != entry.mesh_sha256:
        yield of_file(name, f"mesh_sha256 must be that of {FILE_NAME}", found)


def _as_written(out: Path, name: str) -> Iterator[Violation]:
    """The meshes and the plan are unchanged; the plan has the hashes of both."""
    path = plan_path(out, name)
    try:
        expected = recorded_model(out, name)
        path = model_path(out, name)
        refuse_changed_model(out, name, expected)
    except (DataError, OSError) as error:
        what = "an object's file must be as it was written"
        got = first_line(error).removeprefix(f"{path}: ")
        yield of_file(str(path.relative_to(out)), what, got)


def _broken_shards(task: SurveyTask) -> Iterator[Violation]:
    """The shards exist and are complete."""
    out = Path(task.out)
    for header in task.headers:
        path = header.path(out)
        try:
            read_trials(path, header, ("outcome",), complete=True)
        except DataError as error:
            what = "the shard must be there, whole and of its work unit"
            got = str(error).rpartition(", got ")[2] if path.exists() else "none"
            yield of_file(str(path.relative_to(out)), what, got)


# What is decided again


def _assemble_again(
    manifest: Manifest, surveys: Sequence[Survey], trials: CheckedFile | None
) -> Decisions:
    """Decide again which successes are samples, from the surveys of all objects.

    Code of a dataset is never imported: which successes user-defined filters removed is read from
    `trials`, if it can be read.
    """
    shards, removed = number_rows(surveys, manifest), np.zeros(0, dtype=np.int64)
    if manifest.config.filters.own and trials is not None and "successes" in trials.counts:
        # Columns that cannot be read become a finding later.
        with suppress(OSError), trials.opened() as file:
            ids, reasons = (file["successes"][name][:] for name in ("trial_id", "removal"))
        removed = ids[reasons == Removal.OWN]
    own = np.isin(shards.successes["trial_id"], removed)
    return decide(manifest, shards, own)


def _of_another_state(
    file: CheckedFile, manifest: Manifest, again: Decisions | None
) -> Iterator[Violation]:
    """A file matches the manifest's configuration and the existing shards, with all their rows.

    Args:
        file: The file.
        manifest: Manifest of the dataset.
        again: The dataset assembled again; None if its shards are not all valid.
    """
    due = file_attributes(manifest, "" if again is None else again.shards.seals, file.camera)
    for key in ORIGIN:
        if key not in due or key not in file.attributes or (key == "shards" and again is None):
            continue
        if _rows_depend_on(key, str(file.attributes[key])) != _rows_depend_on(key, due[key]):
            of = "the shards that are there" if key == "shards" else FILE_NAME
            got = "another" if key in ("config", "signature") else file.attributes[key]
            got = f"{got}; run `drakegrasp assemble` again"
            yield of_file(file.name, f"attribute {key} must be that of {of}", got)
            return  # other differences follow from this one

    # The number of rows in each group.
    if again is None:
        return
    counts = {split: len(ids) for split, ids in again.ids.items()}
    if not file.camera:
        counts = {"trials": again.shards.count, "successes": len(again.removal)}
        counts["objects"] = len(manifest.objects)
    for group, number in counts.items():
        count = file.counts.get(group, number)
        if count != number:
            yield of_file(file.name, f"number of rows must be {number}", count, f"/{group}")


def _objects_and_successes(
    trials: CheckedFile, manifest: Manifest, again: Decisions | None, findings: Findings
) -> None:
    """Compare /objects with the manifest, and /successes with the decisions made again."""
    tables = {"objects": (object_columns(manifest), FILE_NAME)}
    if again is not None:
        tables["successes"] = again.columns(), "the shards, the filters and the split"
    with trials.opened() as file:
        for group, (columns, of) in tables.items():
            count = len(next(iter(columns.values())))
            if trials.counts.get(group) == count:  # else already a finding, or no group
                for batch in trials.batches(file, group, np.arange(count), count or 1, findings):
                    findings.add(batch.follow(columns, of))


# Rows


def _trials_tasks(
    files: Mapping[str, CheckedFile],
    dataset: Dataset | None = None,
    again: Decisions | None = None,
    compared: frozenset[str] = frozenset(),
) -> Iterator[Task]:
    """Yield the tasks that judge all attempts, and compare rows that follow from the shards.

    Args:
        files: The files by camera; the trials are under "", if they can be read.
        dataset: The dataset around the files, if there is one.
        again: The dataset assembled again, if its shards are valid.
        compared: Cameras of the files that are compared; "" for the trials.
    """
    # Attempts need their objects: an invalid layout of either is already a finding.
    trials = files.get("")
    sound = trials is not None and {"objects", "trials"} <= set(trials.counts)
    trials = trials if sound else None
    count = 0 if trials is None else trials.counts["trials"]

    # Each range of attempts comes with the task that derives its rows from the shards.
    packs: Iterator[PackTask] = iter(())
    if dataset is not None and again is not None and compared:
        certified = dataset.manifest.config.certified
        packs = pack_tasks(dataset.out, again, certified=certified)
    data = {camera: files[camera] for camera in CAMERAS if camera in compared}
    for start, pack in zip_longest(range(0, count, TASK_ROWS), packs):
        first = pack.start if start is None else start
        rows = np.arange(first, max(first, min(first + TASK_ROWS, count)))
        yield len(rows), partial(_judge, trials, rows, dataset, pack, "" in compared, data)


def _judge(
    trials: CheckedFile | None,
    rows: AnyArray,
    dataset: Dataset | None,
    pack: PackTask | None,
    compared: bool,
    data: Mapping[str, CheckedFile],
) -> Findings:
    """Apply every rule to a range of attempts, and compare the samples among them.

    Args:
        trials: trials.hdf5; None if it cannot be read.
        rows: (n,), rows of /trials.
        dataset: The dataset around the files, if there is one.
        pack: Task that derives the rows again; None if they cannot be compared.
        compared: Whether the attempts are compared as well.
        data: The compared data files, by camera.
    """
    findings = Findings()
    columns, records, images = ({}, {}, {}) if pack is None else read_rows(pack)
    if trials is not None and len(rows):
        stages = trial_rules(trials, dataset)
        with trials.opened() as file:
            for batch in trials.batches(file, "trials", rows, TRIAL_ROWS, findings):
                if compared and pack is not None:
                    own = {name: v[batch.rows - rows[0]] for name, v in columns.items()}
                    follow = partial(Batch.follow, columns=own, what="its shard")
                    batch = batch.judge(findings, [follow])
                batch.judge(findings, *stages)

    if dataset is not None and pack is not None:
        texts = sample_texts(dataset.manifest)
        for (split, camera), due in records.items():
            if camera in data and split in data[camera].counts:
                columns = {name: due[name] for name in due.dtype.names or () if name != "object"}
                columns |= {n: np.array(t, dtype=object)[due["object"]] for n, t in texts.items()}
                first, stored = pack.firsts[split], images[split, camera]
                _compare_samples(data[camera], split, first, columns, stored, findings)
    return findings


def _compare_samples(
    data: CheckedFile,
    split: str,
    first: int,
    due: Mapping[str, AnyArray],
    images: Mapping[str, Sequence[tuple[bytes, int]]],
    findings: Findings,
) -> None:
    """Compare some samples of a data file with the samples derived again.

    Args:
        data: The file.
        split: Name of the split.
        first: Row of the first sample.
        due: Columns of the samples derived again, without images.
        images: Stored images of these samples, see `assembly.pack.Images`.
        findings: Takes the violations.
    """
    rows = np.arange(first, first + len(due["trial_id"]))
    with data.opened() as file:
        for batch in data.batches(file, split, rows, max(len(rows), 1), findings, list(due)):
            # If a sample belongs to another trial, all its other fields differ as well.
            names = ["trial_id"], [name for name in due if name != "trial_id"]
            for own, of in zip(names, ("shards and manifest", "its trial"), strict=True):
                columns = {name: due[name][batch.rows - first] for name in own}
                batch = batch.judge(findings, [partial(Batch.follow, columns=columns, what=of)])
            for name, stored in images.items():
                differs = partial(_differs, file[split][name])
                bad = [differs(row, *stored[row - first]) for row in batch.rows.tolist()]
                what = f"{name} must be what the shard holds"
                other = np.array(bad, dtype=bool)
                findings.add(batch.broken(what, other, "another image"))
                batch = batch.where(~other)


def _differs(dataset: h5py.Dataset, row: int, chunk: bytes, skipped: int) -> bool:
    """Return whether an image differs from a chunk of a shard; mostly the bytes are equal."""
    try:
        stored = dataset.id.read_direct_chunk((row, *(0,) * (dataset.ndim - 1)))
    except RuntimeError:  # packed in another way, or missing
        stored = None
    if stored == (skipped, chunk):
        return False
    try:
        return not np.array_equal(dataset[row : row + 1], unpacked_chunk(chunk, skipped, dataset))
    except OSError:
        return False  # it cannot be read, which the rules of samples report


def _rows_depend_on(key: str, text: str) -> str:
    """Return an attribute without what rows do not depend on: the section `verify` of a config.

    That section is for predicted grasps, and may have changed since.
    """
    if key != "config":
        return text
    try:
        config = json.loads(text)
        config.pop("verify", None)
    except (AttributeError, ValueError):
        return text
    return json.dumps(config, sort_keys=True)
