"""The description of a hand, from an SDFormat file and a YAML file.

In: a YAML file and the SDFormat file that it names. Out: a `Hand`, of any kind and with any number
of fingers. `load_hand` reads the YAML, lets Drake parse the SDFormat file once, checks one against
the other, and stores the joints of each finger as constants, which is all that `kinematics` needs.

The coordinates of a hand with k fingers are c = (spread, closing of finger 1..k) [rad]. Exactly one
coordinate drives each joint; the joint's angle is `gain @ c`. Frames: B palm link, G palm, Fi
distal (fingertip) link of finger i, P a point on it, J a joint.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
import yaml
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    model_validator,
    with_config,
)
from pydrake.math import RollPitchYaw
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex, RevoluteJoint, RigidBody, WeldJoint

from drakegrasp.arithmetic import multiply
from drakegrasp.config import describe_mistake
from drakegrasp.errors import HandError, first_line, one_line
from drakegrasp.frames import Array, invert_pose, make_pose
from drakegrasp.hand.files import hand_file
from drakegrasp.hand.parsing import make_parser
from drakegrasp.hand.shapes import pad_surfaces

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Name = Annotated[str, Field(min_length=1)]
Vector = tuple[Finite, Finite, Finite]
#: Normal and offset (nx, ny, nz, d) of the points p with n.p >= d; the normal need not be unit.
HalfSpace = tuple[Finite, Finite, Finite, Finite]
#: What a closing joint does when it is pushed open; see docs/explanation/physics.md, "Drive".
Drive = Literal["worm", "torque", "locked"]
_STRICT = ConfigDict(frozen=True, extra="forbid")


@with_config(_STRICT)
@dataclass(frozen=True, kw_only=True)
class Coupling:
    """A joint that follows a finger's closing joint."""

    joint: Name
    ratio: Finite  # of its angle to the closing joint's; not zero

    def __post_init__(self) -> None:
        if self.ratio == 0.0:
            raise ValueError("ratio must not be zero, got 0.0")


