"""Verifying grasps, on Dask workers or in this process.

Grasps are verified through two doors: `place_object(...).verify(...)` for those of one object, and
`verify_rows` for those of a dataset's rows.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy.typing as npt
import trimesh

from drakegrasp.api.workers import connection, end_imported_script
from drakegrasp.cluster.admission import admitted_workers
from drakegrasp.cluster.executor import DaskExecutor
from drakegrasp.config import Config
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.errors import GraspError
from drakegrasp.frames import as_numbers
from drakegrasp.hand.settings import override_config
from drakegrasp.runtime.executor import count_workers, run_here
from drakegrasp.runtime.progress import progress_bar
from drakegrasp.simulation.placement import Placed, config_for
from drakegrasp.simulation.placement import PlacedObject as ObjectOnTable
from drakegrasp.simulation.placement import place_object as put_on_table
from drakegrasp.verification.batch import ResultCallback, ignore_result, verify_batch
from drakegrasp.verification.placed_grasp import (
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


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
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
            method: "hand" closes a simulated hand on the contacts and lifts; "forces" asks whether
                forces at the contacts of the surface that they select can lift the object.
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
    how: dict[str, Any] = {"frame": frame, "method": method, "snap_points": snap_points}
    placed = place_on_rows(predictions, data, rows, hand=hand, config=config, **how)

    # The object of a verdict can verify more grasps.
    things = {id(grasp.placed): grasp.placed for grasp in placed}
    doors = {
        key: PlacedObject(model=thing.model, X_TO=thing.X_TO, config=thing.config)
        for key, thing in things.items()
    }
    placed = [replace(grasp, placed=doors[id(grasp.placed)]) for grasp in placed]
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
    tls: bool = True,
    tls_files: tuple[Path, Path, Path] | None = None,
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
        tls: Whether the scheduler must want a certificate.
        tls_files: Certificate authority, certificate and private key (PEM) for it.
        on_result: Is called with each verdict in the caller's order, once all earlier ones exist.
        show: Whether to show progress on standard error.

    Raises:
        ConfigError: If both workers and a scheduler are given, or the scheduler wants no
            certificate although `tls` says so.
        MachineError: If a worker would give other results than this machine.
    """
    end_imported_script()
    cluster = connection(workers, scheduler, scheduler_file, tls, tls_files)
    alone = len(grasps) <= FEW_GRASPS or count_workers(workers) == 1
    if alone and not (scheduler or scheduler_file):
        return _verify_on(None, grasps, on_result, show=show)
    with cluster as client:
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
