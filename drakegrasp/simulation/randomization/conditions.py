"""The conditions of an attempt: what may differ between two attempts at the same palm pose.

Values in use, not factors: where nothing is drawn they are the configuration's and the object's
own. Plain data without Drake; who draws them is `randomization.draws`.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from drakegrasp.arithmetic import Array
from drakegrasp.config import PhysicsConfig
from drakegrasp.frames import pack_pose
from drakegrasp.objects.model import ObjectModel
from drakegrasp.vision.appearance import Appearance, usual_appearance
from drakegrasp.vision.depth_sensor import DepthSensor


@dataclass(frozen=True, kw_only=True)
class Materials:
    """Friction and mass: what the simulation of an attempt depends on.

    Attributes:
        friction_hand, friction_table: Effective coefficients of the object with hand and table.
        mass: Of the object [kg]; its inertia is in proportion.
    """

    friction_hand: float
    friction_table: float
    mass: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Conditions:
    """The conditions of an attempt.

    Attributes:
        materials: Friction and mass.
        appearance: Colours and light.
        X_C0C: Pose (4, 4) of the oto camera in its usual pose.
        sensor: Errors of the depth images.
    """

    materials: Materials
    appearance: Appearance
    X_C0C: Array
    sensor: DepthSensor

    def values(self) -> dict[str, Any]:
        """Return the values that a dataset keeps, by their names in its schema."""
        return {
            **asdict(self.materials),
            **vars(self.appearance),
            "X_C0C": pack_pose(self.X_C0C),
            "depth_noise": self.sensor.noise,
            "depth_seed": self.sensor.seed,
        }


def usual_materials(model: ObjectModel, physics: PhysicsConfig) -> Materials:
    """Return the friction and mass of an object's attempts where nothing is drawn."""
    physics = model.own_physics(physics)
    return Materials(
        friction_hand=physics.friction_hand,
        friction_table=physics.friction_table,
        mass=model.mass,
    )


def usual_conditions(model: ObjectModel, physics: PhysicsConfig) -> Conditions:
    """Return the conditions of an object's attempts where nothing is drawn."""
    return Conditions(
        materials=usual_materials(model, physics),
        appearance=usual_appearance(model.name),
        X_C0C=np.eye(4),
        sensor=DepthSensor(),
    )
