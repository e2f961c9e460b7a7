"""The whole path from meshes to files, apart from who does the work.

`build` plans and records; an `Executor` runs the two kinds of tasks: preparing an object
and running a work unit. Results come back in any order and the files end up the same.
"""

from __future__ import annotations

import socket
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from drakegrasp.build.counts import NAMED, Tally
from drakegrasp.build.prepare import PrepareTask, prepare_one
from drakegrasp.build.work_unit import UnitSummary, WorkUnit, find_outcomes, run_unit
from drakegrasp.config import Config
from drakegrasp.dataset.assemble import Assembly, assemble, is_assembled, summarise
from drakegrasp.dataset.lock import build_lock
from drakegrasp.dataset.log import BuildLog
from drakegrasp.dataset.manifest import (
    Manifest,
    ObjectEntry,
    RefusedMesh,
    claim_directory,
    installed_versions,
    release_directory,
    write_manifest,
)
from drakegrasp.dataset.prepared_objects import load_prepared
from drakegrasp.dataset.shards import ShardHeader
from drakegrasp.errors import DataError, DrakegraspError
from drakegrasp.hand.description import load_hand
from drakegrasp.objects.sources import MeshSource, source_sha256
from drakegrasp.runtime.executor import Crew, Executor
from drakegrasp.runtime.files import disk_full_named, sweep_temporary
from drakegrasp.runtime.progress import Report, progress_bar


@dataclass(frozen=True, kw_only=True)
class BuildReport:
    """What a build did.

    Attributes:
        out: Directory of the dataset.
        simulated: Work units that were run now.
        reused: Work units that had been done before.
        objects: Number of objects.
        refused: Name and reason of each mesh that was refused.
        errors: Number of solver errors by message, of the units that were run now.
        notices: What was found that should not have been there, and what became of it.
        assembly: What the files hold.
    """

    out: Path
    simulated: int
    reused: int
    objects: int
    refused: tuple[RefusedMesh, ...]
    errors: dict[str, int]
    notices: tuple[str, ...]
    assembly: Assembly


@dataclass(frozen=True, kw_only=True, eq=False)
class _Job:
    """What the steps of a build share."""

    out: Path
    execute: Executor
    crew: Crew | None
    log: BuildLog
    show: bool


def build(
    sources: Sequence[MeshSource],
    out: Path,
    config: Config,
    execute: Executor,
    *,
    crew: Crew | None = None,
    show: bool = True,
) -> BuildReport:
    """Build or complete the dataset of some meshes in a directory.

    What is there already, complete and of the same configuration and mesh, is not done
    again. Refused meshes are reported; the others go on.

    Args:
        sources: The meshes.
        out: Directory; new, empty, or of this configuration.
        config: All the rules.
        execute: Who does the work.
        crew: Its processes, if they are started again when they die: then a crash or a hang
            costs one attempt. In the caller's own process it is the caller's to see.
        show: Whether to show progress on standard error.

    Raises:
        DataError: If the directory cannot be used, another process builds there, or no mesh
            is fit to be simulated.
        HandError: If the hand cannot be used.
        DiskFullError: If there is no room; the same call goes on when there is.
        MachineError: If the workers cannot do the work.
    """
    load_hand(config.hand)
    job = _Job(out=out, execute=execute, crew=crew, log=BuildLog(out), show=show)
    with build_lock(out) as dead, disk_full_named(out):
        notices = [] if dead is None else [f"the lock of a dead build was taken over: {dead}"]
        known = claim_directory(out, config)
        if known is not None:
            _refuse_missing(known, sources, out)
        notices += _sweep(out)
        try:
            return _build(sources, config, known, notices, job)
        except BaseException as error:
            # What stopped a build is worth a line, but not another error.
            with suppress(OSError):
                if (out / "manifest.json").exists():
                    job.log("stopped", reason=f"{type(error).__name__}: {error}")
            raise


def _sweep(out: Path) -> list[str]:
    swept = [str(path.relative_to(out)) for path in sweep_temporary(out)]
    return [f"{_count(swept, 'temporary file')} of dead processes removed"] if swept else []


def _build(
    sources: Sequence[MeshSource],
    config: Config,
    known: Manifest | None,
    notices: list[str],
    job: _Job,
) -> BuildReport:
    out, start = job.out, time.monotonic()
    new = Manifest(config=config, versions=installed_versions(config))
    manifest = replace(known or new, config=config)
    write_manifest(manifest, out)
    _log_start(manifest, notices, job)
    with progress_bar("prepare", "objects", show=job.show) as report:
        manifest = _prepare_all(sources, manifest, job, report)
    if not manifest.objects:
        if known is None:
            release_directory(out)
        reasons = "; ".join(f"{entry.name}: {entry.reason}" for entry in manifest.refused)
        raise DataError(f"at least one mesh must be fit to simulate, got none: {reasons}")
    write_manifest(manifest, out)
    with progress_bar("simulate", "attempts", show=job.show) as report:
        tally = _run_all(manifest, job, report)
    if job.crew is not None:
        sweep_temporary(out)  # what workers that were killed were writing
    if tally.simulated or not is_assembled(out):
        with progress_bar("assemble", "shards", show=job.show) as report:
            assemble(out, progress=report)
    if tally.damaged:
        notices.append(
            f"{_count(tally.named, 'shard', tally.damaged)}: damaged, and simulated again"
        )
    seconds = round(time.monotonic() - start, 3)
    job.log("finished", simulated=tally.simulated, reused=tally.reused, seconds=seconds)
    return BuildReport(
        out=out,
        simulated=tally.simulated,
        reused=tally.reused,
        objects=len(manifest.objects),
        refused=manifest.refused,
        errors=dict(tally.errors),
        notices=tuple(notices),
        assembly=summarise(out),
    )


