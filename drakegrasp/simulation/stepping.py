"""Stepping a simulation within an attempt's limits: computing time and the object's speed.

Both ways to stop are exceptions, which `trial.run_attempt` turns into outcomes.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from drakegrasp.config import Config
from drakegrasp.simulation.scene import Scene, advance, hand_positions


class StateError(Exception):
    """The simulated state is no longer physical."""


class TrialTimeout(Exception):  # noqa: N818 - named as the outcome that it becomes
    """The attempt computed for longer than its limit."""


@dataclass(frozen=True)
class TrialLimits:
    """When an attempt is stopped.

    Attributes:
        deadline: Reading of `time.thread_time` at which it times out [s]. A process that was
            suspended, or had to share its core, does not compute meanwhile.
        max_speed: Speed of the object above which the state has exploded [m/s].
    """

    deadline: float
    max_speed: float

    def advance(self, scene: Scene, duration: float) -> None:
        """Simulate for a duration [s], then check the limits.

        Raises:
            TrialTimeout: If the deadline has passed.
            StateError: If the state has exploded.
        """
        advance(scene, duration)
        if time.thread_time() > self.deadline:
            raise TrialTimeout
        if not np.isfinite(hand_positions(scene)).all():
            raise StateError("the positions of the hand's joints became infinite or NaN")
        velocity = scene.plant.EvalBodySpatialVelocityInWorld(scene.context, scene.object)
        speed = float(np.linalg.norm(velocity.translational()))
        if not speed <= self.max_speed:
            raise StateError(
                f"the object's speed must stay below {self.max_speed:g} m/s, got {speed:.3g}"
            )


def start_limits(config: Config) -> TrialLimits:
    """Return the limits of an attempt that starts now."""
    return TrialLimits(time.thread_time() + config.attempt_seconds, config.physics.max_speed)
