"""Stage "settle": drop the object on the table and wait until it rests.

Input: a prepared object. Output: its resting pose X_TO, moved in x and y so that p_TO = (0, 0, z)
(Veres et al., "Initial Object and hand configurations").
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from drakegrasp.arithmetic import dot, multiply, norm
from drakegrasp.config import Config
from drakegrasp.errors import MeshError, first_line
from drakegrasp.frames import GRAVITY, X_WT, Array, make_pose, transform_points
from drakegrasp.mesh.remeshing import subdivide
from drakegrasp.mesh.surfaces import Solid
from drakegrasp.objects.model import ObjectModel
from drakegrasp.seeding import Draw, Stream, object_key
from drakegrasp.simulation.construction import build_object_scene
from drakegrasp.simulation.contacts import table_force
from drakegrasp.simulation.scene import ObjectScene, advance, object_pose, reset_object

#: Simulated time between two checks of the object's speed [s].
CHECK_PERIOD = 0.05
#: Longest edge of the surface that lands [m], and the number of faces up to which longer edges are
#: split. A base supports to within about a quarter of the longest edge from its rim.
MAX_EDGE, MAX_FACES = 0.02, 12_000
#: Largest relative error of the table's force at rest.
MAX_FORCE_ERROR = 0.01
#: A resting pose is rounded to multiples of this, in p_TO [m] and in the quaternion of R_TO: about
#: a micrometre and a microradian. Drake's last bits depend on the CPU, and the palm poses depend on
#: the resting pose.
POSE_GRID = 2.0**-20
#: An object deeper in the table than this [m] is raised and set down again, at most this often.
MAX_SINK, MAX_SETTINGS = 3e-4, 4
#: A larger tilt of an object at rest is reported [rad] (5 degrees); an uneven base tilts by less.
NOTED_TILT = np.pi / 36.0
#: Fraction of the longest time after which an object that still rolls is stopped; see `settle`.
STOP_FRACTION = 0.6
#: Resting poses whose upward directions in {O} differ by less than this are the same pose [rad].
SAME_UP = np.pi / 18.0
#: Time step of drops from random orientations [s].
RANDOM_STEP = 0.008


@dataclass(frozen=True, kw_only=True, eq=False)
class Resting:
    """How an object lies on the table.

    Attributes:
        X_TO: Pose in the table-top frame, (4, 4); p_TO = (0, 0, z).
        seconds: Simulated time until the object rested [s].
        table_force: Upward force of the table at rest [N].
        sink: Depth of the object's lowest point in the table [m].
        stopped: Whether the object was stopped because it was still rolling.
        probability: Fraction of the drops that ended in this pose.
    """

    X_TO: Array
    seconds: float
    table_force: float
    sink: float
    stopped: bool
    probability: float = 1.0

    @property
    def tilt(self) -> float:
        """Angle between the object's z-axis, which pointed up when it fell, and up [rad]."""
        return float(np.arccos(np.clip(self.X_TO[2, 2], -1.0, 1.0)))

    @property
    def notes(self) -> tuple[str, ...]:
        """What a user may not expect of how the object rests, in sentences."""
        notes = []
        if self.tilt > NOTED_TILT:
            degrees = np.degrees(self.tilt)
            notes.append(f"it tipped over by {degrees:.0f} degrees when it was dropped")
        if self.sink > MAX_SINK:
            notes.append(f"its lowest point is {1e3 * self.sink:.2g} mm deep in the table")
        if self.stopped:
            notes.append("it still rolled on the table and was stopped")
        return tuple(notes)


