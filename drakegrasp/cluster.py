"""Running the work on Dask.

Tasks are work units of many attempts; their data goes through shards, and only a summary
comes back. A few tasks per worker are in flight at a time, whatever their number.
"""

from __future__ import annotations

import importlib.util
import logging
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import dask
import numpy.typing as npt
from distributed import Client, LocalCluster, SpecCluster
from distributed.security import Security

from drakegrasp.build import BuildReport, build
from drakegrasp.build_lock import build_lock
from drakegrasp.build_options import BUILTIN
from drakegrasp.builtin import export_builtin
from drakegrasp.config import Config, load_config, parse_config
from drakegrasp.crew import RESUBMISSIONS, DaskExecutor
from drakegrasp.dataset import GraspDataset
from drakegrasp.errors import ConfigError, MachineError
from drakegrasp.executor import Executor, run_here
from drakegrasp.hand import load_hand
from drakegrasp.manifest import BUILTIN_FOLDER, claim_directory
from drakegrasp.meshes import MeshSource, find_meshes
from drakegrasp.progress import progress_bar
from drakegrasp.verification import Verification
from drakegrasp.verify_plan import TASK_GRASPS, Mesh, VerifyTask, plan_verification, split_task
from drakegrasp.verifying import Deliver, verify_tasks
from drakegrasp.workers import SATURATION, WORKER_ENVIRONMENT, admitted_workers

#: How long to wait for a scheduler to answer [s].
CONNECT_SECONDS = 10
#: Settings of Dask: a worker's process must not be a fork, because a fork after the first
#: image hangs; its profiler costs time; a worker takes no task before it can start it.
DASK_SETTINGS: dict[str, Any] = {
    "distributed.worker.multiprocessing-method": "spawn",
    # Ctrl-C reaches every process of a terminal: the client stops, and then its workers.
    "distributed.worker.preload": ["import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"],
    "distributed.worker.profile.enabled": False,
    "distributed.scheduler.worker-saturation": SATURATION,
    "distributed.nanny.pre-spawn-environ": WORKER_ENVIRONMENT,
    # A busy machine takes its time to start a worker again; Dask would close its nanny.
    "distributed.deploy.lost-worker-timeout": "60 s",
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    # A paused worker has no task whose end would free memory: it would wait for ever.
    "distributed.worker.memory.pause": False,
}


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

    What is complete in `out` already is kept, so the same call goes on where one stopped.

    Args:
        objects: Directory of meshes, or "builtin" for the built-in objects.
        out: Directory of the dataset; every worker must see it.
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
        DataError: If `out` cannot be used, another process builds there, or no mesh is fit to be
            simulated.
        MachineError: If there is no scheduler, the workers cannot do the work, or no room is
            left; the same call goes on when that is mended.
    """
    _refuse_workers(workers, scheduler, scheduler_file)
    out, config = Path(out).absolute(), config or load_config()
    load_hand(config.hand)
    sources = find_sources(objects, units, manifest)
    # Locked first: a second build is refused before it starts any worker.
    with build_lock(out), connect(workers, scheduler, scheduler_file) as client:
        if show and _has_dashboard():
            sys.stderr.write(f"{dashboard_line(client)}\n")
        return build_on(client, sources, out, config, show=show)


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
    client: Client,
    sources: Sequence[MeshSource] | None,
    out: Path,
    config: Config,
    *,
    show: bool = True,
) -> BuildReport:
    """Build a dataset on the workers of a client; see `build_dataset`.

    Args:
        client: Of a cluster whose workers all see `out`.
        sources: The meshes; None for the built-in objects.
        out: Directory of the dataset, absolute.
        config: All the rules.
        show: Whether to show progress on standard error.

    Raises:
        DataError: If `out` cannot be used, or no mesh is fit to be simulated.
        MachineError: If a worker would give other results than this machine.
    """
    with admitted_workers(client, config), build_lock(out):
        if sources is None:
            claim_directory(out, config)
            export_builtin(out / BUILTIN_FOLDER)
            sources = find_meshes(out / BUILTIN_FOLDER)
        execute = DaskExecutor(client, resubmissions=RESUBMISSIONS)
        return build(sources, out, config, execute, crew=execute.crew, show=show)


def dashboard_line(client: Client) -> str:
    """Return where the dashboard of a client's cluster is, or what it takes to have one."""
    if not _has_dashboard():
        return "dashboard: none; pip install 'drakegrasp[dashboard]'"
    return f"dashboard: {client.dashboard_link}"


