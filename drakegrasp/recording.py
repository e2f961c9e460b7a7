"""Recordings: a trial or a lift by forces as one HTML file that any browser plays.

In: what is to be run. Out: the file, which needs nothing else, no network either, and the
result of the run: the same bits as without a recording, because the same code runs. Where
there was nothing to run, the file shows how things would have stood.
"""

from __future__ import annotations

import gc
import logging
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np
import numpy.typing as npt
from pydrake.geometry import Cylinder, Meshcat, MeshcatCone, MeshcatParams, Rgba, Sphere
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import Context

from drakegrasp.candidates import Attempt
from drakegrasp.config import Config
from drakegrasp.construction import MESHCAT_RATE, build_scene
from drakegrasp.force_lift import ForceLift, lift_by_forces
from drakegrasp.frames import X_WT, Array
from drakegrasp.hand import load_hand
from drakegrasp.network import allow_network
from drakegrasp.object_model import ObjectModel
from drakegrasp.placed import rest_pose
from drakegrasp.scene import Scene, reset_attempt, reset_object
from drakegrasp.shards import sync_and_rename, temporary_name
from drakegrasp.trial import TrialRecord, run_attempt
from drakegrasp.verified import PREDICTED, REACHED, Verified
from drakegrasp.wrist_fit import WristFit

Result = TypeVar("Result")

#: Where Meshcat has the object; what is put below moves with it.
OBJECT_PATH = "visualizer/object/object"
#: Radius of a contact's dot, length and radius of the arrow along its normal [m].
DOT, ARROW, SHAFT = 0.004, 0.03, 0.0012
#: Length and radius of an arrow's head [m].
HEAD, HEAD_RADIUS = 0.009, 0.0035
#: Length of an arrow for a force as large as a fingertip's limit [m].
LARGEST_FORCE = 0.08
#: The camera looks from this far around the palm's side, about the vertical, and from above [rad].
AZIMUTH, ELEVATION = np.deg2rad(50.0), np.deg2rad(20.0)
#: Its distance in radii of a ball about all that happens, and what the hand adds to that [m].
DISTANCE, HAND_RADIUS = 1.15, 0.1


def record_attempt(
    model: ObjectModel,
    X_TO: npt.ArrayLike,
    attempt: Attempt,
    config: Config,
    path: Path,
    *,
    p_OQ: Array | None = None,
    nhat_Q_O: Array | None = None,
) -> TrialRecord:
    """Run an attempt as `trial.run_attempt` does, and write what is seen of it.

    Args:
        model: The object.
        X_TO: Its resting pose in the table-top frame, (4, 4).
        attempt: What to try.
        config: Hand and rules.
        path: The HTML file.
        p_OQ: (k, 3), predicted contacts in {O}, drawn on the object [m].
        nhat_Q_O: (k, 3), their outward unit normals.

    Raises:
        OSError: If the file cannot be written.
    """

    def run(meshcat: Meshcat) -> TrialRecord:
        scene = build_scene(model, config.physics, load_hand(config.hand), meshcat=meshcat)
        # An attempt that fails before it is simulated is seen where it would have begun.
        _place(meshcat, scene, X_TO, config, attempt.X_OG, attempt.spread, attempt.closing)
        record = run_attempt(scene, X_TO, attempt, config)
        _draw_predicted(meshcat, p_OQ, nhat_Q_O)
        return record

    return _record(run, path)


def record_lift(
    model: ObjectModel,
    X_TO: npt.ArrayLike,
    p_OQ: Array,
    nhat_Q_O: Array,
    config: Config,
    path: Path,
) -> ForceLift:
    """Lift an object as `force_lift.lift_by_forces` does, and write what is seen of it.

    The contacts are drawn on the object, and the forces as they are applied.

    Args:
        model: The object.
        X_TO: Its resting pose in the table-top frame, (4, 4).
        p_OQ: (k, 3), contacts in {O} [m].
        nhat_Q_O: (k, 3), their outward unit normals.
        config: Hand (for the limit of its forces) and rules.
        path: The HTML file.

    Raises:
        OSError: If the file cannot be written.
    """
    limit = load_hand(config.hand).fingertip_force_limit

    def run(meshcat: Meshcat) -> ForceLift:
        scene = build_scene(model, config.physics, meshcat=meshcat)
        # A lift that fails before it is simulated is seen where it would have begun.
        _place(meshcat, scene, X_TO, config)
        # The scene is this function's own, so nobody else meets the monitor.
        scene.simulator.set_monitor(_ForceArrows(meshcat, scene, limit).record)
        try:
            lift = lift_by_forces(scene, X_TO, p_OQ, nhat_Q_O, force_limit=limit, config=config)
        finally:
            # It holds the scene that holds it, which the garbage collector cannot see.
            scene.simulator.clear_monitor()
        _draw_predicted(meshcat, p_OQ, nhat_Q_O)
        return lift

    return _record(run, path)


