"""What the steps of a check share: findings, progress, tasks, and the dataset around a file.

In: a dataset's directory and its manifest. Out: objects by name, violations that are collected,
progress that is reported, and rows that are judged in tasks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from drakegrasp.dataset.checks.findings import Findings, Violation, of_file
from drakegrasp.dataset.checks.open_file import FilePlace, OpenFile
from drakegrasp.dataset.manifest import Manifest
from drakegrasp.dataset.paths import FILE_NAME, model_path
from drakegrasp.errors import MeshError, first_line
from drakegrasp.objects.model import ObjectModel, load_object
from drakegrasp.runtime.executor import Executor, in_order
from drakegrasp.runtime.progress import Report

#: Objects whose meshes, with their search trees, stay in memory during a task; samples are ordered
#: by object.
KEPT_OBJECTS = 4


#: Returns an object by its name, or None if its file is broken, which is a finding.
LoadModel = Callable[[str], ObjectModel | None]


@dataclass(frozen=True, kw_only=True, eq=False)
class Dataset:
    """The dataset around a file that is checked.

    Attributes:
        out: Its directory.
        manifest: Its manifest.
        trials: Its trials.hdf5, if it can be opened.
    """

    out: Path
    manifest: Manifest
    trials: OpenFile | None

    @property
    def names(self) -> list[str]:
        """Names of the objects, by row of /objects."""
        return [entry.name for entry in self.manifest.objects]

    @property
    def groups(self) -> dict[str, str]:
        """Group of each object by its name."""
        return dict(zip(self.names, self.manifest.groups, strict=True))

    @property
    def meshes(self) -> dict[str, str]:
        """Name of the mesh of each object by its name."""
        return {entry.name: entry.mesh_name for entry in self.manifest.objects}


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


@dataclass(frozen=True, kw_only=True, eq=False)
class Rows:
    """Rows of a group, in the process that judges them.

    Attributes:
        file: The file.
        group: The group.
        start, stop: The rows, without the last number.
        dataset: The dataset around the file, if there is one.
        model: Loads an object of that dataset.
    """

    file: OpenFile
    group: str
    start: int
    stop: int
    dataset: Dataset | None
    model: LoadModel


#: Applies rules to rows; returns the numbers of rows that the next steps need.
Judge = Callable[[Rows, Findings], npt.NDArray[np.int64]]


@dataclass(frozen=True, kw_only=True, eq=False)
class RowsTask:
    """Rows of a group to which rules are to be applied, by any process.

    Attributes:
        judge: Applies the rules.
        file: The file.
        group: The group.
        start, stop: The rows, without the last number.
        out, manifest: Of the dataset around the file, if there is one.
        trials: The trials of that dataset, with the bad ones among those that count here.
    """

    judge: Judge
    file: FilePlace
    group: str
    start: int
    stop: int
    out: Path | None = None
    manifest: Manifest | None = None
    trials: FilePlace | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class RowsFound:
    """What a task found.

    Attributes:
        group, rows: The group, and how many rows of it the task had.
        findings: Its violations.
        bad: (n,), rows that break a rule or cannot be read.
        noted: (m,), what its judge returned.
    """

    group: str
    rows: int
    findings: Findings
    bad: npt.NDArray[np.int64]
    noted: npt.NDArray[np.int64]


def judge_rows(
    tasks: Iterable[RowsTask], file: OpenFile, context: Context
) -> npt.NDArray[np.int64]:
    """Judge rows of a file in tasks; return what their judges noted, in the order of the tasks.

    Args:
        tasks: The tasks.
        file: The file; it remembers the bad rows.
        context: Takes the violations, in the order of the tasks.
    """
    bad: dict[str, list[npt.NDArray[np.int64]]] = {group: [] for group in file.groups}
    noted = [np.zeros(0, dtype=np.int64)]
    for found in in_order(context.execute)(_judge, tasks):
        context.advance(found.rows)
        context.findings.merge(found.findings)
        bad[found.group].append(found.bad)
        noted.append(found.noted)
    for group, parts in bad.items():
        file.mark_bad(group, np.concatenate([np.zeros(0, dtype=np.int64), *parts]))
    return np.concatenate(noted)


def _judge(task: RowsTask) -> RowsFound:
    findings = Findings()
    with ExitStack() as stack:
        file = stack.enter_context(task.file.opened())

        # The dataset around it. Its objects are loaded for this task alone.
        dataset, hashes = None, dict[str, str]()
        if task.out is not None and task.manifest is not None:
            trials = None if task.trials is None else stack.enter_context(task.trials.opened())
            dataset = Dataset(out=task.out, manifest=task.manifest, trials=trials)
            hashes = {entry.name: entry.mesh_sha256 for entry in task.manifest.objects}
        load = partial(_load_model, task.out or Path(), hashes, findings)

        rows = Rows(
            file=file,
            group=task.group,
            start=task.start,
            stop=task.stop,
            dataset=dataset,
            model=lru_cache(KEPT_OBJECTS)(load),
        )
        noted = task.judge(rows, findings)
        return RowsFound(
            group=task.group,
            rows=task.stop - task.start,
            findings=findings,
            bad=file.bad(task.group),
            noted=noted,
        )


def _load_model(
    out: Path, hashes: dict[str, str], findings: Findings, name: str
) -> ObjectModel | None:
    """Return an object of a dataset; a broken or wrong file is a finding."""
    path = model_path(out, name)
    file = str(path.relative_to(out))
    try:
        model = load_object(path)
    except MeshError as error:
        findings.add([of_file(file, "the object must be readable", str(error))])
        return None
    if hashes.get(name) != model.mesh_sha256:
        what = f"mesh_sha256 must be that of {FILE_NAME}"
        findings.add([of_file(file, what, model.mesh_sha256)])
    return model
