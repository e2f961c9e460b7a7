"""Paths of points on a hand's surface while its fingers close at one spread angle.

Input: a `Hand` and a spread. Output: `HandPaths` in the palm frame. It has the points of the links
that closing does not move. For each finger it has the points of the links that the finger moves, at
closing positions from the open hand to the limit. The positions are half a degree apart (0.9 mm for
a prismatic joint). This is geometry only, without a simulation. "Closing angle" also means the
position [m] of a closing joint that slides.

The module also computes how the fingertips close on something between them: the `Opposition` of a
hand, two groups of fingers that close against each other, and the `Pinch` in which the groups hold
something of a given width.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull

from drakegrasp.arithmetic import dot, multiply, norm
from drakegrasp.frames import Array, invert_pose, transform_points
from drakegrasp.hand.description import Hand
from drakegrasp.hand.file_format import PAD_BAND, Finger
from drakegrasp.hand.kinematics import (
    closed_positions,
    coordinate_limits,
    fingertip_poses,
    link_poses,
)
from drakegrasp.hand.parsing import KEPT_HANDS
from drakegrasp.hand.shapes import link_shapes
from drakegrasp.mesh.distance_field import DistanceField, make_distance_field
from drakegrasp.mesh.surfaces import cover_triangles

Points = npt.NDArray[np.float32]

#: Step between two closing angles of a path, in units of `Hand.closing_unit`; it moves a fingertip
#: by about 1 mm.
ANGLE_STEP = np.deg2rad(0.5)
#: Approximate spacing of points on a fingertip link, and on another link [m].
TIP_SPACING, LINK_SPACING = 0.003, 0.005
#: A point that moves by less than this per step is on the joint's axis and is left out [m].
STILL = 5e-5
#: The gap between fingertips is computed at every `GAP_STRIDE`-th closing angle of a path.
GAP_STRIDE = 5
#: Number of pairs of hand and spread whose paths a process caches.
KEPT = 16


@dataclass(frozen=True, kw_only=True, eq=False)
class FingerPath:
    """The links that one finger's closing moves, at m closing angles.

    Attributes:
        angles: (m,), closing angles from 0 to the limit [rad or m].
        points: (m, n, 3), points of the links in {G} [m]: first the points of the fingertip's pad,
            then the rest of the fingertip, then the other links.
        pad: Number of points of the pad.
        tip: Number of points of the fingertip, including the pad.
        travel: (n,), largest distance that each point moves between two successive angles [m].
        required: Whether a grasp needs this fingertip on the object.
    """

    angles: Array
    points: Points
    pad: int
    tip: int
    travel: Points
    required: bool = True


@dataclass(frozen=True, kw_only=True, eq=False)
class HandPaths:
    """The paths of a hand with k fingers at one spread.

    Attributes:
        still: (s, 3), points of the links that closing does not move, in {G} [m].
        fingers: One path per finger.
        gaps: For each pair of fingers (a, b), the distance between their fingertips [m]. Rows are
            every `GAP_STRIDE`-th angle of a, columns every `GAP_STRIDE`-th angle of b.
    """

    still: Points
    fingers: tuple[FingerPath, ...]
    gaps: dict[tuple[int, int], npt.NDArray[np.float32]]


@lru_cache(maxsize=KEPT)
def hand_paths(hand: Hand, spread: float) -> HandPaths | None:
    """Return the paths of a hand's fingers at a spread [rad].

    The result is None if several fingers move one link or a finger's closing has no limit. All
    attempts of such a hand are simulated.
    """
    if not has_paths(hand):
        return None

    # Links that no finger moves stay where they are at this spread.
    movers, limits = _movers(hand), coordinate_limits(hand)[1:, 1]
    surfaces = link_points(hand)
    opened = np.zeros(hand.num_fingers)
    still = [
        _place(link_poses(hand, link, spread=spread, closing=opened), surfaces[link])
        for link, moved_by in movers.items()
        if not len(moved_by)
    ]

    # Each finger moves its fingertip and its other links.
    fingers = []
    for i, finger in enumerate(hand.fingers):
        rest = [link for link, by in movers.items() if i in by and link != finger.fingertip]
        fingers.append(_finger_path(hand, i, rest, spread, float(limits[i]), surfaces))
    return HandPaths(
        still=np.concatenate(still),
        fingers=tuple(fingers),
        gaps=_gaps(hand, fingers, spread),
    )


def has_paths(hand: Hand) -> bool:
    """Return whether no two fingers move one link, and every finger's closing has a limit."""
    limits = coordinate_limits(hand)[1:, 1]
    apart = all(len(fingers) <= 1 for fingers in _movers(hand).values())
    return apart and bool(np.all((limits > 0.0) & np.isfinite(limits)))


