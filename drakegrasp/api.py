"""The public calls: building datasets and verifying grasps, on Dask workers or in this process.

A build's tasks are work units of many attempts. Their data are written as shards; only a summary
comes back. A few tasks per worker are in flight at a time, whatever their number.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy.typing as npt

from drakegrasp.build.pipeline import BuildReport, build_locked
from drakegrasp.build.request import BUILTIN
from drakegrasp.cluster.admission import admitted_workers
from drakegrasp.cluster.connect import connect, dashboard_line, has_dashboard
from drakegrasp.cluster.executor import RESUBMISSIONS, DaskExecutor
from drakegrasp.config import Config, load_config, parse_config
from drakegrasp.dataset.lock import build_lock
from drakegrasp.dataset.manifest import claim_directory
from drakegrasp.dataset.paths import BUILTIN_FOLDER
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.errors import ConfigError, GraspError
from drakegrasp.frames import as_numbers
from drakegrasp.hand.description import load_hand
from drakegrasp.objects.builtin.catalog import export_builtin
from drakegrasp.objects.sources import MeshSource, find_meshes
from drakegrasp.runtime.environment import available_cores
from drakegrasp.runtime.executor import Executor, run_here
from drakegrasp.runtime.progress import progress_bar
from drakegrasp.verification.result import Verification
from drakegrasp.verification.tasks import (
    TASK_GRASPS,
    Mesh,
    ResultCallback,
    VerifyTask,
    plan_verification,
    refuse_off_surface,
    run_task,
    split_task,
    verify_tasks,
)

if TYPE_CHECKING:
    from distributed import Client


def build_dataset(
    objects: str | Path,
    out: str | Path,
    *,
    config: Config | None = None,
    units: str = "m",
    manifest: str | Path | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    scheduler_file: str | Path | None = None,
    show: bool = True,
) -> BuildReport:
    """Build the dataset of a directory of meshes; the same as `drakegrasp build`.

    What is complete in `out` is kept: the same call goes on where an earlier one stopped.

    Args:
        objects: Directory of meshes, or "builtin" for the built-in objects.
        out: Directory of the dataset; it must be visible to every worker.
        config: All the rules; the preset `paper` if None.
        units: Unit of length of the meshes: m, cm or mm.
        manifest: YAML file with units and classes per mesh, if it is not beside the meshes.
        workers: Processes on this machine; one per core if None.
        scheduler: Address of a running Dask scheduler to use instead.
        scheduler_file: Its JSON file, instead of the address.
        show: Whether to show progress on standard error.

    Raises:
        MeshError: If there is no mesh.
        ConfigError: If both workers and a scheduler are given.
        DataError: If `out` cannot be used, another process builds there, or no mesh can be
            simulated.
        MachineError: If there is no scheduler, the workers cannot do the work, or no room is
            left; the same call goes on when that is fixed.
    """
    _refuse_workers(workers, scheduler, scheduler_file)
    out, config = Path(out).absolute(), config or load_config()
    load_hand(config.hand)
    sources = find_sources(objects, units, manifest)
    cluster = _announced(connect(workers, scheduler, scheduler_file), show)
    return build_on(cluster, sources, out, config, show=show)


@contextmanager
def _announced(cluster: AbstractContextManager[Client], show: bool) -> Iterator[Client]:
    """Enter a cluster, and say where its dashboard is."""
    with cluster as client:
        if show and has_dashboard():
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
        show: Whether to show progress on standard error.

    Raises:
        DataError: If `out` cannot be used, another process builds there, or no mesh can be
            simulated.
        MachineError: If a worker would give other results than this machine.
    """
    with (
        build_lock(out) as dead,
        cluster as client,
        admitted_workers(client, config) as kernel,
    ):
        # The built-in objects become mesh files of the dataset.
        if sources is None:
            claim_directory(out, config)
            export_builtin(out / BUILTIN_FOLDER)
            sources = find_meshes(out / BUILTIN_FOLDER)

        execute = DaskExecutor(client, resubmissions=RESUBMISSIONS)
        execute.pool.kernel = kernel
        return build_locked(sources, out, config, execute, dead=dead, pool=execute.pool, show=show)


def verify_grasps(
    grasps: npt.ArrayLike,
    mesh: Mesh | None = None,
    *,
    frame: str | None = None,
    X: npt.ArrayLike | None = None,
    X_TO: npt.ArrayLike | None = None,
    units: str | None = None,
    hand: str | Path | None = None,
    method: str = "hand",
    config: Config | None = None,
    dataset: GraspDataset | None = None,
    rows: Sequence[int] | None = None,
    client: Client | None = None,
    show: bool = False,
) -> list[Verification]:
    """Return the verdicts on many predicted grasps, in their order; see `verify_grasp`.

    Other than there a grasp whose contacts are not on the surface is no mistake of the
    caller's: its outcome is `off_surface`.

    Args:
        grasps: (n, 6k).
        mesh: The object, as for `verify_grasp`.
        frame: What the grasps are expressed in, as there.
        X: With frame "camera": X_TC (4, 4), or one per grasp (n, 4, 4).
        X_TO: Pose of the object on the table (4, 4); dropped as in a build if None.
        units: Unit of the mesh's lengths: m, cm or mm; metres if None.
        hand: Name or YAML file of the hand; the configuration's if None.
        method: "hand" or "forces".
        config: Physics, lift and limits; if None that of the dataset or of the placed object,
            else the preset `paper`.
        dataset: In place of a mesh: a data file of a dataset.
        rows: The rows of its split that the grasps are for; all of them, in order, if None.
        client: A Dask client whose workers share the work; a plain loop here if None.
        show: Whether to show progress on standard error.

    Raises:
        GraspError, MeshError, ConfigError, HandError, DataError: As `verify_grasp`, before
            anything is simulated.
        MachineError: If a worker would give other results than this machine.
    """
    tasks = plan_verification(
        grasps,
        mesh,
        frame=frame,
        X=X,
        X_TO=X_TO,
        units=units,
        hand=hand,
        method=method,
        config=config,
        dataset=dataset,
        rows=rows,
    )
    return _verify(tasks, client, show)


