"""Building a dataset or the frozen benchmark on Dask workers.

These are the functions that `drakegrasp` exports and the command line calls.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Unpack

from drakegrasp.cluster.admission import admitted_workers
from drakegrasp.cluster.connect import Workers, dashboard_line, has_dashboard, joined
from drakegrasp.cluster.executor import RESUBMISSIONS, DaskExecutor
from drakegrasp.cluster.wire import by_wire
from drakegrasp.config import BUILD_PRESET, Config
from drakegrasp.dataset.lock import build_lock
from drakegrasp.dataset.manifest import claim_directory, release_directory
from drakegrasp.dataset.paths import BENCHMARK_FILE, BUILTIN_FOLDER
from drakegrasp.dataset.paths import FILE_NAME as MANIFEST
from drakegrasp.dataset.schema import CAMERAS, DATA_FIELDS
from drakegrasp.errors import DataError, GraspError, counted
from drakegrasp.exchange.attempts import read_attempts
from drakegrasp.foreign_files import refuse_address
from drakegrasp.generation.pipeline import (
    BuildReport,
    build_locked,
    ended,
    posture_config,
    refuse_missing,
    refuse_part,
    refuse_unusable,
)
from drakegrasp.generation.request import BUILTIN, Part, read_part, refuse_unknown
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.folder import carry_hand
from drakegrasp.hand.settings import load_config
from drakegrasp.objects.sources import MeshSource, find_meshes
from drakegrasp.runtime.executor import Executor
from drakegrasp.runtime.progress import progress_bar
from drakegrasp.scoring.benchmark import NAME, PRESET, write_objects
from drakegrasp.shapes.catalog import builtin_sources, draw_builtin
from drakegrasp.simulation.attempts import Attempts, unknown_objects
from drakegrasp.simulation.drive import drive_of

if TYPE_CHECKING:
    from distributed import Client


def build_dataset(
    objects: str | Path,
    out: str | Path,
    *,
    config: Config | None = None,
    units: str = "m",
    manifest: str | Path | None = None,
    only: Sequence[str] = (),
    postures: str | Path | Attempts | None = None,
    part: str | None = None,
    read_as: Mapping[str, str] | None = None,
    client: Client | None = None,
    cluster: AbstractContextManager[Client] | None = None,
    show: bool = True,
    **workers: Unpack[Workers],
) -> BuildReport:
    """Build the dataset of a directory of meshes; the same as `drakegrasp build`.

    Work that is complete in `out` is kept: the same call continues where an earlier call stopped.

    Args:
        objects: Directory of meshes, or "builtin" for the built-in objects, whose number
            `config.builtin` specifies.
        out: Directory of the dataset. Files travel over the network if a worker does not see it.
        config: All the rules; None for the preset `fast`. If it draws any number of palm poses and
            states no end, each object ends with 20 samples.
        units: Unit of length of the meshes: m, cm or mm.
        manifest: YAML file with units and classes per mesh, if it is not in their folder.
        only: Names of the objects to build; all if empty.
        postures: A file or a table of postures that replace drawn palm poses. Only the objects that
            it names are built; invalid rows are reported and left out.
        part: A part of the work units, e.g. "3/16"; `merge` joins the directories of all parts.
            It cannot be combined with a requested number of samples.
        read_as: How to read all postures of a file: `frame` and `link` override what the file
            states; `preshape` applies to rows that name none.
        client: A Dask client whose workers do the work, e.g. from `connect`.
        cluster: Instead of a client: starts the workers when the directory is known to be usable,
            and yields their client.
        show: Whether to show progress on standard error.
        workers: The arguments of `connect`, instead of a client; one process per core if neither
            is given.

    Raises:
        MeshError: If there is no mesh.
        GraspError: If no row of the postures is for an available object.
        ConfigError: If both workers and a scheduler are given, the address is empty, the scheduler
            wants no certificate although `tls` is set, or the part is invalid.
        DataError: If `out` cannot be used, another process builds there, or no mesh can be
            simulated.
        MachineError: If there is no scheduler, the workers cannot do the work, or the disk is full;
            the same call continues when that is fixed.
    """
    refuse_address(out)
    running = joined(client, workers) if cluster is None else cluster
    out, config = Path(out).absolute(), config or load_config(BUILD_PRESET)
    hand = load_hand(config.hand_source)
    drive_of(hand, config.lift)
    if isinstance(postures, str | Path):
        postures = read_attempts(Path(postures), hand, read_as=read_as)
    sources = find_sources(objects, units, manifest)
    return build_on(
        running,
        sources,
        out,
        config,
        only=only,
        postures=postures,
        part=None if part is None else read_part(part),
        show=show,
    )


def find_sources(
    objects: str | Path, units: str, manifest: str | Path | None
) -> list[MeshSource] | None:
    """Return the meshes of a directory, or None for the built-in objects.

    Raises:
        MeshError: If there is no mesh.
    """
    if str(objects) == BUILTIN:
        return None
    return find_meshes(objects, units=units, manifest=manifest)


def build_on(
    cluster: AbstractContextManager[Client],
    sources: Sequence[MeshSource] | None,
    out: Path,
    config: Config,
    *,
    only: Sequence[str] = (),
    postures: Attempts | None = None,
    part: Part | None = None,
    show: bool = True,
) -> BuildReport:
    """Build a dataset on the workers of a cluster; see `build_dataset`.

    The directory is locked before the workers start, so a second build is rejected before that.

    Args:
        cluster: Starts workers, and yields their client, e.g. `connect(2)`.
            Give an existing client as `contextlib.nullcontext(client)`.
        sources: The meshes; None for the built-in objects.
        out: Directory of the dataset, absolute.
        config: All the rules.
        only: See `build_dataset`.
        postures: See `build_dataset`.
        part: See `build_dataset`.
        show: Whether to show progress on standard error.

    Raises:
        ConfigError, HandError: As `refuse_unusable` of `generation.pipeline`.
        DataError: If `out` cannot be used, another process builds there, or no mesh can be
            simulated.
        MeshError: If `only` names no object.
        MachineError: If a worker would give other results than this machine.
    """
    config = ended(posture_config(config, postures))
    refuse_unusable(config)
    refuse_part(part, config)
    only, postures = _chosen(_names(sources, config), only, postures)
    with build_lock(out) as dead, ExitStack() as stack:
        # A directory that cannot be used is rejected before workers start.
        before = claim_directory(out, config)

        # Workers read the hand from the directory.
        config = carry_hand(out, config, before.config.hand if before else None)
        stack.callback(_release_unused, out)
        client = stack.enter_context(cluster)
        if show and has_dashboard() and client.dashboard_link:
            sys.stderr.write(f"{dashboard_line(client)}\n")
        meshes = [source.path for source in sources or ()]
        travels = stack.enter_context(admitted_workers(client, config, out, meshes))

        # The built-in objects become mesh files of the dataset.
        if sources is None:
            with progress_bar("objects", "meshes", show=show) as report:
                sources = builtin_sources(out / BUILTIN_FOLDER, config.builtin, report, only)
        sources = [source for source in sources if not only or source.name in only]

        on_workers = DaskExecutor(client, resubmissions=RESUBMISSIONS)
        execute: Executor = on_workers
        if travels:
            execute = stack.enter_context(by_wire(on_workers, client, out))
        return build_locked(
            sources,
            out,
            config,
            execute,
            dead=dead,
            postures=postures,
            part=part,
            pool=on_workers.pool,
            show=show,
        )


def _names(sources: Sequence[MeshSource] | None, config: Config) -> list[str]:
    """Return the names of the meshes, or of the built-in objects if `sources` is None."""
    known = draw_builtin(config.builtin) if sources is None else sources
    return [each.name for each in known]


def _chosen(
    names: Sequence[str], only: Sequence[str], postures: Attempts | None
) -> tuple[Sequence[str], Attempts | None]:
    """Return the names of the objects to build, none for all, and the postures of these objects.

    Raises:
        MeshError: If `only` names no object.
        GraspError: If no posture is for one of the objects.
    """
    refuse_unknown(only, names)
    if postures is None:
        return only, None
    postures = postures.refuse(unknown_objects(postures, names))
    named = dict.fromkeys(
        name for name, bad in zip(postures.objects, postures.invalid, strict=True) if not bad
    )
    only = [name for name in named if not only or name in only]
    if not only:
        why = f": {postures.refused}" if postures.refused else ", got none of them"
        raise GraspError(f"postures must be of an object that is built{why}")
    return only, postures


def known_work(
    objects: str | Path,
    *,
    config: Config,
    units: str = "m",
    manifest: str | Path | None = None,
    only: Sequence[str] = (),
    postures: Path | None = None,
    part: str | None = None,
    read_as: Mapping[str, str] | None = None,
) -> list[str]:
    """Return lines on the work of a build as far as it is known before; nothing is written.

    Arguments and errors are those of `build_dataset`.
    """
    hand = load_hand(config.hand_source)
    table = None if postures is None else read_attempts(postures, hand, read_as=read_as)
    config = ended(posture_config(config, table))
    refuse_unusable(config)
    job = None if part is None else read_part(part)
    refuse_part(job, config)
    drive_of(hand, config.lift)
    names = _names(find_sources(objects, units, manifest), config)
    only, table = _chosen(names, only, table)
    count = len(set(only or names))

    # A posture is tried in each resting pose and with each preshape that it allows.
    if table is not None:
        rows = sum(len(table.of_object(name)) for name in only)
        return [f"{counted(count, 'object')}: {counted(rows, 'posture')}"]
    if config.has_target:
        return _target_lines(config, count)
    poses = config.candidates.max
    work_units = count * sum(1 for _ in config.unit_ranges(poses))
    palms = counted(count * poses, "palm pose")
    lines = [f"{counted(count, 'object')}: at most {palms} in {counted(work_units, 'work unit')}"]
    if job is not None:
        of_job = sum(map(job.has, range(work_units)))
        lines.append(f"part {part}: at most {of_job:,} of these work units")
    return lines


def _target_lines(config: Config, objects: int) -> list[str]:
    """Return what ends a build with a target, and the size of the images of its samples."""
    each, grasps = config.samples_per_object, config.max_grasps
    ends = [counted(config.samples, "sample")] if config.samples is not None else []
    ends += [f"{counted(each, 'sample')} of each"] if each is not None else []
    ends += [f"{counted(grasps, 'grasp')} of each"] if grasps is not None else []
    palms = counted(config.candidates.max, "palm pose")
    lines = [f"{counted(objects, 'object')}: until {' or '.join(ends)}, at most {palms} of each"]
    wanted = [n for n in (config.samples, each and objects * each) if n is not None]
    if not wanted:
        return lines
    # Their size on the disk depends on how well they can be compressed.
    images = [field.empty(1, {"S": config.camera.size}) for field in DATA_FIELDS if field.sample]
    size = min(wanted) * len(CAMERAS) * sum(image.nbytes for image in images)
    images_of = f"images of {counted(min(wanted), 'sample')}"
    return [*lines, f"{images_of}: {size / 1e6:,.1f} MB before compression"]


def _release_unused(out: Path) -> None:
    """Remove what a build put into a directory if it did not begin."""
    if not (out / MANIFEST).exists():
        release_directory(out)


def make_benchmark(
    out: str | Path,
    *,
    only: Sequence[str] = (),
    overrides: Sequence[str] = (),
    client: Client | None = None,
    show: bool = True,
    **workers: Unpack[Workers],
) -> BuildReport:
    """Build the frozen benchmark `drakegrasp-bench-1`; the same as `drakegrasp bench-set`.

    Args:
        out: Directory of the benchmark, a dataset whose samples are all test samples.
        only: Names of objects, for a part of the benchmark; all if empty.
        overrides: `"key=value"` settings that differ from the published ones; each card states
            them.
        client: A Dask client whose workers do the work, e.g. from `connect`.
        show: Whether to show progress on standard error.
        workers: The arguments of `connect`, instead of a client; one process per core if neither
            is given.

    Raises:
        MeshError: If `only` names no object.
        ConfigError, DataError, MachineError: As `build_dataset`.
    """
    config, folder = load_config(PRESET, list(overrides)), Path(out).absolute()
    with build_lock(folder):
        # A directory that cannot be used is rejected before anything in it changes.
        _claim_benchmark(folder, config, only)
        with progress_bar("objects", "meshes", show=show) as report:
            meshes = write_objects(folder, config, only=only, progress=report)
    return build_dataset(
        meshes, folder, config=config, only=only, client=client, show=show, **workers
    )


def _claim_benchmark(folder: Path, config: Config, only: Sequence[str]) -> None:
    """Reject a directory that this call cannot build or continue as the benchmark.

    Raises:
        DataError: If it has other files, another dataset, or objects that `only` leaves out.
    """
    known = claim_directory(folder, config)
    if known is None:
        return
    if not (folder / BUILTIN_FOLDER / BENCHMARK_FILE).is_file():
        raise DataError(
            f"{folder}: must be empty or hold {NAME}, got another dataset; choose another OUT"
        )
    names = only or [each.name for each in draw_builtin(config.builtin)]
    refuse_missing(known, names, folder)
