"""How robust a grasp is: the attempt is repeated with noise, and with less friction.

In: an attempt that succeeded. Out: a `Certificate`: the share of repeats that hold with noise on
palm pose, friction and mass, and the least friction at which the grasp holds without noise. All
are simulated at half the time step. The noise depends on the attempt's own seed alone.
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

#: Time step of these simulations over the trial's, throughout the lift: a grasp that is an artefact
#: of the step fails.
STEP_RATIO = 0.5


@dataclass(frozen=True, kw_only=True)
class Certificate:
    """How robust one grasp is.

    Attributes:
        share: Share of the repeats that hold, 0..1; NaN if every repeat was inconclusive.
        friction: Least coefficient of hand and object at which it holds, to within
            `physics.friction_hand` / 2^`certify.friction_steps`; inf if it does not hold at
            `physics.friction_hand` at half the step, NaN if a simulation was inconclusive.
    """

    share: float
    friction: float


#: Random factors are rounded to multiples of this: the exponential of two C libraries differs by
#: far less.
FACTOR_GRID = 2.0**-32
#: The certificate of a grasp whose simulations were inconclusive.
UNKNOWN = Certificate(share=np.nan, friction=np.nan)


def certify(model: ObjectModel, X_TO: Array, attempt: Attempt, config: Config) -> Certificate:
    """Return how robust a grasp is.

    Args:
        model: The object.
        X_TO: Its resting pose, (4, 4).
        attempt: One that succeeds under the configuration.
        config: The rules; `certify` has the number of repeats and the noise.
    """
    # The object's own friction, if it has one, varies as the configured one does.
    physics = model.own_physics(config.physics)
    config = config.model_copy(update={"physics": physics})
    model = replace(model, friction=None)

    # Repeat the attempt with noise; inconclusive repeats do not count.
    stream = Stream(attempt.seed, attempt.standoff_index)
    repeats = _repeats(stream, model, X_TO, attempt, config)
    conclusive = [holds for holds in repeats if holds is not None]

    # Search for the least friction; what geometry decides does not depend on friction.
    (prediction,) = predict(model, load_hand(config.hand), X_TO, [attempt], config.screen)

    def holds(friction: float) -> bool | None:
        return _holds(model, X_TO, attempt, prediction, config, friction)

    return Certificate(
        share=float(np.mean(conclusive)) if conclusive else np.nan,
        friction=least_friction(holds, config.physics.friction_hand, config.certify.friction_steps),
    )


def least_friction(holds: Callable[[float], bool | None], highest: float, steps: int) -> float:
    """Return the least friction that holds, by bisection.

    It assumes that a grasp that holds at one coefficient holds at every higher one.

    Args:
        holds: Returns whether a grasp holds at a coefficient, None if inconclusive.
        highest: The highest coefficient.
        steps: Number of times that the interval is halved.

    Returns:
        The coefficient; inf if the highest does not hold, NaN if `holds` was inconclusive.
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
    """Yield for each repeat with noise whether it holds, None if inconclusive."""
    rules, mu = config.certify, config.physics.friction_hand
    for _ in range(rules.repeats):
        # The order of the draws is part of the seed's meaning: palm, friction, mass.
        noisy = replace(attempt, X_OG=multiply(attempt.X_OG, _palm_noise(stream, rules)))
        friction = mu * _noise_factor(stream, rules.friction_noise)
        factor = _noise_factor(stream, rules.mass_noise)
        scaled = replace(model, mass=factor * model.mass, I_OOcm_O=factor * model.I_OOcm_O)

        # `model` has the same shape as `scaled`, and its distance field is already computed.
        (prediction,) = predict(model, load_hand(config.hand), X_TO, [noisy], config.screen)
        yield _holds(scaled, X_TO, noisy, prediction, config, friction)


def _noise_factor(stream: Stream, deviation: float) -> float:
    """Return exp(deviation times a normal number), a multiple of `FACTOR_GRID`."""
    return round(math.exp(deviation * stream.normal(1)[0]) / FACTOR_GRID) * FACTOR_GRID


def _palm_noise(stream: Stream, rules: CertifyConfig) -> Array:
    """Return the random pose (4, 4) of the palm in its nominal frame."""
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
    """Return whether an attempt succeeds, or None if that is inconclusive."""
    changes = {
        "friction_hand": friction,
        "time_step": STEP_RATIO * config.physics.time_step,
        "coarse_steps": 1,
    }
    physics = config.physics.model_copy(update=changes)
    config = config.model_copy(update={"physics": physics})

    # Friction and masses are fixed when a scene is built.
    scene = build_scene(model, physics, load_hand(config.hand))
    outcome = run_attempt(scene, X_TO, attempt, config, prediction).outcome
    return None if outcome.inconclusive else outcome is Outcome.SUCCESS
