"""Paths of points on a hand's surface while its fingers close, at one angle of the spread.

In: a `Hand` and a spread. Out: `HandPaths`, in the palm frame: points of the links that closing
does not move, and for each finger the points of the links that it moves, at closing positions half
a degree (or 0.9 mm, of a joint that slides) apart, from the open hand to the limit. This is
geometry only, without a simulation. Closing angles are lengths where the closing joint slides.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull

from drakegrasp.arithmetic import dot, multiply, norm
from drakegrasp.frames import Array, invert_pose
from drakegrasp.hand.description import Hand
from drakegrasp.hand.file_format import PAD_BAND, Finger
from drakegrasp.hand.kinematics import coordinate_limits, link_poses
from drakegrasp.hand.parsing import KEPT_HANDS
from drakegrasp.hand.shapes import link_shapes
from drakegrasp.mesh.distance_field import DistanceField, make_distance_field
from drakegrasp.mesh.surfaces import cover_triangles

Points = npt.NDArray[np.float32]

#: Step between two closing angles of a path, in `Hand.closing_unit`; a fingertip moves by about
#: 1 mm.
ANGLE_STEP = np.deg2rad(0.5)
#: Approximate spacing of the points of a fingertip link, and of another link [m].
TIP_SPACING, LINK_SPACING = 0.003, 0.005
#: A point that moves by less than this per step is on the joint's axis and left out [m].
STILL = 5e-5
#: The gap between fingertips is computed at every so many-th angle of a path.
GAP_STRIDE = 5
#: Number of hands and spreads whose paths a process keeps.
KEPT = 16


@dataclass(frozen=True, kw_only=True, eq=False)
class FingerPath:
    """The links that one finger's closing moves, at m closing angles.

    Attributes:
        angles: (m,), closing angles from 0 to the limit [rad or m].
        points: (m, n, 3), points of the links in {G} [m]; those of the fingertip's pad come first,
            then those of the rest of the fingertip.
        pad: Number of points of the pad.
        tip: Number of points of the fingertip, the pad included.
        travel: (n,), largest distance that each moves from one angle to the next [m].
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
    """A hand of k fingers at one spread.

    Attributes:
        still: (s, 3), points of the links that closing does not move, in {G} [m].
        fingers: One path per finger.
        gaps: For each pair of fingers (a, b) the distance between their fingertips at each
            `GAP_STRIDE`-th angle of a, and of b [m].
    """

    still: Points
    fingers: tuple[FingerPath, ...]
    gaps: dict[tuple[int, int], npt.NDArray[np.float32]]


@lru_cache(maxsize=KEPT)
def hand_paths(hand: Hand, spread: float) -> HandPaths | None:
    """Return the paths of a hand's fingers at a spread [rad].

    They are None for a hand in which several fingers move one link, or a finger's closing has no
    limit: all its attempts are simulated.
    """
    # Which fingers move each link.
    closing_gain = {link: chain.gain[:, 1:] for link, chain in hand.link_chains.items()}
    movers = {link: np.flatnonzero(gain.any(axis=0)) for link, gain in closing_gain.items()}
    limits = coordinate_limits(hand)[1:, 1]
    if max(map(len, movers.values())) > 1 or not np.all((limits > 0.0) & np.isfinite(limits)):
        return None

    # Links that no finger moves stay where they are at this spread.
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


def _finger_path(
    hand: Hand, i: int, rest: list[str], spread: float, limit: float, surfaces: dict[str, Array]
) -> FingerPath:
    """Return the path of finger i, from its fingertip and the rest of its links."""
    step = ANGLE_STEP * hand.closing_unit[i]
    angles = np.linspace(0.0, limit, int(np.ceil(limit / step)) + 1)
    closing = np.zeros((len(angles), hand.num_fingers))
    closing[:, i] = angles

    def placed(link: str) -> Points:
        X_GL = link_poses(hand, link, spread=spread, closing=closing)
        return _place(X_GL, surfaces[link])

    # Points of all links, the fingertip first, and of it the pad.
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
    """Return points (..., n, 3) in {G} of points (n, 3) of links with poses (..., 4, 4)."""
    moved = multiply(p_LQ, np.swapaxes(X_GL[..., :3, :3], -1, -2))
    return np.asarray(moved + X_GL[..., None, :3, 3], dtype=np.float32)