def _movers(hand: Hand) -> dict[str, npt.NDArray[np.int64]]:
    """Return the indices of the fingers whose closing moves each link."""
    closing_gain = {link: chain.gain[:, 1:] for link, chain in hand.link_chains.items()}
    return {link: np.flatnonzero(gain.any(axis=0)) for link, gain in closing_gain.items()}


def _finger_path(
    hand: Hand, i: int, rest: list[str], spread: float, limit: float, surfaces: dict[str, Array]
) -> FingerPath:
    """Return the path of finger i.

    Args:
        hand: The hand.
        i: Index of the finger.
        rest: Links that the finger moves, without its fingertip.
        spread: Spread angle [rad].
        limit: Closing position at the limit [rad or m].
        surfaces: Points of each link, see `link_points`.
    """
    step = ANGLE_STEP * hand.closing_unit[i]
    angles = np.linspace(0.0, limit, int(np.ceil(limit / step)) + 1)
    closing = np.zeros((len(angles), hand.num_fingers))
    closing[:, i] = angles

    def placed(link: str) -> Points:
        X_GL = link_poses(hand, link, spread=spread, closing=closing)
        return _place(X_GL, surfaces[link])

    # Points of all links: first the fingertip, and of the fingertip first the pad.
    fingertip = hand.fingers[i].fingertip
    on_pad = _near_pad(hand.fingers[i], surfaces[fingertip])
    order = np.argsort(~on_pad, kind="stable")
    tip = placed(fingertip)[:, order]
    points = np.concatenate([tip, *map(placed, rest)], axis=1)

    # Leave out points that do not move.
    travel = norm(np.diff(points, axis=0)).astype(np.float32).max(axis=0)
    moving = travel > STILL
    return FingerPath(
        angles=angles,
        points=np.ascontiguousarray(points[:, moving]),
        pad=int(np.count_nonzero(moving[: int(on_pad.sum())])),
        tip=int(np.count_nonzero(moving[: tip.shape[1]])),
        travel=travel[moving],
        required=hand.fingers[i].required,
    )


def _place(X_GL: Array, p_LQ: Array) -> Points:
    """Return points (n, 3) of a link with poses X_GL (..., 4, 4) as points (..., n, 3) in {G}."""
    moved = multiply(p_LQ, np.swapaxes(X_GL[..., :3, :3], -1, -2))
    return np.asarray(moved + X_GL[..., None, :3, 3], dtype=np.float32)


def _gaps(
    hand: Hand, fingers: list[FingerPath], spread: float
) -> dict[tuple[int, int], npt.NDArray[np.float32]]:
    """Return `HandPaths.gaps`: look up points of finger a in the distance field of finger b."""
    fields, gaps = _tip_fields(hand), {}
    for b, other in enumerate(fingers):
        # Poses of fingertip b at its angles.
        closing = np.zeros((len(other.angles[::GAP_STRIDE]), hand.num_fingers))
        closing[:, b] = other.angles[::GAP_STRIDE]
        tip = hand.fingers[b].fingertip
        X_FbG = invert_pose(link_poses(hand, tip, spread=spread, closing=closing))

        # Smallest distance of fingertip a from fingertip b, angle by angle.
        for a in range(b):
            points = fingers[a].points[::GAP_STRIDE, : fingers[a].tip]
            gaps[a, b] = np.column_stack([_gap(fields[b], X, points) for X in X_FbG])
    return gaps


def _gap(field: DistanceField, X_FbG: Array, p_GQ: Points) -> npt.NDArray[np.float32]:
    """Return the smallest distance (m,) of points (m, n, 3) from a fingertip with a given pose."""
    X = X_FbG.astype(np.float32)
    x, y, z = (dot(p_GQ, X[axis, :3]).astype(np.float32) + X[axis, 3] for axis in range(3))
    return np.asarray(field.nearest(x, y, z).min(axis=1))


@lru_cache(maxsize=KEPT_HANDS)
def _tip_fields(hand: Hand) -> tuple[DistanceField, ...]:
    """Return the distance field of each fingertip in its own frame."""
    shapes, fields = link_shapes(hand.model), []
    for finger in hand.fingers:
        triangles = np.concatenate([_triangles(c) for c in shapes[finger.fingertip]])
        faces = np.arange(3 * len(triangles), dtype=np.int32).reshape(-1, 3)
        fields.append(make_distance_field(triangles.reshape(-1, 3), faces))
    return tuple(fields)


