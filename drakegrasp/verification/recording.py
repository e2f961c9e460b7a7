"""Recordings of verifications: a trial, a lift by forces, or an object whose grasp is none.

In: a `Verification`. Out: an HTML file, see `visualization.recording`.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pydrake.geometry import Cylinder, Meshcat, MeshcatCone
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context

from drakegrasp.simulation.construction import build_object_scene
from drakegrasp.simulation.scene import ObjectScene
from drakegrasp.verification.forces.contact_forces import hand_contacts
from drakegrasp.verification.forces.lift import ForceLift, lift_by_forces
from drakegrasp.visualization.recording import (
    HEAD_RADIUS,
    OBJECT_PATH,
    SHAFT,
    draw_predicted,
    pose_along,
    record_attempt,
    record_html,
    rgba,
    show_object,
)
from drakegrasp.visualization.style import REACHED

if TYPE_CHECKING:
    from drakegrasp.verification.result import Verification

#: Length of the arrow of a force as large as the strongest fingertip's limit [m].
LARGEST_FORCE = 0.08


def record_verification(verified: Verification, path: Path) -> None:
    """Write a recording of a verification, which is simulated again for it, with its explanation.

    The trial is that of the first wrist pose. A row that is no grasp shows the object at rest.

    Args:
        verified: The verdict.
        path: The HTML file.

    Raises:
        OSError: If the file cannot be written.
    """
    if verified.lift is not None:
        record_lift(verified, path)
    elif verified.pregrasp is None:
        _record_object(verified, path)
    else:
        record_attempt(
            verified.placed.model,
            verified.placed.X_TO_simulated,
            verified.pregrasp,
            verified.config,
            path,
            p_OQ=verified.p_OQ,
            nhat_Q_O=verified.nhat_Q_O,
            caption=verified.explain(),
        )


def record_lift(verified: Verification, path: Path) -> ForceLift:
    """Lift an object by forces again and return the result, and write a recording of it.

    The recording shows the contacts on the object, and the forces as they are applied.

    Args:
        verified: The verdict by method `forces`.
        path: The HTML file.

    Raises:
        OSError: If the file cannot be written.
    """
    placed, config = verified.placed, verified.config
    contacts = hand_contacts(placed.model, verified.p_OQ, verified.nhat_Q_O, config)
    largest = float(np.asarray(contacts.force_limit).max())

    def run(meshcat: Meshcat) -> ForceLift:
        scene = build_object_scene(placed.model, config.physics, meshcat=meshcat)
        # A lift that fails before it is simulated is shown at its start.
        show_object(meshcat, scene, placed.X_TO_simulated, config)
        # The scene belongs to this function, so the monitor disturbs nobody else.
        scene.simulator.set_monitor(_ForceArrows(meshcat, scene, largest).record)
        try:
            lift = lift_by_forces(scene, placed.X_TO_simulated, contacts, config)
        finally:
            # Scene and monitor refer to each other in a way that the garbage collector cannot see.
            scene.simulator.clear_monitor()
        draw_predicted(meshcat, verified.p_OQ, verified.nhat_Q_O)
        return lift

    return record_html(run, path, verified.explain())


def _record_object(verified: Verification, path: Path) -> None:
    """Write a recording of the object at rest."""
    placed, config = verified.placed, verified.config

    def run(meshcat: Meshcat) -> None:
        scene = build_object_scene(placed.model, config.physics, meshcat=meshcat)
        show_object(meshcat, scene, placed.X_TO_simulated, config)

    record_html(run, path, verified.explain())


class _ForceArrows:
    """Draws the forces on the object at every step: arrows whose tips are at the contacts."""

    def __init__(self, meshcat: Meshcat, scene: ObjectScene, force_limit: float) -> None:
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
