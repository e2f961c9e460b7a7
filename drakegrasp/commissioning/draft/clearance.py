"""Whether links of different fingers meet before the fingertips of a grip do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from drakegrasp.commissioning.draft.opposition import Grip
from drakegrasp.commissioning.motion_checks import OVERLAP
from drakegrasp.frames import Array, invert_pose, transform_points
from drakegrasp.hand.finger_sweep import even_points
from drakegrasp.hand.shapes import hull_planes
from drakegrasp.hand.vendor.model import VendorModel

#: Spacing of the points by which two shapes are compared [m].
SPACING = 0.006


class Clearance:
    """The shapes of a model, as planes and points, for comparing many grips."""

    def __init__(self, model: VendorModel, palm: str) -> None:
        self._model, self._palm = model, palm
        self._shapes: dict[str, list[tuple[Array, Array]]] = {}

    def is_clear(self, grip: Grip, postures: Sequence[Mapping[str, float]]) -> bool:
        """Return whether no two links of its fingers, but fingertips, overlap in the postures."""
        fingers = [[joint.child for joint in m.chain.joints] for m in grip.members]
        tips = {m.chain.tip for m in grip.members}
        for posture in postures:
            X = {
                name: self._model.pose(name, posture, self._palm)
                for finger in fingers
                for name in finger
            }
            for i, own in enumerate(fingers):
                for other in fingers[:i]:
                    pairs = ((a, b) for a in own for b in other if not {a, b} <= tips)
                    if any(self._overlap(a, b, X) for a, b in pairs):
                        return False
        return True

    def _overlap(self, a: str, b: str, X: Mapping[str, Array]) -> bool:
        """Return whether points of one link are in another one, or the other way round."""
        X_AB = invert_pose(X[a]) @ X[b]
        for planes_a, points_a in self._of(a):
            for planes_b, points_b in self._of(b):
                if _inside(planes_a, transform_points(X_AB, points_b)):
                    return True
                if _inside(planes_b, transform_points(invert_pose(X_AB), points_a)):
                    return True
        return False

    def _of(self, link: str) -> list[tuple[Array, Array]]:
        """Return planes and points of each shape of a link."""
        if link not in self._shapes:
            corners = [shape.corners() for shape in self._model.links[link].collisions]
            self._shapes[link] = [(hull_planes(c), even_points(c, SPACING)) for c in corners]
        return self._shapes[link]


def _inside(planes: Array, points: Array) -> bool:
    """Return whether one of points (n, 3) is inside planes (m, 4) by more than `OVERLAP`."""
    heights = points @ planes[:, :3].T + planes[:, 3]
    return bool((heights.max(axis=1) < -OVERLAP).any())
