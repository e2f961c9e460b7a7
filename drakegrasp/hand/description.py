"""A hand, read from a YAML file and the model that the YAML file names.

Input: a YAML file and its SDFormat or URDF file. Output: a `Hand`, of any kind and with any number
of fingers. `load_hand` reads the YAML file, lets Drake parse the model once, and checks the two
against each other. It stores the joints of each finger as constants; `kinematics` needs no more.

The coordinates of a hand with k fingers are c = (spread [rad], closing of fingers 1..k [rad, or m
for a sliding closing joint]). The m motors are those of the fingers that no other finger drives.
The closing positions of all fingers are `closing_ratio` times the closing positions of these m
fingers. Frames: B palm link, G palm, Fi distal (fingertip) link of finger i, P a point on it,
J a joint.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
from pydrake.math import RollPitchYaw
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RigidBody

from drakegrasp.arithmetic import multiply
from drakegrasp.config import CarriedHand, HandSource
from drakegrasp.errors import HandError
from drakegrasp.frames import Array, invert_pose, make_pose
from drakegrasp.hand.file_format import (
    Coupling,
    Drive,
    DrivenBy,
    Finger,
    HandFile,
    Spread,
)
from drakegrasp.hand.folder import HandFolder, hand_folder
from drakegrasp.hand.parsing import (
    KEPT_HANDS,
    Chain,
    ModelFile,
    add_model,
    find_drives,
    find_joints,
    joint_slides,
    make_chains,
    moving_joint,
    validate_own_joints,
)
from drakegrasp.hand.shapes import pad_surfaces

#: Sliding distance that is treated as equal to a turn of one radian [m/rad], if one threshold
#: serves closing joints of both kinds. It is about the length of a finger.
SLIDE = 0.1
#: Gain of the velocity-controlled fingers [N m s/rad]: a finger that is 0.1 rad/s too slow gets a
#: torque of 2 N m. The gain of sliding fingers follows from `SLIDE`.
FINGER_DAMPING = 20.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Hand:
    """A hand with k fingers, built by `load_hand`."""

    name: str
    model: ModelFile
    palm_link: str  # frame B
    X_BG: Array  # (4, 4), palm frame, +Gz out of the palm
    frames: dict[str, Array]  # X_BA (4, 4), frames of other tools by their names
    fingers: tuple[Finger, ...]  # in grasp order
    drive: Drive  # what keeps the closing joints from being pushed open
    spread: Spread
    preshape: dict[str, float]  # position of each joint that is fixed in an attempt [rad or m]
    closing_speed: Array  # (k,), speeds of the closing joints [rad/s or m/s]
    standoffs: tuple[float, ...]  # usual distances of the palm from the object [m]
    spreads_deg: tuple[float, ...]  # usual spread angles
    payload: float | None  # largest mass that the hand is made for [kg]
    rated_load: float | None  # largest fingertip force that the manufacturer allows [N]
    #: Names of the model's j joints in the order of its positions, as in every `q`. This is the
    #: order of the tree of links whose root is the palm. It can differ from the order of the file:
    #: in this tree a wrist of the model is below the palm.
    joint_order: tuple[str, ...]
    joint_names: tuple[str, ...]  # the n joints that turn or slide
    joint_slides: npt.NDArray[np.bool_]  # (n,), whether each joint slides
    joint_gain: Array  # (n, 1 + k), positions per coordinate; at most one non-zero in each row
    joint_offset: Array  # (n,), positions at zero coordinates [rad or m]
    joint_limits: Array  # (n, 2), lower and upper limits [rad or m]
    chains: tuple[Chain, ...]  # one per finger, to its fingertip
    link_chains: dict[str, Chain]  # one per link of the palm's tree, including the palm
    #: The hand in each of its preshapes; each of these hands has only the fingers that close in it.
    preshapes: tuple[Hand, ...] = ()
    preshape_names: tuple[str, ...] = ()

    @property
    def num_fingers(self) -> int:
        """Number of fingers, k."""
        return len(self.fingers)

    def palm_in(self, link: str) -> Array:
        """Return the pose X_AG (4, 4) of the palm frame in a frame A of the hand.

        Args:
            link: Name of frame A: the palm link, one of `frames`, or empty for the palm frame
                itself.

        Raises:
            HandError: If the hand has no frame of this name.
        """
        if not link:
            return np.eye(4)
        if link == self.palm_link:
            return self.X_BG
        if link not in self.frames:
            known = ", ".join(map(repr, (self.palm_link, *self.frames)))
            raise HandError(f"link must be 'palm' for the palm frame, or {known}, got {link!r}")
        return multiply(invert_pose(self.frames[link]), self.X_BG)

    def at(self, preshape: int | None) -> Hand:
        """Return the hand in the preshape of an index; this hand if None or without preshapes."""
        return self.preshapes[preshape] if self.preshapes and preshape is not None else self

    def unused_in(self, preshape: int | None) -> int:
        """Return the fingers that a preshape leaves out, as bits; bit 0 is the first finger."""
        used = {finger.name for finger in self.at(preshape).fingers}
        return sum(1 << i for i, finger in enumerate(self.fingers) if finger.name not in used)

    @property
    def fingertip_links(self) -> tuple[str, ...]:
        """Names of the fingertip links in grasp order."""
        return tuple(finger.fingertip for finger in self.fingers)

    @property
    def locked_joints(self) -> tuple[str, ...]:
        """Joints that keep their positions during an attempt."""
        return (*self.spread.joints, *self.preshape)

    @property
    def motor_fingers(self) -> list[int]:
        """(m,), indices of the fingers that have their own motor."""
        return [i for i, finger in enumerate(self.fingers) if finger.driven_by is None]

    @property
    def motor_of(self) -> npt.NDArray[np.int64]:
        """(k,), index of the motor that moves each finger."""
        return np.argmax(self.closing_ratio > 0.0, axis=1)

    @property
    def closing_ratio(self) -> Array:
        """(k, m), ratio of each closing position to that of the finger with each motor."""
        names = [self.fingers[i].name for i in self.motor_fingers]
        ratio = np.zeros((self.num_fingers, len(names)))
        for i, finger in enumerate(self.fingers):
            by = finger.driven_by or DrivenBy(finger=finger.name)
            ratio[i, names.index(by.finger)] = by.ratio
        return ratio

    def followers(self, finger: int) -> list[Coupling]:
        """Return the joints that follow the closing joint of a finger with its own motor."""
        own = self.fingers[finger]
        found = list(own.coupled)
        for other in self.fingers:
            if other.driven_by is not None and other.driven_by.finger == own.name:
                ratio = other.driven_by.ratio
                found.append(Coupling(joint=other.closing_joint, ratio=ratio))
                found += [replace(c, ratio=c.ratio * ratio) for c in other.coupled]
        return found

    @property
    def own_motors(self) -> dict[str, int]:
        """The joints that move if each joint has its own motor, with the finger of each joint.

        They are the joints between the palm and a fingertip. Spread joints are left out, and so are
        joints that slide if the finger's closing joint turns, or turn if it slides.
        """
        found: dict[str, int] = {}
        for i, (finger, chain) in enumerate(zip(self.fingers, self.chains, strict=True)):
            for name, slides in zip(chain.joints, chain.slides.tolist(), strict=True):
                if name not in self.spread.joints and slides == finger.slides:
                    found.setdefault(name, i)
        return found

    @property
    def closing_unit(self) -> Array:
        """(k,), closing distance that is treated as equal to one radian [rad or m].

        For a finger driven by another finger, it is the driver's distance times the ratio.
        """
        units = [SLIDE if self.fingers[i].slides else 1.0 for i in self.motor_fingers]
        return multiply(self.closing_ratio, np.array(units))

    @property
    def joint_units(self) -> dict[str, str]:
        """Unit of each joint's positions, "rad" or "m", by the names of the joints."""
        pairs = zip(self.joint_names, self.joint_slides.tolist(), strict=True)
        return {name: "m" if slides else "rad" for name, slides in pairs}

    @property
    def finger_names(self) -> dict[str, bool]:
        """Names of the fingers in grasp order, each with whether a grasp needs its fingertip."""
        return {finger.name: finger.required for finger in self.fingers}

    @property
    def required(self) -> npt.NDArray[np.bool_]:
        """(k,), whether a grasp needs each fingertip on the object."""
        return np.array([finger.required for finger in self.fingers])


