"""Simulating an attempt piece by piece, for as long as its state means anything.

Both ways to stop are exceptions within an attempt, which `trial.run_attempt` turns into outcomes.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from drakegrasp.config import Config
from drakegrasp.simulation.scene import Scene, advance, hand_positions


class StateError(Exception):
    """The state left the range in which it means anything."""


class LateError(Exception):
    """The attempt's wall-clock limit passed."""


@dataclass(frozen=True)
class Clock:
    """The limits of an attempt: of the wall clock [s], and of the object's speed [m/s]."""

    end: float
    max_speed: float

    def advance(self, scene: Scene, duration: float) -> None:
        """Simulate for a duration [s].

        Raises:
            LateError: If the wall clock has passed its limit.
            StateError: If the state has exploded.
        """
        advance(scene, duration)
        if time.monotonic() > self.end:
            raise LateError
        if not np.isfinite(hand_positions(scene)).all():
            raise StateError("the hand's joints must have finite positions, got others")
        velocity = scene.plant.EvalBodySpatialVelocityInWorld(scene.context, scene.object)
        speed = float(np.linalg.norm(velocity.translational()))
        if not speed <= self.max_speed:
            raise StateError(
                f"the object's speed must stay below {self.max_speed:g} m/s, got {speed:.3g}"
            )


def start_clock(config: Config) -> Clock:
    """Return the clock of an attempt that begins now."""
    return Clock(time.monotonic() + config.attempt_seconds, config.physics.max_speed)
