"""How near the hand comes to the table: its least height above the table's top on a way.

In: the states in which a scene was looked at, in order. Out: the least height of the hand's
collision shapes over the way between them. It reads positions only, so the simulation is the same
with and without it.

Between two looks each joint moves one way, and a link depends on the joints of its own finger,
which move in fixed ratios: a straight way from state to state in the space of the joints passes
through all postures of each finger, whichever finger was faster.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from drakegrasp.arithmetic import dot, multiply
from drakegrasp.frames import X_WT, Array, invert_pose
from drakegrasp.hand.description import Hand
from drakegrasp.hand.kinematics import posed_links
from drakegrasp.hand.shapes import link_rims
from drakegrasp.simulation.scene import Scene, hand_joint_names, hand_positions, palm_pose

#: Largest step of a joint between two postures whose height is computed [rad or m]. A point 0.3 m
#: from its joint is at most 0.02 mm lower in between.
STEP = 0.02


class Way:
    """The states of a hand in one attempt, from look to look."""

    def __init__(self) -> None:
        self._states: list[Array] = []
        self._scene: Scene | None = None

    def look(self, scene: Scene) -> None:
        """Add the state of the scene now; all scenes are of one hand."""
        X_TG = multiply(invert_pose(X_WT), palm_pose(scene))
        self._states.append(np.concatenate([X_TG[2], hand_positions(scene)]))
        self._scene = scene

    def clearance(self) -> float:
        """Return the least height of the hand above the table's top [m]; negative below it."""
        assert self._scene is not None
        states = _between(np.array(self._states))
        names = hand_joint_names(self._scene)
        return least_height(self._scene.hand, names, states[:, 4:], states[:, :4])


def least_height(hand: Hand, names: list[str], q: Array, up_G: Array) -> float:
    """Return the least height of a hand above the table's top in n postures [m].

    Args:
        hand: The hand.
        names: Of its j joints.
        q: Their positions (n, j) [rad or m].
        up_G: The third rows (n, 4) of the palm's poses X_TG.
    """
    lowest, rims = np.inf, link_rims(hand)
    for link, X_GL in posed_links(hand, dict(zip(names, q.T, strict=True))).items():
        if not len(rims[link]):
            continue
        up_L, (p, axis) = multiply(up_G[:, None], X_GL), (rims[link][:, :3], rims[link][:, 3:6])
        heights = dot(up_L[..., :3], p) + up_L[..., 3]
        # The lowest point of a disc is its radius times the sine of its tilt below the centre.
        round_ = rims[link][:, 6] > 0.0
        if round_.any():
            cosine = dot(up_L[..., :3], axis[round_])
            sine = np.sqrt(np.maximum(0.0, 1.0 - cosine**2))
            heights[:, round_] -= rims[link][round_, 6] * sine
        lowest = min(lowest, float(heights.min()))
    return lowest


def _between(states: Array) -> Array:
    """Return states (m, ...) with steps of at most `STEP` from states (n, 4 + j)."""
    parts = [states[:1]]
    for a, b in pairwise(states):
        count = int(np.ceil(np.abs(b - a)[4:].max() / STEP))
        if count:
            share = np.arange(1, count + 1)[:, None] / count
            parts.append(a + share * (b - a))
        else:
            parts.append(b[None])
    return np.concatenate(parts)