def load_hand(source: HandSource = "barrett") -> Hand:
    """Return a hand of the package, the hand of a YAML file, or the hand of a dataset.

    Args:
        source: One of `file_format.hand_names()`, the path of a YAML file with the keys of
            `file_format.HandFile`, whose `model` is a path relative to the YAML file, or
            `Config.hand_source` of a dataset's configuration for the dataset's hand.

    Raises:
        HandError: If there is no such hand, a key or value of the YAML file is invalid, the model
            lacks a link or joint that the YAML file names, or the files of a dataset's hand have
            changed.
    """
    folder = hand_folder(source)
    if isinstance(source, CarriedHand) and folder.digest != source.digest:
        raise HandError(
            f"{folder.root}: must hold the hand of the dataset ({source.digest}), got other files "
            f"({folder.digest})"
        )
    return _load(folder)


@lru_cache(maxsize=KEPT_HANDS)
def _load(folder: HandFolder) -> Hand:
    """Return the hand of a folder; parsing takes 40 ms."""
    described, path = folder.described, folder.root / folder.name
    model = ModelFile(folder.root.resolve() / described.model, folder.stamp)
    name, shaped = path.stem.removesuffix("_hand"), list[Hand]()
    try:
        hand = _build_hand(name, described, model)
        for i, preshape in enumerate(described.preshapes):
            try:
                shaped.append(_build_hand(name, described.in_preshape(preshape), model))
            except HandError as error:
                raise HandError(f"preshapes.{i}: {error}") from None
        names = tuple(preshape.name for preshape in described.preshapes)
        hand = replace(hand, preshapes=tuple(shaped), preshape_names=names)
        _validate_pads(hand)
    except HandError as error:
        raise HandError(f"{path}: {error}") from None
    return hand


