"""The whole path from meshes to files; an `Executor` does the work.

`build` plans and records. The executor runs two kinds of tasks: preparing an object and running a
work unit. Results may come back in any order; the files are the same.
"""

from __future__ import annotations

import time
from collections.abc import Collection, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from drakegrasp.config import Config, continued, is_own_class
from drakegrasp.dataset.assemble import Assembly, assemble_locked, summarise
from drakegrasp.dataset.assembly.split import rank_in_split
from drakegrasp.dataset.assembly.survey import headers_by_object
from drakegrasp.dataset.card import write_card
from drakegrasp.dataset.filtering import own_filters
from drakegrasp.dataset.lock import Holder, build_lock
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
from drakegrasp.dataset.prepared_objects import load_prepared
from drakegrasp.dataset.shards import ShardHeader
from drakegrasp.dataset.statistics import is_assembled
from drakegrasp.errors import ConfigError, DataError, DrakegraspError, GraspError, listed
from drakegrasp.frames import unpack_pose
from drakegrasp.generation.counts import Counts, Target, refuse_two_ends, target_of
from drakegrasp.generation.done_units import find_tasks, find_units
from drakegrasp.generation.events import BuildEvents, nothing_trains, too_heavy
from drakegrasp.generation.prepare import PrepareTask, prepare_one
from drakegrasp.generation.scenes import make_scenes_locked
from drakegrasp.generation.work_unit import WorkUnit, run_unit
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.folder import carry_hand
from drakegrasp.hand.parsing import position_order
from drakegrasp.objects.sources import MeshSource, source_sha256
from drakegrasp.runtime.executor import Executor, WorkerPool
from drakegrasp.runtime.files import disk_full_named, sweep_temporary
from drakegrasp.runtime.progress import Report, progress_bar
from drakegrasp.simulation.attempts import Attempts, misfits
from drakegrasp.simulation.drive import drive_of
from drakegrasp.simulation.samplers import own_sampler

#: By how much a rank may be off the border of a split that depends on which objects have samples.
NEAR_BORDER = 0.05


