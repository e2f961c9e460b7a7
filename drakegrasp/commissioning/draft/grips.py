"""Which fingers close against each other, where they touch, and whether other links collide first.

Input: the joints of a model's fingers, and their closings. Output: `Grip`s, the best first: a
finger, often a thumb, and one or two fingers that it meets. For each pair of fingers, all closings
of both are compared. The pad of a fingertip is the part of its surface that faces the closing
motion.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations
from typing import TypeAlias

import numpy as np

from drakegrasp.commissioning.draft.fingers import STEPS, Closing
from drakegrasp.commissioning.draft.model import VendorJoint, VendorModel
from drakegrasp.frames import Array, invert_pose, transform_points
from drakegrasp.hand.finger_sweep import even_points
from drakegrasp.hand.shapes import hull_planes, ray_span

#: A direction this close to an axis of the link is replaced by the axis [rad].
SNAP = np.deg2rad(12.0)
#: Fraction of a link's length, from its end, that is the pad; fraction of its thickness, and the
#: smallest and largest depth of the pad [m], because pressed objects sink in.
LENGTH, DEPTH, DEEP = 0.55, 0.45, (0.004, 0.008)
#: Distance of the pad point from the end, in thicknesses, and its bounds [m].
FROM_END, NEAR_END = 0.7, (0.004, 0.014)
#: Spacing of points on the surface of a fingertip, and on shapes that are compared [m].
SPACING, COMPARED = 0.0015, 0.006
#: Width of the pinched object [m], and the deviation from it that costs nothing.
WIDTH, TOLERANCE = 0.04, 0.01
#: Cost if one finger has closed fully and the other not at all, if pads do not come close enough
#: [1/m], and if they pinch at another width [1/m].
UNEVEN, APART, OFF_WIDTH = 0.5, 20.0, 40.0
#: Cost of a pad that passes the other pad instead of approaching it.
PASSING = 0.5
#: Fraction of the closing after which a pinch is late, cost of that; opening below which a grip is
#: narrow [m], and cost of that [1/m].
LATE, LATE_COST, OPENING, NARROW = 0.75, 2.0, 0.06, 10.0
#: Pads that come this close to each other meet [m].
MEETING = 0.006
#: Angles by which a contact may be nearer to a fingertip's end than its pad [rad], and their cost.
ROUND, ROUND_COST = np.deg2rad([0.0, 30.0, 60.0]), 0.2
#: A finger that turns about its own direction has no side by which it closes, as a cosine.
SQUARE = 0.3
#: Maximum number of grips that are returned.
GRIPS = 40
#: Maximum number of fingers that grasp; a hand with more fingers uses this many.
FINGERS = 3
#: Allowed overlap of links other than fingertips [m]; points miss a part of what Drake detects.
SUNK = 2e-4
_Ball: TypeAlias = tuple[Array, float]


@dataclass(frozen=True, kw_only=True, eq=False)
class Member:
    """A finger that may be in a grip, with one of its closings, at s steps.

    Attributes:
        joints: Joints of the finger, from the palm.
        closing: How it closes.
        joint: The joint that the motor drives: the first joint that closes, in vendor's positions.
        sign: Direction of that joint's positions in which it closes.
        zero: That joint's position in the open hand [rad or m].
        pad_point: (3,), usual contact point in the fingertip link [m].
        pad_region: Half-spaces of the hand file, in the fingertip link.
        points: (s, 3), pad point in the palm link, from open to closed [m].
        moves: (s, 3), unit directions in which the pad moves.
        normals: (r, s, 3), directions that the pad faces: a fingertip's end is round.
    """

    joints: list[VendorJoint]
    closing: Closing
    joint: VendorJoint
    sign: float
    zero: float
    pad_point: Array
    pad_region: list[list[float]]
    points: Array
    moves: Array
    normals: Array

    @property
    def tip(self) -> str:
        """The fingertip link."""
        return self.joints[-1].child

    def followers(self) -> dict[str, tuple[float, float]]:
        """Return ratio and offset to the driven joint, for the finger's joints that follow it."""
        rows = zip(self.joints, self.closing.gain, self.closing.q0, strict=True)
        return {j.name: (float(g), float(q)) for j, g, q in rows if g != 0.0 and j != self.joint}