@lru_cache(maxsize=KEPT_HANDS)
def link_points(hand: Hand) -> dict[str, Array]:
    """Return points (n, 3) on the surface of each link, in the link's frame [m]."""
    points = {}
    for link, shapes in link_shapes(hand.model).items():
        spacing = TIP_SPACING if link in hand.fingertip_links else LINK_SPACING
        found = [even_points(corners, spacing) for corners in shapes]
        points[link] = np.concatenate([np.zeros((0, 3)), *found])
    return points


@lru_cache(maxsize=KEPT_HANDS)
def pad_points(hand: Hand) -> tuple[Array, ...]:
    """Return points (n, 3) on the pad of each fingertip, in the fingertip link's frame [m]."""
    points = link_points(hand)
    return tuple(
        points[finger.fingertip][_near_pad(finger, points[finger.fingertip])]
        for finger in hand.fingers
    )


def _near_pad(finger: Finger, p_FiQ: Array) -> npt.NDArray[np.bool_]:
    """Return which points (n, 3) [m] of a fingertip are on its pad or next to it."""
    # The points sample the surface: a point just outside the pad also represents points inside.
    return np.asarray(finger.beside_pad(p_FiQ) <= PAD_BAND + TIP_SPACING)


def _triangles(corners: Array) -> Array:
    """Return the faces (m, 3, 3) of a convex hull, counter-clockwise seen from outside."""
    hull = ConvexHull(corners)
    triangles = corners[hull.simplices]
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    inward = dot(normals, hull.equations[:, :3]) < 0.0
    triangles[inward] = triangles[inward][:, ::-1]
    return triangles


def even_points(corners: Array, spacing: float) -> Array:
    """Return points (n, 3) of a convex shape [m]: its corners, and evenly spread surface points."""
    points, owner = cover_triangles(_triangles(corners), spacing / 2.0)
    dense = np.concatenate([corners, points[np.argsort(owner, kind="stable")]])

    # Keep one point per cell of a grid, the first; corners come first and are all kept.
    cells = np.floor(dense / spacing).astype(np.int64)
    _, first = np.unique(cells, axis=0, return_index=True)
    return dense[np.union1d(np.arange(len(corners)), first)]


#: Number of tested postures for each group of fingers.
STEPS = 60
#: Cost of a pinch in which one group has closed fully and the other group not at all [rad].
UNEVEN = 1.0
#: Points at most this far behind the foremost point are treated as equally far in front [m].
FLAT = 2e-4
#: Fingers whose motions differ between directions by at most this fraction have no main axis, like
#: three fingers that close around a centre, however exactly they are mounted.
ROUND = 0.05
#: Largest allowed difference between the width of a pinch and the requested width [m].
WIDTH_ERROR = 0.004


#: Two groups of fingers that close against each other. The array (3,) is a unit axis across Gz: the
#: first group moves along it, the second group against it. The mask (k,) selects the first group.
Opposition: TypeAlias = tuple[Array, npt.NDArray[np.bool_]]


@dataclass(frozen=True, kw_only=True, eq=False)
class Pinch:
    """A posture in which the fingertips hold something.

    Attributes:
        closing: (k,), closing positions [rad or m].
        p_GQ: (k, 3), the foremost points of the pads along the opposition [m].
        p_GM: (3,), the centre between the two groups [m].
        width: Distance between the two groups along the opposition [m].
        tilt: Angle between the line from one group to the other and the opposition [rad].
    """

    closing: Array
    p_GQ: Array
    p_GM: Array
    width: float
    tilt: float


def find_opposition(hand: Hand) -> Opposition:
    """Return the line along which the fingers close, from the motion of their pad points."""
    # Motion of each pad point across Gz, from the open hand to the limits.
    paths = pad_points_at(hand, closing_path(hand, STEPS))
    motion = np.diff(paths, axis=0)[:, :, :2].reshape(-1, 2)
    (xx, xy), (_, yy) = multiply(motion.T, motion)

    # The main axis of the motion; Gy if it has none.
    apart = (xx - yy) / 2.0
    radius = np.sqrt(apart * apart + xy * xy)
    axis = np.array([xy, radius - apart, 0.0] if apart < 0.0 else [radius + apart, xy, 0.0])
    axis = axis / norm(axis) if radius > ROUND * (xx + yy) else np.array([0.0, 1.0, 0.0])

    # The last finger, often a thumb, closes against the axis.
    moved = multiply(paths[-1] - paths[0], axis)
    if moved[-1] > 0.0:
        axis, moved = -axis, -moved
    return axis, moved > 0.0