def _has_dashboard() -> bool:
    return importlib.util.find_spec("bokeh") is not None


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
    deliver: Deliver,
    show: bool = True,
) -> list[Verification]:
    """Return the verdicts of tasks in the order of their grasps; what `drakegrasp verify` does.

    One worker, or few grasps, are a plain loop in this process: it would take longer to start
    others.

    Args:
        tasks: From `verify_plan.plan_verification`.
        workers: Processes on this machine; one per core if None.
        scheduler: Address of a running Dask scheduler to use instead.
        scheduler_file: Its JSON file, instead of the address.
        deliver: Is given each verdict, in that order, as soon as those before it are there.
        show: Whether to show progress on standard error.

    Raises:
        ConfigError: If both workers and a scheduler are given.
        MachineError: If a worker would give other results than this machine.
    """
    _refuse_workers(workers, scheduler, scheduler_file)
    few = sum(len(task.indices) for task in tasks) <= TASK_GRASPS
    if not (scheduler or scheduler_file) and (few or (workers or _cores()) == 1):
        return _verify(tasks, None, show, deliver)
    with connect(workers, scheduler, scheduler_file) as client:
        return _verify(tasks, client, show, deliver)


def _verify(
    tasks: Sequence[VerifyTask],
    client: Client | None,
    show: bool,
    deliver: Deliver = lambda index, result: None,
) -> list[Verification]:
    if client is None:
        # Here it costs nothing to report every grasp.
        parts = [part for task in tasks for part in split_task(task, 1)]
        return _verify_with(run_here, parts, show, deliver)
    if not tasks:
        return []
    with admitted_workers(client, parse_config(tasks[0].config)):
        return _verify_with(DaskExecutor(client), tasks, show, deliver)


def _verify_with(
    execute: Executor, tasks: Sequence[VerifyTask], show: bool, deliver: Deliver
) -> list[Verification]:
    with progress_bar("verify", "grasps", show=show) as report:
        return verify_tasks(tasks, execute, report, deliver)


@contextmanager
def connect(
    workers: int | None = None,
    scheduler: str | None = None,
    scheduler_file: str | Path | None = None,
    *,
    security: Security | None = None,
    memory: str | None = None,
) -> Iterator[Client]:
    """Connect to a running scheduler, or start a cluster on this machine, while the block runs.

    Args:
        workers: Processes of a cluster on this machine; one per core if None.
        scheduler: Address of a running scheduler.
        scheduler_file: Its JSON file, instead of the address.
        security: Certificates; without, nothing is encrypted.
        memory: Limit per process on this machine, e.g. "2GB"; an equal share of it if None.

    Raises:
        MachineError: If there is no scheduler at the address.
    """
    with dask.config.set(DASK_SETTINGS):
        if scheduler or scheduler_file:
            file = None if scheduler_file is None else str(scheduler_file)
            # Dask waits for the file for ever.
            if file is not None and not scheduler and not Path(file).is_file():
                raise MachineError(
                    f"{file}: must be the file of a running Dask scheduler, got none"
                )
            try:
                client = _RemoteClient(
                    scheduler, scheduler_file=file, timeout=CONNECT_SECONDS, security=security
                )
            except (OSError, RuntimeError, TypeError, ValueError) as error:
                raise MachineError(
                    f"{scheduler or file}: must be a running Dask scheduler, got none ({error})"
                ) from None
            with client:
                yield client
        else:
            cluster = LocalCluster(
                n_workers=workers or _cores(),
                threads_per_worker=1,
                dashboard_address="127.0.0.1:0",
                silence_logs=logging.CRITICAL,
                security=security,
                memory_limit=memory or "auto",
            )
            with closing_cluster(cluster), Client(cluster) as client:
                yield client


class _RemoteClient(Client):
    """A client that closes at once where it cannot start.

    Dask leaves that to the garbage collector. Should it run while the next client starts, it waits
    for ever for the lock that this one holds (distributed 2026.8, `LoopRunner.stop`).
    """

    def start(self, **kwargs: Any) -> None:
        """Start the client's loop and connect."""
        try:
            super().start(**kwargs)
        except BaseException:
            self.close()
            raise


@contextmanager
def closing_cluster(cluster: SpecCluster) -> Iterator[None]:
    """Close a cluster when the block ends; a worker that takes its time changes nothing."""
    try:
        yield
    finally:
        # On a busy machine one may not end within Dask's limit: it ends with this process.
        with suppress(TimeoutError):
            cluster.close()


def _cores() -> int:
    return len(os.sched_getaffinity(0))


def _refuse_workers(
    workers: int | None, scheduler: str | None, scheduler_file: str | Path | None
) -> None:
    """Refuse a number of workers that cannot be had.

    Raises:
        ConfigError: If it is below one, or given with a scheduler.
    """
    if workers is not None and (scheduler or scheduler_file):
        raise ConfigError("workers must not be given with a scheduler, which has its own")
    if workers is not None and workers < 1:
        raise ConfigError(f"workers must be at least 1, got {workers}")
