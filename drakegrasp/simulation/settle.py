"""Stage "settle": drop the object on the table and wait until it rests.

In: a prepared object. Out: its resting pose X_TO, moved in x and y so that p_TO = (0, 0, z)
(Veres et al., "Initial Object and hand configurations").
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydrake.math import RotationMatrix

from drakegrasp.arithmetic import multiply, norm
from drakegrasp.config import Config
from drakegrasp.errors import MeshError, first_line
from drakegrasp.frames import X_WT, Array, invert_pose, make_pose
from drakegrasp.objects.model import ObjectModel
from drakegrasp.simulation.construction import build_scene
from drakegrasp.simulation.contacts import read_contacts
from drakegrasp.simulation.scene import Scene, advance, reset_object

#: Simulated time between two checks of the object's speed [s].
CHECK_PERIOD = 0.05
#: Drake's gravity [m/s^2], and the largest relative error of the table's force at rest.
GRAVITY, MAX_FORCE_ERROR = 9.81, 0.01
#: A resting pose is snapped to multiples of this, in p_TO [m] and in the quaternion of R_TO: about
#: a micrometre and a microradian. Drake's last bits depend on the CPU, and the palm poses depend on
#: the resting pose.
POSE_GRID = 2.0**-20
#: Share of the longest time after which an object that still rolls is stopped; see `settle`.
STOP_FRACTION = 0.6


@dataclass(frozen=True, kw_only=True, eq=False)
class Resting:
    """How an object lies on the table.

    Attributes:
        X_TO: Pose in the table-top frame, (4, 4); p_TO = (0, 0, z).
        seconds: Simulated time until it rested [s].
        table_force: Upward force of the table at rest [N].
        stopped: Whether it was stopped because it was still rolling.
    """

    X_TO: Array
    seconds: float
    table_force: float
    stopped: bool


def settle(model: ObjectModel, config: Config) -> Resting:
    """Return the resting pose of an object dropped with {O} aligned to {W}.

    Hydroelastic contact has no rolling resistance, so a round object may roll for very long. After
    `STOP_FRACTION` of `settle.max_time` each check therefore sets the velocity of an object that
    still moves to zero; the released code froze it.

    Raises:
        MeshError: If the object leaves the table, never comes to rest, or Drake cannot
            simulate it.
    """
    try:
        return _settle(model, config)
    # A failed assertion within Drake arrives as SystemExit.
    except (RuntimeError, SystemExit) as error:
        reason = first_line(error)
        raise MeshError(f"{model.name}: Drake failed while dropping it: {reason}") from None


def _settle(model: ObjectModel, config: Config) -> Resting:
    # Hold the object over the table, aligned to {W}, and let it go.
    rules = config.settle
    scene = build_scene(model, config.physics.model_copy(update={"time_step": rules.time_step}))
    lowest = float(model.collision_vertices[:, 2].min())
    X_WO = multiply(X_WT, make_pose(np.eye(3), [0.0, 0.0, rules.drop_height - lowest]))
    reset_object(scene, X_WO)
    scene.simulator.Initialize()

    # Simulate until it has been slow for long enough.
    resting_for, stopped, linear, angular = 0.0, False, 0.0, 0.0
    while resting_for < rules.rest_time:
        if scene.time >= rules.max_time:
            raise MeshError(
                f"{model.name}: must come to rest on the table within {rules.max_time:g} s of "
                f"simulation, got {linear:.3g} m/s and {angular:.3g} rad/s"
            )
        advance(scene, CHECK_PERIOD)
        linear, angular = _speeds(scene)
        if not np.isfinite(linear) or linear > config.physics.max_speed:
            raise MeshError(
                f"{model.name}: its speed must stay below {config.physics.max_speed:g} m/s while "
                f"it settles, got {linear:.3g} m/s"
            )
        slow = linear < rules.max_linear_speed and angular < rules.max_angular_speed
        resting_for = resting_for + CHECK_PERIOD if slow else 0.0
        if not slow and scene.time > STOP_FRACTION * rules.max_time:
            scene.plant.SetVelocities(scene.context, np.zeros(scene.plant.num_velocities()))
            stopped = True

    # The pose over the table's centre, on the grid.
    X_TO = multiply(invert_pose(X_WT), scene.pose(scene.object))
    if X_TO[2, 3] < 0.0:
        raise MeshError(f"{model.name}: must come to rest on the table, got an object that left it")
    X_TO = snapped(X_TO)

    # At rest the table carries the weight: a check of the contact itself.
    force = float(read_contacts(scene).table_force[2])
    weight = model.mass * GRAVITY
    if abs(force - weight) > MAX_FORCE_ERROR * weight:
        raise MeshError(
            f"{model.name}: the table must carry its {weight:.3g} N at rest, got {force:.3g} N"
        )
    return Resting(X_TO=X_TO, seconds=scene.time, table_force=force, stopped=stopped)


def snapped(X_TO: Array) -> Array:
    """Return a resting pose (4, 4) with p_TO = (0, 0, z), rounded to a fine grid.

    Poses that differ by rounding become the same bits, unless they lie halfway between two points
    of the grid: with a rounding error e that happens to one pose in POSE_GRID / e.
    """
    # A quaternion and its negative give the same bits below: each term has two of its entries.
    wxyz = np.rint(RotationMatrix(X_TO[:3, :3]).ToQuaternion().wxyz() / POSE_GRID)
    w, x, y, z = wxyz / norm(wxyz)

    # Written out, since the bits of SciPy's or Drake's conversion may depend on the CPU.
    R_TO = np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )
    return make_pose(R_TO, [0.0, 0.0, np.rint(X_TO[2, 3] / POSE_GRID) * POSE_GRID])


def _speeds(scene: Scene) -> tuple[float, float]:
    """Return the object's linear [m/s] and angular [rad/s] speed."""
    velocity = scene.plant.EvalBodySpatialVelocityInWorld(scene.context, scene.object)
    linear = float(norm(velocity.translational()))
    return linear, float(norm(velocity.rotational()))