def _gaps(
    hand: Hand, fingers: list[FingerPath], spread: float
) -> dict[tuple[int, int], npt.NDArray[np.float32]]:
    """Return `HandPaths.gaps`: look up points of finger a in the distance field of fingertip b."""
    fields, gaps = _tip_fields(hand), {}
    for b, other in enumerate(fingers):
        # Poses of fingertip b at its angles.
        closing = np.zeros((len(other.angles[::GAP_STRIDE]), hand.num_fingers))
        closing[:, b] = other.angles[::GAP_STRIDE]
        tip = hand.fingers[b].fingertip
        X_FbG = invert_pose(link_poses(hand, tip, spread=spread, closing=closing))

        # Least distance of fingertip a from it, angle by angle.
        for a in range(b):
            points = fingers[a].points[::GAP_STRIDE, : fingers[a].tip]
            gaps[a, b] = np.column_stack([_gap(fields[b], X, points) for X in X_FbG])
    return gaps


def _gap(field: DistanceField, X_FbG: Array, p_GQ: Points) -> npt.NDArray[np.float32]:
    """Return the least distance (m,) of points (m, n, 3) from a fingertip, given its pose."""
    X = X_FbG.astype(np.float32)
    x, y, z = (dot(p_GQ, X[axis, :3]).astype(np.float32) + X[axis, 3] for axis in range(3))
    return np.asarray(field.nearest(x, y, z).min(axis=1))


@lru_cache(maxsize=KEPT_HANDS)
def _tip_fields(hand: Hand) -> tuple[DistanceField, ...]:
    """Return the distance field of each fingertip in its own frame."""
    shapes, fields = link_shapes(hand), []
    for finger in hand.fingers:
        triangles = np.concatenate([_triangles(c) for c in shapes[finger.fingertip]])
        faces = np.arange(3 * len(triangles), dtype=np.int32).reshape(-1, 3)
        fields.append(make_distance_field(triangles.reshape(-1, 3), faces))
    return tuple(fields)


@lru_cache(maxsize=KEPT_HANDS)
def link_points(hand: Hand) -> dict[str, Array]:
    """Return points on the surface of each link (n, 3) in its own frame [m]."""
    points = {}
    for link, shapes in link_shapes(hand).items():
        spacing = TIP_SPACING if link in hand.fingertip_links else LINK_SPACING
        found = [even_points(corners, spacing) for corners in shapes]
        points[link] = np.concatenate([np.zeros((0, 3)), *found])
    return points


@lru_cache(maxsize=KEPT_HANDS)
def pad_points(hand: Hand) -> tuple[Array, ...]:
    """Return points on the pad of each fingertip (n, 3) in the fingertip link's frame [m]."""
    points = link_points(hand)
    return tuple(
        points[finger.fingertip][_near_pad(finger, points[finger.fingertip])]
        for finger in hand.fingers
    )


def _near_pad(finger: Finger, p_FiQ: Array) -> npt.NDArray[np.bool_]:
    """Return which points (n, 3) [m] of a fingertip are on its pad, or next to one that may be."""
    # The points are samples of the surface: one beside the pad stands for some within.
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
    """Return the corners (n, 3) of a convex shape and evenly spread points of its surface [m]."""
    points, owner = cover_triangles(_triangles(corners), spacing / 2.0)
    dense = np.concatenate([corners, points[np.argsort(owner, kind="stable")]])

    # One point stays in each cell of a grid; corners come first, so they are the ones that stay.
    cells = np.floor(dense / spacing).astype(np.int64)
    _, first = np.unique(cells, axis=0, return_index=True)
    return dense[np.union1d(np.arange(len(corners)), first)]
