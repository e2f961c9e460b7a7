"""Hand files: where they are, and their keys, version 1. Does not import Drake.

Input: a hand, and its YAML file. Output: a `HandFile` whose values are valid by themselves;
`description` checks them against the model. docs/how-to/add-a-hand.md lists the keys.

A joint is either revolute or prismatic. Positions of revolute joints are angles [rad], positions of
prismatic joints are lengths [m].
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain
from math import sqrt
from pathlib import Path
from typing import Annotated, Literal

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

from drakegrasp import registry
from drakegrasp.config import CarriedHand, HandSource, Standoffs, describe_mistake
from drakegrasp.errors import HandError, one_line
from drakegrasp.frames import Array
from drakegrasp.yaml_text import parse_yaml_once

#: Folder of the package's hand files `<name>_hand.yaml`, their models and the table's model.
MODELS = Path(__file__).resolve().parent.parent / "models"
#: Version of the keys that this module reads.
VERSION = 1

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Name = Annotated[str, Field(min_length=1)]
Vector = tuple[Finite, Finite, Finite]
#: Normal and offset (nx, ny, nz, d) of the points p with n.p >= d; the normal can have any length.
HalfSpace = tuple[Finite, Finite, Finite, Finite]
#: What a closing joint does when it is pushed open; see docs/explanation/physics.md, "Drive".
Drive = Literal["worm", "torque", "locked"]
#: A contact at most this far outside a pad region is a contact of the pad [m]. Shapes are polyhedra
#: and MuJoCo's contacts are at their corners, while the border of a region is drawn along an edge:
#: the border of the Barrett Hand misses the corners of the tip by 0.9 mm. A patch is nine times as
#: wide.
PAD_BAND = 0.001
_STRICT = ConfigDict(frozen=True, extra="forbid")


@with_config(_STRICT)
@dataclass(frozen=True, kw_only=True)
class Coupling:
    """A joint that follows a finger's closing joint: its position is ratio * closing + offset."""

    joint: Name
    ratio: Finite  # not zero
    offset: Finite = 0.0  # its position in the open hand [rad or m]

    def __post_init__(self) -> None:
        if self.ratio == 0.0:
            raise ValueError("ratio must not be zero, got 0.0")


class _Keys(BaseModel):
    """A mapping of the YAML file."""

    model_config = _STRICT


class DrivenBy(_Keys):
    """How another finger drives a finger: the closing is `ratio` times the closing of `finger`."""

    finger: Name
    ratio: Positive = 1.0


#: Keys of a motor, with their values for a finger without its own motor.
_OF_MOTOR = {
    "torque_limit": None,
    "force_limit": None,
    "holding_torque": None,
    "holding_force": None,
    "rotor_inertia": 0.0,
    "gear_ratio": 1.0,
}


