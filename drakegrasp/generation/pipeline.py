"""Builds a dataset from meshes; an `Executor` does the work.

Input: a directory that this process holds, and meshes. Output: the dataset. `build` plans the work
and records the results. The executor runs two kinds of tasks: preparing an object and running a
work unit. The order in which results arrive does not change the files.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from drakegrasp.dataset.assemble import (
    Assembly,
    Survey,
    assemble_locked,
    is_assembled,
    survey,
)
from drakegrasp.dataset.manifest import (
    Manifest,
    ObjectEntry,
    RefusedMesh,
    release_directory,
    write_manifest,
)
from drakegrasp.dataset.prepared_objects import with_drawn
from drakegrasp.dataset.shards import ShardHeader
from drakegrasp.dataset.statistics import palms_in_files
from drakegrasp.dataset.successes import UnitSummary
from drakegrasp.errors import DataError, GraspError, counted, listed, printable
from drakegrasp.filters import Removal
from drakegrasp.frames import unpack_pose
from drakegrasp.generation.directory import BuildDirectory
from drakegrasp.generation.prepare import DrawTask, PrepareTask, draw_palms, find_entry, prepare_one
from drakegrasp.generation.target import Target
from drakegrasp.generation.work_unit import WorkUnit, find_tasks, find_units, run_unit
from drakegrasp.objects.sources import MeshSource, source_sha256
from drakegrasp.outcomes import Outcome
from drakegrasp.runtime.executor import Executor, WorkerPool
from drakegrasp.runtime.files import sweep_temporary
from drakegrasp.runtime.progress import Report, progress_bar
from drakegrasp.simulation.attempts import GraspTable, misfits

#: Outcomes of attempts that ended because of the machine or an error of the simulator.
ENDED = (Outcome.CRASHED, Outcome.TIMEOUT)
#: Fraction of an object's attempts from which on these outcomes cause a warning, and a number
#: below which they do not, unless all attempts end so. None of the millions of attempts behind the
#: benchmarks had such an outcome.
ENDED_SHARE, FEW_ENDED = 0.02, 10


class Counts:
    """Counts of completed work; their memory does not grow with the number of work units.

    Attributes:
        simulated: Work units that were run now.
        reused: Work units that were done before.
        damaged: Damaged shards.
        errors: Number of solver errors by message.
    """

    def __init__(
        self, manifest: Manifest, target: Target | None, pool: WorkerPool | None, report: Report
    ) -> None:
        """Begin to count.

        Args:
            manifest: Manifest of the dataset, which states the number of palm poses.
            target: Target of the build, which states the number of samples; None without one.
            pool: Workers, whose number is shown; None: it is not shown.
            report: Called with the number of samples of a target, else of palm poses, that are done
                and that are due.
        """
        self.simulated = self.reused = 0
        self.damaged: list[str] = []
        self.errors: Counter[str] = Counter()
        self._pool, self._report, self._target = pool, report, target
        self._palms = sum(entry.candidates for entry in manifest.objects)
        self._outcomes: Counter[Outcome] = Counter()
        self._done = 0

        # For each object: all attempts, and those that ended because of the machine.
        self._attempts: Counter[str] = Counter()
        self._ended: Counter[str] = Counter()

    def add(self, summary: UnitSummary, *, reused: bool = False) -> None:
        """Count a completed unit; if `reused`, an earlier build completed it."""
        header, outcomes = summary.header, summary.outcomes
        self.reused += reused
        self.simulated += not reused
        self.errors.update(summary.errors)
        self._outcomes.update(outcomes)
        self._done += header.stop - header.start
        self._attempts[header.object_name] += sum(outcomes.values())
        self._ended[header.object_name] += sum(outcomes.get(outcome, 0) for outcome in ENDED)
        self.show()

    def unexplained(self) -> list[str]:
        """Return a warning for each object with too many crashes or timeouts."""
        lines = []
        for name, ended in self._ended.items():
            attempts = self._attempts[name]
            if ended and (ended == attempts or ended >= max(FEW_ENDED, ENDED_SHARE * attempts)):
                lines.append(
                    f"{name}: {ended:,} of {attempts:,} attempts crashed or timed out, which is no "
                    f"property of grasps. See `drakegrasp doctor`; remove shards/{name} there, and "
                    "the same command tries them again"
                )
        return lines

    def show(self) -> None:
        """Report what is done, and the number of workers."""
        figures = {"attempts": self._attempts.total(), "grasps": self._outcomes[Outcome.SUCCESS]}
        for outcome in ENDED:
            if self._outcomes[outcome]:
                figures[outcome.label] = self._outcomes[outcome]
        if self._pool is not None:
            figures["workers"] = self._pool.size
        done, total = self._progress()
        self._report(done, total, **figures)

    def _progress(self) -> tuple[int, int | None]:
        """Return how much is done, and how much is due; None until each object has been tried."""
        if self._target is None:
            return self._done, self._palms
        return self._target.found, self._target.wanted if self._target.has_begun else None


@dataclass(frozen=True, kw_only=True)
class BuildReport:
    """The result of a build.

    Attributes:
        out: Directory of the dataset.
        simulated: Number of work units that this build ran.
        reused: Number of work units that an earlier build completed.
        objects: Number of objects.
        refused: Name of each refused mesh, and the reason.
        errors: Number of solver errors by message, in the units that this build ran.
        notices: Information for the user, such as repaired damage and removed leftover files.
        unexplained: A line for each object with so many crashes or timeouts that the machine must
            be the cause; the dataset is complete, but the labels of such an object are wrong.
        assembled: Whether this build wrote the assembled files; otherwise they were up to date.
        assembly: Content of the assembled files.
    """

    out: Path
    simulated: int
    reused: int
    objects: int
    refused: tuple[RefusedMesh, ...]
    errors: dict[str, int]
    notices: tuple[str, ...]
    unexplained: tuple[str, ...]
    assembled: bool
    assembly: Assembly


def build(
    directory: BuildDirectory,
    sources: Sequence[MeshSource],
    execute: Executor,
    *,
    postures: GraspTable | None = None,
    pool: WorkerPool | None = None,
    show: bool = True,
) -> BuildReport:
    """Build or complete the dataset of some meshes in a directory.

    Complete results of the same configuration and mesh are reused. Refused meshes are reported;
    the others are built.

    Args:
        directory: The directory, see `open_directory`; its manifest states the configuration.
        sources: The meshes.
        execute: Runs the tasks.
        postures: Postures to try instead of palm poses of samplers. The configuration states their
            digest, see `build_config`. Invalid rows are reported and not tried.
        pool: The executor's processes, if they are restarted when they die. A crash or a hang then
            ends only one attempt. Without a pool, crashes propagate to the caller.
        show: Whether to show progress on standard error.

    Raises:
        DataError: If no mesh can be simulated.
        MeshError: If a mesh file cannot be read.
        GraspError: If no row of the postures can be tried.
        DiskFullError: If the disk is full; the same call continues when there is space.
        MachineError: If the workers cannot do the work.
    """
    return _Build(directory, execute, postures, pool, show=show).run(sources)


class _Build:
    """The steps of a build and their common data."""

    def __init__(
        self,
        directory: BuildDirectory,
        execute: Executor,
        postures: GraspTable | None,
        pool: WorkerPool | None,
        *,
        show: bool,
    ) -> None:
        self._out, self._is_new = directory.out, directory.is_new
        self._manifest, self._notices = directory.manifest, list(directory.notices)
        self._config = directory.manifest.config
        self._execute, self._pool, self._show = execute, pool, show
        self._postures = postures

        # The completed units. With a target: the palm poses that the dataset had of each object,
        # the grasps that are no samples by inspection, and the survey of all units.
        self._units: dict[ShardHeader, UnitSummary] = {}
        self._floors: dict[str, int] = {}
        self._rejected = set[tuple[str, int, int]]()
        self._survey: Survey | None = None

    def run(self, sources: Sequence[MeshSource]) -> BuildReport:
        """Prepare, simulate, assemble."""
        # Write the manifest first, because a directory without a manifest holds no dataset.
        write_manifest(self._manifest, self._out)

        # Prepare each object, or refuse its mesh.
        with self._progress("prepare", "objects") as report:
            self._prepare(sources, report)
        if self._postures and (refused := _refused(self._postures, self._manifest)):
            self._say(refused)
            self._notices.append(refused)

        # Simulate the missing work units; remove the temporary files of killed workers.
        what = "samples" if self._config.has_target else "palms"
        with self._progress("simulate", what) as report:
            counts = self._simulate(report)
        write_manifest(self._manifest, self._out)
        if self._pool is not None:
            sweep_temporary(self._out)

        assembled, assembly = self._assemble()
        if counts.damaged:
            shards = f"{counted(len(counts.damaged), 'shard')} ({listed(counts.damaged)})"
            self._notices.append(f"{shards}: damaged, and simulated again")
        unexplained = tuple(counts.unexplained())
        for line in unexplained:
            self._say(line)
        return BuildReport(
            out=self._out,
            simulated=counts.simulated,
            reused=counts.reused,
            objects=len(self._manifest.objects),
            refused=self._manifest.refused,
            errors=dict(counts.errors),
            notices=tuple(self._notices),
            unexplained=unexplained,
            assembled=assembled,
            assembly=assembly,
        )

    def _say(self, text: str) -> None:
        if self._show:
            sys.stderr.write(f"{printable(text)}\n")

    def _progress(self, stage: str, unit: str) -> AbstractContextManager[Report]:
        return progress_bar(stage, unit, show=self._show)

    # Objects

    def _prepare(self, sources: Sequence[MeshSource], report: Report) -> None:
        """Prepare or refuse every object, in the sources' order, and write the manifest.

        Raises:
            DataError: If there is no object, or objects of two splits have become one group.
        """
        manifest = self._manifest
        before: dict[str, ObjectEntry | RefusedMesh] = {e.name: e for e in manifest.objects}
        before |= {entry.name: entry for entry in manifest.refused}
        entries = self._entries(sources, before, report)

        # If a mesh has changed, its rows and its rejected grasps no longer exist.
        same = {n for n, e in before.items() if entries[n].mesh_sha256 == e.mesh_sha256}
        floors = {name: n for name, n in palms_in_files(self._out).items() if name in same}
        objects, refused = list[ObjectEntry](), list[RefusedMesh]()
        for source in sources:
            entry = entries[source.name]
            if isinstance(entry, RefusedMesh):
                refused.append(entry)
                continue
            floor = self._floors[entry.name] = floors.get(entry.name, 0)

            # A dataset only grows: fewer palm poses take none out of the files.
            most = max(self._config.candidates.max, floor)
            if entry.candidates > most:
                entry = replace(entry, candidates=most, ended=False)

            # Licence and group do not affect results. An object stays in its split.
            old = before.get(entry.name)
            split = old.split if isinstance(old, ObjectEntry) else None
            objects.append(
                replace(entry, tried=None, licence=source.licence, group=source.group, split=split)
            )
        if not objects:
            if self._is_new:
                release_directory(self._out)
            reasons = "; ".join(f"{entry.name}: {entry.reason}" for entry in refused)
            raise DataError(f"no mesh can be simulated: {reasons}")
        self._manifest = replace(
            manifest,
            objects=tuple(objects),
            refused=tuple(refused),
            rejected=tuple(key for key in manifest.rejected if key.object in same),
        )
        self._manifest.homes()  # raises an error for a group in two splits
        write_manifest(self._manifest, self._out)

    def _entries(
        self,
        sources: Sequence[MeshSource],
        before: Mapping[str, ObjectEntry | RefusedMesh],
        report: Report,
    ) -> dict[str, ObjectEntry | RefusedMesh]:
        """Return the entry of each mesh; those that were prepared or refused before are reused."""
        entries: dict[str, ObjectEntry | RefusedMesh] = {}
        for source in sources:
            known = before.get(source.name)
            if not isinstance(known, RefusedMesh):
                known = find_entry(source, self._out, self._config)
            elif known.again or source_sha256(source) != known.mesh_sha256:
                known = None
            if known is not None:
                entries[source.name] = known
        report(len(entries), len(sources))

        # Prepare the others, in any order.
        tasks = [
            PrepareTask(
                source=source,
                out=self._out,
                config=self._config,
                postures=self._postures and self._postures.of_object(source.name),
                restartable=self._pool is not None,
            )
            for source in sources
            if source.name not in entries
        ]
        for name, entry in self._execute(prepare_one, tasks):
            entries[name] = entry
            report(len(entries), len(sources))
        return entries

    # Work units

    def _simulate(self, report: Report) -> Counts:
        """Run the missing work units, and set how many palm poses the dataset takes."""
        manifest, config = self._manifest, self._config
        target = Target(config, self._floors) if config.has_target else None
        counts = Counts(manifest, target, self._pool, report)
        self._rejected = {(k.object, k.candidate, k.standoff_index) for k in manifest.rejected}
        if target is not None:
            _set_units(target, manifest)

        # Count the units of earlier builds, which are reused.
        find = partial(find_units, self._out, config)
        for units, damaged in self._execute(find, find_tasks(self._out, manifest)):
            for summary in units:
                self._add(summary, counts, target, reused=True)
            counts.damaged += damaged
        counts.show()  # the first unit may take a minute

        if target is not None:
            self._meet(target, counts)
        else:
            due = [header for header in manifest.headers() if header not in self._units]
            self._run_units(due, counts, target)
        return counts

    def _meet(self, target: Target, counts: Counts) -> None:
        """Run units until a target is met or cannot be met.

        The manifest then has the number of palm poses that the dataset takes of each object.
        """
        while True:
            self._run_units(target.next_units(), counts, target)
            if dry := target.dry():
                self._draw_more(dry)
                _set_units(target, self._manifest)
            elif None not in (taken := target.taken()).values():
                objects = tuple(replace(e, tried=taken[e.name]) for e in self._manifest.objects)
                met = replace(self._manifest, objects=objects)
                if not target.lose(self._outliers(met)):
                    self._manifest = met
                    self._notices += target.warnings()
                    return

    def _draw_more(self, names: Sequence[str]) -> None:
        """Draw twice as many palm poses of some objects."""
        manifest, most = self._manifest, self._config.candidates.max
        tasks = [
            DrawTask(
                out=self._out,
                name=entry.name,
                config=manifest.config,
                count=min(2 * entry.candidates, most),
            )
            for entry in manifest.objects
            if entry.name in names
        ]
        drawn = dict(self._execute(draw_palms, tasks))
        objects = (with_drawn(entry, drawn.get(entry.name, entry)) for entry in manifest.objects)
        self._manifest = replace(manifest, objects=tuple(objects))
        write_manifest(self._manifest, self._out)  # for those who watch the build

    def _outliers(self, manifest: Manifest) -> dict[str, int]:
        """Return how many samples of each object the filter of outliers removes."""
        filters, names = self._config.filters, [entry.name for entry in manifest.objects]
        if filters.outlier_sigma == 0.0 or not manifest.units:
            return {}
        self._survey = survey(self._out, manifest, self._units)
        successes = self._survey.successes
        lost = successes["object"][successes["removal"] == Removal.OUTLIER]
        counts = np.bincount(lost, minlength=len(names))
        return dict(zip(names, counts.tolist(), strict=True))

    def _run_units(
        self, headers: Iterable[ShardHeader], counts: Counts, target: Target | None
    ) -> None:
        """Run work units; count and log each when it is done."""
        units = (
            WorkUnit(
                out=self._out,
                header=header,
                config=self._config,
                restartable=self._pool is not None,
            )
            for header in headers
        )

        for summary in self._execute(run_unit, units):
            self._add(summary, counts, target)

    def _add(
        self, summary: UnitSummary, counts: Counts, target: Target | None, *, reused: bool = False
    ) -> None:
        """Count a completed unit; if `reused`, an earlier build completed it."""
        self._units[summary.header] = summary
        if target is not None:
            name, successes = summary.header.object_name, summary.successes
            passed = successes[successes["by_filter"] == Removal.KEPT]
            keys = zip(passed["candidate"].tolist(), passed["standoff_index"].tolist(), strict=True)
            hits = [palm for palm, i in keys if (name, palm, i) not in self._rejected]
            target.add(summary.header, hits)
        counts.add(summary, reused=reused)

    # Files

    def _assemble(self) -> tuple[bool, Assembly]:
        """Assemble the shards, unless the assembled files already have exactly these shards.

        Returns:
            Whether the files were written, and their content.
        """
        surveyed = self._survey or survey(self._out, self._manifest, self._units)
        if is_assembled(self._out, surveyed.manifest, surveyed.seals):
            return False, surveyed.assembly
        with self._progress("assemble", "shards") as report:
            return True, assemble_locked(self._out, surveyed, progress=report)


def _set_units(target: Target, manifest: Manifest) -> None:
    """State the work units of each object, but no part of a unit that may still grow."""
    most = manifest.config.candidates.max
    for entry, headers in zip(manifest.objects, manifest.headers_by_object(), strict=True):
        endless = not entry.ended and entry.candidates < most
        whole = {unit.stop for unit in manifest.config.unit_ranges(most)}
        units = [h for h in headers if not endless or h.stop in whole]
        target.set_units(entry.name, units, endless=endless)


def _refused(postures: GraspTable, manifest: Manifest) -> str:
    """Return which rows of the postures are not tried, and why; empty if all are tried.

    Raises:
        GraspError: If no row can be tried.
    """
    for entry in manifest.objects:
        poses = unpack_pose([pose.X_TO for pose in entry.resting])
        reasons = misfits(postures, entry.name, entry.scale, poses)
        postures = postures.refuse(reasons)
    if all(postures.invalid):
        raise GraspError(postures.refused)
    return postures.refused
