"""Building a dataset and verifying grasps, on Dask workers or in this process.

These are the functions that `drakegrasp` exports and the command line calls.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy.typing as npt

from drakegrasp.build.pipeline import (
    BuildReport,
    build_locked,
    posture_config,
    refuse_unusable,
)
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
from drakegrasp.exchange.posture_files import read_postures
from drakegrasp.frames import as_numbers
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.settings import load_config
from drakegrasp.objects.sources import MeshSource, find_meshes
from drakegrasp.runtime.executor import count_workers, run_here
from drakegrasp.runtime.progress import progress_bar
from drakegrasp.shapes.catalog import builtin_sources, draw_builtin
from drakegrasp.simulation.drive import drive_of
from drakegrasp.simulation.postures.table import PostureTable, refuse_unknown_objects
from drakegrasp.verification.batch import ResultCallback, ignore_result, verify_batch
from drakegrasp.verification.placed_grasp import (
    Mesh,
    mesh_config,
    place_on_mesh,
    place_on_rows,
)
from drakegrasp.verification.result import Verification
from drakegrasp.verification.verify import PlacedGrasp, refuse_off_surface

if TYPE_CHECKING:
    from distributed import Client

#: Up to this many grasps are verified in this process: starting workers would take longer.
FEW_GRASPS = 4


def build_dataset(
    objects: str | Path,
    out: str | Path,
    *,
    config: Config | None = None,
    units: str = "m",
    manifest: str | Path | None = None,
    only: Sequence[str] = (),
    postures: str | Path | PostureTable | None = None,
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
        postures: Instead of drawn palm poses: a file of postures, or a table of them. Only the
            objects that it names are built.
        workers: Processes on this machine; one per core if None.
        scheduler: Address of a running Dask scheduler to use instead.
        scheduler_file: Its JSON file, instead of the address.
        tls_files: To encrypt: certificate authority, certificate and private key (PEM).
        show: Whether to show progress on standard error.

    Raises:
        MeshError: If there is no mesh.
        GraspError: If a row of the postures is none, or of an object that is not there.
        ConfigError: If both workers and a scheduler are given, or the address is empty.
        DataError: If `out` cannot be used, another process builds there, or no mesh can be
            simulated.
        MachineError: If there is no scheduler, the workers cannot do the work, or no room is
            left; the same call continues when that is fixed.
    """
    _refuse_workers(workers, scheduler, scheduler_file)
    out, config = Path(out).absolute(), config or load_config()
    hand = load_hand(config.hand)
    drive_of(hand, config.lift)
    if isinstance(postures, str | Path):
        postures = read_postures(Path(postures), hand)
    sources = find_sources(objects, units, manifest)
    security = None if tls_files is None else security_of(tls_files)
    cluster = _announced(connect(workers, scheduler, scheduler_file, security=security), show)
    return build_on(cluster, sources, out, config, only=only, postures=postures, show=show)


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
    postures: PostureTable | None = None,
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
        postures: As for `build_dataset`.
        show: Whether to show progress on standard error.

    Raises:
        ConfigError: As `refuse_unusable` of `build.pipeline`.
        DataError: If `out` cannot be used, another process builds there, or no mesh can be
            simulated.
        MeshError: If `only` names no object.
        MachineError: If a worker would give other results than this machine.
    """
    refuse_unusable(config)
    config = posture_config(config, postures)
    known = draw_builtin(config.builtin) if sources is None else sources
    _refuse_unknown(only, [each.name for each in known])
    if postures is not None:
        refuse_unknown_objects(postures, [each.name for each in known])
        only = [name for name in dict.fromkeys(postures.objects) if not only or name in only]
        if not only:
            raise GraspError("postures must be of an object that is built, got none of them")
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
        return build_locked(
            sources,
            out,
            config,
            execute,
            dead=dead,
            postures=postures,
            pool=execute.pool,
            show=show,
        )


def _refuse_unknown(only: Sequence[str], names: Sequence[str]) -> None:
    """Refuse names that no object has.

    Raises:
        MeshError: If there is one.
    """
    unknown = [name for name in only if name not in names]
    if unknown:
        known = listed(names)
        raise MeshError(f"only must be names of objects ({known}), got {unknown[0]!r}")


def verify_grasp(
    grasp: npt.ArrayLike,
    mesh: Mesh | None = None,
    *,
    frame: str | None = None,
    X_TC: npt.ArrayLike | None = None,
    X_TO: npt.ArrayLike | None = None,
    units: str | None = None,
    hand: str | Path | None = None,
    method: str = "hand",
    config: Config | None = None,
    dataset: GraspDataset | None = None,
    row: int | None = None,
) -> Verification:
    """Return whether a predicted grasp holds an object in the simulator, why not, and how.

    A grasp is 6k numbers for a hand of k fingers (18 for the Barrett Hand): k contact points
    [m], then k unit normals out of the object, in the finger order of the hand file.

    Args:
        grasp: (6k,).
        mesh: Path of a mesh file, a trimesh, or the result of `place_object`, which prepares an
            object once for many calls. {O} is at the centre of its bounding box.
        frame: The frame of the grasp: "object" {O}, "camera" {C} or "workspace" {T}. The default
            is "object" with a mesh, "camera" with a dataset.
        X_TC: With a mesh and frame "camera": pose of the camera in the table-top frame, (4, 4).
        X_TO: Pose of the object on the table, (4, 4); dropped as in a build if None.
        units: Unit of the mesh's lengths: m, cm or mm; metres if None. The grasp is always in
            metres.
        hand: Name or YAML file of the hand; the configuration's ("barrett") if None.
        method: "hand" closes a simulated hand on the contacts and lifts; "forces" lifts by
            forces at the contacts alone.
        config: Physics, lift and limits; if None that of the dataset or of the placed object,
            else the defaults.
        dataset: Instead of a mesh: a data file of a dataset; its row defines the object, its
            pose and the camera's.
        row: The row of the dataset's split that the grasp is for.

    Raises:
        GraspError: If the grasp, its frame or a pose cannot be used.
        OffSurfaceError: If a contact is farther than `verify.max_surface_distance` from the
            surface, or a normal points inwards. `verify_grasps` has an outcome for this.
        MeshError: If the mesh cannot be simulated.
        ConfigError, HandError, DataError: If configuration, hand or dataset cannot be used.
    """
    # One grasp, for one object.
    vector = as_numbers(grasp, "a grasp must be a vector of numbers")
    if vector.ndim != 1:
        raise GraspError(
            f"one grasp must be a vector, got an array of shape {vector.shape}; "
            "verify_grasps takes many"
        )
    if (row is None) != (dataset is None):
        raise GraspError(f"row must be given with a dataset, and only then, got {row}")

    (result,) = verify_grasps(
        vector,
        mesh,
        frame=frame,
        X_TC=X_TC,
        X_TO=X_TO,
        units=units,
        hand=hand,
        method=method,
        config=config,
        dataset=dataset,
        rows=None if row is None else [row],
    )
    refuse_off_surface(result)
    return result


def verify_grasps(
    grasps: npt.ArrayLike,
    mesh: Mesh | None = None,
    *,
    frame: str | None = None,
    X_TC: npt.ArrayLike | None = None,
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

    A grasp whose contacts are not on the surface does not raise here: its outcome is
    `off_surface`.

    Args:
        grasps: (n, 6k).
        mesh: The object of all grasps, given as in `verify_grasp`.
        frame: "object", "camera" or "workspace", as in `verify_grasp`.
        X_TC: With a mesh and frame "camera": (4, 4), or one per grasp (n, 4, 4).
        X_TO: Pose of the object on the table, (4, 4); dropped as in a build if None.
        units: Unit of the mesh's lengths: m, cm or mm; metres if None.
        hand: Name or YAML file of the hand; the configuration's if None.
        method: "hand" or "forces".
        config: Physics, lift and limits; chosen as in `verify_grasp` if None.
        dataset: Instead of a mesh: a data file of a dataset.
        rows: The row of the dataset's split for each grasp; all rows, in order, if None.
        client: A Dask client whose workers share the work; this process does it if None.
        show: Whether to show progress on standard error.

    Raises:
        GraspError, MeshError, ConfigError, HandError, DataError: As `verify_grasp`, before
            anything is simulated.
        MachineError: If a worker would give other results than this machine.
    """
    # Put each grasp on its object: on one of a dataset's, or all on the given mesh.
    if dataset is not None:
        _refuse_what_rows_define(dataset, mesh=mesh, X_TC=X_TC, X_TO=X_TO, units=units)
        placed = place_on_rows(
            grasps, dataset, rows, frame=frame, hand=hand, method=method, config=config
        )
    elif mesh is None:
        raise GraspError("a mesh or a dataset must be given, got neither")
    elif rows is not None:
        raise GraspError("rows must be None without a dataset, got rows")
    else:
        placed = place_on_mesh(
            grasps,
            mesh,
            frame=frame,
            X_TC=X_TC,
            X_TO=X_TO,
            units=units,
            method=method,
            config=mesh_config(mesh, config, hand),
        )

    # Try them there.
    return _verify_on(client, placed, show=show)


def _refuse_what_rows_define(dataset: object, **values: object) -> None:
    """Refuse what is no dataset, and values that the rows of a dataset define."""
    if not isinstance(dataset, GraspDataset):
        raise GraspError(
            "dataset must be a GraspDataset, which has a file and a split, "
            f"got a {type(dataset).__name__}"
        )
    for name, value in values.items():
        if value is not None:
            raise GraspError(f"{name} must be None with a dataset, which defines it, got a value")


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
            return verify_batch(grasps, DaskExecutor(client), report, on_result)


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
