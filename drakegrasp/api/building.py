"""Building a dataset, scenes of several objects or the frozen benchmark on Dask workers.

These are the functions that `drakegrasp` exports and the command line calls.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Unpack

from drakegrasp.cluster.connect import Workers, dashboard_line, joined
from drakegrasp.cluster.executor import RESUBMISSIONS, DaskExecutor
from drakegrasp.cluster.wire import by_wire
from drakegrasp.cluster.worker_checks import checked_workers
from drakegrasp.config import BUILD_PRESET, Config
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.paths import BENCHMARK_FILE, BUILTIN_FOLDER, CLUTTER_FILE, MANIFEST_FILE
from drakegrasp.errors import DataError, GraspError, MeshError, counted, listed
from drakegrasp.exchange.attempts import read_attempts
from drakegrasp.foreign_files import validate_local
from drakegrasp.generation.clutter import ClutterRequest, make_clutter
from drakegrasp.generation.directory import (
    BUILTIN,
    build_config,
    open_directory,
)
from drakegrasp.generation.pipeline import BuildReport, build
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.settings import load_config
from drakegrasp.objects.sources import MeshSource, find_meshes
from drakegrasp.objects.surroundings import Surroundings
from drakegrasp.runtime.executor import Executor, WorkerPool
from drakegrasp.runtime.progress import progress_bar
from drakegrasp.scoring import clutter_benchmark
from drakegrasp.scoring.benchmark import NAME, PRESET, write_objects
from drakegrasp.scoring.clutter_benchmark import ClutterFacts
from drakegrasp.shapes.catalog import builtin_sources, draw_builtin
from drakegrasp.simulation.attempts import GraspTable, unknown_objects
from drakegrasp.simulation.fixtures import load_surroundings

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
    postures: str | Path | GraspTable | None = None,
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
            wants no certificate although `tls` is set.
        DataError: If `out` cannot be used, another process builds there, or no mesh can be
            simulated.
        MachineError: If there is no scheduler, the workers cannot do the work, or the disk is full;
            the same call continues when that is fixed.
    """
    validate_local(out)
    running = joined(client, workers) if cluster is None else cluster
    config = config or load_config(BUILD_PRESET)
    work = _asked(objects, config, units, manifest, only, postures, read_as)
    folder, meshes = Path(out).absolute(), work.sources or ()
    with (
        open_directory(folder, work.config, work.names) as directory,
        _workers_of(running, folder, directory.manifest.config, meshes, show=show) as (
            execute,
            pool,
        ),
    ):
        sources = work.sources
        if sources is None:
            # The built-in objects become mesh files of the dataset.
            folder = directory.out / BUILTIN_FOLDER
            with progress_bar("objects", "meshes", show=show) as report:
                sources = builtin_sources(folder, work.config.builtin, report, work.names)
        return build(
            directory,
            sources,
            execute,
            postures=work.postures,
            pool=pool,
            show=show,
        )


@contextmanager
def _workers_of(
    running: AbstractContextManager[Client],
    out: Path,
    config: Config,
    sources: Sequence[MeshSource] = (),
    *,
    show: bool,
) -> Iterator[tuple[Executor, WorkerPool]]:
    """Start the workers of a build and check them; yield their executor and their pool.

    Args:
        running: Starts the workers, and yields their client.
        out: Directory of the dataset.
        config: Its configuration.
        sources: The meshes that workers read, unless they are in the directory.
        show: Whether to print the address of the dashboard.
    """
    with running as client:
        if show:
            sys.stderr.write(dashboard_line(client))
        meshes = [source.path for source in sources]
        with checked_workers(client, config, out, meshes) as travels:
            execute = DaskExecutor(client, resubmissions=RESUBMISSIONS)
            if not travels:
                yield execute, execute.pool
                return
            with by_wire(execute, client, out) as sending:
                yield sending, execute.pool


class _Work(NamedTuple):
    """What a build does, when all that is asked for is known to be there.

    Attributes:
        config: Configuration of the build.
        sources: The meshes of the objects; None for the built-in objects.
        names: Names of the objects.
        postures: Postures of these objects; None: palm poses are drawn.
    """

    config: Config
    sources: list[MeshSource] | None
    names: list[str]
    postures: GraspTable | None


def _asked(
    objects: str | Path,
    config: Config,
    units: str,
    manifest: str | Path | None,
    only: Sequence[str],
    postures: str | Path | GraspTable | None,
    read_as: Mapping[str, str] | None,
) -> _Work:
    """Return what a build with these arguments of `build_dataset` does; nothing is written.

    Raises:
        MeshError, GraspError, ConfigError, HandError: As `build_dataset`.
    """
    if isinstance(postures, str | Path):
        hand = load_hand(config.hand_source)
        postures = read_attempts(Path(postures), hand, read_as=read_as)
    config = build_config(config, postures)

    # The objects, by their names.
    if str(objects) == BUILTIN:
        sources, names = None, [each.name for each in draw_builtin(config.builtin)]
    else:
        sources = find_meshes(objects, units=units, manifest=manifest)
        names = [source.name for source in sources]
    if unknown := [name for name in only if name not in names]:
        raise MeshError(f"only must be names of objects ({listed(names)}), got {unknown[0]!r}")
    chosen = [name for name in names if not only or name in only]
    if postures is not None:
        postures = postures.refuse(unknown_objects(postures, names))
        given = zip(postures.objects, postures.invalid, strict=True)
        valid = {name for name, bad in given if not bad}
        chosen = [name for name in chosen if name in valid]
        if not chosen:
            why = f": {postures.refused}" if postures.refused else ", got none of them"
            raise GraspError(f"postures must be of an object that is built{why}")
    if sources is not None:
        sources = [source for source in sources if source.name in chosen]
    return _Work(config=config, sources=sources, names=chosen, postures=postures)