@dataclass(frozen=True, kw_only=True, eq=False)
class Grip:
    """Fingers that close against one finger.

    Attributes:
        members: The fingers; the last one opposes the others.
        step: Step of each finger at which an object of `WIDTH` is pinched.
        cost: How far the pinch is from a straight and even pinch.
        axis: (3,), unit, from the fingers to the last one in the pinch, in the palm link.
        middle: (3,), centre between the fingers and the last one [m].
    """

    members: tuple[Member, ...]
    step: tuple[int, ...]
    cost: float
    axis: Array
    middle: Array


def find_members(
    model: VendorModel, palm: str, joints: list[VendorJoint], closings: Sequence[Closing]
) -> list[Member]:
    """Return a finger with the path of its pad, for each of its closings."""
    # The end of the fingertip, and its motion.
    last, link = joints[-1], model.links[joints[-1].child]
    X = _tip_poses(joints, np.stack([closing.path() for closing in closings]))
    parts = [shape.corners() for shape in link.collisions]
    surface = np.concatenate([even_points(part, SPACING) for part in parts])
    end, along = _end_of(surface, _outward(model, palm, joints) if last.slides else None)
    motion = np.diff(X[..., :3, :3] @ end + X[..., :3, 3], axis=1)
    inside = (np.swapaxes(X[:, :-1, :3, :3], -1, -2) @ motion[..., None])[..., 0].mean(axis=1)

    # The pad faces its motion, perpendicular to the finger and to the axis about which it turns.
    front = last.axis if last.slides else np.cross(last.axis, along)
    if np.linalg.norm(front) < SQUARE:
        front = inside.mean(axis=0) - (inside.mean(axis=0) @ along) * along
    sides = {sign: _find_pad(parts, surface, sign * front, along) for sign in (1.0, -1.0)}
    members = []
    for moved, X_BF, closing in zip(inside, X, closings, strict=True):
        *pad, region = sides[1.0 if moved @ front >= 0.0 else -1.0]
        place, normal, towards = ((X_BF[:, :3, :3] @ v[:, None])[..., 0] for v in pad)
        points = place + X_BF[:, :3, 3]
        moves = np.gradient(points, axis=0)
        first = int(np.flatnonzero(closing.gain)[0])
        members.append(
            Member(
                joints=joints,
                closing=closing,
                joint=joints[first],
                sign=float(np.sign(closing.gain[first])),
                zero=float(closing.q0[first]),
                pad_point=pad[0],
                pad_region=region,
                points=points,
                moves=moves / np.linalg.norm(moves, axis=-1, keepdims=True),
                normals=np.stack([np.cos(r) * normal + np.sin(r) * towards for r in ROUND]),
            )
        )
    return members


def _tip_poses(joints: Sequence[VendorJoint], q: Array) -> Array:
    """Return the poses (..., 4, 4) of a fingertip link in the palm link at positions (..., m)."""
    X = np.broadcast_to(np.eye(4), (*q.shape[:-1], 4, 4))
    for j, joint in enumerate(joints):
        X = X @ joint.X_PJ @ joint.motion(q[..., j])
    return np.asarray(X)


def _outward(model: VendorModel, palm: str, joints: Sequence[VendorJoint]) -> Array:
    """Return the direction (3,) from the palm to a sliding fingertip, across its slide."""
    X, axis = _tip_poses(joints, np.zeros(len(joints))), joints[-1].axis
    corners = transform_points(X, model.links[joints[-1].child].corners())
    line = X[:3, :3].T @ (corners.mean(axis=0) - model.links[palm].corners().mean(axis=0))
    return _snapped(line - (line @ axis) * axis)


