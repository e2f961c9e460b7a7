"""The state of a scene: one object, the table and, if given, one hand in a Drake diagram.

A scene is built once per object (`construction.build_scene`) and reset for each attempt: building
costs more than simulating, and a reset context gives the same bits as a new one. A scene makes no
decisions; `settle` and `trial` do.
"""

from __future__ import annotations

from collections.abc import Callable
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
from drakegrasp.config import PhysicsConfig
from drakegrasp.frames import Array
from drakegrasp.hand.description import Hand
from drakegrasp.hand.kinematics import joint_positions
from drakegrasp.objects.model import ObjectModel

#: A joint that turns or slides.
ClosingJoint: TypeAlias = RevoluteJoint | PrismaticJoint


@dataclass(frozen=True, kw_only=True, eq=False)
class HandHandles:
    """The parts of a scene's plant that belong to the hand."""

    hand: Hand
    instance: ModelInstanceIndex
    wrist_instance: ModelInstanceIndex
    wrist_joints: tuple[PrismaticJoint, ...]
    wrist_frame: FixedOffsetFrame
    wrist_trajectory: TrajectorySource
    fingertips: tuple[RigidBody, ...]
    closing_joints: tuple[ClosingJoint, ...]
    closing_limits: tuple[tuple[float, float], ...]  # of the closing joints [rad or m]
    driven: tuple[dict[ClosingJoint, float], ...]  # joints that each motor moves, and their ratios
    motors: tuple[JointActuator, ...]  # of the closing joints
    parts: tuple[tuple[GeometryId, Array], ...]  # each shape of the hand with a point inside it


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """A built diagram with its one context.

    Attributes:
        model: The object.
        simulator: Owns the diagram's context.
        plant, scene_graph: The two systems of the diagram.
        object, table: The bodies.
        table_side: The object's surface that meets the table; the hand meets the other one.
        handles: The parts of the hand, or None in a scene without a hand.
        physics: The configuration that it was built with.
        coarse_scene: Returns the scene whose step is `physics.coarse_steps` times as long; every
            call returns the same one. None where there is no such scene.
    """

    model: ObjectModel
    simulator: Simulator
    plant: MultibodyPlant
    scene_graph: SceneGraph
    object: RigidBody
    table_side: GeometryId
    table: RigidBody
    handles: HandHandles | None
    physics: PhysicsConfig
    coarse_scene: Callable[[], Scene] | None = None

    @property
    def context(self) -> Context:
        """The plant's context."""
        return self.plant.GetMyMutableContextFromRoot(self.simulator.get_mutable_context())

    @property
    def time(self) -> float:
        """Simulated time since the last reset [s]."""
        return float(self.simulator.get_context().get_time())

    def pose(self, body: RigidBody) -> Array:
        """Return the pose X_WB (4, 4) of a body now."""
        return self.plant.EvalBodyPoseInWorld(self.context, body).GetAsMatrix4()


def reset_object(scene: Scene, X_WO: npt.ArrayLike) -> None:
    """Set the time to zero, and put the object at X_WO (4, 4), free and at rest."""
    scene.simulator.get_mutable_context().SetTime(0.0)
    scene.object.Unlock(scene.context)
    scene.plant.SetFreeBodyPose(scene.context, scene.object, RigidTransform(np.asarray(X_WO)))
    scene.plant.SetVelocities(scene.context, np.zeros(scene.plant.num_velocities()))
    _let_object_meet_table(scene, True)