@dataclass(frozen=True, kw_only=True)
class BuildReport:
    """What a build did.

    Attributes:
        out: Directory of the dataset.
        simulated: Number of work units that were run now.
        reused: Number of work units that were done before.
        objects: Number of objects.
        refused: Name and reason of each mesh that was refused.
        errors: Number of solver errors by message, of the units that were run now.
        notices: What the user should know: damage that was repaired, leftovers that were removed.
        unexplained: A line for each object so many of whose attempts crashed or timed out that the
            machine must be at fault; the dataset is complete, but its labels are wrong there.
        assembled: Whether the files were written now, or were those of all shards already.
        assembly: What the files hold.
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


@dataclass(frozen=True, kw_only=True, eq=False)
class _Job:
    """What the steps of a build share."""

    out: Path
    execute: Executor
    pool: WorkerPool | None
    events: BuildEvents
    postures: Attempts | None
    show: bool


def build(
    sources: Sequence[MeshSource],
    out: Path,
    config: Config,
    execute: Executor,
    *,
    postures: Attempts | None = None,
    pool: WorkerPool | None = None,
    show: bool = True,
) -> BuildReport:
    """Build or complete the dataset of some meshes in a directory.

    What is complete already, and of the same configuration and mesh, is not done again. Refused
    meshes are reported; the others go on.

    Args:
        sources: The meshes.
        out: Directory; new, empty, or of this configuration.
        config: All the rules.
        execute: Does the work.
        postures: See `build_locked`.
        pool: The executor's processes, if they are started again when they die: then a crash or
            a hang costs one attempt. Without, crashes propagate to the caller.
        show: Whether to show progress on standard error.

    Raises:
        ConfigError: As `refuse_unusable`.
        DataError: If the directory cannot be used, another process builds there, or no mesh
            can be simulated.
        GraspError: If no row of the postures is one of these objects.
        HandError: If the hand cannot be used.
        DiskFullError: If there is no room; the same call goes on when there is.
        MachineError: If the workers cannot do the work.
    """
    refuse_unusable(config)
    drive_of(load_hand(config.hand_source), config.lift)
    with build_lock(out) as dead:
        return build_locked(
            sources, out, config, execute, dead=dead, postures=postures, pool=pool, show=show
        )


def posture_config(config: Config, postures: Attempts | None) -> Config:
    """Return the configuration of a build that tries postures instead of palm poses of samplers.

    Raises:
        ConfigError: If it names other postures than are given.
    """
    digest, named = None if postures is None else postures.digest(), config.candidates.postures
    if named not in (None, digest):
        must = "left out; the postures that are given decide" if digest else "given with postures"
        raise ConfigError(f"candidates.postures must be {must}, got {named!r}")
    if digest is None:
        return config
    # A posture has no stand-off: there is one attempt of each.
    rules = config.candidates
    changed = {"postures": digest, "standoffs": rules.standoffs[:1]}
    return config.model_copy(update={"candidates": rules.model_copy(update=changed)})


def refuse_unusable(config: Config) -> None:
    """Refuse at once what would stop a build later.

    Raises:
        ConfigError: If it states both a number of grasps and of samples to stop at, or a class of
            the user's own cannot be used.
    """
    refuse_two_ends(config)
    for name in filter(is_own_class, config.candidates.methods):
        own_sampler(name, config.candidates.code)
    own_filters(config.filters)


def build_locked(
    sources: Sequence[MeshSource],
    out: Path,
    config: Config,
    execute: Executor,
    *,
    dead: Holder | None,
    postures: Attempts | None = None,
    pool: WorkerPool | None = None,
    show: bool = True,
) -> BuildReport:
    """Build a dataset in a directory whose lock the caller holds; see `build`.

    Args:
        sources: The meshes.
        out: Directory; new, empty, or of this configuration.
        config: All the rules.
        execute: Does the work.
        dead: Who held the lock before and died, as `build_lock` yields it.
        postures: What is tried instead of palm poses of samplers; the configuration knows it by
            its digest, see `posture_config`. Rows that are none are told, and left out.
        pool: The executor's processes, as for `build`.
        show: Whether to show progress on standard error.

    Raises:
        DataError, DiskFullError, MachineError: As for `build`.
    """
    events = BuildEvents(out, pool, show=show)
    job = _Job(out=out, execute=execute, pool=pool, events=events, postures=postures, show=show)
    with disk_full_named(out):
        # The directory must be ours, and the dataset in it must be of these meshes.
        known = claim_directory(out, config)
        if known is not None:
            refuse_missing(known, [source.name for source in sources], out)
            config = continued(config, known.config)
        config = carry_hand(out, config, known.config.hand if known else None)

        notices = [] if dead is None else [f"the lock of a dead build was taken over: {dead}"]
        notices += _sweep(out)
        try:
            return _build(sources, config, known, notices, job)
        except BaseException as error:
            # The log says why a build stopped; a second error would hide the first.
            with suppress(OSError, DataError):
                if (out / "manifest.json").exists():
                    events.stopped(error)
                else:
                    release_directory(out)
            raise


def _build(
    sources: Sequence[MeshSource],
    config: Config,
    known: Manifest | None,
    notices: list[str],
    job: _Job,
) -> BuildReport:
    """Prepare, simulate, assemble."""
    out, start = job.out, time.monotonic()

    # The manifest comes first: without one a directory holds no dataset.
    hand, versions = load_hand(config.hand_source), installed_versions(config)
    new = Manifest(config=config, versions=versions, fingers=finger_names(config))
    joints = position_order(hand.model, hand.palm_link)
    manifest = replace(known or new, config=config, joints=joints)
    manifest = replace(manifest, versions={**manifest.versions, "hand": versions["hand"]})
    write_manifest(manifest, out)
    job.events.started(manifest, notices)
    if warning := nothing_trains(sources, config.split):
        job.events.warn(warning)

    # Prepare each object, or refuse its mesh.
    with progress_bar("prepare", "objects", show=job.show) as report:
        manifest = _prepare_all(sources, manifest, job, report)
    if not manifest.objects:
        if known is None:
            release_directory(out)
        reasons = "; ".join(f"{entry.name}: {entry.reason}" for entry in manifest.refused)
        raise DataError(f"no mesh can be simulated: {reasons}")
    write_manifest(manifest, out)
    if warning := too_heavy(manifest):
        job.events.warn(warning)
    if job.postures is not None:
        refused, nameless = _refused_postures(job.postures, manifest), job.postures.nameless
        for told in filter(None, (refused, nameless)):
            job.events.warn(told)
            notices.append(told)

    # Simulate the work units that are not done; killed workers leave temporary files.
    with progress_bar("simulate", "attempts", show=job.show) as report:
        counts, manifest, target = _run_all(manifest, job, report)
    write_manifest(manifest, out)
    notices += [] if target is None else target.shortfall()
    if job.pool is not None:
        sweep_temporary(out)

    # Assemble the shards, unless the files are of these very shards already.
    stale = not is_assembled(out, verify_shards=True, execute=job.execute)
    if stale:
        with progress_bar("assemble", "tasks", show=job.show) as report:
            assemble_locked(out, manifest, execute=job.execute, progress=report)
    else:
        write_card(out)  # the licence of a mesh may be stated otherwise now
    if config.scenes.when == "assembled" and (stale or not (out / SCENES_FILE).is_file()):
        with progress_bar("scenes", "objects", show=job.show) as report:
            make_scenes_locked(out, execute=job.execute, progress=report)

    # Report.
    if counts.damaged:
        damaged = _count(counts.named, "shard", counts.damaged)
        notices.append(f"{damaged}: damaged, and simulated again")
    unexplained = tuple(counts.unexplained())
    for line in unexplained:
        job.events.warn(line)
    seconds = time.monotonic() - start
    job.events.finished(simulated=counts.simulated, reused=counts.reused, seconds=seconds)
    return BuildReport(
        out=out,
        simulated=counts.simulated,
        reused=counts.reused,
        objects=len(manifest.objects),
        refused=manifest.refused,
        errors=dict(counts.errors),
        notices=tuple(notices),
        unexplained=unexplained,
        assembled=stale,
        assembly=summarise(out),
    )


def _refused_postures(postures: Attempts, manifest: Manifest) -> str:
    """Return which rows of the postures are not tried, and why; empty if all are.

    Raises:
        GraspError: If none is left.
    """
    for entry in manifest.objects:
        poses = unpack_pose([pose.X_TO for pose in entry.resting])
        reasons = misfits(postures, entry.name, entry.scale, poses)
        postures = postures.refuse(reasons)
    if all(postures.invalid):
        raise GraspError(postures.refused)
    return postures.refused


def _sweep(out: Path) -> list[str]:
    """Remove what dead processes left half-written; return a notice of it."""
    swept = [str(path.relative_to(out)) for path in sweep_temporary(out)]
    return [f"{_count(swept, 'temporary file')} of dead processes removed"] if swept else []


def refuse_missing(known: Manifest, names: Collection[str], out: Path) -> None:
    """Refuse to continue a dataset without a mesh that it was built from.

    Args:
        known: The manifest of the dataset.
        names: Of the meshes that are given.
        out: Directory of the dataset.

    Raises:
        DataError: If one is missing.
    """
    built = [entry.name for entry in known.objects] + [mesh.name for mesh in known.refused]
    missing = [name for name in built if name not in names]
    if missing:
        raise DataError(
            f"{out}: must be given every mesh that it was built from, got none named "
            f"{missing[0]}; choose another --out"
        )


def _prepare_all(
    sources: Sequence[MeshSource], manifest: Manifest, job: _Job, report: Report
) -> Manifest:
    """Return the manifest with every object prepared or refused, in the order of the sources."""
    out, config = job.out, manifest.config
    entries: dict[str, ObjectEntry | RefusedMesh] = {}
    tasks = []

    # What the manifest says of an unchanged mesh still holds.
    for source in sources:
        digest = source_sha256(source)
        entry = _known_entry(source, digest, out, manifest)
        if entry is None:
            tasks.append(
                PrepareTask(
                    source=source,
                    mesh_sha256=digest,
                    out=out,
                    config=config,
                    postures=job.postures and job.postures.of_object(source.name),
                    restartable=job.pool is not None,
                )
            )
        else:
            entries[source.name] = entry
    known = len(entries)
    report(known, len(sources), found=known)

    # Prepare the others, in any order.
    for name, entry in job.execute(prepare_one, tasks):
        entries[name] = entry
        job.events.mesh_done(entry)
        report(len(entries), len(sources), found=known)

    # Licence and group do not affect results; take them from the sources.
    said = {source.name: (source.licence, source.group) for source in sources}
    ordered = [entries[source.name] for source in sources]

    # A rejected grasp of another mesh was another grasp.
    before = {entry.name: entry.mesh_sha256 for entry in manifest.objects}
    same = {entry.name for entry in ordered if before.get(entry.name) == entry.mesh_sha256}
    return replace(
        manifest,
        objects=tuple(
            replace(entry, licence=said[entry.name][0], group=said[entry.name][1])
            for entry in ordered
            if isinstance(entry, ObjectEntry)
        ),
        refused=tuple(entry for entry in ordered if isinstance(entry, RefusedMesh)),
        rejected=tuple(key for key in manifest.rejected if key.object in same),
    )


def _known_entry(
    source: MeshSource, digest: str, out: Path, manifest: Manifest
) -> ObjectEntry | RefusedMesh | None:
    """Return a mesh's entry in the manifest if it still holds, else None."""
    for refusal in manifest.refused:
        if (refusal.name, refusal.mesh_sha256) == (source.name, digest) and not refusal.again:
            return refusal
    for entry in manifest.objects:
        known = (entry.name, entry.class_name, entry.mesh_sha256)
        if known == (source.name, source.class_name, digest):
            try:
                load_prepared(out, source.name, manifest.config)
            except DrakegraspError:
                return None
            return entry
    return None


