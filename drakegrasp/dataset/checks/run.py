"""`drakegrasp check`: every rule on every row of a dataset, or of one of its files.

In: a dataset's directory, or grasping_oto.hdf5, grasping_otm.hdf5, trials.hdf5 or scenes.hdf5
alone. Out: a list of violations, empty for a sound dataset. Rows are read in batches, so the memory
is bounded, and judged in tasks, by an `Executor`. Imports no Drake.

Of a whole dataset the files are compared first with what assembling gives again of its shards
(`assembled`). All other rules do not ask how a value was made: verdicts, poses, images, meshes.
`trials`, `samples` and `scenes` apply them in an order, see `rows`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from drakegrasp.dataset.assembly.decisions import Decisions
from drakegrasp.dataset.card import card_counts
from drakegrasp.dataset.checks import scenes
from drakegrasp.dataset.checks.assembled import (
    assemble_again,
    carried_hand_as_built,
    check_object,
    object_tasks,
    objects_and_successes,
    of_another_state,
    trials_tasks,
)
from drakegrasp.dataset.checks.rows import (
    SCENES,
    Check,
    CheckedFile,
    Dataset,
    Findings,
    Violation,
    look_at,
    of_file,
)
from drakegrasp.dataset.checks.samples import samples_tasks, splits
from drakegrasp.dataset.checks.trials import successes
from drakegrasp.dataset.hdf5 import open_hdf5
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.paths import CARD_FILES, DATA_FILES, SCENES_FILE, TRIALS_FILE
from drakegrasp.dataset.schema import CAMERAS, refuse_other_schema
from drakegrasp.errors import DataError, first_line
from drakegrasp.foreign_files import read_json
from drakegrasp.runtime.executor import Executor, in_order, run_here
from drakegrasp.runtime.files import refuse_half_replaced
from drakegrasp.runtime.progress import Report, silent

__all__ = ["Violation", "check_dataset"]


def check_dataset(
    path: str | Path, *, execute: Executor = run_here, progress: Report | None = None
) -> list[Violation]:
    """Return every broken invariant of a dataset or of one of its files.

    Args:
        path: Directory of a dataset, or one of its HDF5 files. A file alone is checked for all
            that needs no other file.
        execute: Runs the tasks; the result is the same whatever runs them.
        progress: Called with the number of rows and shards that are done and to do.

    Raises:
        DataError: If the path is neither, cannot be read, or is of another schema. In a directory
            a file that cannot be read is a violation, and the others are still checked.
    """
    check = Check(execute=execute, report=progress or silent)
    if Path(path).is_dir():
        _check_directory(Path(path), check)
    else:
        _check_file(Path(path), check)
    return check.findings.violations()


def _check_file(path: Path, check: Check) -> None:
    """Check a file alone."""
    try:
        file = open_hdf5(path)
    except OSError as error:
        raise DataError(
            f"{path}: must be the directory of a dataset or one of its HDF5 files, "
            f"got one that cannot be read ({first_line(error)})"
        ) from None

    # Its attributes say which of the files it is, whatever its name.
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
    """Check the files of a dataset, each with its objects, its shards and the other files."""
    manifest = read_manifest(out)
    names = (*DATA_FILES.items(), ("", TRIALS_FILE))
    looked = {camera: _look_at(out, camera, name, check.findings) for camera, name in names}
    files = {camera: file for camera, file in looked.items() if file is not None}
    check.total = _rows(files) + sum(entry.candidates for entry in manifest.objects)

    # The files that all others follow from.
    objects, surveys = set[str](), []
    results = in_order(check.execute)(check_object, object_tasks(out, manifest))
    for entry, (found, readable, survey) in zip(manifest.objects, results, strict=True):
        check.findings.merge(found)
        check.advance(entry.candidates)
        objects |= {entry.name} if readable else set()
        surveys += [] if survey is None else [survey]
    check.findings.add(carried_hand_as_built(manifest))
    dataset = Dataset(out=out, manifest=manifest, readable=frozenset(objects))
    sound = len(surveys) == sum(entry.candidates > 0 for entry in manifest.objects)
    sound &= len(surveys) > 0 and len(objects) == len(manifest.objects)
    again = assemble_again(manifest, surveys, files.get("")) if sound else None

    # Files of another state are not compared row by row.
    current = set()
    for camera, file in files.items():
        other = [*of_another_state(file, manifest, again)]
        check.findings.add(other)
        if file.config is not None and not other:
            current.add(camera)
    if (trials := files.get("")) is not None:
        decided = again if "" in current else None
        with check.readable(trials):
            objects_and_successes(trials, manifest, decided, check.findings)
    _check_rows(files, check, dataset, again, frozenset(current))
    if (out / SCENES_FILE).exists() and (
        shown := _look_at(out, SCENES, SCENES_FILE, check.findings)
    ):
        # Grasps of broken trials are not compared.
        scenes.judge(shown, check, dataset if "" in current else None)
    if not check.findings:
        _check_card(out, check.findings)  # else it would differ for the same cause


def _check_rows(
    files: Mapping[str, CheckedFile],
    check: Check,
    dataset: Dataset | None = None,
    again: Decisions | None = None,
    current: frozenset[str] = frozenset(),
) -> None:
    """Judge all rows of some files, by camera: first the attempts, then what the samples show.

    Args:
        files: The files; the trials come under "".
        check: Runs the tasks, and takes the violations.
        dataset: The dataset around the files, if there is one.
        again: The dataset assembled again, if its shards are sound.
        current: Cameras of the files that are of the dataset's manifest and shards, "" for the
            trials. They are compared with what is assembled again, or else with each other.
    """
    compared = frozenset() if again is None else current
    check.judge(trials_tasks(files, dataset, again, compared))
    entries = dataset.manifest.objects if dataset else ()
    for camera, file in files.items():
        if camera:
            both = {"", camera} <= current - compared and "trials" in files[""].counts
            trials = files[""] if both else None
            check.judge(samples_tasks(file, dataset, trials, check.findings))
        # What is compared follows from the shards; other files are judged by themselves.
        if camera not in compared:
            with check.readable(file):
                known = {entry.name: entry for entry in entries}
                check.findings.add(splits(file, known) if camera else successes(file))


def _look_at(out: Path, camera: str, name: str, findings: Findings) -> CheckedFile | None:
    """Return a file of a dataset, if it can be read."""
    try:
        with open_hdf5(out / name) as file:
            return look_at(name, file, camera, findings)
    except OSError as error:
        got = first_line(error) if (out / name).exists() else "none; `drakegrasp assemble`"
        findings.add([of_file(name, "the file must be there and readable", got)])
    except DataError as error:
        # One with values elsewhere; that some files are half replaced concerns them all.
        refuse_half_replaced(out)
        got = first_line(error).rpartition(", got ")[2]
        findings.add([of_file(name, "the file must hold its own values", got)])
    return None


def _check_card(out: Path, findings: Findings) -> None:
    """The data card counts what the files hold; older datasets have no card."""
    path = out / CARD_FILES[0]
    try:
        counts = card_counts(out)
    except (DataError, ValueError, IndexError):
        return  # a file is damaged, and found above
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