def reset_attempt(
    scene: Scene,
    X_WO: npt.ArrayLike,
    X_WG: npt.ArrayLike,
    *,
    spread: float,
    closing: npt.ArrayLike | None = None,
) -> None:
    """Put hand and object at the start of an attempt; only the fingers are not locked.

    Args:
        scene: A scene with a hand.
        X_WO: Pose of the object (4, 4).
        X_WG: Pose of the palm (4, 4).
        spread: Angle of the spread joints [rad].
        closing: Position of each finger's closing joint (k,) [rad or m]; None is the open hand.
    """
    # Unlock the wrist before positions are set, then place the object.
    handles = hand_handles(scene)
    context, plant = scene.context, scene.plant
    for joint in handles.wrist_joints:
        joint.Unlock(context)
    reset_object(scene, X_WO)

    # Orientation of the palm, by its frame; joints of the fingers; position of the palm.
    X = np.asarray(X_WG, dtype=float)
    R_WG = RotationMatrix(RotationMatrix.ProjectToRotationMatrix(X[:3, :3]))
    handles.wrist_frame.SetPoseInParentFrame(context, RigidTransform(R_WG, np.zeros(3)))
    angles = np.zeros(handles.hand.num_fingers) if closing is None else closing
    for name, position in joint_positions(handles.hand, spread, angles).items():
        joint = plant.GetJointByName(name, handles.instance)
        slides = isinstance(joint, PrismaticJoint)
        (joint.set_translation if slides else joint.set_angle)(context, position)
    for joint, p in zip(handles.wrist_joints, X[:3, 3], strict=True):
        joint.set_translation(context, float(p))
        joint.Lock(context)

    # The spread keeps its angle: one motor drives it, and the released code locks it too. So do
    # the joints of the preshape.
    for name in handles.hand.locked_joints:
        plant.GetJointByName(name, handles.instance).Lock(context)

    # Only the fingers move while the hand closes.
    scene.object.Lock(context)
    _let_object_meet_table(scene, False)
    handles.wrist_trajectory.UpdateTrajectory(PiecewisePolynomial(X[:3, 3:4]))
    scene.simulator.Initialize()


def release(scene: Scene) -> None:
    """Free the object and the wrist for the lift."""
    for joint in hand_handles(scene).wrist_joints:
        joint.Unlock(scene.context)
    scene.object.Unlock(scene.context)
    _let_object_meet_table(scene, True)


def _let_object_meet_table(scene: Scene, meet: bool) -> None:
    """Include contacts between object and table in the simulation, or exclude them.

    While both are static such a contact changes nothing, but computing it at each step costs more
    than anything else before a finger touches.
    """
    manager = scene.scene_graph.collision_filter_manager(
        scene.scene_graph.GetMyMutableContextFromRoot(scene.simulator.get_mutable_context())
    )
    declare = CollisionFilterDeclaration()
    sides = (
        GeometrySet(scene.table_side),
        GeometrySet(scene.plant.GetCollisionGeometriesForBody(scene.table)),
    )
    manager.Apply(declare.AllowBetween(*sides) if meet else declare.ExcludeBetween(*sides))


@dataclass(frozen=True, kw_only=True, eq=False)
class WristMotion:
    """A straight minimum-jerk motion of the palm's origin, which then stays at the end.

    Attributes:
        p_start, p_end: Start and end in {W}, (3,) [m].
        begin: Time at which it begins [s].
        duration: Of the motion [s].
    """

    p_start: Array
    p_end: Array
    begin: float
    duration: float


def move_wrist(
    scene: Scene, p_WG_target: npt.ArrayLike, duration: float, *, begin: float | None = None
) -> WristMotion:
    """Command a straight minimum-jerk motion of the wrist from where it is now.

    Args:
        scene: A scene with a hand.
        p_WG_target: Target of the palm's origin, (3,) [m]; it stays there afterwards.
        duration: Of the motion [s].
        begin: Time at which it begins [s]; None is now.

    Raises:
        ValueError: If the scene has no hand.
    """
    joints = hand_handles(scene).wrist_joints
    motion = WristMotion(
        p_start=np.array([joint.get_translation(scene.context) for joint in joints]),
        p_end=np.asarray(p_WG_target, dtype=float),
        begin=scene.time if begin is None else begin,
        duration=duration,
    )
    _follow(scene, motion)
    return motion