def load_plain_hand(source: HandSource, where: str) -> Hand:
    """Return a hand for callers that do not support preshapes.

    Args:
        source: See `load_hand`.
        where: Description of the caller, for the message.

    Raises:
        HandError: If the hand has preshapes, or if `load_hand` raises one.
    """
    hand = load_hand(source)
    if hand.preshapes:
        raise HandError(f"hand must be one without preshapes for {where}, got {hand.name}")
    return hand


def _build_hand(name: str, described: HandFile, model: ModelFile) -> Hand:
    # Parse the model without shapes.
    plant = MultibodyPlant(0.0)
    instance = add_model(plant, model)
    palm = described.palm
    X_BG = _pose(palm.rpy_deg, palm.p_BG)

    # Assign each joint to a coordinate, or to its position in the preshape.
    joints = find_joints(plant, instance)
    moving = {joint.name(): joint for joint in joints if moving_joint(joint)}
    drives = find_drives(described, list(moving))
    limits = np.array(
        [(j.position_lower_limit(), j.position_upper_limit()) for j in moving.values()]
    ).reshape(-1, 2)
    _validate_joint_kinds(described, moving)
    for joint, (lower, upper) in zip(moving, limits, strict=True):
        position = described.preshape.get(joint, lower)
        if not lower <= position <= upper:
            raise HandError(
                f"preshape.{joint}: must be {lower:g}..{upper:g}, the joint's limits, "
                f"got {position:g}"
            )

    # Find the chain from the palm to each fingertip; it must contain the finger's closing joint.
    bodies = {body.name(): body for body in map(plant.get_body, plant.GetBodyIndices(instance))}
    base = _body(bodies, palm.link, "palm.link")
    carried, chains = make_chains(joints, base, drives, invert_pose(X_BG)), []
    for i, finger in enumerate(described.fingers):
        tip = _body(bodies, finger.fingertip, f"fingers.{i}.fingertip")
        if tip.name() not in carried:
            above, end = {j.child_body().name(): j.parent_body().name() for j in joints}, tip.name()
            while end in above:
                end = above.pop(end)
            raise HandError(
                f"model: link {tip.name()!r} must be joined to the palm link {base.name()!r}, "
                f"got a chain that ends at {end!r}"
            )
        chain = carried[tip.name()]
        if not chain.gain[:, 1 + i].any():
            raise HandError(
                f"fingers.{i}.closing_joint: must lie between the palm link and the fingertip, "
                f"got {finger.closing_joint!r}"
            )
        chains.append(chain)
    validate_own_joints(described, chains)

    # Without the weld, the plant would have a joint for the palm.
    plant.WeldFrames(plant.world_frame(), base.body_frame())
    plant.Finalize()
    return Hand(
        name=name,
        model=model,
        palm_link=palm.link,
        X_BG=X_BG,
        frames={n: _pose(f.rpy_deg, f.p_BA) for n, f in described.frames.items()},
        fingers=described.driven_fingers(),
        drive=described.drive,
        spread=described.spread,
        preshape=described.preshape,
        closing_speed=described.closing_speeds(),
        standoffs=described.standoffs,
        spreads_deg=described.spreads_deg,
        payload=described.payload,
        rated_load=described.rated_load,
        joint_order=tuple(plant.GetPositionNames(instance, False, False)),
        joint_names=tuple(moving),
        joint_slides=np.array([joint_slides(joint) for joint in moving.values()], dtype=np.bool_),
        joint_gain=np.array([drives[joint][0] for joint in moving]),
        joint_offset=np.array([drives[joint][1] for joint in moving]),
        joint_limits=limits,
        chains=tuple(chains),
        link_chains={name: carried[name] for name in bodies if name in carried},
    )


