"""Whether links of different fingers meet before the fingertips of a grip do."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import combinations

import numpy as np

from drakegrasp.commissioning.draft.opposition import Grip
from drakegrasp.frames import Array, invert_pose, transform_points
from drakegrasp.hand.draft.model import VendorModel
from drakegrasp.hand.finger_sweep import even_points
from drakegrasp.hand.shapes import hull_planes

#: Links other than fingertips overlap by less [m]: points miss a part of what Drake sees.
SUNK = 2e-4
#: Spacing of the points by which two shapes are compared [m].
SPACING = 0.006


class Clearance:
    """The shapes of a model, as planes and points, for comparing many grips."""

    def __init__(self, model: VendorModel, palm: str) -> None:
        self._model, self._palm = model, palm
        self._links: dict[str, tuple[Array, float]] = {}
        self._shapes: dict[str, list[tuple[Array, Array, Array, float]]] = {}

    def is_clear(self, grip: Grip, postures: Iterable[Mapping[str, float]]) -> bool:
        """Return whether no links of two fingers overlap before their fingertips meet.

        Args:
            grip: The fingers.
            postures: Positions of all joints, from the open hand to the closed one.
        """
        fingers = [[joint.child for joint in m.chain.joints] for m in grip.members]
        tips = {m.chain.tip for m in grip.members}
        pairs = [(a, b) for own, other in combinations(fingers, 2) for a in own for b in other]
        for posture in postures:
            X = {
                name: self._model.pose(name, posture, self._palm)
                for finger in fingers
                for name in finger
            }
            if any(self._overlap(a, b, X, 0.0) for a, b in pairs if {a, b} <= tips):
                return True
            if any(self._overlap(a, b, X, SUNK) for a, b in pairs if not {a, b} <= tips):
                return False
        return True

    def _overlap(self, a: str, b: str, X: Mapping[str, Array], depth: float) -> bool:
        """Return whether points of one link are so deep [m] in another, or the other way round."""
        # Balls around whole links tell most pairs apart.
        X_AB = invert_pose(X[a]) @ X[b]
        (near_a, far_a), (near_b, far_b) = self._ball(a), self._ball(b)
        if np.linalg.norm(X_AB[:3, :3] @ near_b + X_AB[:3, 3] - near_a) > far_a + far_b:
            return False
        for planes_a, points_a, centre_a, radius_a in self._of(a):
            for planes_b, points_b, centre_b, radius_b in self._of(b):
                apart = transform_points(X_AB, centre_b[None])[0] - centre_a
                if np.linalg.norm(apart) > radius_a + radius_b:
                    continue
                if _inside(planes_a, transform_points(X_AB, points_b), depth):
                    return True
                if _inside(planes_b, transform_points(invert_pose(X_AB), points_a), depth):
                    return True
        return False

    def _of(self, link: str) -> list[tuple[Array, Array, Array, float]]:
        """Return planes, points and the ball around each shape of a link."""
        if link not in self._shapes:
            self._shapes[link] = []
            for shape in self._model.links[link].collisions:
                points = even_points(shape.corners(), SPACING)
                centre = (points.min(axis=0) + points.max(axis=0)) / 2.0
                radius = float(np.linalg.norm(points - centre, axis=1).max())
                self._shapes[link].append((hull_planes(points), points, centre, radius))
        return self._shapes[link]

    def _ball(self, link: str) -> tuple[Array, float]:
        """Return the centre (3,) and the radius of a ball around a link [m]."""
        if link not in self._links:
            points = np.concatenate([np.zeros((1, 3)), *(p for _, p, _, _ in self._of(link))])
            centre = (points.min(axis=0) + points.max(axis=0)) / 2.0
            self._links[link] = centre, float(np.linalg.norm(points - centre, axis=1).max())
        return self._links[link]


def _inside(planes: Array, points: Array, depth: float) -> bool:
    """Return whether one of points (n, 3) is inside planes (m, 4) by more than a depth [m]."""
    heights = points @ planes[:, :3].T + planes[:, 3]
    return bool((heights.max(axis=1) < -depth).any())
