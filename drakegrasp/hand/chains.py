"""The joints of a hand's links, as constants.

In: the joints that Drake parsed, and what drives each of them. Out: a `Chain` per link, which
is all that `kinematics` needs.

The coordinates of a hand with k fingers are c = (spread, closing of finger 1..k). At most one of
them drives each joint, whose position is `gain @ c + offset`: an angle [rad] where the joint turns,
a length [m] where it slides.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    ModelInstanceIndex,
    PrismaticJoint,
    RevoluteJoint,
    RigidBody,
    WeldJoint,
)

from drakegrasp.arithmetic import multiply
from drakegrasp.errors import HandError
from drakegrasp.frames import Array, invert_pose
from drakegrasp.hand.file_format import HandFile


@dataclass(frozen=True, kw_only=True, eq=False)
class JointDrive:
    """How the coordinates move a joint: its position is gain @ c + offset [rad or m]."""

    gain: Array  # (1 + k,), at most one is not zero
    offset: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Chain:
    """The m joints that turn or slide, from the palm to one link, as constants.

    With positions q = gain @ c + offset, the pose of the link in the palm frame is
    X_GFi = X_PJ[0] X(axis[0], q[0]) X_PJ[1] X(axis[1], q[1]) ... X_JFi, where X(axis, q) turns
    about the axis by an angle, or slides along it.
    """

    joints: tuple[str, ...]  # (m,), their names
    X_PJ: Array  # (m, 4, 4), each joint in the moving frame of the joint before; the first in G
    axis: Array  # (m, 3), unit, in the joint's frame J
    slides: npt.NDArray[np.bool_]  # (m,)
    gain: Array  # (m, 1 + k), positions per coordinate
    offset: Array  # (m,), positions at zero coordinates [rad or m]
    X_JFi: Array  # (4, 4), the link in the moving frame of the last joint


def moving_joint(joint: Any) -> bool:
    """Return whether a joint of a hand turns or slides."""
    return isinstance(joint, RevoluteJoint | PrismaticJoint)


def joint_slides(joint: Any) -> bool:
    """Return whether a joint slides."""
    return isinstance(joint, PrismaticJoint)


def joint_axis(joint: Any) -> Array:
    """Return the unit axis (3,) of a moving joint, in its frame."""
    slides = joint_slides(joint)
    return np.asarray(joint.translation_axis() if slides else joint.revolute_axis())


def find_joints(plant: MultibodyPlant, instance: ModelInstanceIndex) -> list[Any]:
    """Return the joints of a hand's model, in the order of its file.

    Raises:
        HandError: If one neither turns nor slides nor is fixed, or fixes a link to the world.
    """
    joints = [plant.get_joint(index) for index in plant.GetJointIndices(instance)]
    for joint in joints:
        if not (moving_joint(joint) or isinstance(joint, WeldJoint)):
            raise HandError(
                f"model: joint {joint.name()!r} must be revolute, prismatic or fixed, "
                f"got {type(joint).__name__}"
            )
        if joint.parent_body().index() == plant.world_body().index():
            raise HandError(
                f"model: joint {joint.name()!r} must join two links of the hand, got the world"
            )
    return joints


def find_drives(described: HandFile, joints: Sequence[str]) -> dict[str, JointDrive]:
    """Return what drives each joint that turns or slides, by its name.

    Args:
        described: The hand file.
        joints: Names of these joints.

    Raises:
        HandError: If a key names another joint, or a joint is driven twice or by nothing.
    """
    # List what the file says of each joint, with the key that says so.
    found = [(f"spread.joints.{n}", j, 0, 1.0, 0.0) for n, j in enumerate(described.spread.joints)]
    found += [(f"preshape.{j}", j, 0, 0.0, at) for j, at in described.preshape.items()]
    for i, finger in enumerate(described.fingers):
        found.append((f"fingers.{i}.closing_joint", finger.closing_joint, 1 + i, 1.0, 0.0))
        for n, c in enumerate(finger.coupled):
            found.append((f"fingers.{i}.coupled.{n}.joint", c.joint, 1 + i, c.ratio, c.offset))

    # Each joint must be driven once, and only once.
    drives: dict[str, JointDrive] = {}
    for key, joint, column, ratio, offset in found:
        if joint not in joints:
            raise HandError(
                f"{key}: must be a revolute or prismatic joint of the model "
                f"({', '.join(joints)}), got {joint!r}"
            )
        if joint in drives:
            raise HandError(f"{key}: must be a joint that nothing else drives, got {joint!r}")
        gain = ratio * np.eye(1 + len(described.fingers))[column]
        drives[joint] = JointDrive(gain=gain, offset=offset)
    if idle := [joint for joint in joints if joint not in drives]:
        raise HandError(
            f"model: every joint must be driven by a finger or the spread, or be in preshape, "
            f"got {', '.join(idle)} driven by nothing"
        )
    return drives


def is_carried(joints: Sequence[Any], body: RigidBody, base: RigidBody) -> bool:
    """Return whether a link is the palm link or is joined to it."""
    parents = {joint.child_body().index(): joint.parent_body().index() for joint in joints}
    index = body.index()
    while index != base.index() and index in parents:
        index = parents.pop(index)
    return bool(index == base.index())


def make_chain(
    joints: Sequence[Any],
    tip: RigidBody,
    base: RigidBody,
    drives: Mapping[str, JointDrive],
    X_GB: Array,
) -> Chain:
    """Return the chain of joints from the palm to a link.

    Raises:
        HandError: If no chain of joints connects them.
    """
    # Collect the joints on the way from the link up to the palm link.
    by_child = {joint.child_body().index(): joint for joint in joints}
    path: list[Any] = []
    body = tip
    while body.index() != base.index():
        # Remove each joint that was used, so that a closed loop of links ends, too.
        joint = by_child.pop(body.index(), None)
        if joint is None:
            raise HandError(
                f"model: link {tip.name()!r} must be joined to the palm link {base.name()!r}, "
                f"got a chain that ends at {body.name()!r}"
            )
        path.insert(0, joint)
        body = joint.parent_body()

    # Multiply the constant poses between two moving joints into one.
    X, X_PJ, axes = X_GB, [], []
    for joint in path:
        X = multiply(X, joint.frame_on_parent().GetFixedPoseInBodyFrame().GetAsMatrix4())
        if moving_joint(joint):
            X_PJ.append(X)
            axes.append(joint_axis(joint))
            X = np.eye(4)
        else:
            X = multiply(X, joint.X_FM().GetAsMatrix4())
        X = multiply(
            X, invert_pose(joint.frame_on_child().GetFixedPoseInBodyFrame().GetAsMatrix4())
        )

    moving = [joint for joint in path if moving_joint(joint)]
    k = len(next(iter(drives.values())).gain)
    return Chain(
        joints=tuple(joint.name() for joint in moving),
        X_PJ=np.reshape(X_PJ, (-1, 4, 4)),
        axis=np.reshape(axes, (-1, 3)),
        slides=np.array([joint_slides(joint) for joint in moving], dtype=np.bool_),
        gain=np.reshape([drives[joint.name()].gain for joint in moving], (-1, k)),
        offset=np.array([drives[joint.name()].offset for joint in moving], dtype=float),
        X_JFi=X,
    )


def refuse_joints_of_others(described: HandFile, chains: Sequence[Chain]) -> None:
    """Refuse a finger that moves a joint of another one alone; bars beside all fingers may follow.

    Raises:
        HandError: If one does.
    """
    owners = {
        joint: finger.name
        for finger, chain in zip(described.fingers, chains, strict=True)
        for joint in chain.joints
    }
    for i, (finger, chain) in enumerate(zip(described.fingers, chains, strict=True)):
        moved = {"closing_joint": finger.closing_joint}
        moved |= {f"coupled.{n}.joint": c.joint for n, c in enumerate(finger.coupled)}
        for key, joint in moved.items():
            if joint in owners and joint not in chain.joints:
                raise HandError(
                    f"fingers.{i}.{key}: must lie between the palm link and the fingertip "
                    f"{finger.fingertip!r}, got {joint!r} of finger {owners[joint]!r}"
                )