@with_config(_STRICT)
@dataclass(frozen=True, kw_only=True)
class Finger:
    """A finger; its kinematics is its `parsing.Chain`.

    A finger with a `torque_limit` closes by turning, a finger with a `force_limit` by sliding. A
    finger driven by another finger has neither limit in the file. In a `Hand`, its limits are what
    the driver's motor can apply at this finger, and what the driver's worm can hold if only this
    finger is loaded.
    """

    name: Name
    fingertip: Name  # link, frame Fi
    closing_joint: Name  # the driven joint; a positive position closes
    torque_limit: Positive | None = None  # of the motor, at a revolute closing joint [N m]
    force_limit: Positive | None = None  # of the motor, at a prismatic closing joint [N]
    rotor_inertia: NonNegative = 0.0  # of the motor [kg m^2]
    gear_ratio: Positive = 1.0  # motor angle / closing position [-, or rad/m]
    holding_torque: Positive | None = None  # largest load of a stalled worm, revolute joint [N m]
    holding_force: Positive | None = None  # largest load of a stalled worm, prismatic joint [N]
    coupled: tuple[Coupling, ...] = ()
    driven_by: DrivenBy | None = None  # None: the finger has its own motor
    pad_region: tuple[HalfSpace, ...] = ()  # in Fi [m]; contact outside it is of another link
    pad_point: Vector  # usual contact point, in Fi [m]
    required: bool = True  # whether a grasp needs this fingertip on the object

    def __post_init__(self) -> None:
        for fault in self._faults():
            raise ValueError(fault)

    def _faults(self) -> Iterator[str]:
        """Yield the faults that can be found in this finger without the rest of the file."""
        # A finger either turns or slides; a driven finger does what its driver does.
        limits = self.torque_limit, self.force_limit
        if limits.count(None) != 1 and not (self.driven_by and limits.count(None) == 2):
            yield (
                "torque_limit must be given if the closing joint turns, else force_limit, "
                f"got {'none' if self.torque_limit is None else 'both'}"
            )

        # The worm's key fits the kind of joint, and the worm is no weaker than the motor.
        key, wrong = ("force", "torque") if self.slides else ("torque", "force")
        if getattr(self, f"holding_{wrong}") is not None:
            yield f"holding_{wrong} must be holding_{key} together with {key}_limit"
        holding = self.holding_effort
        if holding is not None and holding < self.effort_limit:
            yield (
                f"holding_{key} must be at least the {key}_limit of {self.effort_limit:g} "
                f"{self.effort_unit}, got {holding:g}"
            )

        # The pad.
        for i, (*normal, _) in enumerate(self.pad_region):
            if not any(normal):
                yield f"pad_region.{i} must have a normal that is not zero, got zero"
        if self.beside_pad(self.p_FiP) > 0.0:
            yield f"pad_point must lie in the pad_region, got {list(self.pad_point)}"

    @property
    def slides(self) -> bool:
        """Whether the closing joint slides."""
        return self.force_limit is not None

    @property
    def effort_limit(self) -> float:
        """Largest torque [N m] or force [N] of the motor at the closing joint."""
        limit = self.force_limit if self.torque_limit is None else self.torque_limit
        assert limit is not None
        return limit

    @property
    def holding_effort(self) -> float | None:
        """Torque [N m] or force [N] that a stalled worm holds; None if it is not known."""
        return self.holding_force if self.slides else self.holding_torque

    @property
    def effort_unit(self) -> str:
        """Unit of torques or forces at the closing joint."""
        return "N" if self.slides else "N m"

    @property
    def p_FiP(self) -> Array:
        """Usual contact point (3,) in the fingertip link's frame [m]."""
        return np.array(self.pad_point)

    def on_pad(self, p_FiQ: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Return (...,) whether contact at points (..., 3) of the fingertip link [m] is on the pad.

        A point is on the pad if it is in the pad region or at most `PAD_BAND` outside it.
        """
        return np.asarray(self.beside_pad(p_FiQ) <= PAD_BAND)

    def beside_pad(self, p_FiQ: npt.ArrayLike) -> Array:
        """Return (...,) how far points (..., 3) of the fingertip link are outside the region [m].

        It is the largest of the distances outside the region's planes, negative inside the region.
        """
        points = np.asarray(p_FiQ, dtype=float)
        beside = np.full(points.shape[:-1], -np.inf)
        for nx, ny, nz, d in self.pad_region:
            height = nx * points[..., 0] + ny * points[..., 1] + nz * points[..., 2]
            beside = np.maximum(beside, (d - height) / sqrt(nx * nx + ny * ny + nz * nz))
        return beside


class Spread(_Keys):
    """The joints that keep the spread angle during an attempt; a hand may have no such joints."""

    joints: tuple[Name, ...] = ()


class Preshape(_Keys):
    """A grasp type: which fingers close, and the positions of the other joints."""

    name: Name
    fingers: Annotated[tuple[Name, ...], Field(min_length=1)]
    joints: dict[Name, Finite] = {}  # fixed joint positions in this preshape [rad or m]


class Palm(_Keys):
    """The palm frame G in the palm link's frame B."""

    link: Name
    p_BG: Vector  # [m]
    rpy_deg: Vector = (0.0, 0.0, 0.0)


class ForeignFrame(_Keys):
    """The frame A in which another tool gives the hand's pose, in the palm link's frame B."""

    p_BA: Vector = (0.0, 0.0, 0.0)  # [m]
    rpy_deg: Vector = (0.0, 0.0, 0.0)


class HandFile(_Keys):
    """The contents of the YAML file."""

    version: int
    model: Name  # the SDFormat or URDF file, relative to the YAML file
    palm: Palm
    fingers: Annotated[tuple[Finger, ...], Field(min_length=1)]
    drive: Literal["worm", "torque"] = "torque"
    spread: Spread = Spread()
    preshape: dict[Name, Finite] = {}  # fixed joint positions [rad or m]
    preshapes: tuple[Preshape, ...] = ()  # one is drawn per attempt; empty: all fingers close
    closing_speed_deg: Positive | None = None  # of revolute closing joints [deg/s]
    closing_speed: Positive | None = None  # of sliding closing joints [m/s]
    standoffs: Standoffs  # palm to surface [m]
    spreads_deg: Annotated[
        tuple[Annotated[float, Field(ge=0.0, le=180.0)], ...], Field(min_length=1)
    ] = (0.0,)
    payload: Positive | None = None  # largest mass that the hand is made for [kg]
    rated_load: Positive | None = None  # largest fingertip force that the manufacturer allows [N]
    frames: dict[Name, ForeignFrame] = {}  # frames of other tools by their names

    @model_validator(mode="after")
    def _check(self) -> HandFile:
        for fault in chain(self._faults_of_fingers(), self._faults()):
            raise ValueError(fault)
        return self

    def _faults_of_fingers(self) -> Iterator[str]:
        """Yield faults of names and of motors: each finger has a motor or is driven by another."""
        # Tables and figures identify fingers by their names.
        names = [finger.name for finger in self.fingers]
        if len(set(names)) < len(names):
            yield f"fingers must have a name each, got {', '.join(names)}"

        # Each preshape needs its own name, and with each finger also the finger that drives it.
        drivers = {f.name: f.driven_by.finger if f.driven_by else f.name for f in self.fingers}
        named = [preshape.name for preshape in self.preshapes]
        if len(set(named)) < len(named):
            yield f"preshapes must have a name each, got {', '.join(named)}"
        for i, preshape in enumerate(self.preshapes):
            for finger in preshape.fingers:
                if finger not in drivers:
                    yield f"preshapes.{i}.fingers must be of {', '.join(drivers)}, got {finger!r}"
                elif drivers[finger] not in preshape.fingers:
                    yield (
                        f"preshapes.{i}.fingers must include {drivers[finger]!r}, whose motor "
                        f"drives {finger!r}"
                    )

        # A driven finger must not have a motor, and its driver must have one.
        motors = [finger.name for finger in self.fingers if finger.driven_by is None]
        for i, driver in enumerate(drivers.values()):
            if self.fingers[i].driven_by is None:
                continue
            if driver not in motors:
                yield (
                    f"fingers.{i}.driven_by.finger must be a finger with a motor of its own "
                    f"({', '.join(motors) or 'there is none'}), got {driver!r}"
                )
            for key, none in _OF_MOTOR.items():
                if getattr(self.fingers[i], key) != none:
                    yield (
                        f"fingers.{i}.{key} must be left out with driven_by: the motor is that of "
                        f"finger {driver!r}"
                    )

    def _faults(self) -> Iterator[str]:
        """Yield faults of the drive, the closing speeds, the frames and the spread."""
        # A worm drive needs the holding efforts of all motors.
        own = [(i, f) for i, f in enumerate(self.fingers) if f.driven_by is None]
        for i, finger in own:
            if self.drive == "worm" and finger.holding_effort is None:
                key = "holding_force" if finger.slides else "holding_torque"
                yield f"fingers.{i}.{key} must be given where drive is worm, got none"

        # Each kind of closing joint needs its speed; the other speed must be left out.
        for key, slides, how in (
            ("closing_speed_deg", False, "turns"),
            ("closing_speed", True, "slides"),
        ):
            used, given = any(f.slides == slides for _, f in own), getattr(self, key) is not None
            if used and not given:
                yield f"{key} must be given where a closing joint {how}, got none"
            if given and not used:
                yield f"{key} must be left out: no closing joint {how}"

        # Names that files already use for the palm frame and the palm link.
        for name in {"palm", self.palm.link} & set(self.frames):
            yield f"frames.{name} must have another name, got the name of the palm"

        # Spread angles of a hand without spread joints.
        if not self.spread.joints and set(self.spreads_deg) != {0.0}:
            yield f"spreads_deg must be [0] without spread.joints, got {list(self.spreads_deg)}"

    def in_preshape(self, preshape: Preshape) -> HandFile:
        """Return the file of a hand that has only the fingers of a preshape.

        Joints of the other fingers keep the positions that the preshape specifies, or else the
        positions of the open hand.
        """
        still, fingers = dict(self.preshape), list[Finger]()
        for finger in self.fingers:
            if finger.name in preshape.fingers:
                fingers.append(finger)
                continue
            still[finger.closing_joint] = 0.0
            still.update({c.joint: c.offset for c in finger.coupled})
        still.update(preshape.joints)
        changes = {"fingers": tuple(fingers), "preshape": still, "preshapes": ()}
        return self.model_copy(update=changes)

    def driven_fingers(self) -> tuple[Finger, ...]:
        """Return the fingers; a driven finger gets its limits from the motor of its driver."""
        named, found = {finger.name: finger for finger in self.fingers}, []
        for finger in self.fingers:
            if (by := finger.driven_by) is not None:
                # By virtual work, a torque T at the driver is T / ratio at the finger.
                driver = named[by.finger]
                limit, holding = driver.effort_limit / by.ratio, driver.holding_effort
                holding = None if holding is None else holding / by.ratio
                finger = with_efforts(finger, limit, holding, slides=driver.slides)
            found.append(finger)
        return tuple(found)

    def closing_speeds(self) -> Array:
        """Return the speed (k,) of each closing joint [rad/s or m/s]."""
        sliding, turning = self.closing_speed or 0.0, np.deg2rad(self.closing_speed_deg or 0.0)
        speeds = [
            (sliding if f.slides else float(turning)) * (f.driven_by.ratio if f.driven_by else 1.0)
            for f in self.driven_fingers()
        ]
        return np.array(speeds)


def with_efforts(finger: Finger, limit: float, holding: float | None, *, slides: bool) -> Finger:
    """Return a finger with another effort limit and holding effort.

    Args:
        finger: The finger.
        limit: Largest torque [N m] or force [N] of its motor.
        holding: Largest torque or force that its worm holds; None if unknown.
        slides: Whether its closing joint slides.
    """
    if slides:
        return replace(finger, force_limit=limit, holding_force=holding)
    return replace(finger, torque_limit=limit, holding_torque=holding)


def hand_names() -> list[str]:
    """Return the names of the package's hands and of the hands that plugins register."""
    ours = (path.name.removesuffix("_hand.yaml") for path in MODELS.glob("*_hand.yaml"))
    return sorted({*ours, *registry.names("hands")})


def hand_file(source: HandSource) -> Path:
    """Return the YAML file of a registered hand, of a dataset's hand, or the given file.

    Raises:
        HandError: If there is no such file, or the path of a dataset's hand leads elsewhere.
    """
    if isinstance(source, CarriedHand):
        validate_inside(source.path, source.path.parent)
        return source.path
    path = MODELS / f"{source}_hand.yaml"
    if source in hand_names() and not path.exists():
        path = Path(registry.find("hands", str(source)))
    elif source not in hand_names():
        path = Path(source)
    if not path.is_file():
        names = ", ".join(hand_names())
        raise HandError(f"hand must be one of {names} or a YAML file, got {str(source)!r}")
    return path


def validate_inside(path: Path, folder: Path) -> None:
    """Reject a path that is not a plain file of a folder; the folder may be a stranger's.

    Raises:
        HandError: If the path is missing or no file, or if it or the folder is a link.
    """
    try:
        found, real = path.resolve(strict=True), folder.parent.resolve() / folder.name
    except (OSError, RuntimeError, ValueError):
        raise HandError(f"{path}: must be a file of the dataset's hand, got none") from None
    if not (found.is_relative_to(real) and found.is_file()):
        raise HandError(f"{path}: must be a file in {folder}, got a link or no file")


def parse_hand_file(path: Path, text: bytes) -> HandFile:
    """Return the contents of a hand file.

    Args:
        path: Path of the file, for messages.
        text: Its content.

    Raises:
        HandError: If a key or a value is invalid; the message has one line.
    """
    try:
        tree = parse_yaml_once(text)
    except yaml.YAMLError as error:
        raise HandError(f"{path}: must be YAML, got text that is not ({one_line(error)})") from None

    # Another version may have other keys, so report only the version as the mistake.
    version = tree.get("version", VERSION) if isinstance(tree, dict) else VERSION
    if type(version) is not int or version != VERSION:
        raise HandError(
            f"{path}: version: must be {VERSION}, the hand files that are read, got {version!r}"
        )
    try:
        return HandFile.model_validate(tree)
    except ValidationError as error:
        # A bad item of a list also makes the list too short: do not report what follows from it.
        mistakes = error.errors()
        below = {m["loc"][:n] for m in mistakes for n in range(1, len(m["loc"]))}
        lines = [
            describe_mistake(mistake, whole="hand", legal="a key of a hand file")
            for mistake in mistakes
            if mistake["loc"] not in below
        ]
        raise HandError(f"{path}: {'; '.join(lines)}") from None
