"""Rules of the files of an object: its meshes, its plan and its shards are as they were written.

In: an object of a dataset and its work units. Out: violations, one for each file. A task verifies
the files of one object.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from drakegrasp.dataset.assembly.survey import headers_by_object
from drakegrasp.dataset.checks.findings import Findings, Violation, of_file
from drakegrasp.dataset.manifest import Manifest
from drakegrasp.dataset.paths import model_path, plan_path, recorded_model, refuse_changed_model
from drakegrasp.dataset.shards import ShardHeader, read_trials
from drakegrasp.errors import DataError, first_line
from drakegrasp.outcomes import Outcome
from drakegrasp.runtime.files import read_seal


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
        candidates: Number of palm poses in its work units.
        findings: The violations.
        seals: What `Survey.seals` is; None where a shard is missing or broken.
    """

    object: int
    candidates: int
    findings: Findings
    seals: bytes | None


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
    findings, digest = Findings(), hashlib.sha256()
    findings.add(_own_files(task))
    broken = list(_shards(task, digest.update))
    findings.add(broken)
    return ObjectFound(
        object=task.object,
        candidates=sum(header.stop - header.start for header in task.headers),
        findings=findings,
        seals=None if broken else digest.digest(),
    )


def _own_files(task: ObjectTask) -> Iterator[Violation]:
    """The meshes and the plan are as they were written: the plan vouches for both."""
    out = Path(task.out)
    path = plan_path(out, task.name)
    try:
        expected = recorded_model(out, task.name)
        path = model_path(out, task.name)
        refuse_changed_model(out, task.name, expected)
    except (DataError, OSError) as error:
        what = "an object's file must be as it was written"
        got = first_line(error).removeprefix(f"{path}: ")
        yield of_file(str(path.relative_to(out)), what, got)


def _shards(task: ObjectTask, use_seal: Callable[[bytes], None]) -> Iterator[Violation]:
    """The shards are there and whole, up to the last wanted grasp; the seal of each is used."""
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
        use_seal(read_seal(path))
        if left is not None:
            left -= int((outcome == Outcome.SUCCESS).sum())
