"""Builds a dataset from meshes; an `Executor` does the work.

Input: a directory that this process holds, and meshes. Output: the dataset. `build` plans the work
and records the results. The executor runs two kinds of tasks: preparing an object and running a
work unit. The order in which results arrive does not change the files.
"""

from __future__ import annotations

import socket
import sys
import time
from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from drakegrasp.config import Config
from drakegrasp.dataset.assemble import Assembly, assemble_locked, summarise
from drakegrasp.dataset.lock import BuildLog
from drakegrasp.dataset.manifest import (
    Manifest,
    ObjectEntry,
    RefusedMesh,
    release_directory,
    write_manifest,
)
from drakegrasp.dataset.paths import FILE_NAME, SCENES_FILE
from drakegrasp.dataset.prepared_objects import load_prepared, with_drawn
from drakegrasp.dataset.shards import ShardHeader
from drakegrasp.dataset.statistics import is_assembled, palms_in_files
from drakegrasp.dataset.survey import Decisions, decide, headers_by_object, known_homes, survey
from drakegrasp.errors import (
    DataError,
    DrakegraspError,
    GraspError,
    counted,
    listed,
    printable,
)
from drakegrasp.filters import Removal
from drakegrasp.frames import unpack_pose
from drakegrasp.generation.cautions import nothing_trains, too_heavy
from drakegrasp.generation.counts import Counts
from drakegrasp.generation.directory import BuildDirectory
from drakegrasp.generation.prepare import (
    DrawTask,
    PrepareTask,
    draw_palms,
    first_palms,
    prepare_one,
)
from drakegrasp.generation.request import Part
from drakegrasp.generation.scenes import make_scenes_locked
from drakegrasp.generation.target import Target
from drakegrasp.generation.work_unit import (
    UnitSummary,
    WorkUnit,
    find_tasks,
    find_units,
    run_unit,
)
from drakegrasp.objects.sources import MeshSource, source_sha256
from drakegrasp.runtime.executor import Executor, WorkerPool
from drakegrasp.runtime.files import sweep_temporary
from drakegrasp.runtime.progress import Report, progress_bar
from drakegrasp.simulation.attempts import Attempts, misfits
from drakegrasp.table import Table


@dataclass(frozen=True, kw_only=True)
class BuildReport:
    """The result of a build.

    Attributes:
        out: Directory of the dataset.
        simulated: Number of work units that this build ran.
        reused: Number of work units that an earlier build completed.
        objects: Number of objects.
        refused: Name of each rejected mesh, and the reason.
        errors: Number of solver errors by message, in the units that this build ran.
        notices: Information for the user, such as repaired damage and removed leftover files.
        unexplained: A line for each object with so many crashes or timeouts that the machine must
            be the cause; the dataset is complete, but the labels of such an object are wrong.
        assembled: Whether this build wrote the assembled files; otherwise they were up to date.
        assembly: Content of the assembled files; None after a part of a build that is not the last.
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
    assembly: Assembly | None


def build(
    directory: BuildDirectory,
    sources: Sequence[MeshSource],
    execute: Executor,
    *,
    postures: Attempts | None = None,
    part: Part | None = None,
    pool: WorkerPool | None = None,
    show: bool = True,
) -> BuildReport:
    """Build or complete the dataset of some meshes in a directory.

    Complete results of the same configuration and mesh are reused. Rejected meshes are reported;
    the others are built.

    Args:
        directory: The directory, see `open_directory`; its manifest states the configuration.
        sources: The meshes.
        execute: Runs the tasks.
        postures: Postures to try instead of palm poses of samplers. The configuration states their
            digest, see `build_config`. Invalid rows are reported and not tried.
        part: Part of the work units to run; all if None. The assembled files are written when all
            units are complete.
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
    job = _Build(directory, execute, postures, part, pool, show=show)
    try:
        return job.run(sources)
    except BaseException as error:
        # Log why the build stopped; an error of the log must not hide this error.
        with suppress(OSError, DataError):
            if (directory.out / FILE_NAME).exists():
                job.log("stopped", reason=f"{type(error).__name__}: {error}")
        raise


