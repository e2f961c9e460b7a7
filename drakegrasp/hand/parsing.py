"""The model of a hand: what Drake parses, what its text declares, and its joints as constants.

Input: an SDFormat or URDF file, and the hand file. Output:

- the model's links and joints in a plant. Its motors and couplings are left out, because they come
  from the hand file;
- the masses, efforts and mimic joints that the text of the model declares. Drake does not report
  them: it replaces a mass of zero by its own value, and it couples joints by constraints or not at
  all;
- a `Chain` per link, which is all that `kinematics` needs.

The coordinates of a hand with k fingers are c = (spread, closing of fingers 1..k). At most one of
them drives each joint. The position of the joint is `gain @ c + offset`: an angle [rad] if the
joint turns, a length [m] if it slides.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
import numpy.typing as npt
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    ModelInstanceIndex,
    PrismaticJoint,
    RevoluteJoint,
    RigidBody,
    WeldJoint,
)

from drakegrasp.arithmetic import multiply
from drakegrasp.errors import HandError, first_line
from drakegrasp.frames import Array, invert_pose
from drakegrasp.hand.file_format import HandFile
from drakegrasp.runtime.environment import allow_network

#: Number of hands whose results a process caches; a build has one hand, in some preshapes.
KEPT_HANDS = 32
#: How the coordinates move a joint: gain (1 + k,), of which at most one is not zero, and offset.
#: The position of the joint is gain @ c + offset [rad or m].
JointDrive = tuple[Array, float]


def _is_no_twin(record: logging.LogRecord) -> bool:
    """Return whether a message of Drake is not repeated by an exception."""
    return not record.getMessage().startswith("SDFormat Error")


logging.getLogger("drake").addFilter(_is_no_twin)


@dataclass(frozen=True)
class ModelFile:
    """The model of a hand.

    Attributes:
        path: The SDFormat or URDF file.
        stamp: Sizes and times of the hand's files; a model with changed files is not equal.
    """

    path: Path
    stamp: tuple[int, ...] = ()


def make_parser(plant: MultibodyPlant) -> Parser:
    """Return a parser for a plant that also works under `DRAKE_ALLOW_NETWORK=none`.

    A Drake parser registers a remote package, which raises an error under that setting although our
    models do not use the package. Nothing is downloaded.
    """
    with allow_network("package_map"):
        return Parser(plant)


def add_model(plant: MultibodyPlant, model: ModelFile) -> ModelInstanceIndex:
    """Add the links and joints of a hand's model to a plant; return its model instance.

    Motors and couplings (`<mimic>`) of the file are left out: the hand file replaces them.

    Args:
        plant: Plant that is not finalized. Shapes are added if it is a source of a scene graph.
        model: The file.

    Raises:
        HandError: If the file cannot be read, for example because a mesh is missing.
    """
    if not model.path.is_file():
        raise HandError(f"model: must be an SDFormat or URDF file, got {str(model.path)!r}")
    parser = make_parser(plant)
    actuators = set(plant.GetJointActuatorIndices())
    constraints = set(plant.GetConstraintIds())
    try:
        (instance,) = parser.AddModels(model.path)
    except (RuntimeError, ValueError, SystemExit) as error:  # SystemExit: failed assertion in Drake
        raise HandError(f"model: must be a file of one model, got {first_line(error)}") from None

    # Remove the model's motors and couplings.
    for index in set(plant.GetJointActuatorIndices()) - actuators:
        plant.RemoveJointActuator(plant.get_joint_actuator(index))
    for constraint in set(plant.GetConstraintIds()) - constraints:
        plant.RemoveConstraint(constraint)
    return instance


#: Default moments and products of inertia of URDF and SDFormat.
_MOMENTS = [
    dict.fromkeys(("xx", "yy", "zz", "xy", "xz", "yz"), "0"),
    {"xx": "1", "yy": "1", "zz": "1", "xy": "0", "xz": "0", "yz": "0"},
]


#: A number as models write it.
_NUMBER = re.compile(r"[+-]?(([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?|inf(inity)?)", re.I)


@dataclass(frozen=True, kw_only=True)
class Mimic:
    """A joint that follows another one: its position is ratio * leader + offset [rad or m]."""

    joint: str
    leader: str
    ratio: float
    offset: float


def read_xml(path: Path) -> Element:
    """Return the root of a model file."""
    return ElementTree.parse(path).getroot()


def declared_masses(root: Element) -> dict[str, float]:
    """Return the mass [kg] of each link of a URDF or SDFormat model; 0 if the model gives none."""
    masses = {}
    for link in root.iter("link"):
        name = link.get("name")
        if name is None:
            continue  # URDF's <child link="..."/> has another tag: this one is not a link
        found = link.find("inertial/mass")
        text = None if found is None else found.get("value", found.text)
        masses[name] = _number(text or "0", f"mass of link {name!r}")
    return masses


def impossible_inertias(root: Element) -> dict[str, str]:
    """Return each link with a mass and a physically impossible inertia, with the reason.

    Drake replaces such an inertia by its own value.
    """
    masses, found = declared_masses(root), {}
    for link in root.iter("link"):
        name, inertia = link.get("name", ""), link.find("inertial/inertia")
        if inertia is None or not masses.get(name, 0.0) > 0.0:
            continue
        given = [
            _number(_value(inertia, f"i{axes}", default), f"inertia of link {name!r}")
            for axes, default in _MOMENTS[len(inertia) > 0].items()
        ]
        xx, yy, zz, xy, xz, yz = given
        moments = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        slack = 1e-9 * abs(moments).max()
        if not moments[2] > 0.0:
            found[name] = "0"
        elif moments[0] < -slack or moments[2] > moments[0] + moments[1] + slack:
            found[name] = "principal moments " + ", ".join(f"{m:.3g}" for m in moments)
    return found


def declared_efforts(root: Element) -> dict[str, float]:
    """Return the largest effort [N m or N] of each joint whose <limit> in the model gives one."""
    efforts = {}
    for joint in root.iter("joint"):
        for limit in joint.iter("limit"):
            name, text = joint.get("name", ""), _value(limit, "effort", "0")
            efforts[name] = abs(_number(text, f"effort of joint {name!r}"))
    return {name: effort for name, effort in efforts.items() if effort > 0.0}


def declared_mimics(root: Element) -> list[Mimic]:
    """Return the joints of a URDF or SDFormat model that follow other joints."""
    # URDF, SDFormat and Drake each write a mimic joint differently.
    found = []
    for joint in root.iter("joint"):
        for tag in joint.iter():
            if tag.tag.rpartition("}")[2].rpartition(":")[2] != "mimic":
                continue
            # URDF and Drake use attributes; SDFormat uses elements and has a reference.
            ratio = _number(_value(tag, "multiplier", "1"), "multiplier of a mimic")
            reference = _number(_value(tag, "reference", "0"), "reference of a mimic")
            offset = _number(_value(tag, "offset", "0"), "offset of a mimic") - ratio * reference
            leader = tag.get("joint", "")
            name = joint.get("name", "")
            found.append(Mimic(joint=name, leader=leader, ratio=ratio, offset=offset))
    return found


def validate_joints(root: Element) -> None:
    """Reject impossible limits and mimics of URDF or SDFormat: a parser's error lacks the reason.

    Raises:
        HandError: If a lower limit is above its upper one, or a joint follows one that does not
            exist.
    """
    joints = {joint.get("name", ""): joint for joint in root.iter("joint")}
    for name, joint in joints.items():
        for tag in joint.iter("limit"):
            lower, upper = (
                _number(_value(tag, key, default), f"{key} limit")
                for key, default in (("lower", "-inf"), ("upper", "inf"))
            )
            validate_limits(name, lower, upper)
    for mimic in declared_mimics(root):
        if mimic.leader not in joints:
            raise HandError(
                f"model: joint {mimic.joint!r} must follow a joint that moves, got {mimic.leader!r}"
            )


def validate_limits(name: str, lower: float, upper: float) -> None:
    """Reject a joint whose lower limit is above its upper limit.

    Raises:
        HandError: If it is above.
    """
    if not lower <= upper:
        raise HandError(
            f"model: joint {name!r} must have a lower limit below its upper one, got "
            f"{lower:g}..{upper:g}"
        )


def _value(tag: Element, name: str, default: str) -> str:
    return tag.get(name) or tag.findtext(name) or default


def _number(text: str, what: str) -> float:
    """Return a number of a model, of which Drake would read only the beginning, or nothing."""
    if not _NUMBER.fullmatch(text.strip()):
        raise HandError(f"model: {what} must be a number, got {text!r}")
    return float(text)


@dataclass(frozen=True, kw_only=True, eq=False)
class Chain:
    """The m joints that turn or slide between the palm and one link, as constants.

    With positions q = gain @ c + offset, the pose of the link in the palm frame is
    X_GFi = X_PJ[0] X(axis[0], q[0]) X_PJ[1] X(axis[1], q[1]) ... X_JFi. Here X(axis, q) is a turn
    about the axis by an angle, or a slide along the axis.
    """

    joints: tuple[str, ...]  # (m,), names of the joints
    X_PJ: Array  # (m, 4, 4), joint in the moving frame of the previous joint; the first one in G
    axis: Array  # (m, 3), unit, in the joint's frame J
    slides: npt.NDArray[np.bool_]  # (m,), whether each joint slides
    gain: Array  # (m, 1 + k), positions per coordinate
    offset: Array  # (m,), positions at zero coordinates [rad or m]
    X_JFi: Array  # (4, 4), the link in the moving frame of the last joint


def moving_joint(joint: Any) -> bool:
    """Return whether a joint of a hand is revolute or prismatic."""
    return isinstance(joint, RevoluteJoint | PrismaticJoint)


def validate_joint(joint: Any) -> None:
    """Reject a joint that is not revolute, prismatic or fixed."""
    if not (moving_joint(joint) or isinstance(joint, WeldJoint)):
        raise HandError(
            f"model: joint {joint.name()!r} must be revolute, prismatic or fixed, "
            f"got {type(joint).__name__}"
        )


def joint_slides(joint: Any) -> bool:
    """Return whether a joint slides."""
    return isinstance(joint, PrismaticJoint)


def joint_axis(joint: Any) -> Array:
    """Return the unit axis (3,) of a moving joint, in its frame."""
    slides = joint_slides(joint)
    return np.asarray(joint.translation_axis() if slides else joint.revolute_axis())


def find_joints(plant: MultibodyPlant, instance: ModelInstanceIndex) -> list[Any]:
    """Return the joints of a hand's model in the order of its file.

    Raises:
        HandError: If a joint is not revolute, prismatic or fixed, or has the world as its parent.
    """
    joints = [plant.get_joint(index) for index in plant.GetJointIndices(instance)]
    for joint in joints:
        validate_joint(joint)
        if joint.parent_body().index() == plant.world_body().index():
            raise HandError(
                f"model: joint {joint.name()!r} must join two links of the hand, got the world"
            )
    return joints


def find_drives(described: HandFile, joints: Sequence[str]) -> dict[str, JointDrive]:
    """Return what drives each revolute or prismatic joint, keyed by the joint's name.

    Args:
        described: The hand file.
        joints: Names of these joints.

    Raises:
        HandError: If a key names another joint, or a joint is driven twice or not at all.
    """
    # List what the file specifies for each joint, with the key of the specification.
    found = [(f"spread.joints.{n}", j, 0, 1.0, 0.0) for n, j in enumerate(described.spread.joints)]
    found += [(f"preshape.{j}", j, 0, 0.0, at) for j, at in described.preshape.items()]
    for i, finger in enumerate(described.fingers):
        found.append((f"fingers.{i}.closing_joint", finger.closing_joint, 1 + i, 1.0, 0.0))
        for n, c in enumerate(finger.coupled):
            found.append((f"fingers.{i}.coupled.{n}.joint", c.joint, 1 + i, c.ratio, c.offset))

    # Each joint must be driven exactly once.
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
        drives[joint] = gain, offset
    if idle := [joint for joint in joints if joint not in drives]:
        raise HandError(
            f"model: every joint must be driven by a finger or the spread, or be in preshape, "
            f"got {', '.join(idle)} driven by nothing"
        )
    return drives


def make_chains(
    joints: Sequence[Any], base: RigidBody, drives: Mapping[str, JointDrive], X_GB: Array
) -> dict[str, Chain]:
    """Return the chain of joints from the palm to each link of its tree, including the palm.

    If a wrist supports the palm, the chains begin at the palm and leave out the wrist.
    """
    k = len(next(iter(drives.values()))[0])
    chains = {
        base.name(): Chain(
            joints=(),
            X_PJ=np.zeros((0, 4, 4)),
            axis=np.zeros((0, 3)),
            slides=np.zeros(0, dtype=np.bool_),
            gain=np.zeros((0, k)),
            offset=np.zeros(0),
            X_JFi=X_GB,
        )
    }
    # Each link has one joint to its parent, so no link is found twice.
    carriers = {joint.child_body().name(): joint for joint in joints}
    carriers.pop(base.name(), None)
    links = [base.name()]
    for link in links:
        for child, joint in carriers.items():
            if joint.parent_body().name() == link:
                chains[child] = _extended(chains[link], joint, drives)
                links.append(child)
    return chains


def _extended(chain: Chain, joint: Any, drives: Mapping[str, JointDrive]) -> Chain:
    """Return the chain to a joint's child link, given the chain to its parent link.

    The constant poses between two moving joints are multiplied into one pose.
    """
    X_JF = multiply(chain.X_JFi, joint.frame_on_parent().GetFixedPoseInBodyFrame().GetAsMatrix4())
    X_MC = invert_pose(joint.frame_on_child().GetFixedPoseInBodyFrame().GetAsMatrix4())
    if not moving_joint(joint):
        return replace(chain, X_JFi=multiply(multiply(X_JF, joint.X_FM().GetAsMatrix4()), X_MC))
    gain, offset = drives[joint.name()]
    return Chain(
        joints=(*chain.joints, joint.name()),
        X_PJ=np.concatenate([chain.X_PJ, X_JF[None]]),
        axis=np.concatenate([chain.axis, joint_axis(joint)[None]]),
        slides=np.append(chain.slides, joint_slides(joint)),
        gain=np.concatenate([chain.gain, gain[None]]),
        offset=np.append(chain.offset, offset),
        X_JFi=multiply(np.eye(4), X_MC),
    )


def validate_own_joints(described: HandFile, chains: Sequence[Chain]) -> None:
    """Reject a finger that moves a joint of another finger; it may move joints outside all fingers.

    Raises:
        HandError: If a finger moves a joint of another finger.
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
