"""From which sides palm poses approach an object, and how much of the half sphere they cover.

In: palm poses of an object at rest. Out: directions over the table, a share of covered directions,
and their places on a flat map that keeps areas.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from drakegrasp.frames import Array

#: A direction is covered if an approach is at most this far from it [deg].
NEAR_DEG = 10.0
#: Directions of the half sphere that are looked at.
PROBES = 2000


def approach_directions(X_TO: Array, X_OG: Array) -> Array:
    """Return the unit directions (n, 3) in {T} from which palms (n, 4, 4) come: -Gz."""
    return np.asarray(-X_OG[:, :3, 2] @ X_TO[:3, :3].T)


def coverage(directions: Array) -> float:
    """Return which share of the half sphere over the table lies near an approach.

    Near is NEAR_DEG or less. The directions that are looked at lie on a spiral that gives each the
    same area (Fibonacci lattice; Gonzalez 2010, Mathematical Geosciences 42).

    Args:
        directions: (n, 3), unit, in {T}.
    """
    if not len(directions):
        return 0.0
    i = np.arange(PROBES)
    height, turn = (i + 0.5) / PROBES, i * np.pi * (3.0 - np.sqrt(5.0))
    radius = np.sqrt(1.0 - height**2)
    probes = np.column_stack([radius * np.cos(turn), radius * np.sin(turn), height])

    # The chord of the angle; a direction on the limit may not depend on rounding.
    chord = 2.0 * np.sin(np.deg2rad(NEAR_DEG) / 2.0) + 1e-9
    distance, _ = KDTree(directions).query(probes)
    return float(np.count_nonzero(distance <= chord)) / PROBES


def map_directions(directions: Array) -> Array:
    """Return the places (n, 2) of directions on Lambert's equal-area map about +Tz.

    Straight up is the origin, the horizon the unit circle, and what comes from below is outside of
    it.

    Args:
        directions: (n, 3), unit, in {T}.
    """
    # Of the angle from +Tz: r = sqrt(2) sin(angle / 2) is 1 at the horizon.
    across = np.hypot(directions[:, 0], directions[:, 1])
    r = np.sqrt(np.maximum(1.0 - directions[:, 2], 0.0))
    scale = np.divide(r, across, out=np.zeros_like(r), where=across > 1e-12)
    return np.asarray(directions[:, :2] * scale[:, None])
