"""The state of a scene: one object, the table and one hand in a Drake diagram.

An `ObjectScene` has no hand: objects settle in it. A scene is built once per object
(`construction`) and reset for each attempt, because building costs more than simulating, and a
reset context gives the same bits as a new one. A scene makes no decisions; `settle` and `trial` do.
An attempt steps within limits (`TrialLimits`). Each limit raises an exception, which
`trial.run_attempt` turns into an outcome.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from pydrake.geometry import CollisionFilterDeclaration, GeometryId, GeometrySet, SceneGraph
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    JointActuator,
    ModelInstanceIndex,
    PrismaticJoint,
    RevoluteJoint,
    RigidBody,
)
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context
from pydrake.systems.primitives import TrajectorySource
from pydrake.trajectories import BezierCurve, PiecewisePolynomial

from drakegrasp.arithmetic import multiply
from drakegrasp.config import Config, PhysicsConfig
from drakegrasp.frames import X_WT, Array, invert_pose
from drakegrasp.hand.description import Hand
from drakegrasp.hand.kinematics import joint_positions
from drakegrasp.objects.model import ObjectModel

#: A revolute or prismatic joint.
ClosingJoint: TypeAlias = RevoluteJoint | PrismaticJoint


def joint_limits(joint: ClosingJoint) -> tuple[float, float]:
    """Return the present limits of a joint [rad or m]; they belong to the plant."""
    return float(joint.position_lower_limits()[0]), float(joint.position_upper_limits()[0])


@dataclass(frozen=True, kw_only=True, eq=False)
class Motor:
    """A motor: an actuator at the closing joint of each finger that it moves.

    Attributes:
        actuators: The first one is at the motor's joint, for which its effort is given. All push
            equally.
        ratio: Sum of the fingers' positions per position of this joint.
    """

    actuators: tuple[JointActuator, ...]
    ratio: float = 1.0

    def effort_limit(self) -> float:
        """Return the motor's present largest torque or force [N m or N], at its joint."""
        return float(self.actuators[0].effort_limit()) * self.ratio

    def set_effort_limit(self, limit: float) -> None:
        """Set this limit; by virtual work, each actuator applies limit / ratio."""
        for actuator in self.actuators:
            actuator.set_effort_limit(limit / self.ratio)


@dataclass(frozen=True, kw_only=True, eq=False)
class Neighbour:
    """A free object beside the one that is grasped.

    Attributes:
        body: Its body.
        model: The object.
        X_WN: Pose (4, 4) at the start of each attempt.
    """

    body: RigidBody
    model: ObjectModel
    X_WN: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectScene:
    """An object on the table: a built diagram with its one context.

    Attributes:
        model: The object.
        simulator: The simulator, which owns the diagram's context.
        plant, scene_graph: The two systems of the diagram.
        object, table: The bodies.
        table_side: The object's surface for contact with the table; a hand uses the other surface.
        physics: The configuration with which the scene was built.
        neighbours: The free objects beside it.
        walls: The body of the walls around it; None if there are none.
    """

    model: ObjectModel
    simulator: Simulator
    plant: MultibodyPlant
    scene_graph: SceneGraph
    object: RigidBody
    table_side: GeometryId
    table: RigidBody
    physics: PhysicsConfig
    neighbours: tuple[Neighbour, ...] = ()
    walls: RigidBody | None = None

    @property
    def is_alone(self) -> bool:
        """Whether there is nothing beside the object."""
        return not self.neighbours and self.walls is None

    @property
    def context(self) -> Context:
        """The plant's context."""
        return self.plant.GetMyMutableContextFromRoot(self.simulator.get_mutable_context())

    @property
    def graph_context(self) -> Context:
        """The context of the scene graph."""
        root = self.simulator.get_mutable_context()
        return self.scene_graph.GetMyMutableContextFromRoot(root)

    @property
    def time(self) -> float:
        """Simulated time since the last reset [s]."""
        return float(self.simulator.get_context().get_time())

    def pose(self, body: RigidBody) -> Array:
        """Return the present pose X_WB (4, 4) of a body."""
        return self.plant.EvalBodyPoseInWorld(self.context, body).GetAsMatrix4()


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene(ObjectScene):
    """An object on the table, and a hand with k fingers.

    Attributes:
        hand: The hand.
        instance: The plant's model instance of the hand; that of the wrist is `wrist_instance`.
        wrist_joints: Three joints that slide along the axes of {W}.
        wrist_frame: Frame whose rotation in the context is the palm's orientation.
        wrist_trajectory: The path that the wrist follows.
        fingertips: The k fingertip links.
        closing_joints, motors: The joints that motors drive, and the m motors. They are the closing
            joints of the fingers that no other finger drives, or, in the scene of `own_motors`,
            every joint of the fingers.
        closing_limits: Limits of the closing joints [rad or m].
        closing_units: (m,), motion of each joint that is treated as equal to one radian [rad or m].
        effort_limits: (m,), largest torque or force of each motor [N m or N].
        holding_efforts: Torque or force that each motor's worm holds; None if unknown.
        driven: The joints that each motor moves, with their ratios.
        still_joints: Names of the joints that no motor moves.
        joint_trajectory: The path to follow if every joint has its own motor; None for the motors
            of the hand file.
        parts: Each shape of the hand with a point inside it, (3,) in the shape's frame [m].
        coarse_scene: Returns the scene whose step is `physics.coarse_steps` times as long; every
            call returns the same scene. None if there is no such scene.
        own_motors: Returns the scene in which each joint of the fingers has its own motor; every
            call returns the same scene. None if this is that scene.
    """

    hand: Hand
    instance: ModelInstanceIndex
    wrist_instance: ModelInstanceIndex
    wrist_joints: tuple[PrismaticJoint, ...]
    wrist_frame: FixedOffsetFrame
    wrist_trajectory: TrajectorySource
    fingertips: tuple[RigidBody, ...]
    closing_joints: tuple[ClosingJoint, ...]
    closing_limits: tuple[tuple[float, float], ...]
    closing_units: Array
    effort_limits: Array
    holding_efforts: tuple[float | None, ...]
    driven: tuple[dict[ClosingJoint, float], ...]
    motors: tuple[Motor, ...]
    still_joints: tuple[str, ...]
    parts: tuple[tuple[GeometryId, Array], ...]
    joint_trajectory: TrajectorySource | None = None
    coarse_scene: Callable[[], Scene] | None = None
    own_motors: Callable[[], Scene] | None = None

    @property
    def links(self) -> list[RigidBody]:
        """The hand's links."""
        return [self.plant.get_body(index) for index in self.plant.GetBodyIndices(self.instance)]


