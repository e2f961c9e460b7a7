"""`drakegrasp check`: every rule on every row of a dataset, or of one of its files.

In: a dataset's directory, or grasping_oto.hdf5, grasping_otm.hdf5 or trials.hdf5 alone. Out: a
list of violations, empty for a sound dataset. Rows are read in batches, so the memory is bounded,
and judged in tasks, by an `Executor`. Imports no Drake.

The rules are in `layout`, `object_files`, `samples`, `hold`, `images`, `conditions`, `trials` and
`consistency`. `data_file`, `trials_file` and this module apply them in an order: a row that breaks
a rule is not shown to the rules that build on it, so the check reports the cause and not all that
follows from it.
"""

from __future__ import annotations

import json
from contextlib import ExitStack
from pathlib import Path

from drakegrasp.dataset.assembly.survey import join_seals
from drakegrasp.dataset.card.content import card_content
from drakegrasp.dataset.checks import consistency
from drakegrasp.dataset.checks.context import Context, Dataset
from drakegrasp.dataset.checks.data_file import check_data_file, check_pair
from drakegrasp.dataset.checks.findings import Findings, Violation, of_file
from drakegrasp.dataset.checks.object_files import check_object, object_tasks
from drakegrasp.dataset.checks.open_file import OpenFile, open_file
from drakegrasp.dataset.checks.trials_file import check_trials_file
from drakegrasp.dataset.hdf5 import open_hdf5
from drakegrasp.dataset.manifest import Manifest, read_manifest, refuse_older
from drakegrasp.dataset.paths import CARD_FILES, DATA_FILES, TRIALS_FILE
from drakegrasp.dataset.schema import CAMERAS, refuse_other_schema
from drakegrasp.errors import DataError, first_line
from drakegrasp.runtime.executor import Executor, in_order, run_here
from drakegrasp.runtime.file_set import refuse_half_replaced
from drakegrasp.runtime.progress import Report, silent

__all__ = ["Violation", "check_dataset"]


def check_dataset(
    path: str | Path, *, execute: Executor = run_here, progress: Report | None = None
) -> list[Violation]:
    """Return every broken invariant of a dataset or of one of its files.

    Args:
        path: Directory of a dataset, or one of its three HDF5 files. A file alone is checked for
            all that needs no other file.
        execute: Runs the tasks; the result is the same whatever runs them.
        progress: Called with the number of rows and shards that are done and to do.

    Raises:
        DataError: If the path is neither, cannot be read, or is of another schema. In a directory
            a file that cannot be read is a violation, and the others are still checked.
    """
    path, findings, report = Path(path), Findings(), progress or silent
    with ExitStack() as stack:
        if path.is_dir():
            _check_directory(path, stack, findings, report, execute)
        else:
            _check_file(path, stack, findings, report, execute)
    return findings.violations()


def _check_file(
    path: Path, stack: ExitStack, findings: Findings, report: Report, execute: Executor
) -> None:
    """Check a file alone."""
    try:
        file = stack.enter_context(open_hdf5(path))
    except OSError as error:
        raise DataError(
            f"{path}: must be the directory of a dataset or one of its HDF5 files, "
            f"got one that cannot be read ({first_line(error)})"
        ) from None

    # Its attributes say which of the files it is, whatever its name.
    camera = str(file.attrs.get("camera", ""))
    if camera not in CAMERAS and "trials" not in file:
        raise DataError(
            f"{path}: must be a data file or the trials of a dataset, got another HDF5 file"
        )
    refuse_other_schema(path, file.attrs.get("schema_version"))
    opened = open_file(path.name, file, camera if camera in CAMERAS else "", findings)
    context = Context(findings=findings, report=report, total=_rows(opened), execute=execute)
    if camera in CAMERAS:
        check_data_file(opened, camera, context)
    else:
        check_trials_file(opened, context)


def _check_directory(
    out: Path, stack: ExitStack, findings: Findings, report: Report, execute: Executor
) -> None:
    """Check the files of a dataset, each with its objects, its shards and the other files."""
    # Open the files; the trials come under the camera "".
    manifest = read_manifest(out)
    refuse_older(manifest, out)
    files = _open_files(out, stack, findings)
    rows = sum(map(_rows, files.values()))
    findings.add(consistency.same_configuration(files.values(), manifest))
    trials = files.pop("", None)
    dataset = Dataset(out=out, manifest=manifest, trials=trials)
    context = Context(
        findings=findings,
        report=report,
        total=rows + sum(entry.candidates for entry in manifest.objects),
        execute=execute,
        dataset=dataset,
    )

    # The files that all others follow from.
    shards = _check_objects(out, manifest, context)
    if shards is not None:
        findings.add(consistency.same_shards([*files.values(), *filter(None, [trials])], shards))

    # The trials come first: a sample of a broken trial is not compared with it.
    if trials is not None:
        check_trials_file(trials, context)
    for camera, data in files.items():
        check_data_file(data, camera, context)
        if trials is not None:
            context.add(data, consistency.kept_are_samples(data, trials))
            if not findings.violations():
                context.add(data, consistency.likeness(data, trials, manifest))
    if len(files) == len(CAMERAS) and all(data.config for data in files.values()):
        check_pair(files[CAMERAS[0]], files[CAMERAS[1]], findings)
    if not findings.violations():
        _check_card(out, findings)  # else it would differ for the same cause


def _open_files(out: Path, stack: ExitStack, findings: Findings) -> dict[str, OpenFile]:
    """Return the files of a dataset that can be read, by camera; the trials under ""."""
    files = {}
    for camera, name in (*DATA_FILES.items(), ("", TRIALS_FILE)):
        try:
            file = stack.enter_context(open_hdf5(out / name))
        except OSError as error:
            got = first_line(error) if (out / name).exists() else "none; `drakegrasp assemble`"
            findings.add([of_file(name, "the file must be there and readable", got)])
            continue
        except DataError as error:
            # One with values elsewhere; that some files are half replaced concerns them all.
            refuse_half_replaced(out)
            got = first_line(error).rpartition(", got ")[2]
            findings.add([of_file(name, "the file must hold its own values", got)])
            continue
        files[camera] = open_file(name, file, camera, findings)
    return files


def _check_objects(out: Path, manifest: Manifest, context: Context) -> str | None:
    """The files of each object are as they were written.

    Returns:
        What `shards_sha256` is; None where a shard is missing or broken.
    """
    seals, whole = dict[int, bytes](), True
    for found in in_order(context.execute)(check_object, object_tasks(out, manifest)):
        context.advance(found.candidates)
        context.findings.merge(found.findings)
        if found.seals is None:
            whole = False
        elif found.candidates:
            seals[found.object] = found.seals
    return join_seals(seals) if whole else None


def _check_card(out: Path, findings: Findings) -> None:
    """The data card counts what the files hold; older datasets have no card."""
    path = out / CARD_FILES[0]
    try:
        counts = card_content(out)["counts"]
    except (DataError, ValueError, IndexError):
        return  # a file is damaged, and found above
    try:
        found = json.loads(path.read_text(encoding="utf-8"))["counts"]
    except FileNotFoundError:
        return
    except (OSError, ValueError, KeyError, TypeError) as error:
        found = first_line(error)
    if found != counts:
        what = "the data card must count what the files hold"
        findings.add([of_file(path.name, what, "others; `drakegrasp assemble` writes it anew")])


def _rows(opened: OpenFile) -> int:
    """Return the number of samples or trials of a file."""
    return sum(opened.count(g) for g in opened.groups if g not in ("objects", "successes"))
