"""Stage "settle": drop the object on the table and wait until it rests.

In: a prepared object. Out: its resting pose X_TO, moved in x and y only so that
p_TO = (0, 0, z) (Veres et al., "Initial Object and hand configurations").
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drakegrasp.config import Config
from drakegrasp.errors import MeshError
from drakegrasp.frames import X_WT, Array, invert_pose, make_pose
from drakegrasp.objects.model import ObjectModel
from drakegrasp.simulation.construction import build_scene
from drakegrasp.simulation.contacts import read_contacts
from drakegrasp.simulation.scene import Scene, advance, reset_object

#: Simulated time between two looks at the object's speed [s].
LOOK_PERIOD = 0.05
#: Drake's gravity [m/s^2], and by how much the table's force at rest may miss the weight.
GRAVITY, MAX_FORCE_ERROR = 9.81, 0.01
#: When a rolling object is stopped by hand, as a share of the longest time; see `settle`.
STOP_FRACTION = 0.6


@dataclass(frozen=True, kw_only=True, eq=False)
class Resting:
    """How an object lies on the table.

    Attributes:
        X_TO: Pose in the table-top frame, (4, 4); p_TO = (0, 0, z).
        seconds: Simulated time until it rested [s].
        table_force: Upward force of the table at rest [N].
        stopped: Whether it had to be stopped because it would have rolled on.
    """

    X_TO: Array
    seconds: float
    table_force: float
    stopped: bool


def settle(model: ObjectModel, config: Config) -> Resting:
    """Return the resting pose of an object dropped with {O} aligned to {W}.

    Hydroelastic contact has no rolling resistance, so a round object may roll for very
    long. After `STOP_FRACTION` of `settle.max_time` its velocity is therefore set to zero
    once at every look, as the released code froze whatever still moved.

    Raises:
        MeshError: If the object leaves the table, never comes to rest, or Drake cannot
            simulate it.
    """
    try:
        return _settle(model, config)
    # A failed assertion within Drake arrives as SystemExit.
    except (RuntimeError, SystemExit) as error:
        lines = str(error).strip().splitlines() or [type(error).__name__]
        raise MeshError(f"{model.name}: Drake must be able to drop it, got: {lines[0]}") from None


def _settle(model: ObjectModel, config: Config) -> Resting:
    rules = config.settle
    scene = build_scene(model, config.physics.model_copy(update={"time_step": rules.time_step}))
    lowest = float(model.collision_vertices[:, 2].min())
    X_WO = X_WT @ make_pose(np.eye(3), [0.0, 0.0, rules.drop_height - lowest])
    reset_object(scene, X_WO)
    scene.simulator.Initialize()
    resting_for, stopped, linear, angular = 0.0, False, 0.0, 0.0
    while resting_for < rules.rest_time:
        if scene.time >= rules.max_time:
            raise MeshError(
                f"{model.name}: must come to rest on the table within {rules.max_time:g} s of "
                f"simulation, got {linear:.3g} m/s and {angular:.3g} rad/s"
            )
        advance(scene, LOOK_PERIOD)
        linear, angular = _speeds(scene)
        if not np.isfinite(linear) or linear > config.physics.max_speed:
            raise MeshError(f"{model.name}: must fall calmly, got a speed of {linear:.3g} m/s")
        slow = linear < rules.max_linear_speed and angular < rules.max_angular_speed
        resting_for = resting_for + LOOK_PERIOD if slow else 0.0
        if not slow and scene.time > STOP_FRACTION * rules.max_time:
            scene.plant.SetVelocities(scene.context, np.zeros(scene.plant.num_velocities()))
            stopped = True
    X_TO = invert_pose(X_WT) @ scene.pose(scene.object)
    if X_TO[2, 3] < 0.0:
        raise MeshError(f"{model.name}: must come to rest on the table, got an object that left it")
    X_TO[:2, 3] = 0.0
    force = float(read_contacts(scene).table_force[2])
    weight = model.mass * GRAVITY
    if abs(force - weight) > MAX_FORCE_ERROR * weight:
        raise MeshError(
            f"{model.name}: the table must carry its {weight:.3g} N at rest, got {force:.3g} N"
        )
    return Resting(X_TO=X_TO, seconds=scene.time, table_force=force, stopped=stopped)


def _speeds(scene: Scene) -> tuple[float, float]:
    """Return the object's linear [m/s] and angular [rad/s] speed."""
    velocity = scene.plant.EvalBodySpatialVelocityInWorld(scene.context, scene.object)
    linear = float(np.linalg.norm(velocity.translational()))
    return linear, float(np.linalg.norm(velocity.rotational()))
