"""The whole path from meshes to files, apart from who does the work.

`build` plans and records; an `Executor` runs the two kinds of tasks: preparing an object
and running a work unit. Results come back in any order and the files end up the same.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from drakegrasp.assemble import Assembly, assemble, is_assembled, summarise
from drakegrasp.config import Config, parse_config
from drakegrasp.errors import DataError, DrakegraspError, MeshError
from drakegrasp.executor import Executor
from drakegrasp.hand import load_hand
from drakegrasp.manifest import (
    Manifest,
    claim_directory,
    installed_versions,
    release_directory,
    write_manifest,
)
from drakegrasp.meshes import MeshSource, source_sha256
from drakegrasp.outcomes import Outcome
from drakegrasp.prepared import load_prepared, prepare, save_prepared
from drakegrasp.progress import Report, progress_bar
from drakegrasp.shards import ShardHeader, read_outcomes
from drakegrasp.units import WorkUnit, count_outcomes, run_unit


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
        assembly: What the files hold.
    """

    out: Path
    simulated: int
    reused: int
    objects: int
    refused: tuple[dict[str, str], ...]
    errors: dict[str, int]
    assembly: Assembly


@dataclass(frozen=True, kw_only=True)
class _PrepareTask:
    source: MeshSource
    out: str
    config: dict[str, Any]


def build(
    sources: Sequence[MeshSource],
    out: Path,
    config: Config,
    execute: Executor,
    *,
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
        show: Whether to show progress on standard error.

    Raises:
        DataError: If the directory cannot be used, or no mesh is fit to be simulated.
        HandError: If the hand cannot be used.
    """
    load_hand(config.hand)
    known = claim_directory(out, config)
    if known is not None:
        _refuse_missing(known, sources, out)
    new = Manifest(config=config, versions=installed_versions(config))
    manifest = replace(known or new, config=config)
    write_manifest(manifest, out)
    with progress_bar("prepare", "objects", show=show) as report:
        manifest = _prepare_all(sources, out, manifest, execute, report)
    if not manifest.objects:
        if known is None:
            release_directory(out)
        reasons = "; ".join(f"{entry['name']}: {entry['reason']}" for entry in manifest.refused)
        raise DataError(f"at least one mesh must be fit to simulate, got none: {reasons}")
    write_manifest(manifest, out)
    with progress_bar("simulate", "attempts", show=show) as report:
        simulated, reused, errors = _run_all(manifest, out, execute, report)
    if simulated or not is_assembled(out):
        with progress_bar("assemble", "shards", show=show) as report:
            assemble(out, progress=report)
    return BuildReport(
        out=out,
        simulated=simulated,
        reused=reused,
        objects=len(manifest.objects),
        refused=manifest.refused,
        errors=errors,
        assembly=summarise(out),
    )


def _refuse_missing(known: Manifest, sources: Sequence[MeshSource], out: Path) -> None:
    """Refuse to go on with a dataset without a mesh that it was built from."""
    names = {source.name for source in sources}
    missing = [e["name"] for e in (*known.objects, *known.refused) if e["name"] not in names]
    if missing:
        raise DataError(
            f"{out}: must be given every mesh that it was built from, got none named "
            f"{missing[0]}; choose another --out"
        )


def _prepare_all(
    sources: Sequence[MeshSource], out: Path, manifest: Manifest, execute: Executor, report: Report
) -> Manifest:
    """Return the manifest with every object prepared or refused, in the order of the sources."""
    config = manifest.config.to_dict()
    found, pending = {}, []
    for source in sources:
        entry = _known_entry(source, out, manifest)
        if entry is None:
            pending.append(_PrepareTask(source=source, out=str(out), config=config))
        else:
            found[source.name] = entry
    report(len(found), len(sources))
    for name, entry in execute(_prepare_one, pending):
        found[name] = entry
        report(len(found), len(sources))
    entries = [found[source.name] for source in sources]
    return replace(
        manifest,
        objects=tuple(entry for entry in entries if "reason" not in entry),
        refused=tuple(entry for entry in entries if "reason" in entry),
    )


def _known_entry(source: MeshSource, out: Path, manifest: Manifest) -> dict[str, Any] | None:
    """Return what the manifest says of a mesh, if that still holds."""
    digest = source_sha256(source)
    for entry in manifest.refused:
        if (entry["name"], entry["mesh_sha256"]) == (source.name, digest):
            return dict(entry)
    for entry in manifest.objects:
        known = (entry["name"], entry["class"], entry["mesh_sha256"])
        if known == (source.name, source.class_name, digest):
            try:
                load_prepared(out, source.name, manifest.config)
            except DrakegraspError:
                return None
            return dict(entry)
    return None


def _prepare_one(task: _PrepareTask) -> tuple[str, dict[str, Any]]:
    """Prepare one object; return its name and its entry in the manifest."""
    config, out, source = parse_config(task.config), Path(task.out), task.source
    try:
        prepared = prepare(source, config)
    except MeshError as error:
        digest = source_sha256(source)
        return source.name, {"name": source.name, "mesh_sha256": digest, "reason": str(error)}
    save_prepared(prepared, out, config)
    return source.name, prepared.summary()


def _run_all(
    manifest: Manifest, out: Path, execute: Executor, report: Report
) -> tuple[int, int, dict[str, int]]:
    """Run the work units that are not done; return how many were run, how many reused, errors."""
    progress = _Progress(manifest, report)
    pending = []
    for header in manifest.headers():
        outcomes = _outcomes_on_disk(header, out)
        if outcomes is None:
            pending.append(header)
        else:
            progress.add(header, outcomes)
    reused = len(progress.done)
    config = manifest.config.to_dict()
    units = (
        WorkUnit(out=str(out), header=header, config=config)
        for header in pending
        if progress.wants(header)
    )
    errors: Counter[str] = Counter()
    for summary in execute(run_unit, units):
        progress.add(summary.header, summary.outcomes)
        errors.update(summary.errors)
    return len(progress.done) - reused, reused, dict(errors)


def _outcomes_on_disk(header: ShardHeader, out: Path) -> dict[Outcome, int] | None:
    """Return the outcomes of a shard that is whole, or None: then it is done again."""
    path = header.path(out)
    if not path.exists():
        return None
    try:
        return count_outcomes(read_outcomes(path, header))
    except DataError:
        return None


class _Progress:
    """What is done, by work unit, and whether an object needs more."""

    def __init__(self, manifest: Manifest, report: Report) -> None:
        self.done: dict[ShardHeader, dict[Outcome, int]] = {}
        self._report, self._wanted = report, manifest.config.max_grasps
        self._units: dict[str, list[ShardHeader]] = {}
        for header in manifest.headers():
            self._units.setdefault(header.object_name, []).append(header)
        standoffs = len(manifest.config.candidates.standoffs)
        self._total = standoffs * sum(entry["candidates"] for entry in manifest.objects)
        self._totals: Counter[str] = Counter()

    def add(self, header: ShardHeader, outcomes: dict[Outcome, int]) -> None:
        self.done[header] = outcomes
        self._totals["attempts"] += sum(outcomes.values())
        self._totals["grasps"] += outcomes.get(Outcome.SUCCESS, 0)
        self._report(self._totals["attempts"], self._total, grasps=self._totals["grasps"])

    def wants(self, header: ShardHeader) -> bool:
        """Return whether a unit's object lacks grasps in the units before it."""
        if self._wanted is None:
            return True
        grasps = 0
        for earlier in self._units[header.object_name]:
            if earlier == header or earlier not in self.done:
                break
            grasps += self.done[earlier].get(Outcome.SUCCESS, 0)
        return grasps < self._wanted
