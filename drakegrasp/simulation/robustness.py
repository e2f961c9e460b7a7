"""How much disturbance a grasp tolerates: repeats with noise, and with less friction.

Input: an attempt that was lifted. Output: three results.

1. The number of repeats, with noise on palm pose, friction and mass, that hold, and the number of
   them that would be samples. The repeats use the time step of the trial. The stored lift is not a
   repeat.
2. Whether the attempt without noise would be a sample at half the time step. This is the error of
   the step, which is numerical and therefore reported separately.
3. The smallest friction at which the attempt holds without noise, also at half the time step.

The noise depends only on the attempt's seed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from drakegrasp.arithmetic import Array, multiply
from drakegrasp.config import CertifyConfig, Config, with_whole_lifts
from drakegrasp.hand.description import load_hand
from drakegrasp.objects.model import ObjectModel
from drakegrasp.outcomes import Outcome
from drakegrasp.seeding import Stream
from drakegrasp.simulation.attempt import Attempt
from drakegrasp.simulation.conditions import Conditions, usual_conditions
from drakegrasp.simulation.palms import palm_motion
from drakegrasp.simulation.scene_cache import cached_scene, forget_scenes
from drakegrasp.simulation.screen import Prediction, centred, predict
from drakegrasp.simulation.trial import TrialRecord, run_attempt

#: Finer time step divided by the trial's, throughout the lift; a grasp that is an artefact of the
#: step fails at the finer one.
STEP_RATIO = 0.5
#: Random factors are rounded to multiples of this; exponentials of two C libraries differ by far
#: less.
FACTOR_GRID = 2.0**-32
#: Last number of the place of the stream that decides which attempts are certified.
_DRAWN = 5


def is_drawn(attempt: Attempt, probability: float) -> bool:
    """Return whether an attempt is certified; its own seed decides."""
    stream = Stream(attempt.seed, attempt.standoff_index, _DRAWN)
    return bool(stream.uniform(1)[0] < probability)


def certify(
    model: ObjectModel,
    X_TO: Array,
    attempt: Attempt,
    config: Config,
    is_sample: Callable[[TrialRecord], bool],
    *,
    held: bool = True,
) -> dict[str, float]:
    """Return how much disturbance an attempt tolerates, by the names of the schema.

    * `p_hold_repeats`: number of disturbed repeats with a verdict.
    * `p_hold_held`, `p_hold_samples`: number of these that hold, and that would be samples.
    * `p_hold_half_step`: 1 if the undisturbed attempt would be a sample at half the step, 0 if not;
      NaN if the simulation was inconclusive.
    * `certified_friction`: smallest coefficient of hand and object at which the attempt holds at
    half
      the step, to within the attempt's own coefficient / 2^`certify.friction_steps`. It is inf if
      the attempt does not hold at its own coefficient, and NaN if a simulation was inconclusive or
      the search was not made.

    Args:
        model: The object.
        X_TO: Resting pose of the object, (4, 4).
        attempt: A lifted attempt; noise and less friction are relative to its friction and mass.
        config: The rules; `certify` has the number of repeats and the noise.
        is_sample: Returns whether the trial of a repeat would be a sample.
        held: Whether the attempt holds; the smallest friction is searched only if it does.
    """
    # Repeat the attempt with noise; inconclusive repeats do not count.
    known = attempt.conditions or usual_conditions(model, config.physics)
    config = with_whole_lifts(config)  # whether a grasp holds is decided by a whole lift
    stream = Stream(attempt.seed, attempt.standoff_index)
    noisy = _noisy(stream, attempt, known, config.certify)
    repeats = [_lift(model, X_TO, each, config) for each in noisy]
    conclusive = [record for record in repeats if record is not None]

    # Once without noise at half the step.
    step = STEP_RATIO * config.physics.time_step
    physics = config.physics.model_copy(update={"time_step": step, "coarse_steps": 1})
    finer = config.model_copy(update={"physics": physics})
    hand = load_hand(config.hand_source)
    placed, shaped = centred(model, hand, [attempt]), hand.at(attempt.preshape)
    (prediction,) = predict(model, shaped, X_TO, placed, config.screen)
    undisturbed = _lift(model, X_TO, _with_materials(attempt, known), finer, prediction)

    # Search for the smallest friction; what geometry decides does not depend on friction.
    highest, friction = known.materials.friction_hand, np.nan

    def holds(friction: float) -> bool | None:
        other, record = _with_materials(attempt, known, friction_hand=friction), undisturbed
        if friction != highest:
            record = _lift(model, X_TO, other, finer, prediction)
        return None if record is None else record.outcome is Outcome.SUCCESS

    if held and config.certify.friction_steps:
        friction = least_friction(holds, highest, config.certify.friction_steps)
    return {
        "p_hold_repeats": len(conclusive),
        "p_hold_held": sum(record.outcome is Outcome.SUCCESS for record in conclusive),
        "p_hold_samples": sum(map(is_sample, conclusive)),
        "p_hold_half_step": np.nan if undisturbed is None else float(is_sample(undisturbed)),
        "certified_friction": friction,
    }


def least_friction(holds: Callable[[float], bool | None], highest: float, steps: int) -> float:
    """Return the smallest friction that holds, by bisection.

    It assumes that a grasp that holds at one coefficient also holds at every higher coefficient.

    Args:
        holds: Returns whether a grasp holds at a coefficient, None if inconclusive.
        highest: The highest coefficient.
        steps: Number of bisection steps.

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
    """Yield each repeat of an attempt, with noise on palm pose, friction and mass."""
    materials = known.materials
    for _ in range(rules.repeats):
        # The same seed must give the same draws, so their order is fixed: palm, friction, mass.
        X_GH = palm_motion(stream.normal(6), rules.palm_noise, np.deg2rad(rules.palm_noise_deg))
        noisy = replace(attempt, X_OG=multiply(attempt.X_OG, X_GH))
        friction = materials.friction_hand * _noise_factor(stream, rules.friction_noise)
        mass = materials.mass * _noise_factor(stream, rules.mass_noise)
        yield _with_materials(noisy, known, friction_hand=friction, mass=mass)


def _with_materials(attempt: Attempt, known: Conditions, **changes: float) -> Attempt:
    """Return an attempt with known conditions, except for changes of friction or mass."""
    materials = replace(known.materials, **changes)
    return replace(attempt, conditions=replace(known, materials=materials))


def _noise_factor(stream: Stream, deviation: float) -> float:
    """Return exp(deviation times a normal number), rounded to a multiple of `FACTOR_GRID`."""
    return round(math.exp(deviation * stream.normal(1)[0]) / FACTOR_GRID) * FACTOR_GRID


def _lift(
    model: ObjectModel,
    X_TO: Array,
    attempt: Attempt,
    config: Config,
    prediction: Prediction | None = None,
) -> TrialRecord | None:
    """Return the record of an attempt, or None if it is inconclusive.

    `prediction` is the result of `predict` for the attempt, if the caller already has it. A scene
    in which Drake failed is not used again.
    """
    scene = cached_scene(model, config.physics, config.hand_source, attempt.preshape)
    (attempt,) = centred(model, load_hand(config.hand_source), [attempt])
    record = run_attempt(scene, X_TO, attempt, config, prediction)
    if record.outcome is Outcome.SOLVER_ERROR:
        forget_scenes()
    return None if record.outcome.inconclusive else record
