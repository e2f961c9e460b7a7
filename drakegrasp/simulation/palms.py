"""Palms around an object on the table: the simple ones first, then any number of drawn ones.

Input: points of the object's surface in {T}, where the table is z = 0: all of them, or those that a
camera saw. Output: palm poses that aim at the object, with a spread. They look down on it, slant,
or come from the side, and close across what is narrow there. `closing.closing_features` tells which
would hold. `scoring.predicting` proposes the fixed palms, and the sampler `closing` tries both.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from drakegrasp.arithmetic import Array, dot, multiply, norm, sin_cos_deg
from drakegrasp.frames import make_pose, rotation_about
from drakegrasp.hand.description import Hand
from drakegrasp.hand.finger_sweep import across, reach
from drakegrasp.mesh.cloud import smallest_rectangle

#: Turns about the vertical [degree], relative to closing across the narrow side; and turns that are
#: tried at one height only.
TURNS, DIAGONAL = (0.0, 180.0, 90.0, 270.0), (45.0, 135.0, 225.0, 315.0)
#: Angle of tilted palms, and the horizontal axes of the tilts, measured from the long side
#: [degree].
TILT, TILTED = 25.0, (0.0, 90.0, 180.0, 270.0)
#: Places along the long side, as fractions of half of it.
ASIDE = (-0.4, 0.4)
#: Angle of slanted palms from the vertical, and the directions from which they come, measured from
#: the long side [degree].
SLANT, SLANTED_FROM = 55.0, (0.0, 90.0, 180.0, 270.0)
#: Directions from which horizontal palms come, measured from the long side [degree].
BESIDE = (0.0, 45.0, 90.0, 135.0, 180.0, 225.0, 270.0, 315.0)
#: Palms from the side aim at half the object's height, or if the table is in the way, at most at
#: this fraction of it.
HIGHEST = 0.8
#: Smallest distance of a closing hand from the table [m]; distance by which other palms are higher
#: or deeper [m].
TABLE_GAP, DEEPER = 0.006, 0.02
#: Palms that are closer to each other than both limits are the same [m, rad].
SAME = 0.008, np.deg2rad(12.0)


class Shape(NamedTuple):
    """The shape of the open hand: the index of its preshape, or None, and the spread [rad]."""

    preshape: int | None
    spread: float


class FixedPalm(NamedTuple):
    """A palm pose X_TG (4, 4), the spread [rad] with which the hand closes, and its origin."""

    X_TG: Array
    spread: float
    said: str


class Palms:
    """The palms around the points of an object, for a hand in one of its preshapes.

    Attributes:
        spreads: The spreads that are tried [rad]: the first and the last usual one, or 0 for a hand
            without spread.
    """

    def __init__(self, points: Array, hand: Hand) -> None:
        """Find the object's sides.

        Args:
            points: (n, 3), points of its surface in {T} [m].
            hand: The hand.

        Raises:
            GraspError: If the points are in a vertical plane.
        """
        self._points, self._hand = points, hand
        self._axes, self._middle, self._half = smallest_rectangle(points)
        self._top, self._least = float(points[:, 2].max()), min(hand.standoffs)
        self._along = _rotation_to(self._axes[0])
        self._across = _rotation_to(across(hand)).T
        self._ahead = multiply(self._along, self._across)
        usual = np.deg2rad(hand.spreads_deg) if hand.spread.joints else np.zeros(1)
        self.spreads = tuple(dict.fromkeys((float(usual[0]), float(usual[-1]))))

        # From above, the palm is as deep as the table and the smallest stand-off allow.
        down = reach(hand, np.array([0.0, 0.0, 1.0])) + TABLE_GAP - self._top
        self._standoff = max(self._least, down)

    def fixed(self) -> list[FixedPalm]:
        """Return 30 to 70 palms, the simplest first.

        No two palms of one spread are within `SAME`.
        """
        return distinct([*self._from_above(), *self._from_the_side()])

    def above(
        self,
        turn: float,
        higher: float = 0.0,
        *,
        aside: float = 0.0,
        tilt: float = 0.0,
        towards: float = 0.0,
    ) -> Array:
        """Return the pose X_TG of a palm that looks down.

        Args:
            turn: Turn about the vertical, from closing across the narrow side [degree].
            higher: Distance above the deepest pose [m]; negative is deeper.
            aside: Place along the long side, as a fraction of half of it.
            tilt: Angle from the vertical about the point at half the height [degree].
            towards: Horizontal axis of the tilt, from the long side [degree].
        """
        # All poses look at the point at half the height, so they are relative to it.
        R = multiply(multiply(self._ahead, _rotation_z(turn)), np.diag([1.0, -1.0, -1.0]))
        X = make_pose(R, [0.0, 0.0, self._top / 2.0 + self._standoff + higher])
        if tilt:
            about = multiply(self._ahead, _rotation_z(towards)[:, 0])
            X = multiply(make_pose(rotation_about(about, np.deg2rad(tilt)), np.zeros(3)), X)
        target = self._middle + aside * self._half[0] * self._axes[0]
        return multiply(make_pose(np.eye(3), [*target, self._top / 2.0]), X)

    def beside(
        self, slant: float, where: float, turn: float, *, height: float = 0.5
    ) -> Array | None:
        """Return the pose X_TG of a palm that comes from a side; None if the table is in the way.

        Args:
            slant: Angle of the approach from the vertical [degree].
            where: Direction from which the palm comes, from the long side [degree].
            turn: Turn about the approach, from closing horizontally [degree].
            height: Height at which it looks, as a fraction of the object's.
        """
        outward = multiply(self._along, _rotation_z(where)[:, 0])
        sine, cosine = sin_cos_deg(slant)
        approach = -sine * outward - cosine * np.array([0.0, 0.0, 1.0])
        target = np.array([*self._middle, height * self._top])
        front = float(dot(self._points - target, -approach).max())
        origin = target - (front + self._least) * approach

        # The palm looks along the approach, and the table limits how low it can be.
        y = np.array([-outward[1], outward[0], 0.0])
        R = multiply(np.column_stack([np.cross(y, approach), y, approach]), _rotation_z(turn))
        R = multiply(R, self._across)
        raised = max(0.0, reach(self._hand, -R[2]) + TABLE_GAP - origin[2])
        if target[2] + raised > HIGHEST * self._top:
            return None
        return make_pose(R, origin + np.array([0.0, 0.0, raised]))

    def _from_above(self) -> Iterator[FixedPalm]:
        """Yield the fixed palms that look down on the object."""
        deepest, (spread, *wider) = -min(DEEPER, self._standoff - self._least), self.spreads
        for turn in TURNS:
            for higher in (0.0, DEEPER, deepest):
                yield FixedPalm(self.above(turn, higher), spread, "from above")
        for turn in DIAGONAL:
            yield FixedPalm(self.above(turn), spread, "from above")
        for turn in TURNS[:2]:
            for aside in ASIDE:
                said = "from above, beside the middle"
                yield FixedPalm(self.above(turn, aside=aside), spread, said)
        for towards in TILTED:
            for turn in TURNS[:2]:
                for higher in (0.0, DEEPER):
                    X_TG = self.above(turn, higher, tilt=TILT, towards=towards)
                    yield FixedPalm(X_TG, spread, "from above, tilted")
        for other in wider:
            for turn in TURNS:
                for higher in (0.0, DEEPER):
                    yield FixedPalm(self.above(turn, higher), other, "from above, spread")

    def _from_the_side(self) -> Iterator[FixedPalm]:
        """Yield the fixed palms that come from the side, and close across the vertical."""
        palms = [(SLANT, each, "slanted") for each in SLANTED_FROM]
        palms += [(90.0, each, "from the side") for each in BESIDE]
        for slant, where, said in palms:
            for turn in (0.0, 180.0):
                if (X_TG := self.beside(slant, where, turn)) is not None:
                    yield FixedPalm(X_TG, self.spreads[0], said)


def distinct(palms: list[FixedPalm]) -> list[FixedPalm]:
    """Return the palms that are not within `SAME` of an earlier one with the same spread."""
    kept: list[FixedPalm] = []
    for palm in palms:
        X, known = palm.X_TG, [k.X_TG for k in kept if k.spread == palm.spread]
        poses = np.reshape(known, (-1, 4, 4))
        cosine = (dot(poses[:, :3, :3].reshape(-1, 9), X[:3, :3].ravel()) - 1.0) / 2.0
        near = norm(poses[:, :3, 3] - X[:3, 3]) < SAME[0]
        if not (near & (cosine > np.cos(SAME[1]))).any():
            kept.append(palm)
    return kept


def _rotation_z(degrees: float) -> Array:
    return rotation_about([0.0, 0.0, 1.0], np.deg2rad(degrees))


def _rotation_to(direction: Array) -> Array:
    """Return the rotation about Tz that turns Tx to a horizontal unit direction (2,) or (3,)."""
    x, y = direction[:2]
    return np.array([[x, -y, 0.0], [y, x, 0.0], [0.0, 0.0, 1.0]])