def find_resting_poses(model: ObjectModel, config: Config) -> list[Resting]:
    """Return the different resting poses of an object; the first is the pose of `settle`.

    The number of drops is `objects.resting_poses`. In the first drop {O} is aligned to {W}, the
    others have random orientations. A drop that does not come to rest, or ends like an earlier one,
    adds no pose.

    Raises:
        MeshError: As `settle`, for the first drop.
    """
    found, counts = [settle(model, config)], [1]

    # A drop from a random orientation has no earlier pose to keep. It starts at the table, with
    # longer steps and the surface of lifts, and comes to rest at a fifth of the cost. These drops
    # share a scene.
    rules = config.settle.model_copy(update={"drop_height": 0.0, "time_step": RANDOM_STEP})
    eased = config.model_copy(update={"settle": rules})
    shared = cache(lambda: _scene_of(model, eased, model.resting_surface))
    for drop in range(1, config.objects.resting_poses):
        stream = Stream(config.seed, object_key(model.name), drop, Draw.DROP)
        # Four normal random numbers, normalised, are a uniform quaternion (Muller 1959).
        try:
            resting = _settle(model, eased, rotation_of(stream.normal(4)), shared)
        except MeshError:
            shared.cache_clear()  # a scene is not used again after a failure
            continue

        # The third row of R_TO is the upward direction in {O}.
        cosines = [float(dot(resting.X_TO[2, :3], other.X_TO[2, :3])) for other in found]
        nearest = int(np.argmax(cosines))
        if cosines[nearest] > np.cos(SAME_UP):
            counts[nearest] += 1
        else:
            found.append(resting)
            counts.append(1)
    return [
        replace(resting, probability=count / sum(counts))
        for resting, count in zip(found, counts, strict=True)
    ]


def settle(model: ObjectModel, config: Config) -> Resting:
    """Return the resting pose of an object that is dropped with {O} aligned to {T}.

    The origin of {O} starts at `settle.drop_height` above the table (Veres et al.). If the object
    is taller, its lowest point starts just on the table.

    Hydroelastic contact has no rolling resistance, so a round object may roll for a very long time.
    After `STOP_FRACTION` of `settle.max_time`, each check therefore sets the velocity of an object
    that still moves to zero. The paper's released code froze such an object.

    Args:
        model: The object.
        config: How the object settles.

    Raises:
        MeshError: If the object leaves the table, never comes to rest, or Drake cannot
            simulate it.
    """
    # The paper's drop keeps the fall, the step and the surface that decided the pose in earlier
    # datasets.
    return _settle(
        model, config, np.eye(3), lambda: _scene_of(model, config, settling_surface(model))
    )


def _scene_of(model: ObjectModel, config: Config, surface: Solid) -> ObjectScene:
    """Return a scene with the time step of settling, in which a surface meets the table."""
    physics = config.physics.model_copy(update={"time_step": config.settle.time_step})
    return build_object_scene(model, physics, resting_surface=surface)


def _settle(
    model: ObjectModel, config: Config, R_TO: Array, build: Callable[[], ObjectScene]
) -> Resting:
    """Return the resting pose of an object that is dropped with an orientation; see `settle`.

    Args:
        model: The object.
        config: How the object settles.
        R_TO: Orientation of the object when it is dropped, (3, 3).
        build: Returns the scene.
    """
    try:
        return _drop(build(), config, R_TO)
    # A failed assertion in Drake arrives as SystemExit.
    except (RuntimeError, SystemExit) as error:
        reason = first_line(error)
        raise MeshError(f"{model.name}: Drake failed while dropping it: {reason}") from None


def _drop(scene: ObjectScene, config: Config, R_TO: Array) -> Resting:
    # Free fall does not turn the object, so the simulation begins where it touches the table. If it
    # began higher, the first step in contact would find the object millimetres deep in the table
    # and throw it up and over.
    model, rules = scene.model, config.settle
    lowest = float(dot(model.collision_vertices, R_TO[2]).min())
    fall = max(rules.drop_height + lowest, 0.0)
    reset_object(scene, multiply(X_WT, make_pose(R_TO, [0.0, 0.0, -lowest])))
    # The object is the only body that moves: angular, then linear velocity.
    speed = float(np.sqrt(2.0 * GRAVITY * fall))
    scene.plant.SetVelocities(scene.context, [0.0, 0.0, 0.0, 0.0, 0.0, -speed])
    scene.simulator.Initialize()
    stopped = wait_for_rest(scene, config)

    # An object that landed on a tip may stick in the table like a nail: raise it and set it down.
    sink = _sink(scene)
    for _ in range(MAX_SETTINGS):
        if sink <= MAX_SINK:
            break
        _raise(scene, sink)
        stopped = wait_for_rest(scene, config) or stopped
        sink = _sink(scene)

    # The pose over the table's centre, rounded to the grid.
    X_TO = object_pose(scene)
    if X_TO[2, 3] < 0.0:
        raise MeshError(f"{model.name}: must come to rest on the table, got an object that left it")
    X_TO = snapped(X_TO)

    # At rest the table supports the weight; this checks the contact itself.
    force = float(table_force(scene)[2])
    weight = model.mass * GRAVITY
    if abs(force - weight) > MAX_FORCE_ERROR * weight:
        raise MeshError(
            f"{model.name}: the table must carry its {weight:.3g} N at rest, got {force:.3g} N"
        )
    return Resting(X_TO=X_TO, seconds=scene.time, table_force=force, sink=sink, stopped=stopped)


