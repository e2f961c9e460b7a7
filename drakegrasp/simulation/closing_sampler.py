"""The sampler `closing`: palms that close well on the object's surface, from all sides.

At a resting pose the first palms are the fixed ones of `palms.Palms`. Then palms are drawn in
rounds: from the same family, with random places, heights, turns and slants; near palms that close
well; and at surface points, for rims and handles of what is too wide for the hand. Geometry closes
the hand on the surface (`closing.closing_features`), and palms that close much worse than the best
ones are left out. Directions take turns, and so do palms from above, slanted and from the side.
Palms near an earlier one are left out, until there is no other.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from drakegrasp.arithmetic import Array, dot, multiply, norm, sin_cos_deg
from drakegrasp.config import Config
from drakegrasp.frames import invert_pose, make_pose, rotation_about, transform_points
from drakegrasp.grasp import NEAR_SHIFT, NEAR_TURN, approach_cells
from drakegrasp.hand.description import load_hand
from drakegrasp.mesh.cloud import Solid
from drakegrasp.mesh.surfaces import even_points, on_faces
from drakegrasp.objects.model import ObjectModel
from drakegrasp.seeding import Stream
from drakegrasp.simulation.attempt import palm_motion
from drakegrasp.simulation.closing import centre, closing_features
from drakegrasp.simulation.palms import DEEPER, Palms, Shape

#: Number of surface points around which palms are made.
POINTS = 2048
#: A palm is good if its score is at least a fraction of the score of the best few: first the first
#: one, which then falls to the second one in steps of the third one. Least score of a good palm.
GOOD, BEST, LEAST = (0.9, 0.8, 0.1), 5, 0.4
#: Palms are near if their grasps would not be distinct; if all good palms are near others, both
#: limits shrink by a factor, down to a fraction of them. Number of rounds in a row in vain after
#: which there are no more palms then.
NEARER, NEAREST, LAST_ROUNDS = 0.7, 0.1, 10
#: Least downward component of the approach of palms from above and of slanted ones: the sines of
#: 60 and 30 degrees.
ABOVE_DOWN, SLANTED_DOWN = float(np.sqrt(0.75)), 0.5
#: While palms from other sides close well, at most so many palms from above for each of these.
MOST_ABOVE = 1.5
#: Number of rounds in a row without a good palm after which a side counts as not free.
PATIENCE = 1
#: The kinds of palms of each side, and the numbers of palms drawn in a round.
SIDES = ("above", "slanted", "beside")
ROUND = {"above": 16, "slanted": 14, "beside": 14, "near": 4, "surface": 6}
#: Random numbers of a palm.
NUMBERS = 7
#: Ranges of the draws: turns from the axes, tilts and slants from the vertical [degree], places
#: along the long side and heights, as fractions of half of it and of the object's height.
YAW, TILTS, SLANTS = 20.0, (15.0, 35.0), {"slanted": (30.0, 60.0), "beside": (60.0, 100.0)}
ALONG, HEIGHTS = 0.6, (0.25, 0.75)
#: Standard deviations of palms near good ones [m, degree].
SHIFT, TURN = 0.012, 15.0
#: Largest distance of palms at surface points beyond the smallest stand-off [m]; largest upward
#: component of their approach.
FARTHER, UPWARD = 0.03, 0.17
#: Grids of the upward direction and of the height [m] at which the object rests. These are
#: simulated, so their last bits differ between machines, and draws must not.
UP_GRID, HEIGHT_GRID = 2.0**-10, 2.0**-14


class ScoredPalm(NamedTuple):
    """A palm pose X_LG (4, 4), the hand's shape, and the score with which it closes."""

    X_LG: Array
    shape: Shape
    score: float

    @property
    def side(self) -> int:
        """From where it approaches: 0 from above, 1 slanted, 2 from the side."""
        down = -float(self.X_LG[2, 2])
        return 0 if down >= ABOVE_DOWN else 1 if down >= SLANTED_DOWN else 2


