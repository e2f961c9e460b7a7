"""The configuration: typed data without behaviour, with a unit and a default for every value.

The defaults are the paper's numbers, except for the split: the preset `paper` has the split of the
paper. A preset or a user's YAML file states only the values that differ. Angles are in degrees in
this module, because users write them in YAML, and their names end with `_deg`; everywhere else they
are in radians. Use `drakegrasp.hand.settings.load_config` to get a configuration.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from importlib import resources
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

import yaml
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PrivateAttr,
    ValidationError,
    ValidationInfo,
    create_model,
    field_validator,
    model_validator,
)
from pydantic_core import PydanticCustomError

from drakegrasp import registry
from drakegrasp.errors import ConfigError, one_line
from drakegrasp.filters import LIMITS
from drakegrasp.foreign_files import read_text
from drakegrasp.yaml_text import parse_yaml

#: Bounds of every quantity, so that sums stay finite.
LARGEST, SMALLEST = 1e12, 1e-12
#: Counts are stored in 32 bits, seeds in 64.
MOST, MOST_SEED = 2**31 - 1, 2**64 - 1


def _validate_not_tiny(value: float) -> float:
    if value < SMALLEST:
        raise ValueError(f"must be at least {SMALLEST:g}, got {value}")
    return value


def _validate_at_most_1_m(value: float) -> float:
    if value > 1.0:
        raise ValueError(f"must be at most 1 m, got {value:g} m")
    return value


Number = Annotated[float, Field(ge=-LARGEST, le=LARGEST, allow_inf_nan=False)]
Positive = Annotated[
    float, Field(gt=0.0, le=LARGEST, allow_inf_nan=False), AfterValidator(_validate_not_tiny)
]
NonNegative = Annotated[float, Field(ge=0.0, le=LARGEST, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=1, le=MOST)]
NonNegativeCount = Annotated[int, Field(ge=0, le=MOST)]
Seed = Annotated[int, Field(ge=0, le=MOST_SEED)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
#: Distances of the palm from the object [m].
Standoffs = Annotated[
    tuple[Annotated[Positive, AfterValidator(_validate_at_most_1_m)], ...], Field(min_length=1)
]
Angles = Annotated[tuple[Number, ...], Field(min_length=1)]
#: Identifier of a licence: a line of printable ASCII.
Licence = Annotated[str, Field(pattern=r"^[ -~]*[!-~][ -~]*$", max_length=200)]


#: Number of characters of a wrong value that an error message shows.
LONGEST_SHOWN = 200


#: Mark of a field, as in `Annotated[Count, NO_SHARD]`, whose value changes no shard: it acts on
#: assembled shards, or only tells where to stop.
NO_SHARD = "no shard"


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    @field_validator("*", mode="before")
    @classmethod
    def _no_truth_values(cls, value: Any) -> Any:
        # YAML reads "yes" as true, which pydantic would accept as the number 1.
        if isinstance(value, bool):
            raise PydanticCustomError("bool", "Input should be a number or text")
        return value


class ObjectConfig(_Section):
    """Mass and meshes of the objects."""

    mass: Positive = 1.0  # [kg], of every object (paper, "Object representation")
    max_collision_faces: Annotated[int, Field(ge=12)] = 3000  # after decimation
    # Number of drops, the first upright (paper), the others from random orientations; each distinct
    # resting pose is used.
    resting_poses: Annotated[int, Field(ge=1, le=100)] = 1
    min_diagonal: Positive = 0.01  # [m], smallest allowed diagonal of the bounding box
    max_diagonal: Positive = 2.0  # [m], largest allowed diagonal of the bounding box

    @model_validator(mode="after")
    def _ordered(self) -> ObjectConfig:
        if self.min_diagonal >= self.max_diagonal:
            raise ValueError(
                f"min_diagonal must be less than max_diagonal, got {self.min_diagonal} "
                f"and {self.max_diagonal}"
            )
        return self


class BuiltinConfig(_Section):
    """The built-in objects to use when building from `builtin`; ignored for mesh files.

    With two objects of a class, one is for training and one for testing.
    """

    per_class: Annotated[int, Field(ge=1, le=10_000)] = 2  # objects of each of the 64 classes
    seed: Seed = 0  # of the draws of their sizes, independent of the other draws


#: Longest coarse step that is allowed [s]: our choice; labels were measured with 24 ms.
MAX_COARSE_STEP = 0.06


class PhysicsConfig(_Section):
    """Contact and time stepping; reasons and sources in docs/explanation/physics.md."""

    time_step: Annotated[float, Field(ge=1e-6, le=0.02)] = 0.008  # [s]
    coarse_steps: Annotated[int, Field(ge=1, le=8)] = 3  # time steps in one coarse step of a lift
    friction_hand: Positive = 0.71  # effective coefficient between hand and object
    friction_table: Positive = 0.71  # effective coefficient between table and object
    fingertip_modulus: Annotated[float, Field(gt=0.0, le=1e8)] = 1e7  # hydroelastic [Pa]
    link_modulus: Annotated[float, Field(gt=0.0, le=1e8)] = 1e7  # other hand links [Pa]
    table_modulus: Annotated[float, Field(gt=0.0, le=1e10)] = 5e9  # [Pa], over half of its 0.1 m
    dissipation: Annotated[float, Field(ge=0.0, le=500.0)] = 20.0  # Hunt-Crossley [s/m]
    contact_force: Positive = 0.05  # [N], a weaker contact does not count as one
    max_speed: Positive = 10.0  # [m/s], a faster object means that the simulation diverged
    # [N], largest force at the pad point of a fingertip: if one can exert more, all motors are
    # weakened by one factor. Null: the strength of the hand file.
    finger_load: Positive | None = None

    @model_validator(mode="after")
    def _short_enough(self) -> PhysicsConfig:
        if not self.coarse_steps * self.time_step <= MAX_COARSE_STEP:
            raise ValueError(
                f"coarse_steps times time_step must be at most {MAX_COARSE_STEP} s, "
                f"got {self.coarse_steps} times {self.time_step}"
            )
        return self


class SettleConfig(_Section):
    """Dropping the object on the table until it is at rest."""

    drop_height: NonNegative = 0.3  # [m], of {O} above the table (paper); taller ones start on it
    max_time: Positive = 15.0  # [s] of simulation (released code)
    max_linear_speed: Positive = 1e-3  # [m/s], slower than this is at rest
    max_angular_speed: Positive = 1e-2  # [rad/s], slower than this is at rest
    rest_time: Positive = 0.2  # [s], for which the object must be at rest
    time_step: Annotated[float, Field(ge=1e-6, le=0.02)] = (
        0.002  # [s]; longer steps tilt objects in landing
    )


#: Validation context of values that are read from a dataset.
_STORED = "stored"
#: Name and digest of a user-defined class, as `drakegrasp.registry` writes them.
_OWN_CLASS = re.compile(r"[^/\\:]+\.py:[A-Za-z_]\w*@[0-9a-f]{16}")


def is_own_class(name: object) -> bool:
    """Return whether a value of a setting names a user-defined class, with its digest."""
    return isinstance(name, str) and _OWN_CLASS.fullmatch(name) is not None


class _ExtensibleSection(_Section):
    """A section that may name user-defined classes."""

    _code: dict[str, str] = PrivateAttr(default_factory=dict)

    @property
    def code(self) -> Mapping[str, str]:
        """Source texts of user-defined classes by name, never written to or read from a dataset."""
        return self._code

    def with_code(self, code: Mapping[str, str]) -> Self:
        """Return the section with the source texts of user-defined classes."""
        section = self.model_copy()
        section._code = dict(code)
        return section


def _is_named(kind: registry.Kind, name: object, info: ValidationInfo) -> bool:
    """Return whether a value names a user-defined class or an entry of the registry.

    The extensions with which a dataset was built need not be installed where it is read.
    """
    if not isinstance(name, str):
        return False
    stored = info.context == _STORED and name.isprintable() and name != ""
    return is_own_class(name) or stored or registry.is_known(kind, name)


def _named(kind: registry.Kind, value: Any, info: ValidationInfo) -> tuple[str, ...]:
    """Return a list of names; a name alone is a list of one, and null an empty list."""
    names = value if isinstance(value, list | tuple) else [] if value is None else [value]
    if not all(_is_named(kind, name, info) for name in names):
        known = (*registry.names(kind), "FILE.py:NAME")
        must = f"one of {', '.join(known)}" if len(known) > 1 else known[0]
        raise ValueError(f"must be {must}, or a list of them, got {value!r}")
    return tuple(names)


#: Largest number of palm poses of an object, unless another one is stated (paper).
MOST_PALMS = 10_000


class CandidateConfig(_ExtensibleSection):
    """The palm poses to try."""

    # Samplers that take turns; a sampler that is named twice gets two turns. A user-defined sampler
    # is `file.py:Name`.
    method: Annotated[
        tuple[str, ...],
        Field(min_length=1),
        BeforeValidator(partial(_named, "samplers")),
    ] = ("rotations",)
    # Palm poses per object; if there are more, they are thinned at random with the seed (paper). A
    # dataset may grow.
    max: Count = MOST_PALMS
    global_x_deg: Angles = tuple(range(0, 181, 30))  # paper, Table II
    global_y_deg: Angles = tuple(range(0, 360, 30))
    global_z_deg: Angles = tuple(range(0, 360, 45))
    local_x_deg: Angles = tuple(range(0, 181, 20))
    local_y_deg: Angles = tuple(range(0, 360, 20))
    local_z_deg: Angles = tuple(range(0, 360, 45))
    jitter_deg: NonNegative = 0.0  # each angle gets a random whole number of degrees below this
    # Digest of the postures that are tried instead of sampled palm poses; `--postures` sets it.
    postures: Annotated[str, Field(pattern="^[0-9a-f]{16}$")] | None = None
    # [m] of the palm from the surface, one attempt each (paper); default: those of the hand.
    standoffs: Standoffs
    # One is drawn per attempt (released code); default: those of the hand.
    spreads_deg: Annotated[
        tuple[Annotated[float, Field(ge=0.0, le=180.0)], ...], Field(min_length=1)
    ]


class ScreenConfig(_Section):
    """Attempts that geometry decides without a simulation; see docs/explanation/screening.md."""

    mode: Literal["on", "off"] = "on"  # "off" simulates every attempt from the open hand
    start_margin: Positive = 0.0025  # [m], deeper penetration at the start is a collision
    reach_margin: Positive = 0.0025  # [m], a fingertip that passes nearer than this may touch
    block_margin: Positive = 0.005  # [m], contact stops every finger before it penetrates deeper
    clearance: Positive = 0.004  # [m], distance from the first contact at which fingers start

    @field_validator("mode", mode="before")
    @classmethod
    def _no_truth_values(cls, value: Any) -> Any:
        # YAML reads "on" and "off" as true and false.
        return {True: "on", False: "off"}.get(value, value) if isinstance(value, bool) else value


class CloseConfig(_Section):
    """Closing the fingers on the static object."""

    max_time: Positive = 2.5  # [s], a little more than 140 degrees at 60 degrees per second
    stop_speed: Positive = 0.01  # [rad/s, or 0.1 m/s], slower fingers count as stopped
    check_period: Positive = 0.1  # [s] of simulation between two checks
    # [m], the outcome is `table_contact` if the hand is deeper below the table's top at any time of
    # closing or lifting. Null: not measured.
    scrape_depth: NonNegative | None = 5e-4


class LiftConfig(_Section):
    """Releasing the object and moving the wrist to the target."""

    drive: Literal["worm", "torque", "locked"] | None = None  # None: that of the hand file
    release_time: NonNegative = 0.2  # [s], from release to the motion of the wrist
    p_TG: Annotated[tuple[Number, ...], Field(min_length=3, max_length=3)] = (
        0.0,
        0.0,
        0.60,
    )  # [m], target of the palm (paper)
    max_speed: Positive = 0.5  # [m/s] of the wrist
    max_acceleration: Positive = 1.0  # [m/s^2] of the wrist
    hold_time: NonNegative = 0.3  # [s] at the target before the final verdict
    check_period: Positive = 0.1  # [s] simulated between two checks, and up to a coarse step more
    # "lost_sample" ends a lift, as `moved`, when the object has moved more in the hand than the
    # next two limits at a check: filters must then have limits at least as strict.
    stop_when: Literal["never", "lost_sample"] = "never"
    stop_slip: Positive = 0.010  # [m], of the object in the hand since its release
    stop_turn_deg: Positive = 10.0  # of the object since its release


class RobustnessConfig(_Section):
    """Repeats of samples with noise; see docs/explanation/physics.md."""

    repeats: NonNegativeCount = 0  # disturbed lifts of each selected sample; 0: none
    # Probability that a sample (by the default filters) is selected.
    share: Share = 1.0


class CameraConfig(_Section):
    """The two cameras; see docs/reference/frames-and-units.md."""

    distance: Positive = 0.25  # [m] behind the palm along -Gz (paper)
    size: Annotated[int, Field(ge=8, le=2048)] = 128  # [px], square images
    fov_y_deg: Annotated[float, Field(gt=0.0, lt=180.0)] = 50.0  # vertical field of view
    near: Positive = 0.01  # [m]
    far: Positive = 0.75  # [m]

    @property
    def width(self) -> int:
        """Width of the images [px], as in `ScenesConfig`."""
        return self.size

    @property
    def height(self) -> int:
        """Height of the images [px]."""
        return self.size

    @model_validator(mode="after")
    def _ordered(self) -> CameraConfig:
        if self.near >= self.far:
            raise ValueError(f"near must be less than far, got {self.near} and {self.far}")
        return self


#: Largest angle of the light from its usual direction, which is 26.6 degrees from the vertical, so
#: that the light stays above the horizon [deg].
MAX_LIGHT_ANGLE = 60.0


def _rising(limits: tuple[float, float]) -> tuple[float, float]:
    if limits[0] > limits[1]:
        raise ValueError(f"must be a range, low before high, got {list(limits)}")
    return limits


#: Smallest and largest value of a uniform draw.
Range = Annotated[tuple[Positive, Positive], AfterValidator(_rising)]


class RandomizeConfig(_Section):
    """Conditions that are drawn for each attempt; see docs/explanation/randomization.md.

    Null or 0 switches a draw off. By default all draws are off; that page lists the sources of the
    preset `randomized`.
    """

    object_colour: Share = 0.0  # fraction of a random colour in the object's colour; 1: any
    table_colour: Share = 0.0  # fraction of a random colour in the table's colour
    # Largest angle between the light from above and its usual direction.
    light_angle_deg: Annotated[float, Field(ge=0.0, le=MAX_LIGHT_ANGLE)] = 0.0
    light_strength: Range | None = None  # factor of the light from above
    camera_shift: NonNegative = 0.0  # [m] at most, along each axis of the camera
    camera_turn_deg: Annotated[float, Field(ge=0.0, le=90.0)] = 0.0  # at most, about each axis
    depth_noise: Range | None = None  # [1/m], standard deviation of depth over depth squared
    depth_baseline: NonNegative = 0.0  # [m], between the depth camera and its projector
    friction_hand: Range | None = None  # factor of the coefficient
    friction_table: Range | None = None  # factor of the coefficient
    mass: Range | None = None  # factor of the object's mass and inertia


class ScenesConfig(_Section):
    """The scenes of scenes.hdf5 and their cameras; see docs/how-to/train-on-scenes.md."""

    place: NonNegative = 0.1  # [m] at most, of the object from T along each axis of the table
    views: Annotated[int, Field(ge=1, le=1000)] = 16  # of a training scene
    distance: Range = (0.4, 0.9)  # [m] of the camera from the point at which it looks
    elevation_deg: Annotated[
        tuple[Annotated[float, Field(ge=0.0, le=90.0)], Annotated[float, Field(ge=0.0, le=90.0)]],
        AfterValidator(_rising),
    ] = (20.0, 85.0)  # of the camera above that point
    aim: NonNegative = 0.05  # [m] at most, of this point from the object along each axis
    roll_deg: Annotated[float, Field(ge=0.0, le=180.0)] = 15.0  # at most, about the line of sight
    width: Annotated[int, Field(ge=8, le=2048)] = 320  # [px]
    height: Annotated[int, Field(ge=8, le=2048)] = 240  # [px]
    fov_y_deg: Annotated[float, Field(gt=0.0, lt=180.0)] = 42.5  # of a RealSense D435 (colour)
    near: Positive = 0.05  # [m]
    far: Annotated[float, Field(gt=0.0, le=6.5)] = 3.0  # [m]; 16 bits hold 6.5 m in 0.1 mm

    @model_validator(mode="after")
    def _ordered(self) -> ScenesConfig:
        if self.near >= self.far:
            raise ValueError(f"near must be less than far, got {self.near} and {self.far}")
        return self


class _Filters(_ExtensibleSection):
    # "lifted" switches off the rules on how well the hand holds the object: every success that the
    # filters of images and contacts keep becomes a sample.
    require: Literal["lifted", "limits"] = "limits"
    # Name of a file of `drakegrasp reach`: grasps that its arm does not reach are no samples.
    reachable: str | None = None

    if TYPE_CHECKING:

        def __init__(self, **values: Any) -> None: ...

        def __getattr__(self, name: str) -> Any: ...


_KINDS: dict[str, Any] = {
    "number": Number,
    "positive": Positive,
    "not negative": NonNegative,
    "count": NonNegativeCount,
}


def _filter_config() -> type[_Filters]:
    """Return section `filters`: its settings are those of `drakegrasp.filters.LIMITS`."""
    settings: dict[str, Any] = {}
    for name, limit in LIMITS.items():
        kind = _KINDS[limit.kind] | None if limit.off == "null" else _KINDS[limit.kind]
        settings[name] = (kind, limit.default)
    # User-defined filters: `file.py:Name`, or the name of a filter of another package.
    own = Annotated[tuple[str, ...], BeforeValidator(partial(_named, "filters"))]
    settings["own"] = (own, ())
    doc = "Which successes become samples, decided when the files are assembled; null: no limit."
    return create_model("FilterConfig", __base__=_Filters, __doc__=doc, **settings)


if TYPE_CHECKING:
    FilterConfig = _Filters
else:
    FilterConfig = _filter_config()


class SplitConfig(_Section):
    """How the samples are split for training, validation and test; docs/reference/outcomes.md."""

    # object: whole objects are drawn, and stay in their split. class: the paper's rule.
    by: Literal["object", "class"] = "object"
    # Of the draw of whole objects; datasets that are merged must have the same.
    seed: Seed = 0
    # Fraction of the objects; without effect in a split by class, which tests one object of each
    # class.
    test_fraction: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.15
    # Fraction of the objects; in a split by class, fraction of the samples that are not for
    # testing.
    valid_fraction: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.1
    # In a split by class: names of the classes that are used for training, even with a single
    # object; None: all classes with two or more objects.
    train_classes: tuple[str, ...] | None = None

    @model_validator(mode="after")
    def _of_one_rule(self) -> SplitConfig:
        if self.by == "object" and self.train_classes is not None:
            raise ValueError("by must be class where train_classes is given, got object")
        if self.by == "object" and self.test_fraction + self.valid_fraction >= 1.0:
            raise ValueError(
                "test_fraction and valid_fraction together must be less than 1, unless by is "
                f"class, got {self.test_fraction} and {self.valid_fraction}"
            )
        return self


class VerifyConfig(_Section):
    """How predicted grasps are tried and judged; see docs/how-to/verify-predictions.md."""

    max_contact_error: Positive = 0.02  # [m], of reached from requested contacts, to match
    open_margin_deg: Positive = 20.0  # of opening the fingers first; 0.1 m of a slide is 1 rad
    # Maximum number of wrist poses that are simulated until one holds; 1: only the best fit, which
    # decides whether a verdict matches.
    max_tries: Annotated[int, Field(ge=1, le=5)] = 5


#: Number of palm poses in the first work unit of an object, and the largest number in a unit.
UNIT_CANDIDATES, LARGEST_UNIT = 50, 400


#: The default hand, one of the package.
DEFAULT_HAND = "barrett"


@dataclass(frozen=True, kw_only=True)
class CarriedHand:
    """A hand whose files are in a dataset, which may be from others.

    Attributes:
        path: Path of its hand file, in the folder that holds all files of the hand.
        digest: Digest of these files that the dataset states, see
            `drakegrasp.hand.folder.hand_digest`.
    """

    path: Path
    digest: str


#: Source of a hand: the name of a hand of the package, a hand file, or the hand of a dataset.
HandSource = str | Path | CarriedHand


class Config(_Section):
    """All settings that determine the content of a dataset, except the meshes."""

    # Name of a hand in drakegrasp/models, or the path of a hand file; the path of a dataset's own
    # hand is relative to the dataset.
    hand: str = DEFAULT_HAND
    seed: Seed = 0
    # Number of candidates in a work unit; None: 50, growing up to 400.
    unit_candidates: Count | None = None
    # [s] of CPU time after which an attempt is a `timeout`
    attempt_seconds: Annotated[Positive, NO_SHARD] = 60.0
    objects: ObjectConfig = ObjectConfig()
    builtin: BuiltinConfig = BuiltinConfig()
    physics: PhysicsConfig = PhysicsConfig()
    settle: SettleConfig = SettleConfig()
    candidates: CandidateConfig
    screen: ScreenConfig = ScreenConfig()
    close: CloseConfig = CloseConfig()
    lift: LiftConfig = LiftConfig()
    robustness: RobustnessConfig = RobustnessConfig()
    camera: CameraConfig = CameraConfig()
    randomize: RandomizeConfig = RandomizeConfig()
    scenes: Annotated[ScenesConfig, NO_SHARD] = ScenesConfig()
    # Number of samples after which a build stops: of all objects together, which contribute evenly,
    # and of each object. An object may have fewer.
    samples: Annotated[Count | None, NO_SHARD] = None
    samples_per_object: Annotated[Count | None, NO_SHARD] = None
    # Number of consecutive palm poses without a sample after which an object is given up, if a
    # number of samples is set.
    samples_patience: Annotated[Count, NO_SHARD] = 400
    filters: Annotated[FilterConfig, NO_SHARD] = FilterConfig()
    split: Annotated[SplitConfig, NO_SHARD] = SplitConfig()
    verify: Annotated[VerifyConfig, NO_SHARD] = VerifyConfig()
    _carried: CarriedHand | None = PrivateAttr(None)

    @property
    def hand_source(self) -> str | CarriedHand:
        """Source of the hand: the dataset that contains it, or the value of `hand`."""
        return self._carried or self.hand

    def with_hand(self, hand: str, source: HandSource | None = None) -> Config:
        """Return the configuration with another hand; `source` may be the hand of a dataset."""
        config = self.model_copy(update={"hand": hand})
        config._carried = source if isinstance(source, CarriedHand) else None
        return config

    @model_validator(mode="after")
    def _filters_within_stop(self) -> Config:
        # A grasp that a looser filter would keep may be among the lifts that were ended early.
        if self.lift.stop_when == "never":
            return self
        if self.filters.require == "lifted":
            raise ValueError(
                f"filters.require must be limits where lift.stop_when is {self.lift.stop_when}, "
                "got lifted"
            )
        for key, name in (("max_slip", "stop_slip"), ("max_turn_deg", "stop_turn_deg")):
            limit, stop = getattr(self.filters, key), getattr(self.lift, name)
            if limit is None or limit > stop:
                raise ValueError(
                    f"filters.{key} must be at most {stop}, where lift.{name} ended the lifts, "
                    f"got {'null' if limit is None else limit}"
                )
        return self

    def to_dict(self) -> dict[str, Any]:
        """Return the resolved values as plain JSON types; `parse_stored` is the inverse."""
        return self.model_dump(mode="json")

    @property
    def has_target(self) -> bool:
        """Whether a number of samples is set after which a build stops."""
        return (self.samples, self.samples_per_object) != (None, None)

    @property
    def code(self) -> Mapping[str, str]:
        """Source texts of the files of user-defined classes, by name."""
        return {**self.candidates.code, **self.filters.code}

    def with_code(self, code: Mapping[str, str]) -> Config:
        """Return the configuration with source texts; each section keeps those of its classes."""
        named = (("candidates", self.candidates.method), ("filters", self.filters.own))
        update = {
            key: getattr(self, key).with_code({n: code[n] for n in names if n in code})
            for key, names in named
        }
        return self.model_copy(update=update)

    def unit_ranges(self, candidates: int) -> Iterator[range]:
        """Yield the work units of an object, as ranges of its candidates.

        The units of an object grow from 50 to 400 candidates. So there are few files and tasks, and
        an object that soon has enough grasps is not tried for a long time. Only the last unit
        depends on the number of candidates, so that a dataset can grow.

        Args:
            candidates: Number of candidates of the object.
        """
        start = 0
        while start < candidates:
            size = self.unit_candidates or UNIT_CANDIDATES
            if self.unit_candidates is None:
                size = min(max(size, start), LARGEST_UNIT)
            yield range(start, min(start + size, candidates))
            start += size

    def simulation_hash(self) -> str:
        """Return the hash (16 hex digits) of all values that affect the content of shards.

        Values with the mark `NO_SHARD` are left out, and the number of palm poses, so that a
        dataset may grow. The hash contains the name of the hand file, but not its folder; the
        digest of the hand's files is in the manifest's versions.
        """
        left_out = dict.fromkeys(POSTPROCESSING_KEYS, True)
        values = self.model_dump(mode="json", exclude={**left_out, "candidates": {"max"}})
        values["hand"] = PurePath(self.hand).stem
        canonical = json.dumps(values, sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(canonical.encode()).hexdigest()[:16]


#: Keys of the configuration that change no shard.
POSTPROCESSING_KEYS = tuple(k for k, v in Config.model_fields.items() if NO_SHARD in v.metadata)


#: The preset of a build without a configuration.
BUILD_PRESET = "fast"


def preset_names() -> list[str]:
    """Return the names of the presets that come with the package."""
    folder = resources.files("drakegrasp") / "presets"
    return sorted(
        p.name.removesuffix(".yaml") for p in folder.iterdir() if p.name.endswith(".yaml")
    )


def with_whole_lifts(config: Config) -> Config:
    """Return a configuration that lifts each closed hand until its result is certain."""
    lift = config.lift.model_copy(update={"stop_when": "never"})
    return config.model_copy(update={"lift": lift})


def parse_config(tree: dict[str, Any], context: str | None = None) -> Config:
    """Return the configuration that a tree of plain values describes.

    Args:
        tree: The values.
        context: `_STORED` if the values are read from a dataset.

    Raises:
        ConfigError: See `load_config`.
    """
    try:
        return Config.model_validate(tree, context=context)
    except ValidationError as error:
        # A bad item of a list also makes the list too short: report the first mistake only.
        mistakes: dict[Any, Any] = {}
        for mistake in error.errors():
            mistakes.setdefault(mistake["loc"][:2], mistake)
        lines = [
            describe_mistake(
                mistake, whole="config", legal=f"a known key ({', '.join(_siblings(place))})"
            )
            for place, mistake in mistakes.items()
        ]
        raise ConfigError("; ".join(lines)) from None


def parse_stored(tree: Any) -> Config:
    """Return the configuration that a file of a dataset stores as JSON.

    Raises:
        ConfigError: See `load_config`.
    """
    return parse_config(tree, _STORED)


def read_settings(source: str | Path) -> dict[str, Any]:
    """Return the tree of values of a preset or a YAML file.

    Raises:
        ConfigError: If there is no such preset or file, or its content is not a mapping.
    """
    # The source is the name of a preset, or a path.
    preset = resources.files("drakegrasp") / "presets" / f"{source}.yaml"
    if isinstance(source, str) and source in preset_names():
        text, name = preset.read_text(encoding="utf-8"), source
    else:
        path = Path(source)
        if not path.is_file():
            raise ConfigError(
                f"config must be a YAML file or one of the presets {', '.join(preset_names())}, "
                f"got {str(source)!r}"
            )
        try:
            text, name = read_text(path), str(path)
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(f"{path}: must be a readable UTF-8 file, got: {error}") from None

    # The text must be a YAML mapping; an empty file counts as a mapping without keys.
    try:
        tree = parse_yaml(text)
    except yaml.YAMLError as error:
        raise ConfigError(
            f"{name}: must be YAML, got text that is not ({one_line(error)})"
        ) from None
    if tree is None:
        return {}
    if not isinstance(tree, dict):
        raise ConfigError(f"{name}: must be a mapping of keys to values, got {type(tree).__name__}")

    # A section whose keys are all commented out is read as None.
    empty = [key for key in Config.model_fields if tree.get(key, 0) is None and _is_section(key)]
    return {**tree, **{key: {} for key in empty}}


def _is_section(key: str) -> bool:
    annotation = Config.model_fields[key].annotation
    return isinstance(annotation, type) and issubclass(annotation, BaseModel)


def apply_override(tree: dict[str, Any], text: str) -> None:
    """Set a value in a tree.

    Args:
        tree: Tree of values, which is modified.
        text: `"a.b=c"`, where c is read as YAML.

    Raises:
        ConfigError: If the text has another form, or a section of the path is a value.
    """
    path, separator, value = text.partition("=")
    keys = path.strip().split(".")
    if not separator or not all(keys):
        raise ConfigError(f"--set must be KEY=VALUE with dots between keys, got {text!r}")
    node = tree
    for key in keys[:-1]:
        child = node.setdefault(key, {})
        if not isinstance(child, dict):
            raise ConfigError(f"{path}: {key} must be a section, got the value {child!r}")
        node = child
    try:
        node[keys[-1]] = parse_yaml(value)
    except yaml.YAMLError:
        raise ConfigError(f"{path}: must be a YAML value, got {value!r}") from None


def describe_mistake(mistake: Any, *, whole: str, legal: str) -> str:
    """Return the description of a mistake in a YAML file, `path: must ..., got ...`.

    Args:
        mistake: An item of pydantic's `ValidationError.errors()`.
        whole: Name of the top level, whose path is empty.
        legal: Description of legal keys, for unknown ones, e.g. "a known key (seed, hand)".
    """
    path = ".".join(str(part) for part in mistake["loc"]) or whole
    kind, context = mistake["type"], mistake.get("ctx", {})
    message = str(mistake["msg"]).removeprefix("Value error, ")
    if kind == "value_error":
        return f"{path}: {message}"
    if kind in ("extra_forbidden", "unexpected_keyword_argument"):
        return f"{path}: must be {legal}, got an unknown one"
    if kind == "invalid_key":
        return f"{path}: must be a text to be a key, got {mistake['loc'][-1]!r}"
    if kind == "missing":
        return f"{path}: must be given, got nothing"

    # Pydantic speaks of Python's types; a YAML file has mappings and lists.
    mapping = "a mapping of keys to values"
    must = {
        "model_type": mapping,
        "dataclass_type": mapping,
        "dict_type": mapping,
        "tuple_type": "a list",
        "too_short": f"a list of at least {context.get('min_length')}",
        "too_long": f"a list of at most {context.get('max_length')}",
    }.get(kind, message.removeprefix("Input should be ").removeprefix("Input should "))
    return f"{path}: must be {must}, got {_shown(mistake['input'])}"


def _shown(value: Any) -> str:
    """Return the shortened value for an error message; Python cannot print huge integers."""
    try:
        return repr(value)[:LONGEST_SHOWN]
    except ValueError:
        return "a number of too many digits"


def _siblings(place: tuple[Any, ...]) -> list[str]:
    """Return the known keys of the section that contains a path of the configuration."""
    inside = len(place) > 1 and _is_section(place[0])
    section: Any = Config.model_fields[place[0]].annotation if inside else Config
    return list(section.model_fields)
