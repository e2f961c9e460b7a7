"""An attempt: what a trial starts from. It is plain data and needs no Drake.

Samplers turn palm poses into attempts (`candidates`), `posture` turns a posture from outside into
an attempt, and `trial.run_attempt` runs the trial of an attempt.

The conditions of an attempt are what may differ between two attempts at the same palm pose. Their
values are absolute, not factors. Values that are not drawn are those of the configuration and the
object. Drawn values depend only on the seed and the attempt's numbers. Each attempt has a stream of
random words, and each quantity has its own words in it, so drawing one quantity does not change the
others. Only elementary arithmetic is used, so the values are the same on every machine
(docs/explanation/determinism.md).

Whether a grasp is robust is measured by repeats of its attempt with noise on palm pose, friction
and mass, see `disturbed`. The noise depends only on the attempt's seed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from enum import IntEnum
from typing import Any

import numpy as np

from drakegrasp.arithmetic import Array, multiply, norm, sin_cos
from drakegrasp.config import Config, PhysicsConfig, RandomizeConfig
from drakegrasp.frames import make_pose, pack_pose, rotation_about
from drakegrasp.objects.model import ObjectModel
from drakegrasp.seeding import Draw, Stream, object_key
from drakegrasp.vision.camera import Appearance, DepthSensor, usual_appearance


class Source(IntEnum):
    """The sampler of a palm pose. Values are stored in files: never renumber them."""

    ROTATIONS = 0
    NORMALS = 1
    OWN = 3  # any other sampler: one of another package, or a user-defined one
    POSTURES = 4  # no sampler: the posture comes from outside
    CLOSING = 5


@dataclass(frozen=True, kw_only=True)
class Materials:
    """Friction and mass: the conditions that the simulation of an attempt depends on.

    Attributes:
        friction_hand, friction_table: Effective coefficients of the object with hand and table.
        mass: Mass of the object [kg]; its inertia scales with it.
    """

    friction_hand: float
    friction_table: float
    mass: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Conditions:
    """The conditions of an attempt.

    Attributes:
        materials: Friction and mass.
        appearance: Colours and light.
        X_C0C: Pose (4, 4) of the oto camera relative to its usual pose.
        sensor: Error model of the depth images.
    """

    materials: Materials
    appearance: Appearance
    X_C0C: Array
    sensor: DepthSensor

    def values(self) -> dict[str, Any]:
        """Return the values that a dataset stores, by their names in its schema."""
        return {
            **asdict(self.materials),
            **vars(self.appearance),
            "X_C0C": pack_pose(self.X_C0C),
            "depth_noise": self.sensor.noise,
            "depth_seed": self.sensor.seed,
        }


@dataclass(frozen=True, kw_only=True, eq=False)
class Attempt:
    """The start of a trial, and the numbers by which a dataset identifies it.

    In a dataset, an attempt is a candidate at a stand-off.

    Attributes:
        X_OG: Pose of the palm (4, 4) before the fingers close; the candidate's pose if its ray
            misses.
        spread: Angle of the spread joints [rad].
        closing: Positions (k,) of the closing joints at the start [rad or m]; None for the open
            hand.
        ray_hits: Whether the palm ray meets the object; true if no ray places the palm.
        conditions: Friction, mass, appearance and cameras; None for the usual conditions.
        path: Positions (3, j) of all joints [rad or m], in the plant's order, for a posture that
            spread and closing cannot describe: where the trial begins, where the fingers hold the
            object, and where separate motors then move to and press.
        own_motors: Whether each joint has its own motor. If not, the motors of the hand file close
            the fingers until they stop, and all other joints keep their positions.
        preshape: Index of the hand's preshape; None if all fingers close.
        unused: Fingers that the preshape leaves out, see `Hand.unused_in`.
        candidate: Index of the candidate of its object.
        standoff_index: Index into `candidates.standoffs`.
        standoff: Distance of the palm from the surface point along -Gz [m].
        seed: Seed from which `spread` was drawn.
        resting: Index of the object's resting pose.
        source: The sampler.
        posture_row: Row of a posture in its file; NaN for a palm pose of a sampler.
    """

    X_OG: Array
    spread: float
    closing: Array | None = None
    ray_hits: bool = True
    conditions: Conditions | None = None
    path: Array | None = None
    own_motors: bool = False
    preshape: int | None = None
    unused: int = 0
    candidate: int = 0
    standoff_index: int = 0
    standoff: float = np.nan
    seed: int = 0
    resting: int = 0
    source: Source = Source.ROTATIONS
    posture_row: float = np.nan


def usual_materials(model: ObjectModel, physics: PhysicsConfig) -> Materials:
    """Return the friction and mass of an object's attempts if nothing is drawn."""
    physics = model.own_physics(physics)
    return Materials(
        friction_hand=physics.friction_hand,
        friction_table=physics.friction_table,
        mass=model.mass,
    )