def _end_of(points: Array, along: Array | None) -> tuple[Array, Array]:
    """Return the end (3,) of a link, and the unit direction towards it (3,).

    Args:
        points: (n, 3), points of the link's surface, in the link's frame [m].
        along: Direction of the finger; None for the direction from the origin, where the joint is.
    """
    if along is None:
        centre, far = points.mean(axis=0), np.linalg.norm(points, axis=1)
        ahead = points[far > 0.85 * far.max()].mean(axis=0)
        along = ahead if ahead @ centre > 0.0 else centre
        along = along / np.linalg.norm(along)
    heights = points @ along
    return points[heights > heights.max() - 0.003].mean(axis=0), along


def _find_pad(
    parts: Sequence[Array], points: Array, normal: Array, along: Array
) -> tuple[Array, Array, Array, list[list[float]]]:
    """Return the pad of a link with convex parts (n, 3) [m], in the link's frame.

    The pad consists of its point, the unit directions out of the link and towards the finger's end,
    (3,) each, and the half-spaces of the hand file's `pad_region`.

    Args:
        parts: Corners of each part.
        points: (m, 3), points of their surfaces.
        normal: Direction (3,) in which the link moves when it closes.
        along: Direction (3,) towards the end of the finger.
    """
    normal = _snapped(normal)
    along = _snapped(along - (along @ normal) * normal)
    across = np.cross(normal, along)

    # Choose the level of the pad point: near the end, in the centre of the surface there.
    heights = points @ along
    top, length = float(heights.max()), float(np.ptp(heights))
    thickness = float(np.ptp(points[heights > top - 0.4 * length] @ normal))
    level = max(top - float(np.clip(FROM_END * thickness, *NEAR_END)), top - 0.45 * length)
    at = points[np.abs(heights - level) < 2.0 * SPACING]
    sides = at[at @ normal > (at @ normal).max() - 0.002] @ across
    middle = float(sides.max() + sides.min()) / 2.0

    # Find the surface there: a ray along the normal leaves the last of the parts.
    start = level * along + middle * across + (points @ normal).min() * normal
    spans = [ray_span(part, start, normal) for part in parts]
    leaves = [span[1] for span in spans if span is not None and span[1] >= 0.0]
    height = max(leaves) if leaves else float((at @ normal).max() - start @ normal)
    point = np.round(start + height * normal, 5) + 0.0

    # Compute how deep the region reaches below the point, and how far behind it along the finger.
    depth = float(np.clip(DEPTH * thickness, *DEEP))
    back, region = max(LENGTH * length - (top - level), 0.004), []
    for direction, space in ((normal, depth), (along, back)):
        n = np.round(direction, 4) + 0.0
        region.append([*n.tolist(), round(float(n @ point) - space, 5) + 0.0])
    return point, normal, along, region


def _snapped(direction: Array) -> Array:
    """Return a unit direction (3,), replaced by a coordinate axis if it is close to one."""
    direction = direction / np.linalg.norm(direction)
    axis = int(np.argmax(np.abs(direction)))
    if np.arccos(min(abs(direction[axis]), 1.0)) < SNAP:
        return np.asarray(np.sign(direction[axis]) * np.eye(3)[axis])
    return np.asarray(direction)


def find_grips(fingers: Sequence[Sequence[Member]]) -> list[Grip]:
    """Return the best grips of fingers against one of them.

    The other joints of fingers are at rest; only the finger that opposes may turn its other joints.
    """
    # Compute the cost of each closing of the last finger with each closing of the others.
    ranked: list[tuple[float, int, int, list[tuple[int, int]]]] = []
    resting = [[m for m in ways if m.closing.at_rest] for ways in fingers]
    for t, ways in enumerate(fingers):
        others = [o for o in range(len(fingers)) if o != t]
        costs = {o: _pair_costs(ways, resting[o]) for o in others}
        for group in _alike(resting, others):
            for b, last in enumerate(ways):
                total, chosen = _cheapest(group, costs, b)
                ranked.append((total + last.closing.cost, t, b, chosen))
    ranked.sort(key=lambda entry: entry[:3])

    # Keep the best grips that differ in the last finger's positions.
    grips: dict[tuple[int, tuple[float, ...]], Grip] = {}
    for cost, t, b, chosen in ranked:
        last = fingers[t][b]
        key = t, tuple(np.round(last.closing.q0, 2).tolist())
        if key not in grips and len(grips) < GRIPS:
            grips[key] = _grip([resting[o][a] for o, a in chosen], last, cost)
    return list(grips.values())