@with_config(_STRICT)
@dataclass(frozen=True, kw_only=True)
class Finger:
    """A finger as the YAML describes it; its kinematics is its `Chain`."""

    name: Name
    fingertip: Name  # link, frame Fi
    closing_joint: Name  # the driven joint; a positive angle closes
    torque_limit: Positive  # at the closing joint [N m]
    rotor_inertia: NonNegative = 0.0  # of the motor [kg m^2]
    gear_ratio: Positive = 1.0  # motor angle / closing angle
    holding_torque: Positive | None = None  # what a stalled worm holds at the closing joint [N m]
    coupled: tuple[Coupling, ...] = ()
    pad_region: tuple[HalfSpace, ...] = ()  # in Fi [m]; only there a contact is a fingertip's
    pad_point: Vector  # usual contact point, in Fi [m]

    def __post_init__(self) -> None:
        for i, (*normal, _) in enumerate(self.pad_region):
            if not any(normal):
                raise ValueError(f"pad_region.{i} must have a normal that is not zero, got zero")
        if self.holding_torque is not None and self.holding_torque < self.torque_limit:
            raise ValueError(
                f"holding_torque must be at least the torque_limit of {self.torque_limit:g} N m, "
                f"got {self.holding_torque:g}"
            )
        if not self.on_pad(self.p_FiP):
            raise ValueError(f"pad_point must lie in the pad_region, got {list(self.pad_point)}")

    @property
    def p_FiP(self) -> Array:
        """Usual contact point (3,) in the fingertip link's frame [m]."""
        return np.array(self.pad_point)

    def on_pad(self, p_FiQ: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Return (...,) whether points (..., 3) of the fingertip link [m] belong to the pad."""
        points = np.asarray(p_FiQ, dtype=float)
        inside = np.ones(points.shape[:-1], dtype=np.bool_)
        for nx, ny, nz, d in self.pad_region:
            inside &= nx * points[..., 0] + ny * points[..., 1] + nz * points[..., 2] >= d
        return inside


@with_config(_STRICT)
@dataclass(frozen=True, kw_only=True)
class Spread:
    """The joints that keep the spread angle during an attempt; a hand may have none."""

    joints: tuple[Name, ...] = ()


@dataclass(frozen=True, kw_only=True, eq=False)
class Chain:
    """The m revolute joints from the palm to one link, as constants.

    With angles q = gain @ c, the pose of the link in the palm frame is
    X_GFi = X_PJ[0] R(axis[0], q[0]) X_PJ[1] R(axis[1], q[1]) ... X_JFi.
    """

    X_PJ: Array  # (m, 4, 4), each joint in the moving frame of the joint before; the first in G
    axis: Array  # (m, 3), unit, in the joint's frame J
    gain: Array  # (m, 1 + k), angles per coordinate
    X_JFi: Array  # (4, 4), the link in the moving frame of the last joint


@dataclass(frozen=True, kw_only=True, eq=False)
class Hand:
    """A hand with k fingers; made by `load_hand`."""

    name: str
    sdf_path: Path
    palm_link: str  # frame B
    X_BG: Array  # (4, 4), palm frame, +Gz out of the palm
    fingers: tuple[Finger, ...]  # in grasp order
    drive: Drive  # of the closing joints
    spread: Spread
    closing_speed: float  # of the closing joints [rad/s]
    joint_names: tuple[str, ...]  # the n revolute joints
    joint_gain: Array  # (n, 1 + k), angles per coordinate; one non-zero in each row
    joint_limits: Array  # (n, 2), lower and upper [rad]
    chains: tuple[Chain, ...]  # one per finger, to its fingertip
    link_chains: dict[str, Chain]  # one per link that the palm carries, including the palm

    @property
    def num_fingers(self) -> int:
        """Number of fingers, k."""
        return len(self.fingers)

    @property
    def fingertip_links(self) -> tuple[str, ...]:
        """Names of the fingertip links in grasp order."""
        return tuple(finger.fingertip for finger in self.fingers)


class _Palm(BaseModel):
    model_config = _STRICT
    link: Name
    p_BG: Vector  # [m]
    rpy_deg: Vector = (0.0, 0.0, 0.0)


class _Description(BaseModel):
    """The YAML file."""

    model_config = _STRICT
    model: Name  # the SDFormat file, relative to the YAML file
    palm: _Palm
    fingers: Annotated[tuple[Finger, ...], Field(min_length=1)]
    drive: Literal["worm", "torque"] = "torque"
    spread: Spread = Spread()
    closing_speed_deg: Positive  # [deg/s]

    @model_validator(mode="after")
    def _check_worms(self) -> _Description:
        """Refuse worms of unknown strength."""
        for i, finger in enumerate(self.fingers):
            if self.drive == "worm" and finger.holding_torque is None:
                raise ValueError(
                    f"fingers.{i}.holding_torque must be given where drive is worm, got none"
                )
        return self


def load_hand(name_or_yaml: str | Path = "barrett") -> Hand:
    """Return a hand that comes with the package, or the hand of a YAML file.

    Args:
        name_or_yaml: One of `files.hand_names()`, or the path of a YAML file with the keys of
            `models/barrett_hand.yaml`; its `model` is a path relative to the YAML file.

    Raises:
        HandError: If there is no such hand, a key or value of the YAML cannot be used, or
            the SDFormat model lacks a link or joint that the YAML names.
    """
    # Use a hand that was loaded before, if its files did not change.
    path = hand_file(name_or_yaml)
    known = _loaded.get(path)
    if known is not None and known[1] == _stamp(path, known[0].sdf_path):
        return known[0]

    description = _read_description(path)
    sdf_path = path.parent.resolve() / description.model
    try:
        hand = _build_hand(path.stem.removesuffix("_hand"), description, sdf_path)
        _refuse_empty_pads(hand)
    except HandError as error:
        raise HandError(f"{path}: {error}") from None
    _loaded[path] = hand, _stamp(path, sdf_path)
    return hand


#: Loaded hands, with the sizes and times of their two files: parsing takes 40 ms.
_loaded: dict[Path, tuple[Hand, tuple[int, ...]]] = {}


def _stamp(*paths: Path) -> tuple[int, ...]:
    """Return sizes [byte] and modification times [ns] of the files that exist."""
    stats = [path.stat() for path in paths if path.exists()]
    return tuple(number for s in stats for number in (s.st_size, s.st_mtime_ns))


def _read_description(path: Path) -> _Description:
    try:
        tree = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise HandError(f"{path}: must be YAML, got text that is not ({one_line(error)})") from None
    try:
        return _Description.model_validate(tree)
    except ValidationError as error:
        lines = [
            describe_mistake(mistake, whole="hand", legal="a key of a hand file")
            for mistake in error.errors()
        ]
        raise HandError(f"{path}: {'; '.join(lines)}") from None


def _build_hand(name: str, description: _Description, sdf_path: Path) -> Hand:
    # Parse the model, and assign each joint to a coordinate.
    plant, instance = _parse(sdf_path)
    palm = description.palm
    R_BG = RollPitchYaw(np.deg2rad(palm.rpy_deg)).ToRotationMatrix()
    X_BG = make_pose(R_BG.matrix(), palm.p_BG)
    joints = _joints(plant, instance)
    revolute = {j.name(): j for j in joints if isinstance(j, RevoluteJoint)}
    gains = _gains(description, list(revolute))

    # The chain from the palm to each fingertip; the finger's own closing joint must be in it.
    bodies = {body.name(): body for body in map(plant.get_body, plant.GetBodyIndices(instance))}
    base = _body(bodies, palm.link, "palm.link")
    chains = []
    for i, finger in enumerate(description.fingers):
        tip = _body(bodies, finger.fingertip, f"fingers.{i}.fingertip")
        chain = _chain(joints, tip, base, gains, invert_pose(X_BG))
        if not chain.gain[:, 1 + i].any():
            raise HandError(
                f"fingers.{i}.closing_joint: must lie between the palm link and the fingertip, "
                f"got {finger.closing_joint!r}"
            )
        chains.append(chain)

    return Hand(
        name=name,
        sdf_path=sdf_path,
        palm_link=palm.link,
        X_BG=X_BG,
        fingers=description.fingers,
        drive=description.drive,
        spread=description.spread,
        closing_speed=float(np.deg2rad(description.closing_speed_deg)),
        joint_names=tuple(revolute),
        joint_gain=np.array([gains[joint] for joint in revolute]),
        joint_limits=np.array(
            [(j.position_lower_limit(), j.position_upper_limit()) for j in revolute.values()]
        ),
        chains=tuple(chains),
        link_chains={
            name: _chain(joints, body, base, gains, invert_pose(X_BG))
            for name, body in bodies.items()
            if _is_carried(joints, body, base)
        },
    )


def _refuse_empty_pads(hand: Hand) -> None:
    """Refuse a pad region that holds nothing of its fingertip's surface: nothing could touch."""
    if not any(finger.pad_region for finger in hand.fingers):
        return
    for i, (finger, triangles) in enumerate(zip(hand.fingers, pad_surfaces(hand), strict=True)):
        if not len(triangles):
            raise HandError(
                f"fingers.{i}.pad_region: must hold a part of the surface of link "
                f"{finger.fingertip!r}, got none of it"
            )


def _parse(sdf_path: Path) -> tuple[MultibodyPlant, ModelInstanceIndex]:
    """Return a plant with the model alone, without geometry and not finalized.

    Finalizing would add a floating joint for the palm.
    """
    if not sdf_path.is_file():
        raise HandError(f"model: must be an SDFormat file, got {str(sdf_path)!r}")
    plant = MultibodyPlant(0.0)
    try:
        (instance,) = make_parser(plant).AddModels(sdf_path)
    except (RuntimeError, ValueError) as error:
        raise HandError(f"model: must be a file of one model, got {first_line(error)}") from None
    return plant, instance


def _joints(plant: MultibodyPlant, instance: ModelInstanceIndex) -> list[Any]:
    joints = [plant.get_joint(index) for index in plant.GetJointIndices(instance)]
    for joint in joints:
        if not isinstance(joint, RevoluteJoint | WeldJoint):
            raise HandError(
                f"model: joint {joint.name()!r} must be revolute or fixed, "
                f"got {type(joint).__name__}"
            )
    return joints


def _body(bodies: dict[str, RigidBody], name: str, key: str) -> RigidBody:
    if name not in bodies:
        raise HandError(f"{key}: must be a link of the model ({', '.join(bodies)}), got {name!r}")
    return bodies[name]


def _gains(description: _Description, joints: list[str]) -> dict[str, Array]:
    """Return each revolute joint's angle per coordinate, (1 + k,)."""
    # List which coordinate the YAML gives each joint, with the key that says so.
    drives = [(f"spread.joints.{n}", j, 0, 1.0) for n, j in enumerate(description.spread.joints)]
    for i, finger in enumerate(description.fingers):
        drives.append((f"fingers.{i}.closing_joint", finger.closing_joint, 1 + i, 1.0))
        for n, coupling in enumerate(finger.coupled):
            drives.append((f"fingers.{i}.coupled.{n}.joint", coupling.joint, 1 + i, coupling.ratio))

    # Each joint must be driven once, and only once.
    gains: dict[str, Array] = {}
    for key, joint, column, ratio in drives:
        if joint not in joints:
            raise HandError(
                f"{key}: must be a revolute joint of the model ({', '.join(joints)}), got {joint!r}"
            )
        if joint in gains:
            raise HandError(f"{key}: must be a joint that nothing else drives, got {joint!r}")
        gains[joint] = ratio * np.eye(1 + len(description.fingers))[column]
    if idle := [joint for joint in joints if joint not in gains]:
        raise HandError(
            f"model: every revolute joint must be driven by a finger or the spread, "
            f"got {', '.join(idle)} driven by nothing"
        )
    return gains


def _is_carried(joints: list[Any], body: RigidBody, base: RigidBody) -> bool:
    """Return whether a link is the palm link or is joined to it."""
    parents = {joint.child_body().index(): joint.parent_body().index() for joint in joints}
    index = body.index()
    while index != base.index() and index in parents:
        index = parents.pop(index)
    return bool(index == base.index())


def _chain(
    joints: list[Any], tip: RigidBody, base: RigidBody, gains: dict[str, Array], X_GB: Array
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

    # Multiply the constant poses between two revolute joints into one.
    X, X_PJ, axes = X_GB, [], []
    for joint in path:
        X = multiply(X, joint.frame_on_parent().GetFixedPoseInBodyFrame().GetAsMatrix4())
        if isinstance(joint, RevoluteJoint):
            X_PJ.append(X)
            axes.append(joint.revolute_axis())
            X = np.eye(4)
        else:
            X = multiply(X, joint.X_FM().GetAsMatrix4())
        X = multiply(
            X, invert_pose(joint.frame_on_child().GetFixedPoseInBodyFrame().GetAsMatrix4())
        )

    gain = [gains[joint.name()] for joint in path if isinstance(joint, RevoluteJoint)]
    k = len(next(iter(gains.values())))
    return Chain(
        X_PJ=np.reshape(X_PJ, (-1, 4, 4)),
        axis=np.reshape(axes, (-1, 3)),
        gain=np.reshape(gain, (-1, k)),
        X_JFi=X,
    )
