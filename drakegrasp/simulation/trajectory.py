"""The path of a lift, and the wrenches on an object that follows it.

In: a resting pose. Out: a `LiftPath` of the object's origin: a straight minimum-jerk motion (Flash
and Hogan, 1985) at constant orientation, within the speed and acceleration limits of the palm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from drakegrasp.config import Config
from drakegrasp.frames import X_WT, Array
from drakegrasp.objects.model import ObjectModel
from drakegrasp.simulation.settle import GRAVITY

#: Peak speed of a minimum-jerk motion over its mean speed (Flash and Hogan, 1985).
PEAK_SPEED = 15.0 / 8.0
#: Peak acceleration of a minimum-jerk motion times duration squared over distance.
PEAK_ACCELERATION = 10.0 / np.sqrt(3.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class LiftPath:
    """A straight motion of an object at constant orientation.

    Attributes:
        X_WO: Pose at the start, (4, 4).
        p_WO_end: Position of {O} at the end, (3,) [m].
        duration: Of the motion [s], positive; the object stays there afterwards.
    """

    X_WO: Array
    p_WO_end: Array
    duration: float

    @property
    def R_WO(self) -> Array:
        """Orientation, (3, 3)."""
        return self.X_WO[:3, :3]

    def at(self, time: float) -> tuple[Array, Array, Array]:
        """Return position [m], velocity [m/s] and acceleration [m/s^2] of {O} at a time [s].

        With s = t / T from 0 to 1 over the duration T, and the whole way d (Flash and Hogan, 1985):

            p = p₀ + d (10 s³ − 15 s⁴ + 6 s⁵)
            v = d 30 s² (1 − s)² / T
            a = d 60 s (1 − s) (1 − 2 s) / T²
        """
        s = min(time / self.duration, 1.0)
        start = self.X_WO[:3, 3]
        shift = self.p_WO_end - start
        return (
            start + shift * s**3 * (10.0 - 15.0 * s + 6.0 * s**2),
            shift * 30.0 * s**2 * (1.0 - s) ** 2 / self.duration,
            shift * 60.0 * s * (1.0 - s) * (1.0 - 2.0 * s) / self.duration**2,
        )

    def wrenches(self, model: ObjectModel) -> Array:
        """Return the wrenches (2, 6) at the two peaks of acceleration, about Ocm in {O}.

        Each is [torque; force] on the object [N m, N]. The orientation is constant, so there is no
        torque, and every wrench of the motion lies between these two, which are

            w = [0; m R_OW (g ẑ ± a_max)],   a_max = 10/√3 d / T².
        """
        shift = self.p_WO_end - self.X_WO[:3, 3]
        peak = PEAK_ACCELERATION * shift / self.duration**2
        forces_W = [carrying_force(model, peak), carrying_force(model, -peak)]
        return np.hstack([np.zeros((2, 3)), forces_W @ self.R_WO])


def carrying_force(model: ObjectModel, acceleration: npt.ArrayLike) -> Array:
    """Return the force (3,) in {W} [N] that gives a free object an acceleration (3,) [m/s^2]."""
    against_gravity = np.array([0.0, 0.0, GRAVITY])
    return model.mass * (np.asarray(acceleration, dtype=float) + against_gravity)


def lift_path(X_TO: npt.ArrayLike, config: Config) -> LiftPath:
    """Return the path from a resting pose (4, 4) to p_TO = `lift.p_TG`.

    Without a hand, the object's origin goes to the target of the palm.
    """
    X_WO = X_WT @ np.asarray(X_TO, dtype=float)
    p_WO_end = X_WT[:3, 3] + config.lift.p_TG
    duration = lift_duration(float(np.linalg.norm(p_WO_end - X_WO[:3, 3])), config)
    # The object may start at its target.
    duration = max(duration, config.physics.time_step)
    return LiftPath(X_WO=X_WO, p_WO_end=p_WO_end, duration=duration)


def lift_duration(distance: float, config: Config) -> float:
    """Return the shortest duration [s] of a minimum-jerk motion over a distance [m].

    Its peaks are 15/8 d/T and 10/√3 d/T², so within the limits of speed and acceleration

        T = max(15/8 d / v_max, √(10/√3 d / a_max)).
    """
    at_speed_limit = PEAK_SPEED * distance / config.lift.max_speed
    at_acceleration_limit = np.sqrt(PEAK_ACCELERATION * distance / config.lift.max_acceleration)
    return float(max(at_speed_limit, at_acceleration_limit))