def _alike(resting: Sequence[Sequence[Member]], others: Sequence[int]) -> list[list[int]]:
    """Return groups of fingers that may close together: those with equally many closings."""
    groups = [
        [o for o in others if len(resting[o]) == count]
        for count in sorted({len(resting[o]) for o in others})
    ]
    wanted = min(len(others), FINGERS - 1)
    return [group for group in groups if len(group) >= wanted] or [list(others)]


def _cheapest(
    group: Sequence[int], costs: dict[int, Array], b: int
) -> tuple[float, list[tuple[int, int]]]:
    """Return the cheapest fingers of a group against one, with the same closing if possible."""
    wanted = min(len(costs), FINGERS - 1)
    rows = [costs[o][b] for o in group]
    if len({len(row) for row in rows}) == 1:
        table = np.array(rows)
        best = np.sort(table, axis=0)[:wanted].mean(axis=0)
        ways, total = np.full(len(rows), best.argmin()), float(best.min())
        order = np.argsort(table[:, best.argmin()], kind="stable")[:wanted]
    else:
        least = np.array([row.min() for row in rows])
        order = np.argsort(least, kind="stable")[:wanted]
        ways, total = np.array([row.argmin() for row in rows]), float(least[order].mean())
    return total, [(group[i], int(ways[i])) for i in sorted(order.tolist())]


def _pair_costs(ways: Sequence[Member], others: Sequence[Member]) -> Array:
    """Return the cost (b, a) of each closing of one finger with each closing of others."""
    own = np.array([member.closing.cost for member in others])
    stacked = (
        np.stack([member.points for member in others]),
        np.stack([member.moves for member in others]),
        np.stack([member.normals for member in others], axis=1),
    )
    return np.stack([_costs(last, *stacked).min(axis=(1, 2)) + own for last in ways])


def _costs(last: Member, points: Array, moves: Array, normals: Array) -> Array:
    """Return the cost (a, s, s) of one closing of a finger with each closing of another, by steps.

    Args:
        last: The finger that opposes.
        points: (a, s, 3), positions of the other finger's pad.
        moves: (a, s, 3), unit directions in which that pad moves.
        normals: (r, a, s, 3), directions that it faces.
    """
    # Pads should face each other along the line between them.
    line = last.points[None, None] - points[:, :, None]
    gap = np.linalg.norm(line, axis=-1)
    unit = line / np.maximum(gap, 1e-6)[..., None]
    toll = ROUND_COST * ROUND[:, None, None, None]
    facing = (np.einsum("rasi,asti->rast", normals, unit) - toll).max(axis=0)
    faced = (-np.einsum("rti,asti->rast", last.normals, unit) - toll).max(axis=0)
    nearing = np.einsum("asi,asti->ast", moves, unit)
    neared = -np.einsum("ti,asti->ast", last.moves, unit)
    share = np.linspace(0.0, 1.0, STEPS)
    uneven = np.abs(share[:, None] - share[None])
    off = np.maximum(np.abs(gap - WIDTH) - TOLERANCE, 0.0)

    # Pads that pass at a distance never meet.
    apart = np.maximum(gap.min(axis=(1, 2)) - MEETING, 0.0)
    narrow = np.maximum(OPENING - gap[:, 0, 0], 0.0)
    late = np.maximum(share - LATE, 0.0)
    cost = 2.0 - facing - faced + UNEVEN * uneven + OFF_WIDTH * off
    cost = cost + LATE_COST * (late[:, None] + late[None]) + PASSING * (2.0 - nearing - neared)
    return np.asarray(cost + (APART * apart + NARROW * narrow)[:, None, None])


