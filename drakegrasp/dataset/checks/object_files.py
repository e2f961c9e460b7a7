"""Rules of the files of an object: its meshes, its plan and its shards are as they were written.

In: an object of a dataset and its work units. Out: violations, one for each file, and the survey of
its shards, which assembling begins with. A task verifies the files of one object.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from drakegrasp.config import CarriedHand
from drakegrasp.dataset.assembly.survey import Survey, SurveyTask, survey_object, survey_tasks
from drakegrasp.dataset.checks.findings import Findings, Violation, of_file
from drakegrasp.dataset.manifest import Manifest, ObjectEntry
from drakegrasp.dataset.paths import (
    FILE_NAME,
    model_path,
    plan_path,
    recorded_model,
    refuse_changed_model,
)
from drakegrasp.dataset.shards import read_trials
from drakegrasp.errors import DataError, HandError, MeshError, first_line
from drakegrasp.hand.carried import HAND_FOLDER
from drakegrasp.hand.folder import hand_digest
from drakegrasp.objects.model import load_object
from drakegrasp.outcomes import Outcome


@dataclass(frozen=True, kw_only=True)
class ObjectTask:
    """An object whose files are to be verified.

    Attributes:
        out: Directory of the dataset.
        entry: The object.
        shards: The survey of its shards; None if it has no palm pose.
    """

    out: Path
    entry: ObjectEntry
    shards: SurveyTask | None


def object_tasks(out: Path, manifest: Manifest) -> Iterator[ObjectTask]:
    """Yield the task of each object."""
    surveys = {task.object: task for task in survey_tasks(out, manifest)}
    for i, entry in enumerate(manifest.objects):
        yield ObjectTask(out=out, entry=entry, shards=surveys.get(i))


def check_object(task: ObjectTask) -> tuple[Findings, bool, Survey | None]:
    """Verify the files of an object.

    Returns:
        The violations, whether its meshes can be read, and the survey of its shards; None where
        one is missing or broken, or there is none.
    """
    findings, survey = Findings(), None
    readable = not findings.add(_meshes(task.out, task.entry)) and not findings
    findings.add(_as_written(task.out, task.entry.name))
    if task.shards is not None:
        try:
            survey = survey_object(task.shards)
        except DataError:
            findings.add(_broken_shards(task.shards))
    return findings, readable, survey


def carried_hand_as_built(manifest: Manifest) -> Iterator[Violation]:
    """The hand that the dataset carries is the one that built it."""
    source, what = manifest.config.hand_source, f"the hand must be that of {FILE_NAME}"
    if not isinstance(source, CarriedHand):
        return  # an older dataset carries none
    try:
        found = hand_digest(source)
    except HandError as error:
        yield of_file(HAND_FOLDER, what, first_line(error).rpartition(", got ")[2])
        return
    if found != source.digest:
        yield of_file(HAND_FOLDER, f"{what}, {source.digest}", found)


def _meshes(out: Path, entry: ObjectEntry) -> Iterator[Violation]:
    """The meshes can be read, and are those of the manifest."""
    path = model_path(out, entry.name)
    try:
        found = load_object(path).mesh_sha256
    except MeshError as error:
        yield of_file(str(path.relative_to(out)), "the object must be readable", error)
        return
    if found != entry.mesh_sha256:
        what = f"mesh_sha256 must be that of {FILE_NAME}"
        yield of_file(str(path.relative_to(out)), what, found)


def _as_written(out: Path, name: str) -> Iterator[Violation]:
    """The meshes and the plan are as they were written: the plan vouches for both."""
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
    """The shards are there and whole, up to the last wanted grasp."""
    out, left = Path(task.out), task.wanted
    for header in task.headers:
        if left is not None and left <= 0:
            return
        path = header.path(out)
        try:
            outcome = read_trials(path, header, ("outcome",), complete=True)["outcome"]
        except DataError as error:
            what = "the shard must be there, whole and of its work unit"
            got = str(error).rpartition(", got ")[2] if path.exists() else "none"
            yield of_file(str(path.relative_to(out)), what, got)
            continue
        if left is not None:
            left -= int((outcome == Outcome.SUCCESS).sum())