def settling_surface(model: ObjectModel) -> Solid:
    """Return the object's collision surface without long edges; it decides how the object lands."""
    return subdivide(model.collision_solid, MAX_EDGE, MAX_FACES)


def wait_for_rest(scene: ObjectScene, config: Config) -> bool:
    """Simulate until all objects have been slow for long enough; return whether any was stopped.

    Raises:
        MeshError: If they take too long, or one becomes too fast.
    """
    # Reject an object that takes too long.
    rules, name = config.settle, scene.model.name
    resting_for, stopped, linear, angular = 0.0, False, 0.0, 0.0
    start = scene.time
    while resting_for < rules.rest_time:
        if scene.time - start >= rules.max_time:
            raise MeshError(
                f"{name}: must come to rest on the table within {rules.max_time:g} s of "
                f"simulation, got {linear:.3g} m/s and {angular:.3g} rad/s"
            )

        # Measure its speed a little later.
        advance(scene, CHECK_PERIOD)
        linear, angular = _speeds(scene)
        if not np.isfinite(linear) or linear > config.physics.max_speed:
            raise MeshError(
                f"{name}: its speed must stay below {config.physics.max_speed:g} m/s while "
                f"it settles, got {linear:.3g} m/s"
            )

        # Measure how long it has been slow; stop it if it has moved for too long.
        slow = linear < rules.max_linear_speed and angular < rules.max_angular_speed
        resting_for = resting_for + CHECK_PERIOD if slow else 0.0
        if not slow and scene.time - start > STOP_FRACTION * rules.max_time:
            scene.plant.SetVelocities(scene.context, np.zeros(scene.plant.num_velocities()))
            stopped = True
    return stopped


def _sink(scene: ObjectScene) -> float:
    """Return how deep the object's lowest point is in the table [m]; negative above it."""
    X_TO = object_pose(scene)
    return -float(transform_points(X_TO, scene.model.collision_vertices)[:, 2].min())


def _raise(scene: ObjectScene, height: float) -> None:
    """Move the object up by a height [m] and set its velocity to zero."""
    X_WO = scene.pose(scene.object).copy()
    X_WO[2, 3] += height
    scene.plant.SetFreeBodyPose(scene.context, scene.object, RigidTransform(X_WO))
    scene.plant.SetVelocities(scene.context, np.zeros(scene.plant.num_velocities()))


def snapped(X_TO: Array) -> Array:
    """Return a resting pose (4, 4) with p_TO = (0, 0, z), rounded to a fine grid.

    Poses that differ by rounding errors become equal in every bit, unless they lie halfway between
    two points of the grid. With a rounding error e, that happens to one pose in POSE_GRID / e.
    """
    return on_grid(make_pose(X_TO[:3, :3], [0.0, 0.0, X_TO[2, 3]]))


def on_grid(X_TO: Array) -> Array:
    """Return a pose (4, 4) rounded to a fine grid, see `snapped`."""
    # A quaternion and its negative give the same bits below, because each term has two entries.
    wxyz = np.rint(RotationMatrix(X_TO[:3, :3]).ToQuaternion().wxyz() / POSE_GRID)
    return make_pose(rotation_of(wxyz), np.rint(X_TO[:3, 3] / POSE_GRID) * POSE_GRID)


def rotation_of(wxyz: Array) -> Array:
    """Return the rotation (3, 3) of a quaternion (4,) of any length."""
    # Written out, because the bits of SciPy's or Drake's conversion may depend on the CPU.
    w, x, y, z = wxyz / norm(wxyz)
    return np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


def _speeds(scene: ObjectScene) -> tuple[float, float]:
    """Return the largest linear [m/s] and angular [rad/s] speed of the objects."""
    bodies = [scene.object, *(each.body for each in scene.neighbours)]
    moving = [scene.plant.EvalBodySpatialVelocityInWorld(scene.context, body) for body in bodies]
    linear = max(float(norm(velocity.translational())) for velocity in moving)
    return linear, max(float(norm(velocity.rotational())) for velocity in moving)