class _Build:
    """The steps of a build and their common data; `log` writes events, see `BuildLog`."""

    def __init__(
        self,
        directory: BuildDirectory,
        execute: Executor,
        postures: Attempts | None,
        part: Part | None,
        pool: WorkerPool | None,
        *,
        show: bool,
    ) -> None:
        self._out, self._is_new = directory.out, directory.is_new
        self._manifest, self._notices = directory.manifest, list(directory.notices)
        self._config = directory.manifest.config
        self._execute, self._pool, self._show = execute, pool, show
        self._postures, self._part = postures, part
        self.log = BuildLog(self._out)

        # With a target: the palm poses that the dataset had of each object, the grasps that are no
        # samples by inspection, the successes of each completed unit, and what is decided of them.
        self._floors: dict[str, int] = {}
        self._rejected = set[tuple[str, int, int]]()
        self._successes: dict[ShardHeader, Table] = {}
        self._decisions: Decisions | None = None

    def run(self, sources: Sequence[MeshSource]) -> BuildReport:
        """Prepare, simulate, assemble."""
        start = time.monotonic()

        # Write the manifest first, because a directory without a manifest holds no dataset.
        write_manifest(self._manifest, self._out)
        self._begin()
        self._warn(nothing_trains(sources, self._config.split))

        # Prepare each object, or reject its mesh.
        with self._progress("prepare", "objects") as report:
            self._prepare(sources, report)
        self._warn(too_heavy(self._manifest))
        if self._postures is not None:
            table = self._postures
            for told in filter(None, (_refused(table, self._manifest), table.nameless, table.bare)):
                self._warn(told)
                self._notices.append(told)

        # Simulate the missing work units; remove the temporary files of killed workers.
        what = "samples" if self._config.has_target else "palms"
        with self._progress("simulate", what) as report:
            counts, left = self._simulate(report)
        write_manifest(self._manifest, self._out)
        if self._pool is not None:
            sweep_temporary(self._out)

        # The assembled files need all work units, so only the part that completes them writes them.
        assembled = False if left else self._assemble()
        if left:
            units = counted(left, "work unit")
            self._notices.append(f"{units} of other parts left; `drakegrasp merge` joins all parts")

        # Report.
        if counts.damaged:
            shards = f"{counted(len(counts.damaged), 'shard')} ({listed(counts.damaged)})"
            self._notices.append(f"{shards}: damaged, and simulated again")
        unexplained = tuple(counts.unexplained())
        for line in unexplained:
            self._warn(line)
        done = {"simulated": counts.simulated, "reused": counts.reused}
        self.log("finished", **done, seconds=round(time.monotonic() - start, 3))
        return BuildReport(
            out=self._out,
            **done,
            objects=len(self._manifest.objects),
            refused=self._manifest.refused,
            errors=dict(counts.errors),
            notices=tuple(self._notices),
            unexplained=unexplained,
            assembled=assembled,
            assembly=None if left else summarise(self._out),
        )

    # What people see

    def _begin(self) -> None:
        """Log the start of the build, and observe the workers."""
        self.log(
            "started",
            command=sys.argv,
            host=socket.gethostname(),
            config_hash=self._config.simulation_hash(),
            seed=self._config.seed,
            versions=self._manifest.versions,
        )
        for notice in self._notices:
            self.log("notice", text=notice)
        if self._pool is not None:
            self._pool.on_change = self._workers_changed
            self._pool.on_none = self._no_worker

    def _workers_changed(self, joined: set[str], left: set[str]) -> None:
        assert self._pool is not None
        for event, addresses in (("worker joined", joined), ("worker lost", left)):
            for address in sorted(addresses):
                self.log(event, address=address, workers=self._pool.size)

    def _no_worker(self) -> None:
        self.log("no worker")
        self._say("there is no worker: waiting for one")

    def _warn(self, text: str) -> None:
        """Log and print a warning for the user, unless it is empty."""
        if text:
            self.log("notice", text=text)
            self._say(text)

    def _say(self, text: str) -> None:
        if self._show:
            sys.stderr.write(f"{printable(text)}\n")

    def _progress(self, stage: str, unit: str) -> AbstractContextManager[Report]:
        return progress_bar(stage, unit, show=self._show)

    # Objects

    def _prepare(self, sources: Sequence[MeshSource], report: Report) -> None:
        """Prepare or reject every object, in the sources' order, and write the manifest.

        Raises:
            DataError: If there is no object, or objects of two splits have become one group.
        """
        manifest = self._manifest
        before: dict[str, ObjectEntry | RefusedMesh] = {e.name: e for e in manifest.objects}
        before |= {entry.name: entry for entry in manifest.refused}

        # Reuse the manifest's entries of unchanged meshes.
        entries: dict[str, ObjectEntry | RefusedMesh] = {}
        for source in sources:
            entry = _unchanged(source, before.get(source.name), self._out, self._config)
            if entry is not None:
                entries[source.name] = entry
        reused = len(entries)
        report(reused, len(sources), found=reused)

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
            if isinstance(entry, RefusedMesh):
                self.log("mesh refused", name=name, reason=entry.reason)
            else:
                facts = {"candidates": entry.candidates, "notes": list(entry.notes)}
                self.log("mesh prepared", name=name, **facts)
            report(len(entries), len(sources), found=reused)

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
        known_homes(self._manifest)  # raises an error for a group in two splits
        write_manifest(self._manifest, self._out)

    # Work units

    def _simulate(self, report: Report) -> tuple[Counts, int]:
        """Run the missing work units, and set how many palm poses the dataset takes.

        Returns:
            The counts of all units, and the number of units that are left to other parts.
        """
        manifest, config = self._manifest, self._config
        target = Target(config, self._floors) if config.has_target else None
        counts = Counts(manifest, target, self._pool, report)
        self._rejected = {(k.object, k.candidate, k.standoff_index) for k in manifest.rejected}
        if target is not None:
            _set_units(target, manifest)

        # The progress bar shows the number of workers as it changes.
        if self._pool is not None:

            def change(joined: set[str], left: set[str]) -> None:
                self._workers_changed(joined, left)
                counts.show()

            self._pool.on_change = change

        # Count the units of earlier builds, which are reused.
        done = set[ShardHeader]()
        find = partial(find_units, self._out, config)
        for units, damaged in self._execute(find, find_tasks(self._out, manifest)):
            for summary in units:
                done.add(summary.header)
                self._add(summary, counts, target, reused=True)
            for path, reason in damaged:
                counts.damaged.append(path)
                self.log("damaged shard", reason=reason)
        counts.show()  # the first unit may take a minute

        if target is not None:
            self._meet(target, counts)
            return counts, 0
        part = self._part
        due = [
            (header, part is None or part.has(i))
            for i, header in enumerate(manifest.headers())
            if header not in done
        ]
        self._run_units((header for header, mine in due if mine), counts, target)
        return counts, sum(not mine for _, mine in due)

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
                config=manifest.config_of(entry.name),
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
        if filters.outlier_sigma == 0.0 or self._config.max_grasps is not None:
            return {}
        if not manifest.units:
            return {}
        self._decisions = decide(manifest, survey(self._out, manifest, self._successes))
        objects = self._decisions.survey.successes["object"]
        lost = objects[self._decisions.removal == Removal.OUTLIER]
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
            self.log(
                "unit done",
                object=summary.header.object_name,
                start=summary.header.start,
                stop=summary.header.stop,
                outcomes={outcome.label: count for outcome, count in summary.outcomes.items()},
                seconds={stage: round(seconds, 4) for stage, seconds in summary.seconds.items()},
                errors=summary.errors,
            )

    def _add(
        self, summary: UnitSummary, counts: Counts, target: Target | None, *, reused: bool = False
    ) -> None:
        """Count a completed unit; if `reused`, an earlier build completed it."""
        if target is not None and summary.successes is not None:
            name = summary.header.object_name
            hits = [c for c, s in summary.hits if (name, c, s) not in self._rejected]
            target.add(summary.header, hits)
            self._successes[summary.header] = summary.successes
        counts.add(summary, reused=reused)

    # Files

    def _assemble(self) -> bool:
        """Assemble the shards, unless the assembled files already have exactly these shards.

        Returns:
            Whether the files were written.
        """
        out = self._out
        stale = not is_assembled(out, verify_shards=True)
        if stale:
            with self._progress("assemble", "shards") as report:
                known, decisions = self._successes or None, self._decisions
                assemble_locked(
                    out, self._manifest, known=known, decisions=decisions, progress=report
                )
        scenes = self._config.scenes.when == "assembled"
        if scenes and (stale or not (out / SCENES_FILE).is_file()):
            with self._progress("scenes", "objects") as report:
                make_scenes_locked(out, execute=self._execute, progress=report)
        return stale