class Closing:
    """The palms of one resting pose."""

    def __init__(self, model: ObjectModel, X_TO: Array, stream: Stream, config: Config) -> None:
        """Find the object's sides, and the fixed palms that close well.

        Raises:
            HandError: If several of the hand's fingers move one link.
        """
        self._model, self._hand, self._stream = model, load_hand(config.hand_source), stream

        # Points of the surface in {L}, with outward normals.
        self._X_LO = level_pose(X_TO)
        self._X_OL = invert_pose(self._X_LO)
        self._points, self._normals = _surface(model, self._X_LO)
        inside = np.argwhere(model.field.values < 0.0)
        middle = inside.mean(axis=0) * model.field.spacing + model.field.origin
        self._solid = Solid(field=model.field, middle=middle)

        # The palms of each preshape.
        preshapes = range(len(self._hand.preshapes)) if self._hand.preshapes else [None]
        self._palms = {i: Palms(self._points, self._hand.at(i)) for i in preshapes}
        self._shapes = [Shape(i, s) for i, palms in self._palms.items() for s in palms.spreads]
        fixed = [
            (palm.X_TG, Shape(i, palm.spread))
            for i, palms in self._palms.items()
            for palm in palms.fixed()
        ]

        # The order, the palms of each side that wait for their turn, best first; the best scores.
        self._order: list[ScoredPalm] = []
        self._waiting: list[list[ScoredPalm]] = [[], [], []]
        self._best = [0.0] * BEST

        # What counts as good and as near, and the rounds in a row without a good palm of each side.
        self._good, self._near, self._vain = GOOD[0], 1.0, [0, 0, 0]
        self._add(fixed, range(3))

    def poses(self) -> Iterator[tuple[Array, Shape] | None]:
        """Yield palm poses X_OG (4, 4) and the shape of the hand, as long as palms close well.

        None tells that the palms that follow are nearer to those before.
        """
        rounds = 0  # in a row without a palm
        while True:
            palm = self._next()
            if palm is not None:
                rounds = 0
                yield multiply(self._X_OL, palm.X_LG), palm.shape
            elif min(self._vain) < PATIENCE:
                sides = [s for s in range(3) if self._vain[s] < PATIENCE and not self._good_of(s)]
                self._add(self._draw(sides), sides)
            elif self._good > GOOD[1]:
                self._good, self._vain = self._good - GOOD[2], [PATIENCE - 1] * 3
            elif rounds == LAST_ROUNDS or not self._order:
                return
            else:
                rounds += self._near == NEAREST
                self._near, self._vain = max(NEARER * self._near, NEAREST), [0, 0, 0]
                yield None

    def _next(self) -> ScoredPalm | None:
        """Return the next palm, now in the order, or None if more must be drawn first."""
        good = [self._good_of(side) for side in range(3)]
        for side in range(3):
            if good[side]:
                self._vain[side] = min(self._vain[side], PATIENCE - 1)

        # Palms from above do not outnumber others by much.
        counts = np.bincount([palm.side for palm in self._order], minlength=3)
        others_are_free = min(self._vain[1:]) < PATIENCE
        if others_are_free and counts[0] >= MOST_ABOVE * (counts[1] + counts[2] + 1):
            good[0] = []
        palms = [palm for of_side in good for palm in of_side]
        if not palms:
            return None

        # The next palm comes from the direction with the fewest palms so far; among equal ones from
        # the side with the fewest; and among these it is the one that closes best.
        before, cells = self._cells(self._order), self._cells(palms)
        turns = [
            (before.count(cell), counts[palm.side], -palm.score)
            for palm, cell in zip(palms, cells, strict=True)
        ]
        palm = palms[min(range(len(palms)), key=turns.__getitem__)]
        self._order.append(palm)

        # Palms that are near it, and the palm itself, wait no longer.
        for waiting in self._waiting:
            near = self._near_any(_stacked(waiting), palm.X_LG[None])
            waiting[:] = [each for each, is_near in zip(waiting, near, strict=True) if not is_near]
        return palm

    def _cells(self, palms: Sequence[ScoredPalm]) -> list[int]:
        """Return the cell of directions of each palm's approach, in {O}."""
        cells: list[int] = approach_cells(multiply(self._X_OL, _stacked(palms))).tolist()
        return cells

    def _good_of(self, side: int) -> list[ScoredPalm]:
        """Return the good palms of a side that wait, best first."""
        least = max(LEAST, self._good * self._best[0])
        return [palm for palm in self._waiting[side] if palm.score >= least]

    def _add(self, drawn: Sequence[tuple[Array, Shape]], sides: Sequence[int]) -> None:
        """Close the hand at palms drawn for some sides; those that close well wait their turn."""
        X_LG = np.reshape([X for X, _ in drawn], (-1, 4, 4))
        near = self._near_any(X_LG, _stacked(self._order))
        palms = self._closed(
            [each for each, is_near in zip(drawn, near, strict=True) if not is_near]
        )
        self._best = sorted([*self._best, *(palm.score for palm in palms)])[-BEST:]
        for side, waiting in enumerate(self._waiting):
            waiting += [palm for palm in palms if palm.side == side and palm.score >= LEAST]
            waiting.sort(key=lambda palm: -palm.score)
            if self._good_of(side):
                self._vain[side] = 0
            elif side in sides:
                self._vain[side] += 1

    def _near_any(self, X_LG: Array, others: Array) -> Array:
        """Return whether palms (m,) are near any of others (n, 4, 4)."""
        shift = norm(X_LG[:, None, :3, 3] - others[:, :3, 3])
        R, others_R = (np.reshape(X[:, :3, :3], (-1, 9)) for X in (X_LG, others))
        cosine = (dot(R[:, None], others_R) - 1.0) / 2.0
        closer = cosine >= sin_cos_deg(self._near * NEAR_TURN)[1]
        return np.asarray((closer & (shift <= self._near * NEAR_SHIFT)).any(axis=1))

    def _closed(self, drawn: Sequence[tuple[Array, Shape]]) -> list[ScoredPalm]:
        """Return palms with their scores."""
        palms = list[ScoredPalm]()
        for shape in self._shapes:
            own = [X_LG for X_LG, other in drawn if other == shape]
            if own:
                hand = self._hand.at(shape.preshape)
                X_OG = centre(self._model, hand, shape.spread, multiply(self._X_OL, np.array(own)))
                found = closing_features(self._solid, hand, shape.spread, X_OG, X_TS=self._X_LO)
                rows = zip(multiply(self._X_LO, X_OG), found["score"].tolist(), strict=True)
                palms += [ScoredPalm(X_LG, shape, score) for X_LG, score in rows]
        return palms

    def _draw(self, sides: Sequence[int]) -> list[tuple[Array, Shape]]:
        """Return the palms of a round for some sides, as far as the table leaves room for them."""
        left_out = [kind for side, kind in enumerate(SIDES) if side not in sides]
        kinds = [kind for kind, number in ROUND.items() for _ in range(number)]
        kinds = [kind for kind in kinds if kind not in left_out]
        numbers = self._stream.uniform(NUMBERS * len(kinds)).reshape(-1, NUMBERS)
        drawn = [self._palm(kind, *row) for kind, row in zip(kinds, numbers.tolist(), strict=True)]
        return [(X_LG, shape) for X_LG, shape in drawn if X_LG is not None]

    def _palm(self, kind: str, first: float, *u: float) -> tuple[Array | None, Shape]:
        """Return a palm of a kind of `ROUND`, from numbers in [0, 1); None if there is no room."""
        if kind == "near" and self._order:
            # Around one of the better half of the palms so far.
            better = sorted(self._order, key=lambda palm: -palm.score)
            parent = better[int(first * (len(better) + 1) / 2.0)]
            spread = np.sqrt(3.0) * (2.0 * np.array(u) - 1.0)  # of standard deviation 1
            motion = palm_motion(spread, SHIFT, float(np.deg2rad(TURN)))
            return multiply(parent.X_LG, motion), parent.shape

        shape = self._shapes[int(first * len(self._shapes))]
        palms = self._palms[shape.preshape]
        if kind in SLANTS:
            low, high = SLANTS[kind]
            turn = 180.0 * int(2.0 * u[2]) + YAW * (2.0 * u[3] - 1.0)
            height = HEIGHTS[0] + u[4] * (HEIGHTS[1] - HEIGHTS[0])
            return palms.beside(low + u[0] * (high - low), 360.0 * u[1], turn, height=height), shape
        if kind == "surface":
            return self._at_surface(u), shape
        X_LG = palms.above(
            90.0 * int(4.0 * u[0]) + YAW * (2.0 * u[1] - 1.0),
            DEEPER * (2.0 * u[2] - 1.0),
            aside=ALONG * (2.0 * u[3] - 1.0),
            tilt=TILTS[0] + u[4] * (TILTS[1] - TILTS[0]),
            towards=360.0 * u[5],
        )
        return X_LG, shape

    def _at_surface(self, u: Sequence[float]) -> Array | None:
        """Return a palm that looks at a surface point against its normal; None from below."""
        i = int(u[0] * len(self._points))
        z = -self._normals[i]
        if z[2] > UPWARD:
            return None
        helper = np.array([1.0, 0.0, 0.0] if abs(z[0]) < 0.9 else [0.0, 1.0, 0.0])
        x = np.cross(helper, z)
        x = x / norm(x)
        R = multiply(np.column_stack([x, np.cross(z, x), z]), _turned(360.0 * u[1]))
        least = min(self._hand.standoffs)
        return make_pose(R, self._points[i] - (least + FARTHER * u[2]) * z)