def _grip(others: Sequence[Member], last: Member, cost: float) -> Grip:
    """Return the grip of some fingers against one, each with its closing."""
    costs = [_costs(last, m.points[None], m.moves[None], m.normals[:, None])[0] for m in others]
    at = int(np.stack(costs).min(axis=1).sum(axis=0).argmin())
    steps = [int(table[:, at].argmin()) for table in costs]

    # The pad points in the pinch: the last finger's point, and the mean of the others.
    points = np.array([m.points[s] for m, s in zip(others, steps, strict=True)])
    end, start = last.points[at], points.mean(axis=0)
    return Grip(
        members=(*others, last),
        step=(*steps, at),
        cost=cost,
        axis=(end - start) / np.linalg.norm(end - start),
        middle=(end + start) / 2.0,
    )


def clear_grips(
    model: VendorModel,
    palm: str,
    grips: Iterable[Grip],
    postures: Callable[[Grip], Iterable[Mapping[str, float]]],
) -> Iterator[Grip]:
    """Yield the grips in which no links of two fingers overlap before their fingertips meet.

    Args:
        model: The model.
        palm: Link B.
        grips: The grips.
        postures: Returns positions of all joints, from the open hand of a grip to the closed one.
    """

    @cache
    def shapes_of(link: str) -> tuple[_Ball, list[tuple[Array, Array, _Ball]]]:
        """Return the ball around a link, and planes, points and the ball of each of its shapes."""
        clouds = [even_points(s.corners(), COMPARED) for s in model.links[link].collisions]
        whole = np.concatenate([np.zeros((1, 3)), *clouds])
        return _ball(whole), [(hull_planes(points), points, _ball(points)) for points in clouds]

    def overlap(a: str, b: str, X: Mapping[str, Array], depth: float) -> bool:
        """Return whether a point of one link is deeper [m] than `depth` inside the other link."""
        # Balls around whole links exclude most pairs.
        X_AB = invert_pose(X[a]) @ X[b]
        X_BA = invert_pose(X_AB)
        (around_a, parts_a), (around_b, parts_b) = shapes_of(a), shapes_of(b)
        return not _apart(X_AB, around_b, around_a) and any(
            _inside(planes_a, transform_points(X_AB, points_b), depth)
            or _inside(planes_b, transform_points(X_BA, points_a), depth)
            for planes_a, points_a, ball_a in parts_a
            for planes_b, points_b, ball_b in parts_b
            if not _apart(X_AB, ball_b, ball_a)
        )

    def is_clear(grip: Grip) -> bool:
        fingers = [[joint.child for joint in member.joints] for member in grip.members]
        tips = {member.tip for member in grip.members}
        pairs = [(a, b) for own, other in combinations(fingers, 2) for a in own for b in other]
        for posture in postures(grip):
            X = {name: model.pose(name, posture, palm) for finger in fingers for name in finger}
            if any(overlap(a, b, X, 0.0) for a, b in pairs if {a, b} <= tips):
                return True
            if any(overlap(a, b, X, SUNK) for a, b in pairs if not {a, b} <= tips):
                return False
        return True

    return filter(is_clear, grips)


def _ball(points: Array) -> _Ball:
    """Return the centre (3,) and the radius of a ball around points (n, 3) [m]."""
    centre = (points.min(axis=0) + points.max(axis=0)) / 2.0
    return centre, float(np.linalg.norm(points - centre, axis=1).max())


def _apart(X_AB: Array, ball_B: _Ball, ball_A: _Ball) -> bool:
    """Return whether two balls do not intersect."""
    (p_BQ, radius_b), (p_AP, radius_a) = ball_B, ball_A
    distance = np.linalg.norm(X_AB[:3, :3] @ p_BQ + X_AB[:3, 3] - p_AP)
    return bool(distance > radius_a + radius_b)


def _inside(planes: Array, points: Array, depth: float) -> bool:
    """Return whether one of points (n, 3) is inside planes (m, 4) by more than a depth [m]."""
    heights = points @ planes[:, :3].T + planes[:, 3]
    return bool((heights.max(axis=1) < -depth).any())