def _run_all(
    manifest: Manifest, job: _Job, report: Report
) -> tuple[Counts, Manifest, Target | None]:
    """Run the work units that are not done.

    Returns:
        The counts of all, the manifest with how many palm poses a target of samples took, and the
        target.
    """
    every = replace(manifest, objects=tuple(replace(e, tried=None) for e in manifest.objects))
    counts = Counts(every, job.pool, report)

    # The progress bar shows the number of workers as it changes.
    if job.pool is not None:

        def change(joined: set[str], left: set[str]) -> None:
            job.events.workers_changed(joined, left)
            counts.show()

        job.pool.on_change = change

    # What an earlier build has done is not done again.
    by_object = {units[0].object_name: units for units in headers_by_object(every) if units}
    target = target_of(every.config, by_object)
    done = _count_done(every, job, counts, target)
    if target is None:
        # An object may have enough grasps by the time that there is room for its next unit.
        headers = (h for h in every.headers() if counts.needs(h) and h not in done)
        _run_units(headers, every, job, counts, None)
        return counts, every, None

    # Round after round until the target is met.
    while (plan := target.plan())[2]:
        _run_units(target.next_units(), every, job, counts, target)
    taken, _, _ = plan
    objects = tuple(
        replace(entry, tried=_tried(by_object.get(entry.name, ())[: taken.get(entry.name, 0)]))
        for entry in every.objects
    )
    return counts, replace(every, objects=objects), target


