"""Where a fingertip touches: the part of its surface that faces the closing motion.

In: the shapes of a fingertip link and how it moves. Out: a `Pad` in the link's frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drakegrasp.frames import Array
from drakegrasp.hand.finger_sweep import even_points
from drakegrasp.hand.shapes import ray_span

#: A direction this near to an axis of the link is taken for the axis [rad].
SNAP = np.deg2rad(12.0)
#: Share of a link, from its end, that is pad; and of its thickness. The second is at least so deep
#: and at most so deep [m]: what is pressed sinks in.
LENGTH, DEPTH, DEEP = 0.55, 0.45, (0.004, 0.008)
#: Distance of the pad point from the end, in thicknesses, and its bounds [m].
FROM_END, NEAR_END = 0.7, (0.004, 0.014)
#: Spacing of points on the surface [m].
SPACING = 0.0015


@dataclass(frozen=True, kw_only=True, eq=False)
class Pad:
    """A pad in its link's frame.

    Attributes:
        point: (3,), where contacts usually are [m].
        normal: (3,), unit, out of the link.
        along: (3,), unit, towards the end of the finger.
        depth: How deep below the point the region reaches [m].
        back: How far behind the point, along the finger, it reaches [m].
    """

    point: Array
    normal: Array
    along: Array
    depth: float
    back: float

    def region(self) -> list[list[float]]:
        """Return the half-spaces of the hand file's `pad_region`."""
        planes = []
        for direction, space in ((self.normal, self.depth), (self.along, self.back)):
            n = np.round(direction, 4) + 0.0
            planes.append([*n.tolist(), round(float(n @ self.point) - space, 5) + 0.0])
        return planes


def end_of(points: Array, along: Array | None) -> tuple[Array, Array]:
    """Return the end (3,) of a link, and the unit direction to it (3,).

    Args:
        points: (n, 3), of its surface, in the link's frame [m].
        along: Direction of the finger; if None it leads from the origin, where the joint is.
    """
    if along is None:
        centre = points.mean(axis=0)
        far = points[np.linalg.norm(points, axis=1) > 0.85 * np.linalg.norm(points, axis=1).max()]
        along = far.mean(axis=0) if far.mean(axis=0) @ centre > 0.0 else centre
        along = along / np.linalg.norm(along)
    heights = points @ along
    end = points[heights > heights.max() - 0.003]
    return end.mean(axis=0), along


def surface_points(parts: Sequence[Array]) -> Array:
    """Return points (n, 3) on convex parts of corners (m, 3) each [m]."""
    return np.concatenate([even_points(part, SPACING) for part in parts])


def find_pad(parts: Sequence[Array], points: Array, normal: Array, along: Array) -> Pad:
    """Return the pad of a link of convex parts (n, 3) [m], in its frame.

    Args:
        parts: Corners of each.
        points: (m, 3), of their surfaces.
        normal: Direction (3,) in which the link moves when it closes.
        along: Direction (3,) towards the end of the finger.
    """
    normal = snapped(normal)
    along = along - (along @ normal) * normal
    along = snapped(along / np.linalg.norm(along))
    across = np.cross(normal, along)

    # The level of the pad point: near the end, in the middle of what is there.
    heights = points @ along
    top, length = float(heights.max()), float(np.ptp(heights))
    near = points[heights > top - 0.4 * length]
    thickness = float(np.ptp(near @ normal))
    level = top - float(np.clip(FROM_END * thickness, *NEAR_END))
    level = max(level, top - 0.45 * length)
    at = points[np.abs(heights - level) < 2.0 * SPACING]
    front = at[at @ normal > (at @ normal).max() - 0.002]
    sides = front @ across
    middle = float(sides.max() + sides.min()) / 2.0

    # The surface there: a ray along the normal leaves the last of the parts.
    start = level * along + middle * across + (points @ normal).min() * normal
    spans = [ray_span(part, start, normal) for part in parts]
    leaves = [span[1] for span in spans if span is not None and span[1] >= 0.0]
    height = max(leaves) if leaves else float((at @ normal).max() - start @ normal)
    depth = float(np.clip(DEPTH * thickness, *DEEP))
    point = start + height * normal
    return Pad(
        point=np.round(point, 5) + 0.0,
        normal=normal,
        along=along,
        depth=depth,
        back=max(LENGTH * length - (top - level), 0.004),
    )


def snapped(direction: Array) -> Array:
    """Return a unit direction (3,), or the axis that is near to it."""
    direction = direction / np.linalg.norm(direction)
    axis = int(np.argmax(np.abs(direction)))
    if np.arccos(min(abs(direction[axis]), 1.0)) < SNAP:
        return np.asarray(np.sign(direction[axis]) * np.eye(3)[axis])
    return np.asarray(direction)