def record_verification(verified: Verified, path: Path) -> None:
    """Write what is seen of a verification, which is run again for it.

    A grasp that was not simulated is shown as it would have begun: with the hand where it
    comes closest, if a pose of the palm was looked for.

    Args:
        verified: The result.
        path: The HTML file.

    Raises:
        OSError: If the file cannot be written.
    """
    model, X_TO = verified.placed.model, rest_pose(verified.placed.X_TO)
    config = verified.config
    p_OQ, nhat_Q_O = verified.p_OQ, verified.nhat_Q_O
    if verified.attempt is not None:
        record_attempt(model, X_TO, verified.attempt, config, path, p_OQ=p_OQ, nhat_Q_O=nhat_Q_O)
    elif verified.lift is not None:
        record_lift(model, X_TO, p_OQ, nhat_Q_O, config, path)
    else:
        _record_still(model, X_TO, verified.fit, p_OQ, nhat_Q_O, config, path)


def _record_still(
    model: ObjectModel,
    X_TO: Array,
    fit: WristFit | None,
    p_OQ: Array,
    nhat_Q_O: Array,
    config: Config,
    path: Path,
) -> None:
    """Write how object, predicted contacts and, if there is a fit, the hand would have stood."""

    def run(meshcat: Meshcat) -> None:
        hand = None if fit is None else load_hand(config.hand)
        scene = build_scene(model, config.physics, hand, meshcat=meshcat)
        if fit is None:
            _place(meshcat, scene, X_TO, config)
        else:
            _place(meshcat, scene, X_TO, config, fit.X_OG, fit.spread, fit.closing)
        _draw_predicted(meshcat, p_OQ, nhat_Q_O)

    _record(run, path)


def _place(
    meshcat: Meshcat,
    scene: Scene,
    X_TO: npt.ArrayLike,
    config: Config,
    X_OG: Array | None = None,
    spread: float = 0.0,
    closing: Array | None = None,
) -> None:
    """Show the object, and the hand if a pose of it is given, before anything moves."""
    X_WO = X_WT @ np.asarray(X_TO, dtype=float)
    if X_OG is None:
        reset_object(scene, X_WO)
        scene.simulator.Initialize()
        side_W = np.array([1.0, 0.0, 0.0])
    else:
        reset_attempt(scene, X_WO, X_WO @ X_OG, spread=spread, closing=closing)
        side_W = X_WO[:3, :3] @ X_OG[:3, 3]
    way = X_WT[:3, 3] + config.lift.p_TG - X_WO[:3, 3]
    radius = np.linalg.norm(way) / 2.0 + np.linalg.norm(scene.model.half_extents) + HAND_RADIUS
    azimuth = np.arctan2(side_W[1], side_W[0]) + AZIMUTH
    towards = np.array([np.cos(azimuth), np.sin(azimuth), np.tan(ELEVATION)])
    middle = X_WO[:3, 3] + way / 2.0
    meshcat.SetCameraPose(middle + DISTANCE * radius * towards, middle)


def _record(run: Callable[[Meshcat], Result], path: Path) -> Result:
    """Return what `run` does, and write what is seen of it when it ends well."""
    meshcat = _make_meshcat()
    try:
        for part in ("/Grid", "/Axes"):
            meshcat.SetProperty(part, "visible", False)
        meshcat.StartRecording(frames_per_second=MESHCAT_RATE)
        result = run(meshcat)
        meshcat.StopRecording()
        meshcat.PublishRecording()
        _write(path, meshcat.StaticHtml())
    finally:
        # Diagrams sit in reference cycles; when the one of `run` is gone, the port is closed.
        del meshcat
        gc.collect()
    return result


