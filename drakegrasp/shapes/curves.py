"""Curves in the plane: corners and sizes in metres come in, evenly spaced points go out.

A curve is a polyline. It is either a profile (r, z) that `drakegrasp.shapes.solids` revolves about
z, or an outline (x, y) that it moves along a path.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import numpy.typing as npt
from scipy.interpolate import PchipInterpolator

from drakegrasp.arithmetic import sin_cos_deg
from drakegrasp.frames import Array

#: Usual edge length where fingers touch [m], which is below the width of a fingertip.
EDGE = 0.006

#: Edge lengths of objects with many parts, and of large flat sides [m].
BROAD, LARGE = 1.3 * EDGE, 1.8 * EDGE

#: Edges inside a cavity or below a foot are longer by this factor, since no finger touches them.
COARSE = 1.7

#: Possible numbers of points of a ring: few, so that neighbouring rings mostly have equal numbers.
RING_SIZES = np.array([8, 12, 16, 24, 32, 48, 64])

#: A piece of a curve starts at the end of the previous piece if they are this close [m].
MEETS = 1e-9

#: Distance from its ends at which an inset profile starts to follow the original profile [m].
OVERLAP = 0.001


def resample(points: npt.ArrayLike, step: float) -> Array:
    """Return a polyline (n, d) with its corners kept and no piece longer than `step` [m]."""
    corners = np.asarray(points, dtype=float)
    pieces = [corners[:1]]
    for start, end in pairwise(corners):
        count = max(1, int(np.ceil(np.linalg.norm(end - start) / step - 1e-6)))
        fractions = np.linspace(0.0, 1.0, count + 1)[1:, None]
        pieces.append(start + fractions * (end - start))
    return np.concatenate(pieces)


def spaced(step: float, *knots: float) -> Array:
    """Return numbers (n,) from knot to knot with steps of at most `step`."""
    return resample([[knot] for knot in knots], step)[:, 0]


def scaled(shares: npt.ArrayLike, *sizes: float) -> Array:
    """Return points (n, d) whose coordinates are given as fractions of the sizes (d,) [m]."""
    return np.asarray(shares, dtype=float) * sizes


def joined(*pieces: npt.ArrayLike) -> Array:
    """Return curves (n, d) as one curve; a common end point of two pieces occurs once."""
    curve = np.asarray(pieces[0], dtype=float)
    for piece in pieces[1:]:
        points = np.asarray(piece, dtype=float)
        meets = np.abs(points[0] - curve[-1]).max() < MEETS
        curve = np.vstack([curve, points[int(meets) :]])
    return curve


def smooth(points: npt.ArrayLike, step: float) -> Array:
    """Return points (n, d) about `step` [m] apart on a curve through `points` (k, d).

    The curve is a monotone cubic in the chord length: it does not overshoot.
    """
    knots = np.asarray(points, dtype=float)
    fine = PchipInterpolator(arc_length(knots), knots)(np.linspace(0.0, arc_length(knots)[-1], 400))
    return spread_evenly(fine, step)


def between(knots: npt.ArrayLike, at: npt.ArrayLike) -> Array:
    """Return the values at `at` (n,) of a monotone cubic through knots (k, 2) or (k, 1 + d)."""
    rows = np.asarray(knots, dtype=float)
    values = rows[:, 1] if rows.shape[1] == 2 else rows[:, 1:]
    return np.asarray(PchipInterpolator(rows[:, 0], values)(at))


def inset(side: npt.ArrayLike, distance: float, *, floor: float) -> Array:
    """Return the profile `side` (n, 2) moved inwards by `distance` [m] and cut at z = `floor` [m].

    `side` is a profile (r, z) with rising z. The result ends at the same height.
    """
    fine = resample(side, 0.0005)
    height = fine[-1, 1]
    tangent = np.gradient(fine, arc_length(fine), axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    moved = fine + distance * np.column_stack([-tangent[:, 1], tangent[:, 0]])
    moved = moved[np.argsort(moved[:, 1], kind="stable")]
    inside = moved[(moved[:, 1] > floor + OVERLAP) & (moved[:, 1] < height - OVERLAP)]
    ends = [(np.interp(z, moved[:, 1], moved[:, 0]), z) for z in (floor, height)]
    return np.vstack([ends[0], inside, ends[1]])


def bevelled(radius: float, height: float, bevel: float) -> list[tuple[float, float]]:
    """Return the corners (r, z) of an upright wall with bevelled foot and head, off the axis."""
    foot = foot_and_wall(radius, height - bevel, bevel)
    return [*foot, (radius - bevel, height)]


def foot_and_wall(radius: float, height: float, bevel: float) -> list[tuple[float, float]]:
    """Return the corners (r, z) of an upright wall with a bevelled foot only."""
    return [(radius - bevel, 0.0), (radius, bevel), (radius, height)]


def arch(
    a: float, b: float, *, x: float = 0.0, z: float, degrees: tuple[float, float], count: int
) -> Array:
    """Return an arc (count, 3) of an ellipse of half-axes `a` and `b` [m] in the plane y = 0.

    Args:
        a: Half-axis along x [m].
        b: Half-axis along z [m].
        x: Coordinate of the centre [m].
        z: Coordinate of the centre [m].
        degrees: Angles at which the arc starts and ends [deg].
        count: Number of points.
    """
    s, c = sin_cos_deg(np.linspace(*degrees, count))
    return np.column_stack([x + a * c, 0.0 * c, z + b * s])


def ellipse(a: float, b: float, *, edge: float) -> Array:
    """Return an ellipse (n, 2) with half-axes `a` and `b` [m], counter-clockwise."""
    angles = ring_angles(ring_size((a + b) / 2.0, edge))
    return np.column_stack([a * np.cos(angles), b * np.sin(angles)])


def rounded_polygon(corners: npt.ArrayLike, radius: float, *, edge: float) -> Array:
    """Return a convex polygon (n, 2), counter-clockwise, with corners rounded by `radius` [m]."""
    points = np.asarray(corners, dtype=float)
    outline = []
    for before, corner, after in zip(
        np.roll(points, 1, axis=0), points, np.roll(points, -1, axis=0), strict=True
    ):
        u = (before - corner) / np.linalg.norm(before - corner)
        v = (after - corner) / np.linalg.norm(after - corner)
        half = np.arccos(np.clip(u @ v, -1.0, 1.0)) / 2.0
        centre = corner + radius / np.sin(half) * (u + v) / np.linalg.norm(u + v)
        touch = corner + u * radius / np.tan(half) - centre
        start = np.arctan2(touch[1], touch[0])
        turn = np.pi - 2.0 * half
        count = max(2, int(np.ceil(radius * turn / edge)))
        angles = start + np.linspace(0.0, turn, count + 1)
        outline.append(centre + radius * np.column_stack([np.cos(angles), np.sin(angles)]))
    ring = np.concatenate(outline)
    return resample(np.vstack([ring, ring[:1]]), edge)[:-1]


def rounded_rectangle(width: float, depth: float, radius: float, *, edge: float) -> Array:
    """Return a centred rectangle (n, 2) of `width` x `depth` [m] with rounded corners."""
    x, y = width / 2.0, depth / 2.0
    return rounded_polygon([(x, -y), (x, y), (-x, y), (-x, -y)], radius, edge=edge)


def ring_size(radius: float, edge: float) -> int:
    """Return the number of points of a ring of `radius` [m] for edges of about `edge` [m]."""
    wanted = 2.0 * np.pi * radius / edge
    return int(RING_SIZES[np.argmin(np.abs(np.log(RING_SIZES / wanted)))])


def ring_angles(count: int) -> Array:
    """Return the angles (count,) [rad] of a ring, from 0."""
    return 2.0 * np.pi * np.arange(count) / count


def arc_length(points: Array) -> Array:
    """Return the length along a polyline (n, d) at each of its points, (n,) [m]."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


def spread_evenly(points: Array, step: float) -> Array:
    """Return points (m, d) spread evenly along a polyline (n, d), about `step` [m] apart."""
    s = arc_length(points)
    even = np.linspace(0.0, s[-1], max(1, round(s[-1] / step)) + 1)
    return np.column_stack([np.interp(even, s, column) for column in points.T])