def _pose(rpy_deg: Sequence[float], p: Sequence[float]) -> Array:
    return make_pose(RollPitchYaw(np.deg2rad(rpy_deg)).ToRotationMatrix().matrix(), p)


def _validate_joint_kinds(described: HandFile, joints: dict[str, Any]) -> None:
    """Reject a closing joint that slides without a force limit or turns without a torque limit."""
    for i, finger in enumerate(described.driven_fingers()):
        slides = joint_slides(joints[finger.closing_joint])
        if slides != finger.slides and finger.driven_by is not None:
            raise HandError(
                f"fingers.{i}.driven_by: must be a finger whose closing joint "
                f"{'slides' if slides else 'turns'}, as {finger.closing_joint!r}, "
                f"got {finger.driven_by.finger!r}"
            )
        if slides != finger.slides:
            key, how = ("force_limit", "slides") if slides else ("torque_limit", "turns")
            raise HandError(
                f"fingers.{i}.{key}: must be given, as joint {finger.closing_joint!r} {how}, "
                "got none"
            )
    for n, name in enumerate(described.spread.joints):
        if joint_slides(joints[name]):
            raise HandError(f"spread.joints.{n}: must be a joint that turns, got {name!r}")


def _validate_pads(hand: Hand) -> None:
    """Reject a pad region that contains no part of its fingertip's surface: it could not touch."""
    if not any(finger.pad_region for finger in hand.fingers):
        return
    for i, (finger, triangles) in enumerate(
        zip(hand.fingers, pad_surfaces(hand.model, hand.fingers), strict=True)
    ):
        if not len(triangles):
            raise HandError(
                f"fingers.{i}.pad_region: must hold a part of the surface of link "
                f"{finger.fingertip!r}, got none of it"
            )


def _body(bodies: dict[str, RigidBody], name: str, key: str) -> RigidBody:
    if name not in bodies:
        raise HandError(f"{key}: must be a link of the model ({', '.join(bodies)}), got {name!r}")
    return bodies[name]
