"""Recordings of verifications: a trial, a lift by forces, or a grasp that was not simulated.

In: a `Verification`. Out: an HTML file, see `visualization.recording`.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from pydrake.geometry import Cylinder, Meshcat, MeshcatCone
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context

from drakegrasp.config import Config
from drakegrasp.frames import Array
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.strength import fingertip_forces
from drakegrasp.objects.model import ObjectModel
from drakegrasp.simulation.construction import build_scene
from drakegrasp.simulation.drive import drive_of
from drakegrasp.simulation.placement import canonical_pose
from drakegrasp.simulation.scene import Scene
from drakegrasp.verification.forces.lift import ForceLift, lift_by_forces
from drakegrasp.verification.wrist.solver import WristFit
from drakegrasp.visualization.recording import (
    HEAD_RADIUS,
    OBJECT_PATH,
    SHAFT,
    draw_predicted,
    pose_along,
    record_attempt,
    record_html,
    rgba,
    show_start,
)
from drakegrasp.visualization.style import REACHED

if TYPE_CHECKING:
    from drakegrasp.verification.result import Verification

#: Length of the arrow of a force as large as the strongest fingertip's limit [m].
LARGEST_FORCE = 0.08


def record_lift(
    model: ObjectModel,
    X_TO: npt.ArrayLike,
    p_OQ: Array,
    nhat_Q_O: Array,
    config: Config,
    path: Path,
) -> ForceLift:
    """Return the result of `lift.lift_by_forces`, and write a recording of it.

    The recording shows the contacts on the object, and the forces as they are applied.

    Args:
        model: The object.
        X_TO: (4, 4), its resting pose in the table-top frame.
        p_OQ: (k, 3), contacts in {O} [m].
        nhat_Q_O: (k, 3), their outward unit normals in {O}.
        config: Hand (for the limits of its forces), physics, lift and limits.
        path: The HTML file.

    Raises:
        OSError: If the file cannot be written.
    """
    hand = load_hand(config.hand)
    limit = fingertip_forces(hand, drive_of(hand, config.lift))

    def run(meshcat: Meshcat) -> ForceLift:
        scene = build_scene(model, config.physics, meshcat=meshcat)
        # A lift that fails before it is simulated is shown at its start.
        show_start(meshcat, scene, X_TO, config)
        # The scene belongs to this function, so the monitor disturbs nobody else.
        scene.simulator.set_monitor(_ForceArrows(meshcat, scene, float(limit.max())).record)
        try:
            lift = lift_by_forces(scene, X_TO, p_OQ, nhat_Q_O, force_limit=limit, config=config)
        finally:
            # Scene and monitor refer to each other in a way that the garbage collector cannot see.
            scene.simulator.clear_monitor()
        draw_predicted(meshcat, p_OQ, nhat_Q_O)
        return lift

    return record_html(run, path)


def record_verification(verified: Verification, path: Path) -> None:
    """Write a recording of a verification, which is simulated again for it.

    A grasp that was not simulated is shown at rest, with the hand at the palm pose that comes
    closest to the contacts, if there is one.

    Args:
        verified: The verdict.
        path: The HTML file.

    Raises:
        OSError: If the file cannot be written.
    """
    model, X_TO = verified.placed.model, canonical_pose(verified.placed.X_TO)
    config = verified.config
    p_OQ, nhat_Q_O = verified.p_OQ, verified.nhat_Q_O
    if verified.pregrasp is not None:
        record_attempt(model, X_TO, verified.pregrasp, config, path, p_OQ=p_OQ, nhat_Q_O=nhat_Q_O)
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
    """Write a recording of the object, the predicted contacts and the hand of a fit, at rest."""

    def run(meshcat: Meshcat) -> None:
        hand = None if fit is None else load_hand(config.hand)
        scene = build_scene(model, config.physics, hand, meshcat=meshcat)
        if fit is None:
            show_start(meshcat, scene, X_TO, config)
        else:
            show_start(meshcat, scene, X_TO, config, fit.X_OG, fit.spread, fit.closing)
        draw_predicted(meshcat, p_OQ, nhat_Q_O)

    record_html(run, path)


class _ForceArrows:
    """Draws the forces on the object at every step: arrows whose tips are at the contacts."""

    def __init__(self, meshcat: Meshcat, scene: Scene, force_limit: float) -> None:
        self._meshcat, self._scene = meshcat, scene
        self._length = LARGEST_FORCE / force_limit  # [m/N]
        self._made = 0

    def record(self, root_context: Context) -> None:
        """Record the forces that are applied now; the simulator's monitor."""
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
            self._meshcat.SetTransform(path, pose_along(force.p_BoBq_B, -f_O), time)
            scale = [1.0, 1.0, self._length * magnitude]
            self._meshcat.SetProperty(path, "scale", scale, time)

    def _make(self, count: int) -> None:
        """Add arrows of length 1 until there are `count`."""
        colour = rgba(REACHED)
        for i in range(self._made, count):
            path = f"{OBJECT_PATH}/forces/{i + 1}/arrow"
            self._meshcat.SetObject(
                f"{path}/head", MeshcatCone(0.2, HEAD_RADIUS, HEAD_RADIUS), colour
            )
            self._meshcat.SetObject(f"{path}/shaft", Cylinder(SHAFT, 0.8), colour)
            self._meshcat.SetTransform(f"{path}/shaft", RigidTransform([0.0, 0.0, 0.6]))
        self._made = max(self._made, count)