def run_verification(
    tasks: Sequence[VerifyTask],
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    scheduler_file: str | Path | None = None,
    deliver: ResultCallback,
    show: bool = True,
) -> list[Verification]:
    """Return the verdicts of tasks in the order of their grasps; what `drakegrasp verify` does.

    One worker, or few grasps, run as a plain loop in this process: starting workers would take
    longer.

    Args:
        tasks: From `tasks.plan_verification`.
        workers: Processes on this machine; one per core if None.
        scheduler: Address of a running Dask scheduler to use instead.
        scheduler_file: Its JSON file, instead of the address.
        deliver: Called with each verdict, in that order, as soon as those before it are there.
        show: Whether to show progress on standard error.

    Raises:
        ConfigError: If both workers and a scheduler are given.
        MachineError: If a worker would give other results than this machine.
    """
    _refuse_workers(workers, scheduler, scheduler_file)
    few = sum(len(task.indices) for task in tasks) <= TASK_GRASPS
    if not (scheduler or scheduler_file) and (few or (workers or available_cores()) == 1):
        return _verify(tasks, None, show, deliver)
    with connect(workers, scheduler, scheduler_file) as client:
        return _verify(tasks, client, show, deliver)


def _verify(
    tasks: Sequence[VerifyTask],
    client: Client | None,
    show: bool,
    deliver: ResultCallback = lambda index, result: None,
) -> list[Verification]:
    if client is None:
        # In this process a task per grasp costs nothing, and progress is finer.
        parts = [part for task in tasks for part in split_task(task, 1)]
        return _verify_with(run_here, parts, show, deliver)
    if not tasks:
        return []
    with admitted_workers(client, parse_config(tasks[0].config)):
        return _verify_with(DaskExecutor(client), tasks, show, deliver)


def _verify_with(
    execute: Executor, tasks: Sequence[VerifyTask], show: bool, deliver: ResultCallback
) -> list[Verification]:
    with progress_bar("verify", "grasps", show=show) as report:
        return verify_tasks(tasks, execute, report, deliver)


def _refuse_workers(
    workers: int | None, scheduler: str | None, scheduler_file: str | Path | None
) -> None:
    """Refuse a number of workers below one, or one given together with a scheduler.

    Raises:
        ConfigError: If so.
    """
    if workers is not None and (scheduler or scheduler_file):
        raise ConfigError("workers must not be given with a scheduler, which has its own")
    if workers is not None and workers < 1:
        raise ConfigError(f"workers must be at least 1, got {workers}")


def verify_grasp(
    grasp: npt.ArrayLike,
    mesh: Mesh | None = None,
    *,
    frame: str | None = None,
    X: npt.ArrayLike | None = None,
    X_TO: npt.ArrayLike | None = None,
    units: str | None = None,
    hand: str | Path | None = None,
    method: str = "hand",
    config: Config | None = None,
    dataset: GraspDataset | None = None,
    row: int | None = None,
) -> Verification:
    """Return whether a predicted grasp holds an object in the simulator, why not, and how.

    The grasp is 6k numbers for a hand of k fingers (18 for the Barrett Hand): k contact
    points [m], then k unit normals out of the object, in the hand file's finger order.

    Args:
        grasp: (6k,).
        mesh: Path of a mesh file, a trimesh, or what `place_object` returned: that one is
            prepared once for many calls. {O} is at the centre of its bounding box.
        frame: What the grasp is expressed in: "object" {O} (the default), "camera" {C} or
            "workspace" {T}. With a dataset the default is the camera of its file.
        X: With frame "camera": pose of the camera in the table-top frame, X_TC (4, 4).
        X_TO: Pose of the object on the table (4, 4); dropped as in a build if None.
        units: Unit of the mesh's lengths: m, cm or mm; metres if None. The grasp is in metres
            always.
        hand: Name or YAML file of the hand; the configuration's ("barrett") if None.
        method: "hand" closes a simulated hand on the contacts and lifts; "forces" lifts by
            forces at the contacts alone.
        config: Physics, lift and limits; if None that of the dataset or of the placed object,
            else the preset `paper`.
        dataset: In place of a mesh: a data file of a dataset, whose row has the object, its
            pose and the camera's.
        row: The row of its split that the grasp is for.

    Raises:
        GraspError: If the grasp, its frame or a pose cannot be used.
        OffSurfaceError: If a contact is farther than `verify.max_surface_distance` from the
            surface, or a normal points inwards. `verify_grasps` has an outcome for this.
        MeshError: If the mesh cannot be simulated.
        ConfigError, HandError, DataError: If configuration, hand or dataset cannot be used.
    """
    vector = as_numbers(grasp, "a grasp must be a vector of numbers")
    if vector.ndim != 1:
        raise GraspError(
            f"one grasp must be a vector, got an array of shape {vector.shape}; "
            "verify_grasps takes many"
        )
    if dataset is not None and row is None:
        raise GraspError("row must be that of the dataset that the grasp is for, got None")
    (task,) = plan_verification(
        vector,
        mesh,
        frame=frame,
        X=X,
        X_TO=X_TO,
        units=units,
        hand=hand,
        method=method,
        config=config,
        dataset=dataset,
        rows=None if row is None else [row],
    )
    _, (result,) = run_task(task)
    refuse_off_surface(result)
    return result
