"""An attempt: what a trial starts from. It is plain data and needs no Drake.

Samplers turn palm poses into attempts (`candidates`), `posture` turns a posture from outside into
an attempt, and `trial.run_attempt` runs the trial of an attempt.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from drakegrasp.arithmetic import Array
from drakegrasp.simulation.conditions import Conditions


class Source(IntEnum):
    """The sampler of a palm pose. Values are stored in files: never renumber them."""

    ROTATIONS = 0
    NORMALS = 1
    OWN = 3  # any other sampler: one of another package, or a user-defined one
    POSTURES = 4  # no sampler: the posture comes from outside
    CLOSING = 5


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