def _stacked(palms: Sequence[ScoredPalm]) -> Array:
    return np.reshape([palm.X_LG for palm in palms], (-1, 4, 4))


def level_pose(X_TO: Array) -> Array:
    """Return X_LO (4, 4), an object's resting pose without its yaw, on coarse grids.

    {L} is {T} turned about the vertical. Resting poses that differ by rounding have one X_LO, but
    for rare ones between two grid points.
    """
    up_O = np.rint(X_TO[2, :3] / UP_GRID) * UP_GRID
    z = up_O / norm(up_O)
    x = np.cross([0.0, 1.0, 0.0] if abs(z[1]) < 0.9 else [0.0, 0.0, 1.0], z)
    x = x / norm(x)
    height = float(np.rint(X_TO[2, 3] / HEIGHT_GRID) * HEIGHT_GRID)
    return make_pose(np.stack([x, np.cross(z, x), z]), [0.0, 0.0, height])


def _surface(model: ObjectModel, X_LO: Array) -> tuple[Array, Array]:
    """Return points (n, 3) that cover the surface evenly, not below the table, and normals."""
    vertices, faces = model.visual_vertices, model.visual_faces.astype(np.int64)
    points, face = on_faces(vertices, faces, even_points(POINTS))
    a, b, c = np.moveaxis(vertices[faces[face]], 1, 0)
    outward = np.cross(b - a, c - a)
    outward = outward / norm(outward)[:, None]
    p_LQ = np.maximum(transform_points(X_LO, points), [-np.inf, -np.inf, 0.0])
    return p_LQ, multiply(outward, X_LO[:3, :3].T)


def _turned(degrees: float) -> Array:
    return rotation_about([0.0, 0.0, 1.0], np.deg2rad(degrees))
