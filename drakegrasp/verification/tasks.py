"""What a caller asks to be verified, as tasks: grasps with their objects, in {O}.

In: grasp vectors in any of three frames, with a mesh, or with the rows of a dataset that
they were predicted for. Out: `VerifyTask`s, plain data that can cross a process border. All
of a caller's mistakes are found here, before anything is simulated.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import trimesh

from drakegrasp.config import Config, parse_config
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.prepared_objects import load_prepared
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.errors import GraspError, OffSurfaceError
from drakegrasp.frames import Array, read_pose, unpack_pose
from drakegrasp.hand.description import load_hand
from drakegrasp.outcomes import Outcome
from drakegrasp.runtime.blas import one_thread
from drakegrasp.runtime.executor import Executor
from drakegrasp.runtime.progress import Report
from drakegrasp.simulation.placement import (
    Placed,
    PlacedObject,
    config_of,
    place_object,
    refuse_no_config,
    refuse_other_objects,
)
from drakegrasp.verification.prediction import (
    boxes_away,
    read_grasps,
    refuse_other_units,
    to_object_frame,
)
from drakegrasp.verification.result import Verification
from drakegrasp.verification.verify import METHODS, verify_contacts

#: Grasps in a task: some seconds of work, so that no worker waits long for the last one.
TASK_GRASPS = 4

Mesh: TypeAlias = str | Path | trimesh.Trimesh | Placed


#: Who takes results as they come: called with a grasp's index and its result.
ResultCallback: TypeAlias = Callable[[int, Verification], None]


@dataclass(frozen=True, kw_only=True, eq=False)
class VerifyTask:
    """Some grasps of one object.

    Attributes:
        indices: Which of the caller's grasps they are.
        placed: The object on the table.
        p_OQ, nhat_Q_O: (m, k, 3), contact points [m] and outward unit normals.
        method: "hand" or "forces".
        config: `Config.to_dict()`.
    """

    indices: tuple[int, ...]
    placed: PlacedObject
    p_OQ: Array
    nhat_Q_O: Array
    method: str
    config: dict[str, Any]


@one_thread
def run_task(task: VerifyTask) -> tuple[tuple[int, ...], list[Verification]]:
    """Verify the grasps of a task, one after the other."""
    config = parse_config(task.config)
    results = [
        verify_contacts(task.placed, p, n, method=task.method, config=config)
        for p, n in zip(task.p_OQ, task.nhat_Q_O, strict=True)
    ]
    return task.indices, results


def plan_verification(
    grasps: npt.ArrayLike,
    mesh: Mesh | None,
    *,
    frame: str | None,
    X: npt.ArrayLike | None,
    X_TO: npt.ArrayLike | None,
    units: str | None,
    hand: str | Path | None,
    method: str,
    config: Config | None,
    dataset: GraspDataset | None,
    rows: Sequence[int] | None,
) -> list[VerifyTask]:
    """Return the tasks of some grasps; the arguments are those of `verify_grasps`.

    Raises:
        GraspError: If a grasp, frame or pose cannot be used.
        MeshError: If the mesh cannot be simulated.
        ConfigError, HandError, DataError: If configuration, hand or dataset cannot be used.
    """
    if method not in METHODS:
        raise GraspError(f"method must be one of {', '.join(METHODS)}, got {method!r}")
    if (mesh is None) == (dataset is None):
        got = "neither" if mesh is None else "both"
        raise GraspError(f"a mesh or a dataset must be given, got {got}")
    if config is not None:
        refuse_no_config(config)
    if dataset is None:
        if rows is not None:
            raise GraspError("rows must be those of a dataset, got some without a dataset")
        assert mesh is not None
        config = _with_hand(config_of(mesh) if config is None else config, hand)
        points, normals = read_grasps(grasps, load_hand(config.hand).num_fingers)
        placed = place_object(mesh, units=units, X_TO=X_TO, config=config)
        pose = None if X is None else read_pose(X, "X")
        groups = [(placed, np.arange(len(points)), pose)]
        frame = frame or "object"
    else:
        if not isinstance(dataset, GraspDataset):
            raise GraspError(
                "dataset must be a GraspDataset, which says of which split, "
                f"got a {type(dataset).__name__}"
            )
        for name, value in (("X", X), ("X_TO", X_TO), ("units", units)):
            if value is not None:
                raise GraspError(f"{name} must be None with a dataset, which has it, got a value")
        out = dataset.path.parent
        known = read_manifest(out).config
        config = _with_hand(known if config is None else config, hand)
        refuse_other_objects(config, known, "as in the dataset, whose objects are prepared")
        points, normals = read_grasps(grasps, load_hand(config.hand).num_fingers)
        chosen = _chosen_rows(dataset, rows, len(points))
        frame = frame or "camera"
        groups = _objects_of_rows(dataset, out, known, chosen, with_camera=frame == "camera")
    whole = []
    for placed, indices, pose in groups:
        p_OQ, nhat_Q_O = to_object_frame(
            points[indices], normals[indices], frame=frame, X=pose, X_TO=placed.X_TO
        )
        task = VerifyTask(
            indices=tuple(indices.tolist()),
            placed=placed,
            p_OQ=p_OQ,
            nhat_Q_O=nhat_Q_O,
            method=method,
            config=config.to_dict(),
        )
        whole.append(task)
    _refuse_other_units(whole)
    return [part for task in whole for part in split_task(task, TASK_GRASPS)]


def split_task(task: VerifyTask, size: int) -> list[VerifyTask]:
    """Return a task as tasks of at most so many grasps."""
    parts = [slice(start, start + size) for start in range(0, len(task.indices), size)]
    return [
        replace(
            task,
            indices=task.indices[part],
            p_OQ=task.p_OQ[part],
            nhat_Q_O=task.nhat_Q_O[part],
        )
        for part in parts
    ]


def _refuse_other_units(tasks: Sequence[VerifyTask]) -> None:
    """Refuse grasps that are all far from their objects; a few are the prediction's fault."""
    if tasks:
        nearest = min(tasks, key=lambda t: boxes_away(t.p_OQ, t.placed.model.half_extents))
        refuse_other_units(nearest.p_OQ, nearest.placed.model.half_extents)


