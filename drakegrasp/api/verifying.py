"""Verifying grasps: by a lift, on Dask workers or in this process; by a protocol, in MuJoCo.

`verify_grasp` and `verify_grasps` verify grasps on everything that a grasp can be on: a mesh, a
placed object, a sample, or a dataset. Protocols run in processes of this machine.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, TypeAlias, Unpack

import numpy as np
import numpy.typing as npt
import trimesh

from drakegrasp.config import Config
from drakegrasp.dataset.clutter import Clutter
from drakegrasp.dataset.reader import GraspDataset, Sample
from drakegrasp.errors import GraspError
from drakegrasp.exchange.columns import HDF5_SUFFIXES
from drakegrasp.exchange.dexgraspbench import fitted_postures, write_grasps
from drakegrasp.hand.description import load_hand
from drakegrasp.protocols.postures import (
    PostureResult,
    PostureTrials,
    prepare_trials,
    verify_postures,
)
from drakegrasp.reach.arm import Arm
from drakegrasp.runtime.environment import require_mujoco
from drakegrasp.runtime.executor import Executor, count_workers, processes, run_here
from drakegrasp.runtime.progress import progress_bar
from drakegrasp.simulation.placement import PlacedObject, place_object
from drakegrasp.verification.placing import (
    PlacedGrasp,
    contacts_on_object,
    contacts_on_rows,
    dataset_config,
)
from drakegrasp.verification.result import Verification
from drakegrasp.verification.verify import ResultCallback, ignore_result, verify_batch

if TYPE_CHECKING:
    from distributed import Client

    from drakegrasp.cluster.connect import Workers

#: Source of an object on the table: a mesh file, a mesh, or a placed object.
ObjectMesh: TypeAlias = str | Path | trimesh.Trimesh | PlacedObject
#: Target of a grasp: an object, a scene, or a sample or dataset that defines the object of each
#: grasp.
GraspTarget: TypeAlias = ObjectMesh | Clutter | Sample | GraspDataset

#: Receives verdicts as they are computed: called with the place of a grasp in the sequence, its
#: verdict, and what the trials share.
OnVerdict: TypeAlias = Callable[[int, PostureResult, PostureTrials], None]

#: Workers take as long to start as one process takes for this many verdicts; if they save no more,
#: they are not started. Measured on two cores: 4.4 s, and 0.24 s for a verdict.
FEW_GRASPS = 16
#: Largest number of grasps of one object in a task, and smallest number of tasks per worker, so
#: that no worker is idle at the end.
MOST_TOGETHER, TASKS_PER_WORKER = 16, 4


def verify_grasp(
    grasp: npt.ArrayLike,
    on: GraspTarget,
    *,
    row: int | None = None,
    object: int | str | None = None,
    frame: str | None = None,
    X_TC: npt.ArrayLike | None = None,
    units: str | None = None,
    X_TO: npt.ArrayLike | None = None,
    hand: str | Path | None = None,
    config: Config | None = None,
    arm: Arm | None = None,
) -> Verification:
    """Return whether a predicted grasp holds its object in the simulator, and the reason.

    >>> verdict = verify_grasp(grasp, "mug.obj", units="cm")          # doctest: +SKIP
    >>> verdict = verify_grasp(my_network(sample.image), on=sample)   # doctest: +SKIP

    Args:
        grasp: (6k,) for a hand of k fingers (18 for the Barrett Hand): k contact points [m], then
            k normals out of the object, in the finger order of the hand file. A list, an array, or
            a tensor of torch.
        on: Target of the grasp, see `verify_grasps`.
        row: The grasp's row, if `on` is a `GraspDataset`.
        object: The grasped object, if `on` is a scene of `load_scene`.
        frame: Frame of the grasp: "object", "table", "camera", "world" or "mesh". See
            `verify_grasps` for details of this and the following arguments.
        X_TC: With frame "camera" on an object: pose (4, 4) of the camera in {T}.
        units: Unit of a mesh: m, cm or mm.
        X_TO: Pose (4, 4) of an object on the table.
        hand: Name or YAML file of the hand.
        config: Hand, physics, lift and rules.
        arm: An arm, see `load_arm`: `reach` of the verdict tells what it can do about the grasp.

    Returns:
        The verdict. Numbers that are not a valid grasp, e.g. NaN, have the outcome `invalid`.

    Raises:
        GraspError: If the grasp is not a vector, or as `verify_grasps`.
        MeshError, ConfigError, HandError, DataError: As `verify_grasps`.
    """
    if row is not None and np.ndim(row):
        raise GraspError(f"row must be one whole number, got {row!r}")
    if row is None and isinstance(on, GraspDataset):
        raise GraspError(f"row must be given with a GraspDataset, 0 to {len(on) - 1}, got None")

    if (count := _count(grasp)) != 1:
        raise GraspError(
            f"one grasp must be a vector, got {count} grasps; many go into verify_grasps"
        )
    rows = None if row is None else [row]
    (verdict,) = verify_grasps(
        grasp,
        on,
        rows=rows,
        object=object,
        frame=frame,
        X_TC=X_TC,
        units=units,
        X_TO=X_TO,
        hand=hand,
        config=config,
        arm=arm,
    )
    return verdict


def _count(grasps: Any) -> int:
    """Return the number of grasps; 1 for what is no array, which is refused when it is read."""
    try:
        return len(grasps) if np.ndim(grasps) > 1 else 1
    except ValueError:
        return 1


def verify_grasps(
    grasps: npt.ArrayLike,
    on: GraspTarget,
    *,
    rows: Sequence[int] | None = None,
    object: int | str | None = None,
    frame: str | None = None,
    X_TC: npt.ArrayLike | None = None,
    units: str | None = None,
    X_TO: npt.ArrayLike | None = None,
    hand: str | Path | None = None,
    config: Config | None = None,
    arm: Arm | None = None,
    client: Client | None = None,
    show: bool = False,
) -> list[Verification]:
    """Return the verdicts on predicted grasps, in their order; see `verify_grasp`.

    | `on` | the grasps are on | default frame | friction and mass |
    |---|---|---|---|
    | path of a mesh, `trimesh.Trimesh` | this object, dropped on the table | object | of `config` |
    | `PlacedObject` | this object in its pose | object | as given to `place_object` |
    | scene of `load_scene` | `object`, among its neighbours | object | of `config` |
    | `Sample` | the object and pose of its row, for all grasps | camera | drawn for its row |
    | `GraspDataset` | the objects and poses of `rows` | camera | drawn for each row |

    Args:
        grasps: (n, 6k), or (6k,) for one grasp. A row that is not a valid grasp has the outcome
            `invalid` and does not affect other rows.
        on: Target of the grasps, see the table.
        rows: Only for a `GraspDataset`: row of its split for each grasp; None for all rows, in
            order.
        object: Only for a scene of `load_scene`: the grasped object, by its index in the scene, or
            by its name if that is there once.
        frame: Frame of the grasps: "object" {O}, whose origin is the centre of the bounding box;
            "camera" {C}; "table" {T}, at the centre of the table top; "world" {W}; or "mesh" {M},
            with the axes and origin of the mesh file. None for the default.
        X_TC: Only for an object, with frame "camera": pose of the camera in {T}, (4, 4), or one
            per grasp (n, 4, 4). Rows have their own cameras.
        units: Only for a mesh: unit of its lengths, m, cm or mm; metres if None. An `objects.yaml`
            in the folder of the mesh overrides it. Grasps are always in metres.
        X_TO: Only for an object: its pose on the table, (4, 4).
        hand: Name or YAML file of the hand; None for the hand of the configuration or the dataset.
        config: Hand, physics, lift and rules. If None, those of the placed object or of the
            dataset, or else the defaults. If it replaces a dataset's, values drawn for a row are
            not used.
        arm: An arm, see `load_arm`. It is asked in this process, for the first wrist poses, among
            what is around the object.
        client: A Dask client whose workers share the work. If None, few grasps are verified in this
            process, see `FEW_GRASPS`, and more of them by workers on this machine.
        show: Whether to show progress on standard error.

    Raises:
        GraspError: If the array does not hold grasps, `on` is not a valid target, an argument does
            not apply to the target, a row does not exist, the number of rows is not that of the
            grasps, or a frame or pose is invalid.
        MeshError: If a mesh cannot be simulated or does not come to rest.
        ConfigError: If config is not a `Config`, or the object was prepared with other values.
        HandError: If the hand cannot be used.
        DataError: If the dataset cannot be used, or has changed since the sample was read.
        MachineError: If a worker would give other results than this machine.
    """
    on = _target(on, object)
    if isinstance(on, Sample | GraspDataset):
        _validate_none(on, X_TC=X_TC, units=units, X_TO=X_TO)
        if isinstance(on, Sample) and rows is not None:
            raise GraspError(f"rows must be None on a Sample, which is one row, got {rows!r}")
        data, chosen = (on.dataset, on.row) if isinstance(on, Sample) else (on, rows)
        used = dataset_config(data, config, hand)
        # A given configuration is used as it is; that of a dataset has the rows' draws.
        drawn, frame = config is None, frame or "camera"
        placed = contacts_on_rows(grasps, data, chosen, config=used, drawn=drawn, frame=frame)
    else:
        if rows is not None:
            raise GraspError(f"rows must be given with a GraspDataset only, got {rows!r}")
        target = place_object(on, units=units, X_TO=X_TO, hand=hand, config=config)
        used, frame = target.config, frame or "object"
        placed = contacts_on_object(grasps, target, frame=frame, X_TC=X_TC)
    verdicts = run_verification(placed, used, client=client, show=show, explained=False)
    return verdicts if arm is None else [verdict.reached_by(arm) for verdict in verdicts]


def _validate_none(on: Sample | GraspDataset, **given: object) -> None:
    """Reject arguments whose values a sample or a dataset defines."""
    for name, value in given.items():
        if value is not None:
            raise GraspError(
                f"{name} must be None on a {type(on).__name__}, which defines it, got a value"
            )


def _target(on: GraspTarget, object: int | str | None) -> ObjectMesh | Sample | GraspDataset:
    """Return the target of grasps, which is an object of a scene in place of the scene.

    Raises:
        GraspError: If it is none, or an object is not given with a scene and only then.
    """
    if isinstance(on, Clutter):
        if object is None:
            raise GraspError(f"object must be given with a scene, {on}, got None")
        return on.placed(object)
    if object is not None:
        raise GraspError(f"object must be given with a scene only, got {object!r}")
    if not isinstance(on, str | Path | trimesh.Trimesh | PlacedObject | Sample | GraspDataset):
        raise GraspError(
            "on must be the path of a mesh, a trimesh.Trimesh, a placed object, a scene, a Sample "
            f"or a GraspDataset, got a {type(on).__name__}"
        )
    if isinstance(on, str | Path) and Path(on).suffix.lower() in HDF5_SUFFIXES:
        raise GraspError(
            f"on must be GraspDataset({str(on)!r}, split=...) for a data file, got its path"
        )
    return on


def run_verification(
    grasps: Sequence[PlacedGrasp],
    config: Config,
    *,
    client: Client | None = None,
    on_result: ResultCallback = ignore_result,
    show: bool = True,
    explained: bool = True,
    **workers: Unpack[Workers],
) -> list[Verification]:
    """Return the verdicts on placed grasps in the caller's order; the work of `drakegrasp verify`.

    With one worker, or with few grasps, this process does the work, because starting workers would
    take longer.

    Args:
        grasps: See `verification.placing`.
        config: The configuration, whose hand all workers must have.
        client: A Dask client whose workers do the work.
        on_result: Is called with each verdict in the caller's order, once all earlier ones exist.
        show: Whether to show progress on standard error.
        explained: See `verify_batch`.
        workers: The arguments of `connect`, instead of a client.

    Raises:
        ConfigError: As `connect`.
        MachineError: If a worker would give other results than this machine.
    """
    asked = {name for name, value in workers.items() if value is not None}
    here = client is None and asked <= {"workers", "tls"} and workers.get("tls", True)
    saved = len(grasps) * (1.0 - 1.0 / count_workers(workers.get("workers")))
    # A worker of another process pool may not start processes.
    if here and (saved <= FEW_GRASPS or multiprocessing.current_process().daemon):
        with progress_bar("verify", "grasps", show=show) as report:
            return verify_batch(grasps, run_here, report, on_result, explained=explained)

    # Importing Dask takes a third of a second.
    from drakegrasp.cluster.connect import joined
    from drakegrasp.cluster.executor import DaskExecutor
    from drakegrasp.cluster.worker_checks import checked_workers

    cluster = joined(client, workers)
    if not grasps:
        return []
    with (
        cluster as joint,
        progress_bar("verify", "grasps", show=show) as report,
        checked_workers(joint, config),
    ):
        tasks = TASKS_PER_WORKER * max(len(joint.nthreads()), 1)
        together = min(max(len(grasps) // tasks, 1), MOST_TOGETHER)
        return verify_batch(
            grasps, DaskExecutor(joint), report, on_result, together=together, explained=explained
        )


# Protocols of MuJoCo


def verify_by_protocol(
    grasps: Sequence[PlacedGrasp],
    config: Config,
    protocol: str,
    on_result: OnVerdict,
    *,
    keep: Path | None = None,
    workers: int | None = None,
    show: bool = True,
) -> None:
    """Try the first wrist pose of grasps of one hand, in their order.

    Args:
        grasps: See `verification.placing`.
        config: Their configuration, with the hand.
        protocol: Name of a protocol that runs in MuJoCo, or `FILE.py:NAME`.
        on_result: Receives the verdicts.
        keep: Folder of the convex parts of objects, for the next call; None: they are not kept.
        workers: Number of processes; one per core if None.
        show: Whether to show progress on standard error.

    Raises:
        ConfigError: If there is no such protocol, or it does not run in MuJoCo.
        MachineError: If a package is missing.
    """
    require_mujoco("mujoco", "coacd")
    hand = load_hand(config.hand_source)
    with TemporaryDirectory() as scratch, processes(workers) as execute:
        with progress_bar("cut", "objects", show=show) as report:
            postures, folder = fitted_postures(grasps, execute), Path(scratch)
            path, files = write_grasps(
                postures, hand, folder, execute=execute, keep=keep, report=report
            )
        _try_all(files, prepare_trials(protocol, path, folder), on_result, execute, show)


def verify_files_by_protocol(
    files: Sequence[Path],
    protocol: str,
    on_result: OnVerdict,
    *,
    hand: Path,
    objects: Path,
    workers: int | None = None,
    show: bool = True,
) -> None:
    """Try the grasps of files of DexGraspBench, in their order; see `verify_by_protocol`.

    Args:
        files: The files.
        protocol: See `verify_by_protocol`, like `on_result`, `workers` and `show`.
        on_result: See `verify_by_protocol`.
        hand: MJCF of the hand, whose world is the hand's root.
        objects: Folder to which the object paths in the files are relative.
        workers: See `verify_by_protocol`.
        show: See `verify_by_protocol`.

    Raises:
        ConfigError, MachineError: As `verify_by_protocol`.
        HandError: If the MJCF cannot be used.
    """
    trials = prepare_trials(protocol, hand, objects)
    with processes(workers) as execute:
        _try_all(files, trials, on_result, execute, show)


def _try_all(
    files: Sequence[Path | str],
    trials: PostureTrials,
    on_result: OnVerdict,
    execute: Executor,
    show: bool,
) -> None:
    holding = 0
    with progress_bar("verify", "grasps", show=show) as report:
        for index, result in enumerate(verify_postures(files, trials, execute)):
            on_result(index, result, trials)
            holding += result[0].success
            report(index + 1, len(files), holding=holding)
