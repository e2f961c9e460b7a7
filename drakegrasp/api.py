"""Building a dataset and verifying grasps, on Dask workers or in this process.

Grasps are verified through two doors: `place_object(...).verify(...)` for those of one object, and
`verify_rows` for those of a dataset's rows.

These are the functions that `drakegrasp` exports and the command line calls.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy.typing as npt
import trimesh

from drakegrasp.build.pipeline import BuildReport, build_locked, refuse_unusable
from drakegrasp.build.request import BUILTIN
from drakegrasp.cluster.admission import admitted_workers
from drakegrasp.cluster.certificates import security_of
from drakegrasp.cluster.connect import connect, dashboard_line, has_dashboard
from drakegrasp.cluster.executor import RESUBMISSIONS, DaskExecutor
from drakegrasp.config import Config
from drakegrasp.dataset.lock import build_lock
from drakegrasp.dataset.manifest import claim_directory
from drakegrasp.dataset.paths import BUILTIN_FOLDER
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.errors import ConfigError, GraspError, MeshError, listed
from drakegrasp.frames import Array, as_numbers
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.settings import load_config, override_config
from drakegrasp.objects.sources import MeshSource, find_meshes
from drakegrasp.runtime.executor import count_workers, run_here
from drakegrasp.runtime.progress import progress_bar
from drakegrasp.scoring.benchmark import PRESET, write_objects
from drakegrasp.scoring.ranked import ranked_sets
from drakegrasp.scoring.references import REFERENCES
from drakegrasp.scoring.run import Request, Score
from drakegrasp.scoring.run import score as score_request
from drakegrasp.shapes.catalog import builtin_sources, draw_builtin
from drakegrasp.simulation.drive import drive_of
from drakegrasp.simulation.placement import Placed, config_for
from drakegrasp.simulation.placement import PlacedObject as ObjectOnTable
from drakegrasp.simulation.placement import place_object as put_on_table
from drakegrasp.verification.batch import ResultCallback, ignore_result, verify_batch
from drakegrasp.verification.placed_grasp import (
    dataset_config,
    place_on_object,
    place_on_rows,
)
from drakegrasp.verification.result import Verification
from drakegrasp.verification.verify import PlacedGrasp

if TYPE_CHECKING:
    from distributed import Client

#: What an object on the table is made of: a mesh file, a mesh, or an object that was placed before.
ObjectMesh: TypeAlias = str | Path | trimesh.Trimesh | Placed

#: Up to this many grasps are verified in this process: starting workers would take longer.
FEW_GRASPS = 4
#: Grasps of one object are verified together, at most so many, as long as each worker has some
#: tasks, so that none is idle in the end.
MOST_TOGETHER, TASKS_PER_WORKER = 16, 4


def build_dataset(
    objects: str | Path,
    out: str | Path,
    *,
    config: Config | None = None,
    units: str = "m",
    manifest: str | Path | None = None,
    only: Sequence[str] = (),
    workers: int | None = None,
    scheduler: str | None = None,
    scheduler_file: str | Path | None = None,
    tls_files: tuple[Path, Path, Path] | None = None,
    show: bool = True,
) -> BuildReport:
    """Build the dataset of a directory of meshes; the same as `drakegrasp build`.

    Work that is complete in `out` is kept: the same call continues where an earlier one stopped.

    Args:
        objects: Directory of meshes, or "builtin" for the built-in objects, of which
            `config.builtin` says how many.
        out: Directory of the dataset; it must be visible to every worker.
        config: All the rules; the defaults if None.
        units: Unit of length of the meshes: m, cm or mm.
        manifest: YAML file with units and classes per mesh, if it is not beside the meshes.
        only: Names of the objects to build; all if empty.
        workers: Processes on this machine; one per core if None.
        scheduler: Address of a running Dask scheduler to use instead.
        scheduler_file: Its JSON file, instead of the address.
        tls_files: To encrypt: certificate authority, certificate and private key (PEM).
        show: Whether to show progress on standard error.

    Raises:
        MeshError: If there is no mesh.
        ConfigError: If both workers and a scheduler are given, or the address is empty.
        DataError: If `out` cannot be used, another process builds there, or no mesh can be
            simulated.
        MachineError: If there is no scheduler, the workers cannot do the work, or no room is
            left; the same call continues when that is fixed.
    """
    _refuse_workers(workers, scheduler, scheduler_file)
    out, config = Path(out).absolute(), config or load_config()
    drive_of(load_hand(config.hand), config.lift)
    sources = find_sources(objects, units, manifest)
    security = None if tls_files is None else security_of(tls_files)
    cluster = _announced(connect(workers, scheduler, scheduler_file, security=security), show)
    return build_on(cluster, sources, out, config, only=only, show=show)


@contextmanager
def _announced(cluster: AbstractContextManager[Client], show: bool) -> Iterator[Client]:
    """Enter a cluster and print the link to its dashboard, if it has one."""
    with cluster as client:
        if show and has_dashboard() and client.dashboard_link:
            sys.stderr.write(f"{dashboard_line(client)}\n")
        yield client


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
    show: bool = True,
) -> BuildReport:
    """Build a dataset on the workers of a cluster; see `build_dataset`.

    The directory is locked before the workers start: a second build is refused before that.

    Args:
        cluster: Starts workers that all see `out`, and yields their client, e.g. `connect(2)`. A
            client of the caller's own goes in as `contextlib.nullcontext(client)`.
        sources: The meshes; None for the built-in objects.
        out: Directory of the dataset, absolute.
        config: All the rules.
        only: As for `build_dataset`.
        show: Whether to show progress on standard error.

    Raises:
        ConfigError: As `refuse_unusable` of `build.pipeline`.
        DataError: If `out` cannot be used, another process builds there, or no mesh can be
            simulated.
        MeshError: If `only` names no object.
        MachineError: If a worker would give other results than this machine.
    """
    refuse_unusable(config)
    known = draw_builtin(config.builtin) if sources is None else sources
    _refuse_unknown(only, [each.name for each in known])
    with build_lock(out) as dead, ExitStack() as stack:
        # A directory that cannot be used is refused before workers start.
        claim_directory(out, config)
        client = stack.enter_context(cluster)
        stack.enter_context(admitted_workers(client, config))

        # The built-in objects become mesh files of the dataset.
        if sources is None:
            with progress_bar("objects", "meshes", show=show) as report:
                sources = builtin_sources(out / BUILTIN_FOLDER, config.builtin, report, only)
        sources = [source for source in sources if not only or source.name in only]

        execute = DaskExecutor(client, resubmissions=RESUBMISSIONS)
        return build_locked(sources, out, config, execute, dead=dead, pool=execute.pool, show=show)


def _refuse_unknown(only: Sequence[str], names: Sequence[str]) -> None:
    """Refuse names that no object has.

    Raises:
        MeshError: If there is one.
    """
    unknown = [name for name in only if name not in names]
    if unknown:
        known = listed(names)
        raise MeshError(f"only must be names of objects ({known}), got {unknown[0]!r}")


@dataclass(frozen=True, kw_only=True, eq=False)
class PlacedObject(ObjectOnTable):
    """An object on the table, on which grasps can be verified; made by `place_object`."""

    def verify(
        self,
        grasps: npt.ArrayLike,
        *,
        frame: str = "object",
        X_TC: npt.ArrayLike | None = None,
        method: str = "hand",
        snap_points: bool = False,
        client: Client | None = None,
        show: bool = False,
    ) -> list[Verification]:
        """Return whether predicted grasps hold the object in the simulator, why not, and how.

        A grasp is 6k numbers for a hand of k fingers (18 for the Barrett Hand): k contact points
        [m], then k unit normals out of the object, in the finger order of the hand file. A row of
        numbers that is no grasp has the outcome `invalid`, and spoils no other.

        Args:
            grasps: (n, 6k), or (6k,) for one.
            frame: The frame of the grasps: "object" {O}, whose origin is the centre of the
                bounding box, "camera" {C} or "workspace" {T}.
            X_TC: With frame "camera": pose of the camera in the table-top frame, (4, 4), or one
                per grasp (n, 4, 4).
            method: "hand" closes a simulated hand on the contacts and lifts; "forces" lifts by
                forces at the contacts alone.
            snap_points: Whether to move the points, not the normals, to the nearest ones of the
                object's surface first.
            client: A Dask client whose workers share the work; this process does it if None.
            show: Whether to show progress on standard error.

        Returns:
            The verdicts, in the order of the grasps.

        Raises:
            GraspError: If the whole array has another shape, or the frame, the camera's pose or
                the method cannot be used.
            MachineError: If a worker would give other results than this machine.
        """
        placed = place_on_object(
            grasps, self, frame=frame, X_TC=X_TC, method=method, snap_points=snap_points
        )
        return _verify_on(client, placed, show=show)


def place_object(
    mesh: ObjectMesh,
    *,
    units: str | None = None,
    X_TO: npt.ArrayLike | None = None,
    hand: str | Path | None = None,
    config: Config | None = None,
) -> PlacedObject:
    """Return an object on the table, prepared once for any number of grasps.

    Args:
        mesh: Path of a mesh file, a mesh, or an object that was placed before. The origin
            of {O} is the centre of its bounding box, not that of the file.
        units: Unit of the mesh's lengths: m, cm or mm; metres if None. An `objects.yaml` beside
            a file wins. Grasps are always in metres.
        X_TO: Pose of the object on the table, (4, 4); dropped as in a build if None.
        hand: Name or YAML file of the hand; the configuration's ("barrett") if None.
        config: Hand, physics, lift and rules; that of an object that was placed before, else the
            defaults, if None.

    Raises:
        MeshError: If the mesh cannot be simulated or does not come to rest.
        GraspError: If X_TO is no pose or does not stand on the table.
        ConfigError: If config is none, or an object was placed before with other values.
        HandError: If the hand cannot be used.
    """
    used = config_for(mesh, config)
    if hand is not None:
        used = override_config(used, [], hand=str(hand))
    placed = put_on_table(mesh, units=units, X_TO=X_TO, config=used)
    return PlacedObject(model=placed.model, X_TO=placed.X_TO, config=placed.config)


def verify_rows(
    data: GraspDataset,
    predictions: npt.ArrayLike,
    rows: Sequence[int] | None = None,
    *,
    frame: str = "camera",
    method: str = "hand",
    snap_points: bool = False,
    hand: str | Path | None = None,
    config: Config | None = None,
    client: Client | None = None,
    show: bool = False,
) -> list[Verification]:
    """Return the verdicts on grasps that were predicted for rows of a dataset, in their order.

    A row says which object it is, how it lies on the table, where the camera was, and what
    friction and mass were drawn. See `PlacedObject.verify`.

    Args:
        data: A data file of a dataset, with its split.
        predictions: (n, 6k), or (6k,) for one.
        rows: The row of the split for each grasp; all rows, in order, if None.
        frame: "camera" of this data file, "object" or "workspace".
        method: "hand" or "forces".
        snap_points: Whether to move the points to the object's surface first.
        hand: Name or YAML file of the hand; the dataset's if None.
        config: Physics, lift and rules instead of the dataset's, with what its rows drew.
        client: A Dask client whose workers share the work; this process does it if None.
        show: Whether to show progress on standard error.

    Raises:
        GraspError: As `PlacedObject.verify`, or if rows do not exist or are not one per grasp.
        ConfigError, HandError, DataError: If configuration, hand or dataset cannot be used.
        MachineError: If a worker would give other results than this machine.
    """
    if not isinstance(data, GraspDataset):
        raise GraspError(
            "data must be a GraspDataset, which has a file and a split, "
            f"got a {type(data).__name__}"
        )
    placed = place_on_rows(
        predictions, data, rows, frame=frame, hand=hand, method=method, snap_points=snap_points,
        config=config,
    )  # fmt: skip
    return _verify_on(client, placed, show=show)


def verify_grasp(
    grasp: npt.ArrayLike,
    mesh: ObjectMesh | None = None,
    *,
    row: int | None = None,
    **options: Any,
) -> Verification:
    """Return the verdict on one grasp: the call of version 0.2, see `verify_grasps`."""
    vector = as_numbers(grasp, "a grasp must be a vector of numbers")
    if vector.ndim != 1:
        raise GraspError(f"one grasp must be a vector, got an array of shape {vector.shape}")
    rows = None if row is None else [row]
    (result,) = _verify_as_before("verify_grasp", vector, mesh, rows=rows, **options)
    return result


def verify_grasps(
    grasps: npt.ArrayLike, mesh: ObjectMesh | None = None, **options: Any
) -> list[Verification]:
    """Return the verdicts on many grasps: the call of version 0.2, which the next one drops.

    Use `place_object(mesh, units=…, X_TO=…, hand=…, config=…).verify(grasps, …)`, or
    `verify_rows(dataset, grasps, rows, …)`; their arguments have the same names.
    """
    return _verify_as_before("verify_grasps", grasps, mesh, **options)


def _verify_as_before(
    name: str,
    grasps: npt.ArrayLike,
    mesh: ObjectMesh | None,
    *,
    dataset: GraspDataset | None = None,
    rows: Sequence[int] | None = None,
    frame: str | None = None,
    X_TC: npt.ArrayLike | None = None,
    **options: Any,
) -> list[Verification]:
    """Verify grasps by one of the two new calls, with a warning that says which."""
    new = "place_object(mesh, ...).verify(grasps)" if dataset is None else "verify_rows"
    warnings.warn(f"{name} will be gone in the next version, use {new}", FutureWarning, 3)

    # Rows of a dataset define what the others name.
    if dataset is not None:
        names = ("units", "X_TO")
        given = {"mesh": mesh, "X_TC": X_TC, **{n: options.pop(n, None) for n in names}}
        for key, value in given.items():
            if value is not None:
                raise GraspError(
                    f"{key} must be None with a dataset, which defines it, got a value"
                )
        return verify_rows(dataset, grasps, rows, frame=frame or "camera", **options)
    if mesh is None:
        raise GraspError("a mesh or a dataset must be given, got neither")
    if rows is not None:
        raise GraspError("rows must be None without a dataset, got rows")

    of_object = {"units", "X_TO", "hand", "config"} & options.keys()
    placed = place_object(mesh, **{n: options.pop(n) for n in of_object})
    return placed.verify(grasps, frame=frame or "object", X_TC=X_TC, **options)


def run_verification(
    grasps: Sequence[PlacedGrasp],
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    scheduler_file: str | Path | None = None,
    on_result: ResultCallback = ignore_result,
    show: bool = True,
) -> list[Verification]:
    """Return the verdicts on placed grasps in the caller's order; the work of `drakegrasp verify`.

    With one worker, or with few grasps, this process does the work: starting workers would take
    longer.

    Args:
        grasps: From `verification.placed_grasp`.
        workers: Processes on this machine; one per core if None.
        scheduler: Address of a running Dask scheduler to use instead.
        scheduler_file: Its JSON file, instead of the address.
        on_result: Is called with each verdict in the caller's order, once all earlier ones exist.
        show: Whether to show progress on standard error.

    Raises:
        ConfigError: If both workers and a scheduler are given.
        MachineError: If a worker would give other results than this machine.
    """
    _refuse_workers(workers, scheduler, scheduler_file)
    alone = len(grasps) <= FEW_GRASPS or count_workers(workers) == 1
    if alone and not (scheduler or scheduler_file):
        return _verify_on(None, grasps, on_result, show=show)
    with connect(workers, scheduler, scheduler_file) as client:
        return _verify_on(client, grasps, on_result, show=show)


def _verify_on(
    client: Client | None,
    grasps: Sequence[PlacedGrasp],
    on_result: ResultCallback = ignore_result,
    *,
    show: bool,
) -> list[Verification]:
    """Verify grasps on the workers of a client, or in this process without one."""
    with progress_bar("verify", "grasps", show=show) as report:
        if client is None or not grasps:
            return verify_batch(grasps, run_here, report, on_result)
        with admitted_workers(client, grasps[0].config):
            tasks = TASKS_PER_WORKER * max(len(client.nthreads()), 1)
            together = min(max(len(grasps) // tasks, 1), MOST_TOGETHER)
            return verify_batch(grasps, DaskExecutor(client), report, on_result, together=together)


def _refuse_workers(
    workers: int | None, scheduler: str | None, scheduler_file: str | Path | None
) -> None:
    """Refuse a number of workers that is below one, or given with a scheduler.

    Raises:
        ConfigError: If so.
    """
    if scheduler is not None and not scheduler.strip():
        raise ConfigError(f"scheduler must be an address like tcp://host:8786, got {scheduler!r}")
    if workers is not None and (scheduler or scheduler_file):
        raise ConfigError("workers must not be given with a scheduler, which has its own")
    count_workers(workers)


def score(
    predictions: npt.ArrayLike | str | Path | Sequence[str | Path],
    dataset: GraspDataset,
    *,
    rows: Sequence[int] | None = None,
    confidence: npt.ArrayLike | None = None,
    train: GraspDataset | None = None,
    references: Sequence[str] = tuple(REFERENCES),
    per_object: int | None = None,
    overrides: Sequence[str] = (),
    out: str | Path | None = None,
    again: str = "drakegrasp.score",
    workers: int | None = None,
    scheduler: str | None = None,
    scheduler_file: str | Path | None = None,
    show: bool = False,
) -> Score:
    """Return the score of predicted grasps beside reference rows; see docs/how-to/score.md.

    Args:
        predictions: In the frame of the rows' camera: (n, 6k), one per row, or (n, m, 6k), m per
            row; or a file of them, or several files of one method that was trained several times.
            An empty list scores the reference rows alone.
        dataset: The split whose rows the predictions are for.
        rows: With an array: (n,), the row of each; all rows, in order, if None.
        confidence: With an array: (n,) or (n, m), greater is better.
        train: Training rows for reference rows; the split `train` of the same file if None.
        references: Names of the reference rows, see `scoring.references.REFERENCES`.
        per_object: Rows of each object, at most; all if None.
        overrides: `"key=value"` settings; `verify.max_tries` is 1 if they do not say otherwise,
            because the headline is of the first wrist pose.
        out: Folder that keeps verdicts, so that the same call goes on, and gets the card.
        again: What the card says about how to make it again.
        workers: Processes on this machine; one per core if None.
        scheduler: Address of a running Dask scheduler to use instead.
        scheduler_file: Its JSON file, instead of the address.
        show: Whether to show progress on standard error.

    Raises:
        GraspError: If predictions and rows do not fit.
        ConfigError, DataError, HandError, MachineError: As `run_verification`.
    """
    # What is scored, by which rules.
    unknown = [name for name in references if name not in REFERENCES]
    if unknown:
        raise GraspError(f"references must be of {', '.join(REFERENCES)}, got {unknown[0]!r}")
    settings = ("verify.max_tries=1", *overrides)
    name, ranked = ranked_sets(predictions, dataset, rows=rows, confidence=confidence)
    request = Request(
        data=dataset,
        train=GraspDataset(dataset.path, split="train") if train is None else train,
        predictions=ranked,
        name=name,
        references=tuple(references),
        per_object=per_object,
        config=dataset_config(dataset, overrides=settings),
        again=again,
    )

    # Its verdicts, by this process or workers, and the card.
    def try_all(grasps: Array, chosen: Sequence[int], on_result: ResultCallback) -> object:
        placed = place_on_rows(grasps, dataset, chosen, overrides=settings)
        return run_verification(
            placed,
            workers=workers,
            scheduler=scheduler,
            scheduler_file=scheduler_file,
            on_result=on_result,
            show=show,
        )

    scored = score_request(request, try_all, None if out is None else Path(out))
    if out is not None:
        scored.save(Path(out))
    return scored


def make_benchmark(
    out: str | Path,
    *,
    only: Sequence[str] = (),
    overrides: Sequence[str] = (),
    workers: int | None = None,
    scheduler: str | None = None,
    scheduler_file: str | Path | None = None,
    show: bool = True,
) -> BuildReport:
    """Make the frozen benchmark `drakegrasp-bench-1`; the same as `drakegrasp bench-set`.

    Args:
        out: Directory of the benchmark, which is a dataset whose samples all test.
        only: Names of objects, for a part of the benchmark; all if empty.
        overrides: `"key=value"` settings that differ from the published ones; each card says so.
        workers: Processes on this machine; one per core if None.
        scheduler: Address of a running Dask scheduler to use instead.
        scheduler_file: Its JSON file, instead of the address.
        show: Whether to show progress on standard error.

    Raises:
        MeshError: If `only` names no object.
        ConfigError, DataError, MachineError: As `build_dataset`.
    """
    config, folder = load_config(PRESET, list(overrides)), Path(out).absolute()
    with progress_bar("objects", "meshes", show=show) as report:
        meshes = write_objects(folder, config, only=only, progress=report)
    return build_dataset(
        meshes,
        folder,
        config=config,
        only=only,
        workers=workers,
        scheduler=scheduler,
        scheduler_file=scheduler_file,
        show=show,
    )
