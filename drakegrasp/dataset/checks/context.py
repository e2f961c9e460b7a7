"""What the steps of a check share: findings, progress, tasks, and the dataset around a file.

In: a dataset's directory and its manifest. Out: objects by name, violations that are collected,
progress that is reported, and rows that are judged in tasks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt

from drakegrasp.dataset.checks.findings import Findings, Violation, of_file
from drakegrasp.dataset.checks.open_file import OpenFile
from drakegrasp.dataset.manifest import Manifest
from drakegrasp.dataset.paths import FILE_NAME, model_path
from drakegrasp.errors import MeshError, first_line
from drakegrasp.objects.model import ObjectModel, load_object
from drakegrasp.runtime.executor import Executor
from drakegrasp.runtime.progress import Report

#: Objects whose meshes, with their search trees, stay in memory; samples are ordered by object.
KEPT_OBJECTS = 4


class _LoadModel(Protocol):
    def __call__(self, name: str, /) -> ObjectModel | None: ...


@dataclass(frozen=True, kw_only=True, eq=False)
class Dataset:
    """The dataset around a file that is checked.

    Attributes:
        out: Its directory.
        manifest: Its manifest.
        trials: Its trials.hdf5, if it can be opened.
        findings: Where violations of its objects' files go.
    """

    out: Path
    manifest: Manifest
    trials: OpenFile | None
    findings: Findings

    @property
    def names(self) -> list[str]:
        """Names of the objects, by row of /objects."""
        return [entry.name for entry in self.manifest.objects]

    @cached_property
    def model(self) -> _LoadModel:
        """Function that returns an object by name, or None if its file is broken."""
        return lru_cache(KEPT_OBJECTS)(partial(_load_model, self))


@dataclass(kw_only=True, eq=False)
class Context:
    """A check while it runs.

    Attributes:
        findings: Where violations go.
        report: Called with the number of rows and shards that are done and to do.
        total: Number of rows and shards to do.
        execute: Runs the tasks.
        dataset: The dataset around the file; None if a file is checked alone.
        done: Number of rows and shards that are done.
    """

    findings: Findings
    report: Report
    total: int
    execute: Executor
    dataset: Dataset | None = None
    done: int = 0

    def advance(self, count: int) -> None:
        """Report that more rows or shards are done."""
        self.done += count
        self.report(self.done, self.total)

    def add(self, file: OpenFile, violations: Iterator[Violation]) -> None:
        """Collect violations of whole columns of a file, which may turn out unreadable."""
        try:
            self.findings.add(violations)
        except (OSError, UnicodeDecodeError) as error:
            what = "all columns must be readable"
            self.findings.add([of_file(file.name, what, first_line(error))])


#: Applies rules to the rows of a task; returns the numbers of rows that the next steps need.
Judge = Callable[["RowsTask", Findings], npt.NDArray[np.int64]]


@dataclass(frozen=True, kw_only=True, eq=False)
class RowsTask:
    """Rows of a group to which rules are to be applied, by any process.

    Attributes:
        judge: Applies the rules.
        file: The file.
        group: The group.
        start, stop: The rows, without the last number.
        dataset: The dataset around the file, if there is one.
    """

    judge: Judge
    file: OpenFile
    group: str
    start: int
    stop: int
    dataset: Dataset | None


@dataclass(frozen=True, kw_only=True, eq=False)
class RowsFound:
    """What a task found.

    Attributes:
        task_start, rows: First row of the task, and how many it had.
        findings: Its violations.
        bad: (n,), rows that break a rule or cannot be read.
        noted: (m,), what its judge returned.
    """

    task_start: int
    rows: int
    findings: Findings
    bad: npt.NDArray[np.int64]
    noted: npt.NDArray[np.int64]


def judge_rows(
    tasks: Iterable[RowsTask], file: OpenFile, group: str, context: Context
) -> npt.NDArray[np.int64]:
    """Judge the rows of a group in tasks; return what their judges noted, in the order of rows.

    Args:
        tasks: For rows of the group, together all of them.
        file: The file; it remembers the bad rows.
        group: The group.
        context: Takes the violations.
    """
    results = []
    for found in context.execute(_judge, tasks):
        results.append(found)
        context.advance(found.rows)
    results.sort(key=lambda found: found.task_start)
    for found in results:
        context.findings.merge(found.findings)
    for rows in (found.bad for found in results if len(found.bad)):
        file.mark_bad(group, rows)
    return np.concatenate([np.zeros(0, dtype=np.int64), *(found.noted for found in results)])


def _judge(task: RowsTask) -> RowsFound:
    findings, file, dataset = Findings(), replace(task.file, bad_rows={}), task.dataset
    dataset = None if dataset is None else replace(dataset, findings=findings)
    noted = task.judge(replace(task, file=file, dataset=dataset), findings)
    return RowsFound(
        task_start=task.start,
        rows=task.stop - task.start,
        findings=findings,
        bad=file.bad(task.group),
        noted=noted,
    )


def _load_model(dataset: Dataset, name: str) -> ObjectModel | None:
    """Return an object of a dataset; a broken or wrong file is a finding."""
    path = model_path(dataset.out, name)
    file = str(path.relative_to(dataset.out))
    try:
        model = load_object(path)
    except MeshError as error:
        dataset.findings.add([of_file(file, "the object must be readable", str(error))])
        return None
    hashes = {entry.name: entry.mesh_sha256 for entry in dataset.manifest.objects}
    if hashes.get(name) != model.mesh_sha256:
        what = f"mesh_sha256 must be that of {FILE_NAME}"
        dataset.findings.add([of_file(file, what, model.mesh_sha256)])
    return model
