"""Which work units an earlier build has done.

In: the work units of an object. Out: the outcomes of those whose shard is whole, and what is wrong
with the others that are there. A task lists the folder of an object once and verifies the seals of
its shards, so a build that goes on looks at them with all its workers.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from drakegrasp.config import Config
from drakegrasp.dataset.assembly.survey import SurveyTask, count_samples, survey_tasks
from drakegrasp.dataset.manifest import Manifest
from drakegrasp.dataset.paths import shards_folder
from drakegrasp.dataset.shards import ShardHeader
from drakegrasp.errors import DataError
from drakegrasp.generation.counts import has_target
from drakegrasp.generation.work_unit import find_outcomes
from drakegrasp.outcomes import Outcome


@dataclass(frozen=True, kw_only=True)
class FoundUnits:
    """What is there of an object.

    Attributes:
        done: The work units whose shard is whole, with their numbers of attempts by outcome and of
            samples, None if there is no target of them.
        damaged: Path within the dataset of each other shard, and what is wrong with it.
    """

    done: tuple[tuple[ShardHeader, dict[Outcome, int], int | None], ...]
    damaged: tuple[tuple[str, str], ...]


def find_tasks(out: Path, manifest: Manifest) -> Iterator[SurveyTask]:
    """Yield the task of each object of which there may be a shard."""
    try:
        folders = set(os.listdir(out / "shards"))
    except FileNotFoundError:
        return
    for task in survey_tasks(out, manifest):
        if shards_folder(out, task.headers[0].object_name).name in folders:
            yield task


def find_units(config: Config, task: SurveyTask) -> FoundUnits:
    """Look at the shards of an object of a dataset, up to its last wanted grasp."""
    out, done, damaged = Path(task.out), [], []
    names = set(os.listdir(shards_folder(out, task.headers[0].object_name)))
    grasps, unbroken = 0, True
    for header in task.headers:
        # Enough grasps in the units before the first gap: no other unit is needed.
        if task.wanted is not None and grasps >= task.wanted:
            break

        # A file that is not listed is not opened.
        try:
            outcomes = find_outcomes(out, header) if header.file_name in names else None
        except DataError as error:
            damaged.append((str(header.path(out).relative_to(out)), str(error)))
            outcomes = None
        if outcomes is None:
            unbroken = False
            continue

        # A process may have died after it wrote the shard and before it removed the journal.
        if header.journal_path(out).name in names:
            header.journal_path(out).unlink(missing_ok=True)
        samples = count_samples(out, header, config) if has_target(config) else None
        done.append((header, outcomes, samples))
        grasps += outcomes.get(Outcome.SUCCESS, 0) * unbroken
    return FoundUnits(done=tuple(done), damaged=tuple(damaged))
