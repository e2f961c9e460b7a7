"""Rules of the files of an object: its meshes, its plan and its shards are as they were written.

In: an object of a dataset and its work units. Out: violations, one for each file. A task verifies
the files of one object.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from drakegrasp.dataset.assembly.survey import headers_by_object
from drakegrasp.dataset.checks.findings import Findings, Violation, of_file
from drakegrasp.dataset.manifest import Manifest
from drakegrasp.dataset.paths import refuse_changed_object
from drakegrasp.dataset.shards import ShardHeader, read_trials
from drakegrasp.errors import DataError
from drakegrasp.outcomes import Outcome


@dataclass(frozen=True, kw_only=True)
class ObjectTask:
    """An object whose files are to be verified.

    Attributes:
        out: Directory of the dataset.
        object: Row of the object in the manifest.
        name: Its name.
        headers: Its work units, in the order of their candidates.
        wanted: Number of grasps after which its shards end; None for all of them.
    """

    out: str
    object: int
    name: str
    headers: tuple[ShardHeader, ...]
    wanted: int | None


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectFound:
    """What is wrong with the files of an object.

    Attributes:
        object: Row of the object in the manifest.
        units: Number of its work units.
        findings: The violations.
    """

    object: int
    units: int
    findings: Findings


def object_tasks(out: Path, manifest: Manifest) -> Iterator[ObjectTask]:
    """Yield the task of each object."""
    pairs = zip(manifest.objects, headers_by_object(manifest), strict=True)
    for i, (entry, headers) in enumerate(pairs):
        yield ObjectTask(
            out=str(out),
            object=i,
            name=entry.name,
            headers=headers,
            wanted=manifest.config.max_grasps,
        )


def check_object(task: ObjectTask) -> ObjectFound:
    """Verify the files of an object."""
    findings = Findings()
    findings.add(_own_files(task))
    findings.add(_shards(task))
    return ObjectFound(object=task.object, units=len(task.headers), findings=findings)


def _own_files(task: ObjectTask) -> Iterator[Violation]:
    """The meshes and the plan are as they were written: the plan vouches for both."""
    out = Path(task.out)
    try:
        refuse_changed_object(out, task.name)
    except DataError as error:
        path, _, got = str(error).partition(": ")
        what = "an object's file must be as it was written"
        yield of_file(str(Path(path).relative_to(out)), what, got)


def _shards(task: ObjectTask) -> Iterator[Violation]:
    """The shards are there and whole, up to the last wanted grasp."""
    out, left = Path(task.out), task.wanted
    for header in task.headers:
        if left is not None and left <= 0:
            return
        path = header.path(out)
        try:
            # The seal is of the bytes that were written, so nothing is unpacked to verify it.
            outcome = read_trials(path, header, ("outcome",), complete=True)["outcome"]
        except DataError as error:
            what = "the shard must be there, whole and of its work unit"
            got = str(error).rpartition(", got ")[2] if path.exists() else "none"
            yield of_file(str(path.relative_to(out)), what, got)
            continue
        if left is not None:
            left -= int((outcome == Outcome.SUCCESS).sum())