def reset_object(scene: ObjectScene, X_WO: npt.ArrayLike) -> None:
    """Set the time to zero, and put the object at X_WO (4, 4), free and at rest.

    Neighbours stand where they stood when the scene was built.
    """
    scene.simulator.get_mutable_context().SetTime(0.0)
    scene.object.Unlock(scene.context)
    places = [(scene.object, np.asarray(X_WO)), *((n.body, n.X_WN) for n in scene.neighbours)]
    for body, X_WB in places:
        scene.plant.SetFreeBodyPose(scene.context, body, RigidTransform(X_WB))
    scene.plant.SetVelocities(scene.context, np.zeros(scene.plant.num_velocities()))
    _let_object_meet_table(scene, True)


def reset_attempt(
    scene: Scene,
    X_WO: npt.ArrayLike,
    X_WG: npt.ArrayLike,
    *,
    spread: float,
    closing: npt.ArrayLike | None = None,
    q: Array | None = None,
) -> None:
    """Put hand and object at the start of an attempt; all but the fingers are locked.

    Args:
        scene: Scene with the hand.
        X_WO: Pose of the object (4, 4).
        X_WG: Pose of the palm (4, 4).
        spread: Angle of the spread joints [rad].
        closing: Position of each finger's closing joint (k,) [rad or m]; None for the open hand.
        q: Positions of all joints of the hand (j,), in the plant's order; replaces spread and
            closing.
    """
    # Unlock the wrist before positions are set, then place the object.
    context, plant = scene.context, scene.plant
    for joint in scene.wrist_joints:
        joint.Unlock(context)
    reset_object(scene, X_WO)

    # Set the palm's orientation by its frame, the joints of the fingers, and the palm's position.
    X = np.asarray(X_WG, dtype=float)
    R_WG = RotationMatrix(RotationMatrix.ProjectToRotationMatrix(X[:3, :3]))
    scene.wrist_frame.SetPoseInParentFrame(context, RigidTransform(R_WG, np.zeros(3)))
    angles = np.zeros(scene.hand.num_fingers) if closing is None else closing
    if q is None:
        positions = joint_positions(scene.hand, spread, angles)
    else:
        positions = dict(zip(hand_joint_names(scene), q.tolist(), strict=True))
    for name, position in positions.items():
        joint = plant.GetJointByName(name, scene.instance)
        slides = isinstance(joint, PrismaticJoint)
        (joint.set_translation if slides else joint.set_angle)(context, position)
    for joint, p in zip(scene.wrist_joints, X[:3, 3], strict=True):
        joint.set_translation(context, float(p))
        joint.Lock(context)

    # The spread joints keep their angle, because one motor drives them, and the paper's released
    # code also locks them. The joints of the preshape also keep their positions.
    _lock_still_joints(scene)

    # Only the fingers move while the hand closes.
    scene.object.Lock(context)
    _let_object_meet_table(scene, False)
    scene.wrist_trajectory.UpdateTrajectory(PiecewisePolynomial(X[:3, 3:4]))
    if scene.joint_trajectory is not None:
        command_joints(scene, [0.0], [closing_angles(scene)])
    scene.simulator.Initialize()


