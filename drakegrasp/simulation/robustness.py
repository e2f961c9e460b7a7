"""How robust a grasp is: the same attempt again, a little otherwise and at half the step.

In: an attempt that succeeded. Out: a `Certificate`: the share of repeats with noise on palm
pose, friction and mass that hold, and the least friction at which it holds without noise. What
is drawn depends on the attempt's own seed alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from drakegrasp.arithmetic import Array, multiply, norm
from drakegrasp.config import CertifyConfig, Config
from drakegrasp.frames import make_pose, rotation_about
from drakegrasp.hand.description import load_hand
from drakegrasp.objects.model import ObjectModel
from drakegrasp.outcomes import Outcome
from drakegrasp.seeding import Stream
from drakegrasp.simulation.candidates import Attempt
from drakegrasp.simulation.construction import build_scene
from drakegrasp.simulation.screen import Prediction, predict
from drakegrasp.simulation.trial import run_attempt

#: The step of these simulations, in calm lifts too, over the short one of the trial: an artefact
#: of the step does not hold.
STEP_RATIO = 0.5


@dataclass(frozen=True, kw_only=True)
class Certificate:
    """How robust one grasp is.

    Attributes:
        share: Of the repeats that hold, 0..1; NaN if no repeat came to a verdict.
        friction: Least coefficient of hand and object at which it holds, to within
            `physics.friction_hand` / 2^`certify.friction_steps`; inf if it does not hold at
            `physics.friction_hand` at half the step, NaN if a simulation came to no verdict.
    """

    share: float
    friction: float


#: Drawn factors are multiples of this: the C library's exponential may differ by far less.
FACTOR_GRID = 2.0**-32
#: Of a grasp about which nothing is known.
UNKNOWN = Certificate(share=np.nan, friction=np.nan)


def certify(model: ObjectModel, X_TO: Array, attempt: Attempt, config: Config) -> Certificate:
    """Return how robust a grasp is.

    Args:
        model: The object.
        X_TO: Its resting pose, (4, 4).
        attempt: One that succeeds under the configuration.
        config: The rules; `certify` says how often and with how much noise.
    """
    stream = Stream(attempt.seed, attempt.standoff_index)
    held = list(_repeats(stream, model, X_TO, attempt, config))
    judged = [one for one in held if one is not None]
    (prediction,) = predict(model, load_hand(config.hand), X_TO, [attempt], config.screen)

    def holds(friction: float) -> bool | None:
        return _holds(model, X_TO, attempt, prediction, config, friction)

    return Certificate(
        share=float(np.mean(judged)) if judged else np.nan,
        friction=least_friction(holds, config.physics.friction_hand, config.certify.friction_steps),
    )


def least_friction(holds: Callable[[float], bool | None], highest: float, steps: int) -> float:
    """Return the least friction that holds by bisection: what holds is taken to hold above, too.

    Args:
        holds: Whether a coefficient does, or None if that was not found out.
        highest: The coefficient from which it goes down.
        steps: How often the interval is halved.

    Returns:
        The coefficient; inf if the highest does not hold, NaN if one that was asked is unknown.
    """
    low, high = 0.0, highest
    answer = holds(high)
    if not answer:
        return np.nan if answer is None else np.inf
    for _ in range(steps):
        middle = (low + high) / 2.0
        answer = holds(middle)
        if answer is None:
            return np.nan
        low, high = (low, middle) if answer else (middle, high)
    return high


def _repeats(
    stream: Stream, model: ObjectModel, X_TO: Array, attempt: Attempt, config: Config
) -> Iterator[bool | None]:
    rules, mu = config.certify, config.physics.friction_hand
    for _ in range(rules.repeats):
        other = replace(attempt, X_OG=multiply(attempt.X_OG, _palm_noise(stream, rules)))
        friction = mu * _noise_factor(stream, rules.friction_noise)
        factor = _noise_factor(stream, rules.mass_noise)
        heavy = replace(model, mass=factor * model.mass, I_OOcm_O=factor * model.I_OOcm_O)
        # The shape is the same, and so is what geometry says.
        (prediction,) = predict(model, load_hand(config.hand), X_TO, [other], config.screen)
        yield _holds(heavy, X_TO, other, prediction, config, friction)


def _noise_factor(stream: Stream, deviation: float) -> float:
    """Return exp(deviation times a normal number), a multiple of `FACTOR_GRID`."""
    return round(math.exp(deviation * stream.normal(1)[0]) / FACTOR_GRID) * FACTOR_GRID


def _palm_noise(stream: Stream, rules: CertifyConfig) -> Array:
    """Return a pose (4, 4) of the palm in the one that was meant."""
    shift = rules.palm_noise * stream.normal(3)
    turn = np.deg2rad(rules.palm_noise_deg) * stream.normal(3)
    angle = float(norm(turn))
    axis = turn / angle if angle > 0.0 else np.array([0.0, 0.0, 1.0])
    return make_pose(rotation_about(axis, angle), shift)


def _holds(
    model: ObjectModel,
    X_TO: Array,
    attempt: Attempt,
    prediction: Prediction | None,
    config: Config,
    friction: float,
) -> bool | None:
    """Return whether an attempt succeeds, or None if that was not found out."""
    changed = {
        "friction_hand": friction,
        "time_step": STEP_RATIO * config.physics.time_step,
        "coarse_steps": 1,
    }
    physics = config.physics.model_copy(update=changed)
    config = config.model_copy(update={"physics": physics})
    # A scene has its friction and its masses from when it was built.
    scene = build_scene(model, physics, load_hand(config.hand))
    outcome = run_attempt(scene, X_TO, attempt, config, prediction).outcome
    return None if outcome.says_nothing else outcome is Outcome.SUCCESS