def _with_hand(config: Config, hand: str | Path | None) -> Config:
    return config if hand is None else parse_config({**config.to_dict(), "hand": str(hand)})


def _chosen_rows(
    dataset: GraspDataset, rows: Sequence[int] | None, count: int
) -> npt.NDArray[np.int64]:
    chosen = np.arange(count) if rows is None else np.asarray(rows)
    # An empty list is one of real numbers to NumPy.
    if chosen.size and chosen.dtype.kind not in "iu":
        raise GraspError(f"rows must be whole numbers, got values of type {chosen.dtype}")
    chosen = chosen.astype(np.int64).ravel()
    if len(chosen) != count:
        raise GraspError(f"rows must be one per grasp ({count}), got {len(chosen)}")
    if rows is None and count != len(dataset):
        raise GraspError(
            f"there must be a grasp for each of the {len(dataset)} rows of {dataset.split} in "
            f"{dataset.path.name}, or rows, got {count} grasps"
        )
    wrong = chosen[(chosen < 0) | (chosen >= len(dataset))]
    if len(wrong):
        raise GraspError(
            f"rows must be 0 to {len(dataset) - 1} of {dataset.split} in {dataset.path.name}, "
            f"got {wrong[0]}"
        )
    return chosen


def _objects_of_rows(
    dataset: GraspDataset,
    out: Path,
    config: Config,
    rows: npt.NDArray[np.int64],
    *,
    with_camera: bool,
) -> list[tuple[PlacedObject, npt.NDArray[np.int64], Array | None]]:
    """Return each object with the indices of its grasps and their cameras' poses."""
    names = dataset.column("object_props/object_name")[rows]
    X_TC = unpack_pose(dataset.column(f"object_props/frame_work2cam_{dataset.camera}")[rows])
    groups = []
    for name in dict.fromkeys(names.tolist()):
        indices = np.flatnonzero(names == name)
        placed = place_object(load_prepared(out, name, config), config=config)
        poses = read_pose(X_TC[indices], "the camera's pose") if with_camera else None
        groups.append((placed, indices, poses))
    return groups


def refuse_off_surface(result: Verification) -> None:
    """Refuse the result of a single grasp whose contacts are not on the object.

    Raises:
        OffSurfaceError: If so.
    """
    if result.outcome is Outcome.OFF_SURFACE:
        raise OffSurfaceError(f"contacts must be on the object's surface, got: {result.reason}")


def verify_tasks(
    tasks: Sequence[VerifyTask],
    execute: Executor,
    report: Report,
    deliver: ResultCallback = lambda index, result: None,
) -> list[Verification]:
    """Return the results of tasks in the order of the caller's grasps.

    Args:
        tasks: From `tasks.plan_verification`.
        execute: Who does the work.
        report: Is told how many are done and how many hold.
        deliver: Is given each result, in that order, as soon as those before it are there.
    """
    by_indices = {task.indices: task for task in tasks}
    total, delivered = sum(map(len, by_indices)), 0
    found: dict[int, Verification] = {}
    report(0, total, holding=0)
    for indices, results in execute(run_task, tasks):
        # One object for all of its results, whatever crossed a process border.
        placed = by_indices[indices].placed
        for index, result in zip(indices, results, strict=True):
            found[index] = replace(result, placed=placed)
        while delivered in found:
            deliver(delivered, found[delivered])
            delivered += 1
        report(len(found), total, holding=sum(r.success for r in found.values()))
    return [found[i] for i in range(total)]
