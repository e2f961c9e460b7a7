"""Builds a dataset from meshes; an `Executor` does the work.

`build` plans the work and records the results. The executor runs two kinds of tasks: preparing an
object and running a work unit. The order in which results arrive does not change the files.
"""

from __future__ import annotations

import socket
import sys
import time
from collections.abc import Collection, Iterable, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Protocol

import numpy as np

from drakegrasp.config import MOST_PALMS, Config
from drakegrasp.dataset.assemble import Assembly, assemble_locked, summarise
from drakegrasp.dataset.assembly.removal import judge_successes, own_filters
from drakegrasp.dataset.assembly.survey import Survey, headers_by_object, known_homes, survey
from drakegrasp.dataset.card import write_card
from drakegrasp.dataset.lock import BuildLog, build_lock
from drakegrasp.dataset.manifest import (
    Manifest,
    ObjectEntry,
    RefusedMesh,
    claim_directory,
    finger_names,
    installed_versions,
    release_directory,
    write_manifest,
)
from drakegrasp.dataset.paths import SCENES_FILE
from drakegrasp.dataset.prepared_objects import load_prepared, with_drawn
from drakegrasp.dataset.shards import ShardHeader
from drakegrasp.dataset.statistics import is_assembled, palms_in_files
from drakegrasp.errors import (
    ConfigError,
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
from drakegrasp.generation.counts import Counts, refuse_two_ends
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
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.folder import carry_hand
from drakegrasp.hand.parsing import position_order
from drakegrasp.objects.sources import MeshSource, source_sha256
from drakegrasp.runtime.executor import Executor, WorkerPool
from drakegrasp.runtime.files import disk_full_named, sweep_temporary
from drakegrasp.runtime.progress import Report, progress_bar
from drakegrasp.simulation.attempts import Attempts, misfits
from drakegrasp.simulation.candidates import refuse_samplers
from drakegrasp.simulation.drive import drive_of

#: Number of samples of each object that a build makes if nothing else ends it.
SAMPLES_PER_OBJECT = 20


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
    sources: Sequence[MeshSource],
    out: Path,
    config: Config,
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
        sources: The meshes.
        out: Directory of the dataset; new, empty, or with a dataset of this configuration.
        config: Configuration of the dataset.
        execute: Runs the tasks.
        postures: See `build_locked`.
        part: See `build_locked`.
        pool: The executor's processes, if they are restarted when they die. A crash or a hang then
            ends only one attempt. Without a pool, crashes propagate to the caller.
        show: Whether to show progress on standard error.

    Raises:
        ConfigError: As for `refuse_unusable` and `refuse_part`.
        DataError: If the directory cannot be used, another process builds there, or no mesh
            can be simulated.
        GraspError: If no row of the postures is for one of these objects.
        HandError: If the hand cannot be used.
        DiskFullError: If the disk is full; the same call continues when there is space.
        MachineError: If the workers cannot do the work.
    """
    refuse_unusable(config)
    refuse_part(part, config)
    drive_of(load_hand(config.hand_source), config.lift)
    with build_lock(out) as dead:
        return build_locked(
            sources,
            out,
            config,
            execute,
            dead=dead,
            postures=postures,
            part=part,
            pool=pool,
            show=show,
        )


def ended(config: Config) -> Config:
    """Return the configuration of a build that ends.

    Without a target and a number of palm poses, samplers without an end would go on for hours.
    """
    rules = config.candidates
    endless = "closing" in rules.method and rules.postures is None
    if config.has_target or not endless or rules.max != MOST_PALMS:
        return config
    return config.model_copy(update={"samples_per_object": SAMPLES_PER_OBJECT})


def posture_config(config: Config, postures: Attempts | None) -> Config:
    """Return the configuration of a build that tries postures instead of palm poses of samplers.

    Raises:
        ConfigError: If the configuration names other postures than the given ones.
    """
    digest, named = None if postures is None else postures.digest(), config.candidates.postures
    if named not in (None, digest):
        must = "left out; the postures that are given decide" if digest else "given with postures"
        raise ConfigError(f"candidates.postures must be {must}, got {named!r}")
    if digest is None:
        return config
    # A posture has no stand-off, so there is one attempt per posture.
    rules = config.candidates
    changed = {"postures": digest, "standoffs": rules.standoffs[:1]}
    return config.model_copy(update={"candidates": rules.model_copy(update=changed)})


def refuse_unusable(config: Config) -> None:
    """Reject a configuration that would stop a build later.

    Raises:
        ConfigError: If it limits both the number of grasps and the number of samples, or a
            user-defined class cannot be used.
        HandError: If a sampler cannot be used with the hand.
    """
    refuse_two_ends(config)
    if config.candidates.postures is None:
        refuse_samplers(config)
    own_filters(config.filters)


def refuse_part(part: Part | None, config: Config) -> None:
    """Reject a part of a build that ends when there are enough samples.

    Raises:
        ConfigError: If it is such a part: which units it needs depends on the results of all parts.
    """
    if part is None:
        return
    for key in ("samples", "samples_per_object", "max_grasps"):
        value = getattr(config, key)
        if value is not None:
            raise ConfigError(
                "part must be of a build with a number of palm poses (--candidates N) and no other "
                f"end, got {key}={value}, whose work units depend on the results of all parts"
            )


def build_locked(
    sources: Sequence[MeshSource],
    out: Path,
    config: Config,
    execute: Executor,
    *,
    dead: str | None,
    postures: Attempts | None = None,
    part: Part | None = None,
    pool: WorkerPool | None = None,
    show: bool = True,
) -> BuildReport:
    """Build a dataset in a directory whose lock the caller holds; see `build`.

    Args:
        sources: The meshes.
        out: Directory of the dataset; new, empty, or with a dataset of this configuration.
        config: Configuration of the dataset.
        execute: Runs the tasks.
        dead: Name of the process that held the lock before and died, as `build_lock` yields it.
        postures: Postures to try instead of palm poses of samplers. The configuration states their
            digest, see `posture_config`. Invalid rows are reported and not tried.
        part: Part of the work units to run; all if None. The assembled files are written when all
            units are complete.
        pool: The executor's processes, as for `build`.
        show: Whether to show progress on standard error.

    Raises:
        DataError, DiskFullError, MachineError: As for `build`.
    """
    job = _Build(out, execute, pool, postures, part, show=show)
    with disk_full_named(out):
        # The directory must have this configuration, and a dataset in it must have these meshes.
        known = claim_directory(out, config)
        if known is not None:
            refuse_missing(known, [source.name for source in sources], out)
        config = carry_hand(out, config, known.config.hand if known else None)

        notices = [] if dead is None else [f"the lock of a dead build was taken over: {dead}"]
        swept = [str(path.relative_to(out)) for path in sweep_temporary(out)]
        if swept:
            notices.append(f"{_count(swept, 'temporary file')} of dead processes removed")
        try:
            return job.run(sources, config, known, notices)
        except BaseException as error:
            # Log why the build stopped; an error of the log must not hide this error.
            with suppress(OSError, DataError):
                if (out / "manifest.json").exists():
                    job.log("stopped", reason=f"{type(error).__name__}: {error}")
                else:
                    release_directory(out)
            raise


class _Add(Protocol):
    """Counts a completed unit; if `reused`, an earlier build completed it."""

    def __call__(self, summary: UnitSummary, *, reused: bool = False) -> None: ...


class _Build:
    """The steps of a build and their common data; `log` writes events, see `BuildLog`."""

    def __init__(
        self,
        out: Path,
        execute: Executor,
        pool: WorkerPool | None,
        postures: Attempts | None,
        part: Part | None,
        *,
        show: bool,
    ) -> None:
        self._out, self._execute, self._pool = out, execute, pool
        self._part, self._left = part, 0
        self._postures, self._show, self.log = postures, show, BuildLog(out)
        self._floors: dict[str, int] = {}
        self._warnings: list[str] = []
        self._surveyed: Survey | None = None  # of the last check for outliers

    def run(
        self,
        sources: Sequence[MeshSource],
        config: Config,
        known: Manifest | None,
        notices: list[str],
    ) -> BuildReport:
        """Prepare, simulate, assemble."""
        out, start = self._out, time.monotonic()

        # Write the manifest first, because a directory without a manifest holds no dataset.
        hand, versions = load_hand(config.hand_source), installed_versions(config)
        new = Manifest(config=config, versions=versions, fingers=finger_names(config))
        joints = position_order(hand.model, hand.palm_link)
        manifest = replace(known or new, config=config, joints=joints)
        manifest = replace(manifest, versions={**manifest.versions, "hand": versions["hand"]})
        write_manifest(manifest, out)
        self._begin(manifest, notices)
        self._warn(nothing_trains(sources, config.split))

        # Prepare each object, or reject its mesh.
        with self._progress("prepare", "objects") as report:
            manifest = self._prepare_all(sources, manifest, report)
        if not manifest.objects:
            if known is None:
                release_directory(out)
            reasons = "; ".join(f"{entry.name}: {entry.reason}" for entry in manifest.refused)
            raise DataError(f"no mesh can be simulated: {reasons}")
        known_homes(manifest)  # objects of two splits that have become one group are rejected
        write_manifest(manifest, out)
        self._warn(too_heavy(manifest))
        if self._postures is not None:
            table = self._postures
            for told in filter(None, (_refused(table, manifest), table.nameless, table.bare)):
                self._warn(told)
                notices.append(told)

        # Simulate the missing work units; remove the temporary files of killed workers.
        with self._progress("simulate", "samples" if config.has_target else "palms") as report:
            counts, manifest = self._run_all(manifest, report)
        write_manifest(manifest, out)
        notices += self._warnings
        if self._pool is not None:
            sweep_temporary(out)

        # The assembled files need all work units, so only the part that completes them writes them.
        stale = False if self._left else self._assemble(manifest)
        if self._left:
            others = counted(self._left, "work unit")
            notices.append(f"{others} of other parts left; `drakegrasp merge` joins all parts")

        # Report.
        if counts.damaged:
            notices.append(f"{_count(counts.damaged, 'shard')}: damaged, and simulated again")
        unexplained = tuple(counts.unexplained())
        for line in unexplained:
            self._warn(line)
        done = {"simulated": counts.simulated, "reused": counts.reused}
        self.log("finished", **done, seconds=round(time.monotonic() - start, 3))
        return BuildReport(
            out=out,
            **done,
            objects=len(manifest.objects),
            refused=manifest.refused,
            errors=dict(counts.errors),
            notices=tuple(notices),
            unexplained=unexplained,
            assembled=stale,
            assembly=None if self._left else summarise(out),
        )

    def _assemble(self, manifest: Manifest) -> bool:
        """Assemble the shards, unless the assembled files already have exactly these shards.

        Returns:
            Whether the files were written.
        """
        out, execute = self._out, self._execute
        stale = not is_assembled(out, verify_shards=True)
        if stale:
            with self._progress("assemble", "shards") as report:
                assemble_locked(out, manifest, surveyed=self._surveyed, progress=report)
        else:
            write_card(out)  # the licence of a mesh may have changed
        scenes = manifest.config.scenes.when == "assembled"
        if scenes and (stale or not (out / SCENES_FILE).is_file()):
            with self._progress("scenes", "objects") as report:
                make_scenes_locked(out, execute=execute, progress=report)
        return stale

    def _progress(self, stage: str, unit: str) -> AbstractContextManager[Report]:
        return progress_bar(stage, unit, show=self._show)

    def _warn(self, text: str) -> None:
        """Log and print a warning for the user, unless it is empty."""
        if text:
            self.log("notice", text=text)
            self._say(text)

    def _say(self, text: str) -> None:
        if self._show:
            sys.stderr.write(f"{printable(text)}\n")

    def _no_worker(self) -> None:
        self.log("no worker")
        self._say("there is no worker: waiting for one")

    def _begin(self, manifest: Manifest, notices: Sequence[str]) -> None:
        """Log the start of the build, and observe the workers."""
        self.log(
            "started",
            command=sys.argv,
            host=socket.gethostname(),
            config_hash=manifest.config.simulation_hash(),
            seed=manifest.config.seed,
            versions=manifest.versions,
        )
        for notice in notices:
            self.log("notice", text=notice)
        if self._pool is not None:
            self._pool.on_change = self._workers_changed
            self._pool.on_none = self._no_worker

    def _workers_changed(self, joined: set[str], left: set[str]) -> None:
        assert self._pool is not None
        for event, addresses in (("worker joined", joined), ("worker lost", left)):
            for address in sorted(addresses):
                self.log(event, address=address, workers=self._pool.size)

    def _prepare_all(
        self, sources: Sequence[MeshSource], manifest: Manifest, report: Report
    ) -> Manifest:
        """Return the manifest with every object prepared or rejected, in the sources' order."""
        entries: dict[str, ObjectEntry | RefusedMesh] = {}
        tasks = []

        # Reuse the manifest's entries of unchanged meshes.
        for source in sources:
            digest = source_sha256(source)
            entry = _known_entry(source, digest, self._out, manifest)
            if entry is not None:
                entries[source.name] = entry
                continue
            tasks.append(
                PrepareTask(
                    source=source,
                    mesh_sha256=digest,
                    out=self._out,
                    config=manifest.config,
                    postures=self._postures and self._postures.of_object(source.name),
                    restartable=self._pool is not None,
                )
            )
        known = len(entries)
        report(known, len(sources), found=known)

        # Prepare the others, in any order.
        for name, entry in self._execute(prepare_one, tasks):
            entries[name] = entry
            if isinstance(entry, RefusedMesh):
                self.log("mesh refused", name=name, reason=entry.reason)
            else:
                facts = {"candidates": entry.candidates, "notes": list(entry.notes)}
                self.log("mesh prepared", name=name, **facts)
            report(len(entries), len(sources), found=known)

        # If a mesh has changed, its rows and its rejected grasps no longer exist.
        ordered = [entries[source.name] for source in sources]
        before = {entry.name: entry for entry in manifest.objects}
        same = {e.name for e in ordered if e.name in before and _same_mesh(before[e.name], e)}
        floors = {name: n for name, n in palms_in_files(self._out).items() if name in same}
        objects = list[ObjectEntry]()
        for source in sources:
            entry = entries[source.name]
            if isinstance(entry, RefusedMesh):
                continue
            self._floors[entry.name] = floors.get(entry.name, 0)

            # A dataset only grows: fewer palm poses take none out of the files.
            most = max(manifest.config.candidates.max, self._floors[entry.name])
            if entry.candidates > most:
                entry = replace(entry, candidates=most, ended=False)

            # Licence and group do not affect results. An object stays in its split.
            split = before[entry.name].split if entry.name in before else None
            objects.append(
                replace(entry, tried=None, licence=source.licence, group=source.group, split=split)
            )
        return replace(
            manifest,
            objects=tuple(objects),
            refused=tuple(entry for entry in ordered if isinstance(entry, RefusedMesh)),
            rejected=tuple(key for key in manifest.rejected if key.object in same),
        )

    def _run_all(self, manifest: Manifest, report: Report) -> tuple[Counts, Manifest]:
        """Run the missing work units.

        Returns:
            The counts of all units, and the manifest. With a target, the manifest has the number of
            palm poses that the dataset takes of each object.
        """
        config = manifest.config
        target = Target(config, self._floors) if config.has_target else None
        counts = Counts(manifest, target, self._pool, report)

        # The progress bar shows the number of workers as it changes.
        if self._pool is not None:

            def change(joined: set[str], left: set[str]) -> None:
                self._workers_changed(joined, left)
                counts.show()

            self._pool.on_change = change

        # Count the units of earlier builds, which are reused.
        rejected = {(key.object, key.candidate, key.standoff_index) for key in manifest.rejected}
        if target is not None:
            _set_units(target, manifest)

        def add(summary: UnitSummary, *, reused: bool = False) -> None:
            if target is not None:
                name = summary.header.object_name
                hits = [c for c, s in summary.hits if (name, c, s) not in rejected]
                target.add(summary.header, hits)
            counts.add(summary, reused=reused)

        done = set[ShardHeader]()
        find = partial(find_units, self._out, config)
        for units, damaged in self._execute(find, find_tasks(self._out, manifest)):
            for summary in units:
                done.add(summary.header)
                add(summary, reused=True)
            for path, reason in damaged:
                counts.damaged.append(path)
                self.log("damaged shard", reason=reason)
        counts.show()  # the first unit may take a minute

        if target is not None:
            return counts, self._meet(target, manifest, add)
        due = [header for header in manifest.headers() if header not in done]
        part = self._part
        mine = due if part is None else [h for i, h in enumerate(manifest.headers()) if part.has(i)]
        self._run_units((header for header in mine if header not in done), manifest, add)
        self._left = len({*due} - {*mine})
        return counts, manifest

    def _meet(self, target: Target, manifest: Manifest, add: _Add) -> Manifest:
        """Run units until a target is met or cannot be met.

        Returns:
            The manifest with the number of palm poses that the dataset takes of each object.
        """
        while True:
            self._run_units(target.next_units(), manifest, add)
            if dry := target.dry():
                manifest = self._draw_more(dry, manifest)
                write_manifest(manifest, self._out)  # for those who watch the build
                _set_units(target, manifest)
            elif None not in (taken := target.taken()).values():
                objects = tuple(replace(e, tried=taken[e.name]) for e in manifest.objects)
                met = replace(manifest, objects=objects)
                if not target.lose(self._outliers(met)):
                    self._warnings = target.warnings()
                    return met

    def _draw_more(self, names: Sequence[str], manifest: Manifest) -> Manifest:
        """Return the manifest with twice as many palm poses of some objects."""
        config = manifest.config
        tasks = [
            DrawTask(
                out=self._out,
                name=entry.name,
                config=manifest.config_of(entry.name),
                count=min(2 * entry.candidates, config.candidates.max),
            )
            for entry in manifest.objects
            if entry.name in names
        ]
        drawn = dict(self._execute(draw_palms, tasks))
        objects = (with_drawn(entry, drawn.get(entry.name, entry)) for entry in manifest.objects)
        return replace(manifest, objects=tuple(objects))

    def _outliers(self, manifest: Manifest) -> dict[str, int]:
        """Return how many samples of each object the filter of outliers removes."""
        config, names = manifest.config, [entry.name for entry in manifest.objects]
        if config.filters.outlier_sigma == 0.0 or config.max_grasps is not None:
            return {}
        if not manifest.units:
            return {}
        self._surveyed = survey(self._out, manifest)
        successes = self._surveyed.successes
        lost = judge_successes(successes, config.filters) == Removal.OUTLIER
        counts = np.bincount(successes["object"][lost], minlength=len(names))
        return dict(zip(names, counts.tolist(), strict=True))

    def _run_units(
        self,
        headers: Iterable[ShardHeader],
        manifest: Manifest,
        add: _Add,
    ) -> None:
        """Run work units, and count their results."""
        units = (
            WorkUnit(
                out=self._out,
                header=header,
                config=manifest.config,
                restartable=self._pool is not None,
            )
            for header in headers
        )

        # Count and log each unit when it is done.
        for summary in self._execute(run_unit, units):
            add(summary)
            self.log(
                "unit done",
                object=summary.header.object_name,
                start=summary.header.start,
                stop=summary.header.stop,
                outcomes={outcome.label: count for outcome, count in summary.outcomes.items()},
                seconds={stage: round(seconds, 4) for stage, seconds in summary.seconds.items()},
                errors=summary.errors,
            )


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


def refuse_missing(known: Manifest, names: Collection[str], out: Path) -> None:
    """Check that all meshes from which a dataset was built are given to continue it.

    Args:
        known: The manifest of the dataset.
        names: Names of the given meshes.
        out: Directory of the dataset.

    Raises:
        DataError: If a mesh is missing.
    """
    built = [entry.name for entry in known.objects] + [mesh.name for mesh in known.refused]
    missing = [name for name in built if name not in names]
    if missing:
        raise DataError(
            f"{out}: must be given every mesh that it was built from, got none named "
            f"{missing[0]}; choose another --out"
        )


def _known_entry(
    source: MeshSource, digest: str, out: Path, manifest: Manifest
) -> ObjectEntry | RefusedMesh | None:
    """Return the manifest's entry of a mesh if it is still valid, else None."""
    for refusal in manifest.refused:
        if (refusal.name, refusal.mesh_sha256) == (source.name, digest) and not refusal.again:
            return refusal
    for entry in manifest.objects:
        known = (entry.name, entry.class_name, entry.mesh_sha256)
        if known == (source.name, source.class_name, digest):
            try:
                prepared = load_prepared(out, source.name, manifest.config)
            except DrakegraspError:
                return None
            # A build that was stopped may have drawn more palm poses than the manifest says.
            enough = prepared.asked >= first_palms(manifest.config)
            return with_drawn(entry, prepared.entry()) if enough else None
    return None


def _same_mesh(entry: ObjectEntry, other: ObjectEntry | RefusedMesh) -> bool:
    return entry.mesh_sha256 == other.mesh_sha256


def _count(names: Sequence[str], what: str) -> str:
    """Return e.g. `3 shards (a, b, c)`; a long list of names is cut."""
    return f"{len(names)} {what}{'s' * (len(names) != 1)} ({listed(names)})"
