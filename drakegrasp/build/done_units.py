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

from drakegrasp.build.target import has_target
from drakegrasp.build.work_unit import find_outcomes
from drakegrasp.config import Config
from drakegrasp.dataset.assembly.survey import count_samples, headers_by_object
from drakegrasp.dataset.manifest import Manifest
from drakegrasp.dataset.paths import shards_folder
from drakegrasp.dataset.shards import ShardHeader
from drakegrasp.errors import DataError
from drakegrasp.outcomes import Outcome


@dataclass(frozen=True, kw_only=True)
class FindTask:
    """An object whose shards are looked at.

    Attributes:
        out: Directory of the dataset.
        headers: Its work units, in the order of their candidates.
        wanted: Number of grasps that it needs; None for all attempts.
        config: Of the dataset, if samples are counted.
    """

    out: str
    headers: tuple[ShardHeader, ...]
    wanted: int | None
    config: Config | None


@dataclass(frozen=True, kw_only=True)
class FoundUnits:
    """What is there of an object.

    Attributes:
        done: The work units whose shard is whole, with their numbers of attempts by outcome.
        samples: Number of samples of each of them, if they are counted.
        damaged: Path within the dataset of each other shard, and what is wrong with it.
    """

    done: tuple[tuple[ShardHeader, dict[Outcome, int]], ...]
    samples: tuple[int, ...]
    damaged: tuple[tuple[str, str], ...]


def find_tasks(out: Path, manifest: Manifest) -> Iterator[FindTask]:
    """Yield the task of each object of which there may be a shard."""
    counted = has_target(manifest.config)
    try:
        folders = set(os.listdir(out / "shards"))
    except FileNotFoundError:
        return
    for headers in headers_by_object(manifest):
        if headers and shards_folder(out, headers[0].object_name).name in folders:
            yield FindTask(
                out=str(out),
                headers=headers,
                wanted=manifest.config.max_grasps,
                config=manifest.config if counted else None,
            )


def find_units(task: FindTask) -> FoundUnits:
    """Look at the shards of an object, up to its last wanted grasp."""
    out, done, samples, damaged = Path(task.out), [], list[int](), []
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
        done.append((header, outcomes))
        if task.config is not None:
            samples.append(count_samples(out, header, task.config))
        grasps += outcomes.get(Outcome.SUCCESS, 0) * unbroken
    return FoundUnits(done=tuple(done), samples=tuple(samples), damaged=tuple(damaged))
