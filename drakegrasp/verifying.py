"""Verification as callers use it: one grasp, or many on whatever executor there is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

import numpy.typing as npt

from drakegrasp.config import Config
from drakegrasp.dataset import GraspDataset
from drakegrasp.errors import GraspError, OffSurfaceError
from drakegrasp.executor import Executor
from drakegrasp.outcomes import Outcome
from drakegrasp.prediction import as_numbers
from drakegrasp.progress import Report
from drakegrasp.verification import Verification
from drakegrasp.verify_plan import Mesh, VerifyTask, plan_verification, run_task

#: Who takes results as they come: called with a grasp's index and its result.
Deliver: TypeAlias = Callable[[int, Verification], None]


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
    deliver: Deliver = lambda index, result: None,
) -> list[Verification]:
    """Return the results of tasks in the order of the caller's grasps.

    Args:
        tasks: From `verify_plan.plan_verification`.
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