def usual_conditions(model: ObjectModel, physics: PhysicsConfig) -> Conditions:
    """Return the conditions of an object's attempts if nothing is drawn."""
    return Conditions(
        materials=usual_materials(model, physics),
        appearance=usual_appearance(model.name),
        X_C0C=np.eye(4),
        sensor=DepthSensor(),
    )


#: The words of each quantity in an attempt's stream. The same seed means other values if they move.
WORDS = {
    "object_colour": slice(0, 3),
    "table_colour": slice(3, 6),
    "light_direction": slice(6, 8),
    "light_strength": slice(8, 9),
    "camera_shift": slice(9, 12),
    "camera_turn": slice(12, 15),
    "depth_noise": slice(15, 16),
    "friction_hand": slice(16, 17),
    "friction_table": slice(17, 18),
    "mass": slice(18, 19),
}


def draw_conditions(
    model: ObjectModel, config: Config, candidate: int, standoff_index: int
) -> Conditions:
    """Return the conditions of an attempt; values that are not drawn are the usual ones.

    Args:
        model: The object; factors apply to its mass, and fractions to its colour.
        config: What is drawn, and the seed.
        candidate: Index of the attempt's candidate.
        standoff_index: Index of the attempt's stand-off.
    """
    stream = Stream(config.seed, object_key(model.name), candidate, standoff_index, Draw.CONDITIONS)
    return conditions_from(stream, model, config)


def conditions_from(stream: Stream, model: ObjectModel, config: Config) -> Conditions:
    """Return the conditions that a stream yields, see `draw_conditions`."""
    usual, rules = usual_conditions(model, config.physics), config.randomize
    if rules == RandomizeConfig():
        return usual

    # One number in [0, 1) per word.
    numbers = stream.uniform(max(words.stop for words in WORDS.values()))
    drawn = {name: numbers[words] for name, words in WORDS.items()}

    return replace(
        usual,
        materials=_drawn_materials(usual.materials, rules, drawn),
        appearance=_appearance(usual.appearance, rules, drawn),
        X_C0C=_camera_jitter(rules, drawn),
        sensor=DepthSensor(
            noise=_between(rules.depth_noise, drawn["depth_noise"], 0.0),
            baseline=rules.depth_baseline,
            seed=stream.key if rules.depth_noise else 0,
        ),
    )


def _drawn_materials(
    usual: Materials, rules: RandomizeConfig, drawn: dict[str, Array]
) -> Materials:
    return Materials(
        **{
            name: getattr(usual, name) * _between(getattr(rules, name), drawn[name], 1.0)
            for name in ("friction_hand", "friction_table", "mass")
        }
    )


def _appearance(usual: Appearance, rules: RandomizeConfig, drawn: dict[str, Array]) -> Appearance:
    factor = _between(rules.light_strength, drawn["light_strength"], 1.0)
    return Appearance(
        object_colour=_mixed(usual.object_colour, drawn["object_colour"], rules.object_colour),
        table_colour=_mixed(usual.table_colour, drawn["table_colour"], rules.table_colour),
        light_direction=_turned_light(
            usual.light_direction, rules.light_angle_deg, drawn["light_direction"]
        ),
        light_strength=usual.light_strength * factor,
    )


def _between(limits: tuple[float, float] | None, number: Array, otherwise: float) -> float:
    """Return a number (1,) in 0..1 mapped to a range; `otherwise` if there is no range."""
    return otherwise if limits is None else limits[0] + (limits[1] - limits[0]) * float(number[0])