def _set_units(target: Target, manifest: Manifest) -> None:
    """State the work units of each object, but no part of a unit that may still grow."""
    most = manifest.config.candidates.max
    for entry, headers in zip(manifest.objects, headers_by_object(manifest), strict=True):
        endless = not entry.ended and entry.candidates < most
        whole = {unit.stop for unit in manifest.config.unit_ranges(most)}
        units = [h for h in headers if not endless or h.stop in whole]
        target.set_units(entry.name, units, endless=endless)


def _refused(postures: Attempts, manifest: Manifest) -> str:
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


def _unchanged(
    source: MeshSource, entry: ObjectEntry | RefusedMesh | None, out: Path, config: Config
) -> ObjectEntry | RefusedMesh | None:
    """Return the manifest's entry of a mesh as it is now; None if the mesh must be prepared."""
    if isinstance(entry, RefusedMesh):
        same = not entry.again and source_sha256(source) == entry.mesh_sha256
        return entry if same else None
    if entry is None or entry.class_name != source.class_name:
        return None
    if source_sha256(source) != entry.mesh_sha256:
        return None
    try:
        prepared = load_prepared(out, source.name, config)
    except DrakegraspError:
        return None
    # A build that was stopped may have drawn more palm poses than the manifest says.
    enough = prepared.asked >= first_palms(config)
    return with_drawn(entry, prepared.entry()) if enough else None
