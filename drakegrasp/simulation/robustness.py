"""Repeats of an attempt with noise on palm pose, friction and mass.

Input: an attempt whose trial is a sample. Output: the records of its repeats. They use the time
step of the trial and are lifted to the end; the stored trial is not a repeat. The noise depends
only on the attempt's seed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from drakegrasp.arithmetic import Array, multiply
from drakegrasp.config import Config, with_whole_lifts
from drakegrasp.hand.description import load_hand
from drakegrasp.objects.model import ObjectModel
from drakegrasp.outcomes import Outcome
from drakegrasp.seeding import Stream
from drakegrasp.simulation.attempt import Attempt
from drakegrasp.simulation.conditions import Conditions, usual_conditions
from drakegrasp.simulation.palms import palm_motion
from drakegrasp.simulation.scene_cache import cached_scene, forget_scenes
from drakegrasp.simulation.screen import centred
from drakegrasp.simulation.trial import TrialRecord, run_attempt

#: Standard deviation of the noise on the palm pose along each axis [m], and about each axis [rad].
PALM_SHIFT, PALM_TURN = 0.002, float(np.deg2rad(1.0))
#: Standard deviation of the logarithm of the factors on friction and mass.
FACTOR_NOISE = 0.1
#: Random factors are rounded to multiples of this; exponentials of two C libraries differ by far
#: less.
FACTOR_GRID = 2.0**-32
#: Last number of the place of the stream that decides which attempts are repeated.
_DRAWN = 5


def is_drawn(attempt: Attempt, probability: float) -> bool:
    """Return whether an attempt is repeated; its own seed decides."""
    stream = Stream(attempt.seed, attempt.standoff_index, _DRAWN)
    return bool(stream.uniform(1)[0] < probability)


def repeat_disturbed(
    model: ObjectModel, X_TO: Array, attempt: Attempt, config: Config
) -> list[TrialRecord]:
    """Return the records of disturbed repeats; inconclusive repeats are left out.

    Args:
        model: The object.
        X_TO: Resting pose of the object, (4, 4).
        attempt: A lifted attempt; the noise is relative to its friction and mass.
        config: The rules; `robustness` has the number of repeats.
    """
    # Whether a grasp holds is decided by a whole lift.
    config = with_whole_lifts(config)
    known = attempt.conditions or usual_conditions(model, config.physics)
    records = list[TrialRecord]()
    for noisy in disturbed(attempt, known, config.robustness.repeats):
        scene = cached_scene(model, config.physics, config.hand_source, noisy.preshape)
        (centred_attempt,) = centred(model, load_hand(config.hand_source), [noisy])
        record = run_attempt(scene, X_TO, centred_attempt, config)
        # A scene in which Drake failed is not used again.
        if record.outcome is Outcome.SOLVER_ERROR:
            forget_scenes()
        if not record.outcome.inconclusive:
            records.append(record)
    return records


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