def command_joints(scene: Scene, times: Sequence[float], positions: Sequence[Array]) -> None:
    """Command separate motors along straight paths to positions (m,) [rad or m] at times [s]."""
    assert scene.joint_trajectory is not None
    points = np.column_stack(positions)
    straight = PiecewisePolynomial.FirstOrderHold
    path = straight(times, points) if len(times) > 1 else PiecewisePolynomial(points)
    scene.joint_trajectory.UpdateTrajectory(path)


def commanded_joints(scene: Scene) -> Array:
    """Return the present commanded positions (m,) [rad or m] of separate motors."""
    source = scene.joint_trajectory
    assert source is not None
    context = source.GetMyContextFromRoot(scene.simulator.get_context())
    return np.asarray(source.get_output_port().Eval(context)[: len(scene.motors)])


def release(scene: Scene) -> None:
    """Free the object and the wrist for the lift."""
    for joint in scene.wrist_joints:
        joint.Unlock(scene.context)
    scene.object.Unlock(scene.context)
    _let_object_meet_table(scene, True)


def _let_object_meet_table(scene: ObjectScene, meet: bool) -> None:
    """Include contacts between object and table in the simulation, or exclude them.

    While both are static, such a contact changes nothing, but computing it at each step would cost
    more than everything else before a finger touches.
    """
    manager = scene.scene_graph.collision_filter_manager(scene.graph_context)
    declare = CollisionFilterDeclaration()
    sides = (
        GeometrySet(scene.table_side),
        GeometrySet(scene.plant.GetCollisionGeometriesForBody(scene.table)),
    )
    manager.Apply(declare.AllowBetween(*sides) if meet else declare.ExcludeBetween(*sides))


def _lock_still_joints(scene: Scene) -> None:
    for name in scene.still_joints:
        scene.plant.GetJointByName(name, scene.instance).Lock(scene.context)


@dataclass(frozen=True, kw_only=True, eq=False)
class WristMotion:
    """A straight minimum-jerk motion of the palm's origin, which then stays at the end.

    Attributes:
        p_start, p_end: Start and end in {W}, (3,) [m].
        begin: Time at which it begins [s].
        duration: Duration of the motion [s].
    """

    p_start: Array
    p_end: Array
    begin: float
    duration: float


def move_wrist(
    scene: Scene, p_WG_target: npt.ArrayLike, duration: float, *, begin: float | None = None
) -> WristMotion:
    """Command a straight minimum-jerk motion of the wrist from its present position.

    Args:
        scene: Scene with the hand.
        p_WG_target: Target of the palm's origin, (3,) [m]; it stays there afterwards.
        duration: Duration of the motion [s].
        begin: Time at which it begins [s]; None for now.
    """
    motion = WristMotion(
        p_start=np.array([j.get_translation(scene.context) for j in scene.wrist_joints]),
        p_end=np.asarray(p_WG_target, dtype=float),
        begin=scene.time if begin is None else begin,
        duration=duration,
    )
    _follow(scene, motion)
    return motion


def _follow(scene: Scene, motion: WristMotion) -> None:
    # A quintic Bezier curve with threefold end points starts and stops with zero speed and
    # acceleration: it is the minimum-jerk motion (Flash and Hogan, 1985).
    points = np.column_stack([motion.p_start] * 3 + [motion.p_end] * 3)
    # Drake reaches a command at the end of the step, so we command one step ahead. The wrist then
    # has no lag at any step size.
    begin = motion.begin - scene.physics.time_step
    curve = BezierCurve(begin, begin + motion.duration, points)
    scene.wrist_trajectory.UpdateTrajectory(curve)