def _follow(scene: Scene, motion: WristMotion) -> None:
    # A quintic Bezier curve with threefold ends starts and stops with zero speed and
    # acceleration: the minimum-jerk motion (Flash and Hogan, 1985).
    points = np.column_stack([motion.p_start] * 3 + [motion.p_end] * 3)
    # Drake reaches a command at the end of the step, so we command one step ahead; the wrist then
    # has no lag at any step size.
    begin = motion.begin - scene.physics.time_step
    curve = BezierCurve(begin, begin + motion.duration, points)
    hand_handles(scene).wrist_trajectory.UpdateTrajectory(curve)


def transfer_state(scene: Scene, before: Scene, time: float, motion: WristMotion) -> None:
    """Continue a lift in another scene, from the state that the scene before has reached.

    Args:
        scene: The scene that continues; it differs from the one before in its time step alone.
        before: The scene whose state and palm orientation it takes over.
        time: Of the state [s]; a step of both scenes begins there.
        motion: Of the wrist.

    Raises:
        ValueError: If one of them has no hand.
    """
    # Drake steps at whole multiples of the step: a time just before one would skip a step.
    step = scene.physics.time_step
    scene.simulator.get_mutable_context().SetTime(round(time / step) * step)

    # Copy the palm's orientation and the state. A plant's context cannot be copied as a whole: it
    # refers to the geometries of its own diagram.
    source, target = hand_handles(before), hand_handles(scene)
    X = source.wrist_frame.GetPoseInParentFrame(before.context)
    target.wrist_frame.SetPoseInParentFrame(scene.context, X)
    state = before.plant.GetPositionsAndVelocities(before.context)
    scene.plant.SetPositionsAndVelocities(scene.context, state)

    # Lock spread and preshape, and follow the same path of the wrist.
    for name in target.hand.locked_joints:
        scene.plant.GetJointByName(name, target.instance).Lock(scene.context)
    _follow(scene, motion)
    scene.simulator.Initialize()


def advance(scene: Scene, duration: float) -> None:
    """Simulate for a duration [s]."""
    scene.simulator.AdvanceTo(scene.time + duration, interruptible=False)


def closing_rates(scene: Scene) -> Array:
    """Return the speed of each finger's closing joint (k,), in its unit [1/s]; positive closes.

    The unit is `Hand.closing_unit`: one speed limit serves joints that turn and joints that slide.
    """
    handles = hand_handles(scene)
    rates = [joint.GetOneVelocity(scene.context) for joint in handles.closing_joints]
    return np.array(rates) / handles.hand.closing_unit


def finger_speed(scene: Scene) -> float:
    """Return the largest speed of a closing joint, in its unit [1/s]."""
    return float(np.abs(closing_rates(scene)).max())


def closing_angles(scene: Scene) -> Array:
    """Return the position of each finger's closing joint (k,) [rad or m]."""
    return np.array(
        [joint.GetOnePosition(scene.context) for joint in hand_handles(scene).closing_joints]
    )


def hand_positions(scene: Scene) -> Array:
    """Return the positions of all joints of the hand in the plant's order [rad or m]."""
    return scene.plant.GetPositions(scene.context, hand_handles(scene).instance)


def hand_joint_names(scene: Scene) -> list[str]:
    """Return the joints' names in the order of `hand_positions`."""
    names = scene.plant.GetPositionNames(
        hand_handles(scene).instance, add_model_instance_prefix=False, always_add_suffix=False
    )
    return list(names)


def palm_pose(scene: Scene) -> Array:
    """Return the pose X_WG (4, 4) of the palm now."""
    handles = hand_handles(scene)
    base = scene.plant.GetBodyByName(handles.hand.palm_link, handles.instance)
    return multiply(scene.pose(base), handles.hand.X_BG)


def hand_handles(scene: Scene) -> HandHandles:
    """Return the parts of the scene's hand.

    Raises:
        ValueError: If the scene has no hand.
    """
    if scene.handles is None:
        raise ValueError("the scene must have a hand, got one without")
    return scene.handles