def _mixed(own: Array, random: Array, share: float) -> Array:
    """Return a colour (3,) mixed with a fraction of a random colour."""
    return np.asarray((1.0 - share) * own + share * random)


def _turned_light(direction: Array, angle_deg: float, numbers: Array) -> Array:
    """Return a unit vector (3,), uniform over the cap of half angle `angle_deg` about another."""
    if not angle_deg:
        return direction
    # Two directions across the light; the light is never along x.
    across = np.cross(direction, [1.0, 0.0, 0.0])
    across /= norm(across)
    other = np.cross(direction, across)

    # The height within a cap is uniform (Archimedes).
    _, least = sin_cos(np.deg2rad(angle_deg))
    cosine = 1.0 - numbers[0] * (1.0 - least)
    sine = np.sqrt(np.maximum(1.0 - cosine * cosine, 0.0))
    s, c = sin_cos(2.0 * np.pi * numbers[1])
    turned = cosine * direction + sine * (c * across + s * other)
    return np.asarray(turned / norm(turned))


def _camera_jitter(rules: RandomizeConfig, drawn: dict[str, Array]) -> Array:
    """Return X_C0C (4, 4): shifts along the camera's axes x, y, z, then turns about them."""
    shift = rules.camera_shift * (2.0 * drawn["camera_shift"] - 1.0)
    angles = np.deg2rad(rules.camera_turn_deg) * (2.0 * drawn["camera_turn"] - 1.0)
    R = np.eye(3)
    if rules.camera_turn_deg:
        for axis, angle in zip(np.eye(3), angles, strict=True):
            R = multiply(R, rotation_about(axis, angle))
    return make_pose(R, shift)


# Repeats with noise on palm pose, friction and mass

#: Standard deviation of the noise on the palm pose along each axis [m], and about each axis [rad].
PALM_SHIFT, PALM_TURN = 0.002, float(np.deg2rad(1.0))
#: Standard deviation of the logarithm of the factors on friction and mass.
FACTOR_NOISE = 0.1
#: Random factors are rounded to multiples of this; exponentials of two C libraries differ by far
#: less.
FACTOR_GRID = 2.0**-32


def is_drawn(attempt: Attempt, probability: float) -> bool:
    """Return whether an attempt is repeated; its own seed decides."""
    stream = Stream(attempt.seed, attempt.standoff_index, Draw.REPEAT)
    return bool(stream.uniform(1)[0] < probability)


def disturbed(attempt: Attempt, known: Conditions, repeats: int) -> Iterator[Attempt]:
    """Yield repeats of an attempt with noise on palm pose, friction and mass.

    Args:
        attempt: The attempt.
        known: Its conditions without noise.
        repeats: Number of repeats.
    """
    stream = Stream(attempt.seed, attempt.standoff_index)
    for _ in range(repeats):
        # The same seed must give the same draws, so their order is fixed: palm, friction, mass.
        X_GH = palm_motion(stream.normal(6), PALM_SHIFT, PALM_TURN)
        friction = known.materials.friction_hand * _noise_factor(stream)
        mass = known.materials.mass * _noise_factor(stream)
        materials = replace(known.materials, friction_hand=friction, mass=mass)
        yield replace(
            attempt,
            X_OG=multiply(attempt.X_OG, X_GH),
            conditions=replace(known, materials=materials),
        )


def _noise_factor(stream: Stream) -> float:
    """Return exp(`FACTOR_NOISE` times a normal number), rounded to a multiple of `FACTOR_GRID`."""
    return round(math.exp(FACTOR_NOISE * stream.normal(1)[0]) / FACTOR_GRID) * FACTOR_GRID


def palm_motion(numbers: Array, shift: float, turn: float) -> Array:
    """Return a random pose (4, 4) of a palm in its frame before the motion.

    Args:
        numbers: (6,), normal random numbers: along the axes, then about the axes.
        shift: Standard deviation along each axis [m].
        turn: Standard deviation of each component of the rotation vector [rad].
    """
    vector = turn * numbers[3:]
    angle = float(norm(vector))
    axis = vector / angle if angle > 0.0 else np.array([0.0, 0.0, 1.0])
    return make_pose(rotation_about(axis, angle), shift * numbers[:3])