def _make_meshcat() -> Meshcat:
    """Return a Meshcat that only this machine can reach.

    Meshcat is a server from the moment it is made, and there is no other way to its HTML.
    Under `DRAKE_ALLOW_NETWORK=none`, as our workers run, making one raises, so the ban is
    eased meanwhile; nothing leaves the machine. Nobody is to open the address that Drake
    announces, so that is not said.
    """
    logger = logging.getLogger("drake")
    level = logger.level
    logger.setLevel(logging.WARNING)
    try:
        with allow_network("meshcat"):
            # Port 0 is any that is free, so any number of recordings can be made at once.
            return Meshcat(MeshcatParams(host="localhost", port=0, show_stats_plot=False))
    finally:
        logger.setLevel(level)


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = temporary_name(path)
    try:
        temporary.write_text(text, encoding="utf-8")
        sync_and_rename(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _draw_predicted(meshcat: Meshcat, p_OQ: Array | None, nhat_Q_O: Array | None) -> None:
    """Draw a dot per contact on the object, with an arrow along its normal."""
    if p_OQ is None or nhat_Q_O is None:
        return
    colour = _rgba(PREDICTED)
    for i, (p, n) in enumerate(zip(p_OQ, nhat_Q_O, strict=True)):
        path = f"{OBJECT_PATH}/predicted/{i + 1}"
        meshcat.SetTransform(path, _along(p, n))
        meshcat.SetObject(f"{path}/dot", Sphere(DOT), colour)
        meshcat.SetObject(f"{path}/shaft", Cylinder(SHAFT, ARROW - HEAD), colour)
        meshcat.SetTransform(f"{path}/shaft", RigidTransform([0.0, 0.0, (ARROW - HEAD) / 2.0]))
        # A cone opens along its +z from its apex, here the arrow's tip.
        meshcat.SetObject(f"{path}/head", MeshcatCone(HEAD, HEAD_RADIUS, HEAD_RADIUS), colour)
        tip = RigidTransform(RotationMatrix.MakeXRotation(np.pi), [0.0, 0.0, ARROW])
        meshcat.SetTransform(f"{path}/head", tip)


class _ForceArrows:
    """An arrow per force on the object, its tip at the contact, drawn at every step."""

    def __init__(self, meshcat: Meshcat, scene: Scene, force_limit: float) -> None:
        self._meshcat, self._scene = meshcat, scene
        self._length = LARGEST_FORCE / force_limit  # [m/N]
        self._made = 0

    def record(self, root_context: Context) -> None:
        """Record the forces that are applied now; a monitor of the simulator."""
        scene, time = self._scene, root_context.get_time()
        forces = scene.plant.get_applied_spatial_force_input_port().Eval(scene.context)
        R_OW = scene.pose(scene.object)[:3, :3].T
        self._make(len(forces))
        for i, force in enumerate(forces):
            f_O = R_OW @ force.F_Bq_W.translational()
            magnitude = float(np.linalg.norm(f_O))
            if magnitude == 0.0:
                continue
            path = f"{OBJECT_PATH}/forces/{i + 1}"
            self._meshcat.SetTransform(path, _along(force.p_BoBq_B, -f_O), time)
            scale = [1.0, 1.0, self._length * magnitude]
            self._meshcat.SetProperty(path, "scale", scale, time)

    def _make(self, count: int) -> None:
        """Add arrows of length 1 until there are so many."""
        colour = _rgba(REACHED)
        for i in range(self._made, count):
            path = f"{OBJECT_PATH}/forces/{i + 1}/arrow"
            self._meshcat.SetObject(
                f"{path}/head", MeshcatCone(0.2, HEAD_RADIUS, HEAD_RADIUS), colour
            )
            self._meshcat.SetObject(f"{path}/shaft", Cylinder(SHAFT, 0.8), colour)
            self._meshcat.SetTransform(f"{path}/shaft", RigidTransform([0.0, 0.0, 0.6]))
        self._made = max(self._made, count)


def _along(p_OQ: Array, v_O: Array) -> RigidTransform:
    """Return the pose in {O} of a frame at a point whose z axis is along a vector."""
    return RigidTransform(RotationMatrix.MakeFromOneVector(v_O, 2), p_OQ)


def _rgba(colour: str) -> Rgba:
    return Rgba(*(int(colour[i : i + 2], 16) / 255.0 for i in (1, 3, 5)))