def _tried(units: Sequence[ShardHeader]) -> int:
    """Return the number of palm poses in the first units of an object."""
    return units[-1].stop if units else 0


def _spared(manifest: Manifest) -> set[str]:
    """Return the names of the objects whose palm poses are not refined."""
    # By the name, which a shard is of; a group can be said anew, and is for morphs alone another.
    share, seed = manifest.config.refine.spared, manifest.config.seed
    names = (entry.name for entry in manifest.objects)
    return {name for name in names if rank_in_split(name, seed) < share}


def _likely_tested(manifest: Manifest) -> set[str]:
    """Return the names of the objects that a split by object may test or validate with.

    Which it does depends on which objects have samples. The shares are a little larger here, so
    that hardly any is left out.
    """
    rules, config = manifest.config.split, manifest.config
    ranks = {
        entry.name: rank_in_split(group, config.seed)
        for entry, group in zip(manifest.objects, manifest.groups, strict=True)
    }
    low, high = rules.test_fraction + NEAR_BORDER, 1.0 - rules.valid_fraction - NEAR_BORDER
    return {name for name, rank in ranks.items() if rank < low or rank >= high}


def _run_units(
    headers: Iterable[ShardHeader],
    manifest: Manifest,
    job: _Job,
    counts: Counts,
    target: Target | None,
) -> None:
    """Run work units, and count what they found."""
    config, restartable = manifest.config, job.pool is not None
    spared, tested = _spared(manifest), _likely_tested(manifest)
    units = (
        WorkUnit(
            out=job.out,
            header=header,
            config=config,
            refined=header.object_name not in spared,
            likely_tested=header.object_name in tested,
            restartable=restartable,
        )
        for header in headers
    )

    for summary in job.execute(run_unit, units):
        counts.simulated += 1
        counts.errors.update(summary.errors)
        if target is not None and summary.samples is not None:
            target.add(summary.header, summary.samples)
        counts.add(summary.header, summary.outcomes, samples=summary.samples)
        job.events.unit_done(summary)


def _count_done(
    manifest: Manifest, job: _Job, counts: Counts, target: Target | None
) -> set[ShardHeader]:
    """Return the work units that are done; count them, and the damage."""
    done = set[ShardHeader]()
    find = partial(find_units, manifest.config)
    for found in job.execute(find, find_tasks(job.out, manifest)):
        for header, outcomes, samples in found.done:
            done.add(header)
            counts.reused += 1
            counts.add(header, outcomes, reused=True, samples=samples)
            if target is not None and samples is not None:
                target.add(header, samples)
        for path, reason in found.damaged:
            counts.add_damaged(path)
            job.events.damaged_shard(reason)
    return done


def _count(names: Sequence[str], what: str, total: int | None = None) -> str:
    """Return e.g. `3 shards (a, b, c)`; of many only the first are named."""
    count = len(names) if total is None else total
    return f"{count} {what}{'s' * (count != 1)} ({listed(names, total)})"