def known_work(
    objects: str | Path,
    *,
    config: Config,
    units: str = "m",
    manifest: str | Path | None = None,
    only: Sequence[str] = (),
    postures: str | Path | GraspTable | None = None,
    read_as: Mapping[str, str] | None = None,
) -> list[str]:
    """Return lines on the work of a build as far as it is known before; nothing is written.

    Arguments and errors are those of `build_dataset`.
    """
    work = _asked(objects, config, units, manifest, only, postures, read_as)
    config, count = work.config, len(work.names)

    # A posture is tried in each resting pose and with each preshape that it allows.
    if work.postures is not None:
        rows = sum(len(work.postures.of_object(name)) for name in work.names)
        return [f"{counted(count, 'object')}: {counted(rows, 'posture')}"]
    poses = config.candidates.max
    number = count * sum(1 for _ in config.unit_ranges(poses))
    palms = counted(count * poses, "palm pose")
    ends = [counted(config.samples, "sample")] if config.samples is not None else []
    each = config.samples_per_object
    ends += [f"{counted(each, 'sample')} of each"] if each is not None else []
    until = f"until {' or '.join(ends)}, " if ends else ""
    units = counted(number, "work unit")
    return [f"{counted(count, 'object')}: {until}at most {palms} in {units}"]


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
    running, folder = joined(client, workers), Path(out).absolute()
    config = build_config(load_config(PRESET, list(overrides)))
    names = list(only) or [each.name for each in draw_builtin(config.builtin)]
    if (folder / MANIFEST_FILE).exists() and not (
        folder / BUILTIN_FOLDER / BENCHMARK_FILE
    ).is_file():
        raise DataError(
            f"{folder}: must be empty or hold {NAME}, got another dataset; choose another OUT"
        )
    with (
        open_directory(folder, config, names) as directory,
        _workers_of(running, folder, directory.manifest.config, show=show) as (execute, pool),
    ):
        with progress_bar("objects", "meshes", show=show) as report:
            meshes = find_meshes(write_objects(folder, config, only=only, progress=report))
        sources = [source for source in meshes if source.name in names]
        return build(directory, sources, execute, pool=pool, show=show)


def make_clutter_benchmark(
    out: str | Path,
    *,
    client: Client | None = None,
    show: bool = True,
    **workers: Unpack[Workers],
) -> tuple[ClutterFacts, bool]:
    """Build the frozen benchmark `drakegrasp-clutter-1`; the same as `bench-set --clutter`.

    The same call continues.

    Args:
        out: Directory of the benchmark, a dataset with a clutter.hdf5.
        client: A Dask client whose workers do the work, e.g. from `connect`.
        show: Whether to show progress on standard error.
        workers: The arguments of `connect`, instead of a client; one process per core if neither
            is given.

    Returns:
        What identifies its scenes, and whether they are the published ones.

    Raises:
        ConfigError, DataError, MachineError: As `build_dataset`.
    """
    with joined(client, workers) as running:
        about: dict[str, Any] = {"client": running, "show": show}
        build_dataset(BUILTIN, out, config=load_config(clutter_benchmark.PRESET), **about)
        build_clutter(out, **clutter_benchmark.SCENES, **about)
    found = clutter_benchmark.facts_of(Path(out) / CLUTTER_FILE)
    return found, found == clutter_benchmark.published()


def build_clutter(
    out: str | Path,
    *,
    scenes: int = 50,
    objects: tuple[int, int] = (2, 6),
    surroundings: str | Path | Surroundings | Sequence[str | Path | Surroundings] = "table",
    tries: int = 10,
    client: Client | None = None,
    show: bool = True,
    **workers: Unpack[Workers],
) -> dict[str, dict[str, int]]:
    """Write OUT/clutter.hdf5, scenes of several objects; the same as `drakegrasp clutter`.

    Scenes that are complete are kept: the same call continues, and more scenes are added to those
    that are there. Other objects, surroundings or tries replace the file.

    Args:
        out: Directory of a dataset with samples.
        scenes: Number of scenes.
        objects: Smallest and largest number of objects of a scene.
        surroundings: table, bin, shelf, a YAML file of boxes, a model of Drake (.sdf, .urdf,
            .dmd.yaml), or several of these, which scenes take in turn.
        tries: Number of grasps of each scene, among those that geometry calls free, that are tried.
        client: A Dask client whose workers do the work, e.g. from `connect`.
        show: Whether to show progress on standard error.
        workers: The arguments of `connect`, instead of a client; one process per core if neither
            is given.

    Returns:
        The numbers of scenes, objects, views and grasps by split.

    Raises:
        ConfigError: If a number or the surroundings are not possible.
        DataError: If there is no dataset, it has no samples or is damaged, another process builds
            in it, or objects do not come to rest.
        MachineError: If the workers cannot do the work, or the disk is full.
    """
    places = [surroundings] if isinstance(surroundings, str | Path | Surroundings) else surroundings
    request = ClutterRequest(
        scenes=scenes,
        objects=objects,
        surroundings=[p if isinstance(p, Surroundings) else load_surroundings(p) for p in places],
        tries=tries,
    )
    request.validate()
    folder = Path(out).absolute()
    config = read_manifest(folder).config
    with (
        _workers_of(joined(client, workers), folder, config, show=show) as (execute, _),
        progress_bar("clutter", "scenes", show=show) as report,
    ):
        return make_clutter(folder, request, execute=execute, restartable=True, progress=report)