def _log_start(manifest: Manifest, notices: Sequence[str], job: _Job) -> None:
    job.log(
        "started",
        command=sys.argv,
        host=socket.gethostname(),
        config_hash=manifest.config.simulation_hash(),
        seed=manifest.config.seed,
        versions=manifest.versions,
    )
    for notice in notices:
        job.log("notice", text=notice)
    if job.crew is not None:
        job.crew.on_change = partial(_log_change, job)
        job.crew.on_none = partial(_say_none, job)


def _log_change(job: _Job, joined: set[str], left: set[str]) -> None:
    assert job.crew is not None
    for event, addresses in (("worker joined", joined), ("worker lost", left)):
        for address in sorted(addresses):
            job.log(event, address=address, workers=job.crew.size)


def _say_none(job: _Job) -> None:
    job.log("no worker")
    if job.show:
        sys.stderr.write("no worker is there: waiting for one\n")


def _count(names: Sequence[str], what: str, total: int | None = None) -> str:
    """Return e.g. `3 shards (a, b, c)`; of many only the first are named."""
    total = len(names) if total is None else total
    more = ", ..." if total > NAMED else ""
    return f"{total} {what}{'s' * (total != 1)} ({', '.join(names[:NAMED])}{more})"


def _refuse_missing(known: Manifest, sources: Sequence[MeshSource], out: Path) -> None:
    """Refuse to go on with a dataset without a mesh that it was built from."""
    names = {source.name for source in sources}
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
    out, config = job.out, manifest.config.to_dict()
    found: dict[str, ObjectEntry | RefusedMesh] = {}
    pending = []
    for source in sources:
        entry = _known_entry(source, out, manifest)
        if entry is None:
            expendable = job.crew is not None
            pending.append(
                PrepareTask(source=source, out=str(out), config=config, expendable=expendable)
            )
        else:
            found[source.name] = entry
    known = len(found)
    report(known, len(sources), found=known)
    for name, entry in job.execute(prepare_one, pending):
        found[name] = entry
        if isinstance(entry, RefusedMesh):
            job.log("mesh refused", name=name, reason=entry.reason)
        else:
            job.log("mesh prepared", name=name, candidates=entry.candidates)
        report(len(found), len(sources), found=known)
    entries = [found[source.name] for source in sources]
    return replace(
        manifest,
        objects=tuple(entry for entry in entries if isinstance(entry, ObjectEntry)),
        refused=tuple(entry for entry in entries if isinstance(entry, RefusedMesh)),
    )


def _known_entry(
    source: MeshSource, out: Path, manifest: Manifest
) -> ObjectEntry | RefusedMesh | None:
    """Return what the manifest says of a mesh, if that still holds."""
    digest = source_sha256(source)
    for refusal in manifest.refused:
        if (refusal.name, refusal.mesh_sha256) == (source.name, digest):
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


def _run_all(manifest: Manifest, job: _Job, report: Report) -> Tally:
    """Run the work units that are not done; return what is done then."""
    tally = Tally(manifest, job.crew, report)
    config, expendable = manifest.config.to_dict(), job.crew is not None
    if job.crew is not None:

        def change(joined: set[str], left: set[str]) -> None:
            _log_change(job, joined, left)
            tally.show()

        job.crew.on_change = change

    def units() -> Iterator[WorkUnit]:
        for header in manifest.headers():
            if tally.wants(header) and not _is_done(header, tally, job):
                yield WorkUnit(
                    out=str(job.out), header=header, config=config, expendable=expendable
                )

    for summary in job.execute(run_unit, units()):
        tally.simulated += 1
        tally.errors.update(summary.errors)
        tally.add(summary.header, summary.outcomes)
        _log_unit(summary, job)
    return tally


def _is_done(header: ShardHeader, tally: Tally, job: _Job) -> bool:
    """Return whether a shard is there and whole, and count it; one that is harmed is named."""
    try:
        outcomes = find_outcomes(job.out, header)
    except DataError as error:
        tally.add_damaged(str(header.path(job.out).relative_to(job.out)))
        job.log("damaged shard", reason=str(error))
        return False
    if outcomes is None:
        return False
    # Its process may have died between the shard and the end of the journal.
    header.journal_path(job.out).unlink(missing_ok=True)
    tally.reused += 1
    tally.add(header, outcomes, found=True)
    return True


def _log_unit(summary: UnitSummary, job: _Job) -> None:
    header = summary.header
    job.log(
        "unit done",
        object=header.object_name,
        start=header.start,
        stop=header.stop,
        outcomes={outcome.label: count for outcome, count in summary.outcomes.items()},
        seconds={stage: round(seconds, 4) for stage, seconds in summary.seconds.items()},
        errors=summary.errors,
    )
