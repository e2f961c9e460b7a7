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

from drakegrasp.arithmetic import Array, multiply
from drakegrasp.config import CertifyConfig, Config, with_whole_lifts
from drakegrasp.hand.description import load_hand
from drakegrasp.objects.model import ObjectModel
from drakegrasp.outcomes import Outcome
from drakegrasp.seeding import Stream
from drakegrasp.simulation.candidates import Attempt, palm_motion
from drakegrasp.simulation.construction import build_scene
from drakegrasp.simulation.randomization.conditions import Conditions, usual_conditions
from drakegrasp.simulation.sampling.centring import centred
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
        friction: Least coefficient of hand and object at which it holds, to within the attempt's
            own / 2^`certify.friction_steps`; inf if it does not hold at its own at half the step,
            NaN if a simulation was inconclusive.
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
        attempt: One that succeeds under the configuration; noise and less friction start from its
            own friction and mass.
        config: The rules; `certify` has the number of repeats and the noise.
    """
    # Repeat the attempt with noise; inconclusive repeats do not count.
    known = attempt.conditions or usual_conditions(model, config.physics)
    repeater = _Repeater(model, X_TO, config)
    stream = Stream(attempt.seed, attempt.standoff_index)
    repeats = [repeater.holds(each) for each in _noisy(stream, attempt, known, config.certify)]
    conclusive = [holds for holds in repeats if holds is not None]

    # Search for the least friction; what geometry decides does not depend on friction.
    prediction = repeater.predict(attempt)

    def holds(friction: float) -> bool | None:
        return repeater.holds(_with_materials(attempt, known, friction_hand=friction), prediction)

    highest = known.materials.friction_hand
    return Certificate(
        share=float(np.mean(conclusive)) if conclusive else np.nan,
        friction=least_friction(holds, highest, config.certify.friction_steps),
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


def _noisy(
    stream: Stream, attempt: Attempt, known: Conditions, rules: CertifyConfig
) -> Iterator[Attempt]:
    """Yield each repeat of an attempt: with noise on palm pose, friction and mass."""
    materials = known.materials
    for _ in range(rules.repeats):
        # The order of the draws is part of the seed's meaning: palm, friction, mass.
        X_GH = palm_motion(stream.normal(6), rules.palm_noise, np.deg2rad(rules.palm_noise_deg))
        noisy = replace(attempt, X_OG=multiply(attempt.X_OG, X_GH))
        friction = materials.friction_hand * _noise_factor(stream, rules.friction_noise)
        mass = materials.mass * _noise_factor(stream, rules.mass_noise)
        yield _with_materials(noisy, known, friction_hand=friction, mass=mass)


def _with_materials(attempt: Attempt, known: Conditions, **changes: float) -> Attempt:
    """Return an attempt with another friction or mass than the known one."""
    materials = replace(known.materials, **changes)
    return replace(attempt, conditions=replace(known, materials=materials))


def _noise_factor(stream: Stream, deviation: float) -> float:
    """Return exp(deviation times a normal number), a multiple of `FACTOR_GRID`."""
    return round(math.exp(deviation * stream.normal(1)[0]) / FACTOR_GRID) * FACTOR_GRID


class _Repeater:
    """Runs attempts at half the time step."""

    def __init__(self, model: ObjectModel, X_TO: Array, config: Config) -> None:
        """Take an object, its resting pose (4, 4) and the rules of the attempts."""
        step = STEP_RATIO * config.physics.time_step
        physics = config.physics.model_copy(update={"time_step": step, "coarse_steps": 1})
        # Whether a grasp holds is the verdict of a whole lift.
        self._config = with_whole_lifts(config).model_copy(update={"physics": physics})
        self._model, self._X_TO, self._hand = model, X_TO, load_hand(config.hand)
        self._scene = build_scene(model, physics, self._hand)

    def predict(self, attempt: Attempt) -> Prediction | None:
        """Return what geometry says of an attempt."""
        rules = self._config.screen
        placed = centred(self._model, self._hand, [attempt])
        (prediction,) = predict(self._model, self._hand, self._X_TO, placed, rules)
        return prediction

    def holds(self, attempt: Attempt, prediction: Prediction | None = None) -> bool | None:
        """Return whether an attempt succeeds, or None if that is inconclusive.

        Args:
            attempt: What to try.
            prediction: What `predict` returns for it, where the caller has it already.
        """
        (attempt,) = centred(self._model, self._hand, [attempt])
        record = run_attempt(self._scene, self._X_TO, attempt, self._config, prediction)
        if not record.outcome.inconclusive:
            return record.outcome is Outcome.SUCCESS
        # A scene in which Drake failed must not be used again.
        self._scene = build_scene(self._model, self._config.physics, self._hand)
        return None