def transfer_state(scene: Scene, before: Scene, time: float, motion: WristMotion) -> None:
    """Continue a lift in another scene, from the state that the previous scene has reached.

    Args:
        scene: The scene that continues; it differs from the previous scene only in its time step.
        before: The previous scene, whose state and palm orientation are copied.
        time: Time of the state [s]; a step of both scenes begins there.
        motion: Motion of the wrist.
    """
    # Drake steps at integer multiples of the step: a time just before one would skip a step.
    step = scene.physics.time_step
    scene.simulator.get_mutable_context().SetTime(round(time / step) * step)

    # Copy the palm's orientation and the state. A plant's context cannot be copied as a whole: it
    # refers to the geometries of its own diagram.
    X = before.wrist_frame.GetPoseInParentFrame(before.context)
    scene.wrist_frame.SetPoseInParentFrame(scene.context, X)
    state = before.plant.GetPositionsAndVelocities(before.context)
    scene.plant.SetPositionsAndVelocities(scene.context, state)

    # Separate motors continue to press towards the same positions.
    if scene.joint_trajectory is not None:
        command_joints(scene, [0.0], [commanded_joints(before)])

    # Lock spread and preshape, and follow the same path of the wrist.
    _lock_still_joints(scene)
    _follow(scene, motion)
    scene.simulator.Initialize()


def advance(scene: ObjectScene, duration: float) -> None:
    """Simulate for a duration [s]."""
    scene.simulator.AdvanceTo(scene.time + duration, interruptible=False)


def closing_rates(scene: Scene) -> Array:
    """Return the speed of each closing joint (m,), in its unit [1/s].

    With these units (`Scene.closing_units`), one speed limit applies to revolute and prismatic
    joints.
    """
    rates = [joint.GetOneVelocity(scene.context) for joint in scene.closing_joints]
    return np.array(rates) / scene.closing_units


def finger_speed(scene: Scene) -> float:
    """Return the largest speed of a closing joint, in its unit [1/s]."""
    return float(np.abs(closing_rates(scene)).max())


def closing_angles(scene: Scene) -> Array:
    """Return the position of each closing joint (m,) [rad or m]."""
    return np.array([joint.GetOnePosition(scene.context) for joint in scene.closing_joints])


def hand_positions(scene: Scene) -> Array:
    """Return the positions of all joints of the hand in the plant's order [rad or m]."""
    return scene.plant.GetPositions(scene.context, scene.instance)


def hand_joint_names(scene: Scene) -> list[str]:
    """Return the joint names in the order of `hand_positions`."""
    names = scene.plant.GetPositionNames(
        scene.instance, add_model_instance_prefix=False, always_add_suffix=False
    )
    return list(names)


def object_pose(scene: ObjectScene) -> Array:
    """Return the present pose X_TO (4, 4) of the object."""
    return multiply(invert_pose(X_WT), scene.pose(scene.object))


def neighbour_poses(scene: ObjectScene) -> Array:
    """Return the present poses X_TN (n, 4, 4) of the neighbours."""
    poses = [scene.pose(each.body) for each in scene.neighbours]
    return multiply(invert_pose(X_WT), np.reshape(poses, (-1, 4, 4)))


def palm_pose(scene: Scene) -> Array:
    """Return the present pose X_WG (4, 4) of the palm."""
    base = scene.plant.GetBodyByName(scene.hand.palm_link, scene.instance)
    return multiply(scene.pose(base), scene.hand.X_BG)


class StateError(Exception):
    """The simulated state is no longer physical."""


class TrialTimeout(Exception):  # noqa: N818 - named as the outcome that it becomes
    """The attempt computed for longer than its limit."""


@dataclass(frozen=True)
class TrialLimits:
    """Limits at which an attempt is stopped.

    Attributes:
        deadline: Reading of `time.thread_time` at which the attempt times out [s]. It does not
            count time in which the process was suspended or another process used its core.
        max_speed: Speed of the object above which the state has diverged [m/s].
    """

    deadline: float
    max_speed: float

    def advance(self, scene: Scene, duration: float) -> None:
        """Simulate for a duration [s], then check the limits.

        Raises:
            TrialTimeout: If the deadline has passed.
            StateError: If the state has diverged.
        """
        advance(scene, duration)
        if time.thread_time() > self.deadline:
            raise TrialTimeout
        if not np.isfinite(hand_positions(scene)).all():
            raise StateError("the positions of the hand's joints became infinite or NaN")
        velocity = scene.plant.EvalBodySpatialVelocityInWorld(scene.context, scene.object)
        speed = float(np.linalg.norm(velocity.translational()))
        if not speed <= self.max_speed:
            raise StateError(
                f"the object's speed must stay below {self.max_speed:g} m/s, got {speed:.3g}"
            )


def start_limits(config: Config) -> TrialLimits:
    """Return the limits of an attempt that starts now."""
    return TrialLimits(time.thread_time() + config.attempt_seconds, config.physics.max_speed)