def find_pinch(hand: Hand, width: float) -> Pinch | None:
    """Return the straightest pinch of a width [m]; None if the fingers have no such pinch."""
    # The foremost point of each pad along the opposition, at each posture.
    axis, group = find_opposition(hand)
    if group.all() or not group.any():
        return None
    closing, front = pad_fronts(hand, (axis, group))

    # Combine each posture of the first group with each posture of the second group.
    first, second = front[:, group], front[:, ~group]
    along_first = (first @ axis).max(axis=1)
    along_second = (second @ axis).min(axis=1)
    gap = along_second[None, :] - along_first[:, None]
    line = second.mean(axis=1)[None] - first.mean(axis=1)[:, None]
    along = line @ axis
    across = np.linalg.norm(line - along[..., None] * axis, axis=-1)
    tilt = np.arctan2(across, np.maximum(along, 1e-6))

    # Among the pinches of this width in front of the palm, choose the straightest one in which all
    # fingers have closed by about the same fraction.
    share = np.linspace(0.0, 1.0, STEPS)
    cost = tilt + UNEVEN * np.abs(share[:, None] - share)
    cost[np.abs(gap - width) > WIDTH_ERROR] = np.inf
    motors = hand.motor_of
    if set(motors[group]) & set(motors[~group]):
        # Groups that share a motor close together.
        cost[~np.eye(STEPS, dtype=np.bool_)] = np.inf
    cost[(first[..., 2].min(axis=1) <= 0.0)] = np.inf
    cost[:, second[..., 2].min(axis=1) <= 0.0] = np.inf
    i, j = np.unravel_index(np.argmin(cost), cost.shape)
    if not np.isfinite(cost[i, j]):
        return None

    p_GQ = np.where(group[:, None], front[i], front[j])
    middle = (front[i][group].mean(axis=0) + front[j][~group].mean(axis=0)) / 2
    shift = (along_first[i] + along_second[j]) / 2.0 - middle @ axis
    return Pinch(
        closing=np.where(group, closing[i], closing[j]),
        p_GQ=p_GQ,
        p_GM=middle + shift * axis,
        width=float(gap[i, j]),
        tilt=float(tilt[i, j]),
    )


def reach(hand: Hand, direction: Array) -> float:
    """Return the largest coordinate of the closing hand along a direction (3,) in {G} [m]."""
    return float(dot(_swept_corners(hand), direction).max())


@lru_cache(maxsize=KEPT_HANDS)
def _swept_corners(hand: Hand) -> Array:
    """Return the corners (n, 3) in {G} of the convex hull of everything the closing hand sweeps."""
    surfaces, closing, corners = link_points(hand), closing_path(hand, STEPS), []
    for link in hand.link_chains:
        if len(points := surfaces[link]):
            X_GL = link_poses(hand, link, spread=0.0, closing=closing)
            swept = multiply(points, np.swapaxes(X_GL[:, :3, :3], -1, -2)) + X_GL[:, None, :3, 3]
            swept = swept.reshape(-1, 3)
            corners.append(swept[ConvexHull(swept).vertices])
    found = np.concatenate(corners)
    return found[ConvexHull(found).vertices]


def closing_path(hand: Hand, steps: int) -> Array:
    """Return closing positions (steps, k) from the open hand to the limits [rad or m]."""
    return np.linspace(0.0, 1.0, steps)[:, None] * closed_positions(hand)


def pad_points_at(hand: Hand, closing: Array) -> Array:
    """Return the pad points (..., k, 3) in {G} [m] at closing positions (..., k) [rad or m]."""
    X_GF = fingertip_poses(hand, spread=0.0, closing=closing)
    points = np.array([finger.p_FiP for finger in hand.fingers])
    return multiply(X_GF[..., :3, :3], points[:, :, None])[..., 0] + X_GF[..., :3, 3]


def pad_fronts(hand: Hand, opposition: Opposition) -> tuple[Array, Array]:
    """Return closing positions (n, k) and the foremost point of each pad there (n, k, 3) [m].

    The positions run from the open hand to the limits. "Foremost" is along the opposition, in {G}.
    """
    closing, (axis, group) = closing_path(hand, STEPS), opposition
    X_GF = fingertip_poses(hand, spread=0.0, closing=closing)
    front = np.zeros((len(closing), hand.num_fingers, 3))
    for i, points in enumerate(pad_points(hand)):
        sign = 1.0 if group[i] else -1.0
        for n, X in enumerate(X_GF[:, i]):
            p_GQ = transform_points(X, points)
            along = sign * p_GQ @ axis
            # A flat pad has many foremost points: use their mean.
            front[n, i] = p_GQ[along >= along.max() - FLAT].mean(axis=0)
    return closing, front


def across(hand: Hand) -> Array:
    """Return the unit direction (3,) across the opposition in {G}, across Gz."""
    axis, _ = find_opposition(hand)
    return np.array([axis[1], -axis[0], 0.0])
