"""Which fingers close against each other, where they touch, and where the palm is.

Input: the joints of a model's fingers, and their closings. Output: `Grip`s, the best first: a
finger, often a thumb, and one or two fingers that it meets; and for a grip the possible palm
frames. The pad of a fingertip is the part of its surface that faces the closing motion.

For each pair of fingers, all closings of both are compared. In the posture in which their pads
hold an object of `WIDTH`, with u the unit vector from one pad to the other, n the normals of the
pads and m the directions in which they move as the fingers close, the best pair has the smallest

    J = (∠(n₁, u) + ∠(m₁, u) + ∠(n₂, -u) + ∠(m₂, -u)) / 4 + |c₁ - c₂| + π · unmet + `REST` · away,

because two forces hold an object if both lie along u and in the friction cones about the normals.
c is the fraction by which a finger has closed: fingers that are not equally fast push the object
away. `unmet` counts what the pinch lacks: an object of this width between the pads before the end
of the closing; pads that meet when nothing is between them; an opening of `OPENING`; fingers that
close as usual. `away` is how far other joints are from their rest.

Gz of a palm frame G is perpendicular to the line along which the fingers close, and no link is on
the line from the palm along Gz to the place where the fingers pinch. Gy points to the finger that
opposes the others. The best frame faces along an axis of the palm link, or else as nearly as
possible from the palm to the pinch. A frame comes last if its ray to the pinch does not come out of
the palm, or if the hand reaches far beyond the pinch, where a table would be.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.math import RollPitchYaw, RotationMatrix

from drakegrasp.frames import Array, invert_pose, make_pose, transform_points
from drakegrasp.hand.checks import PALM_DEPTH, ray_end
from drakegrasp.hand.draft.fingers import STEPS, Closing
from drakegrasp.hand.draft.vendor import VendorJoint, VendorModel, chain_poses
from drakegrasp.hand.finger_sweep import even_points
from drakegrasp.hand.shapes import ray_span

#: A direction this close to an axis of the link is replaced by the axis [rad].
SNAP = np.deg2rad(12.0)
#: Fraction of a link's length, from its end, that is the pad; fraction of its thickness, and the
#: smallest and largest depth of the pad [m], because pressed objects sink in.
LENGTH, DEPTH, DEEP = 0.55, 0.45, (0.004, 0.008)
#: Distance of the pad point from the end, in thicknesses, and its bounds [m].
FROM_END, NEAR_END = 0.7, (0.004, 0.014)
#: Spacing of points on the surface of a fingertip [m].
SPACING = 0.0015
#: Width of the pinched object [m], and the largest deviation from it.
WIDTH, TOLERANCE = 0.04, 0.01
#: Fraction of the closing by which both fingers hold the object, smallest distance between the pads
#: in the open hand [m], and largest distance between pad points that meet [m]: a thumb that closes
#: between two fingers passes both at half of their distance.
LATE, OPENING, MEETING = 0.75, 0.05, 0.03
#: Cost of other joints away from their rest [1]: they may leave it by 10 degrees for each degree by
#: which that straightens the pinch.
REST = 0.1
#: Angles by which a contact may be nearer to a fingertip's end than its pad [rad].
ROUND = np.deg2rad([0.0, 30.0])
#: A finger that turns about its own direction has no side by which it closes, as a cosine.
SQUARE = 0.3
#: Step between the tested directions [deg], and largest angle from an axis of the palm that is
#: replaced by the axis.
STEP_DEG, ALIGNED = 15, np.deg2rad(15.0)
#: Smallest distance of the pinch in front of the palm, and largest reach of the hand beyond the
#: pinch [m].
AHEAD, BEYOND = 0.015, 0.06
#: Maximum number of grips that are returned.
GRIPS = 40
#: Maximum number of fingers that grasp; a hand with more fingers uses this many.
FINGERS = 3


@dataclass(frozen=True, kw_only=True, eq=False)
class Finger:
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
        fingers: The fingers; the last one opposes the others.
        step: Step of each finger at which an object of `WIDTH` is pinched.
        cost: J, the mean over the fingers that meet the last one [rad].
        axis: (3,), unit, from the fingers to the last one in the pinch, in the palm link.
        middle: (3,), centre between the fingers and the last one [m].
    """

    fingers: tuple[Finger, ...]
    step: tuple[int, ...]
    cost: float
    axis: Array
    middle: Array


def trace_finger(
    model: VendorModel, palm: str, joints: list[VendorJoint], closings: Sequence[Closing]
) -> list[Finger]:
    """Return a finger with the path of its pad, for each of its closings."""
    # The end of the fingertip, and its motion.
    last, link = joints[-1], model.links[joints[-1].child]
    _, X = chain_poses(joints, np.stack([closing.path() for closing in closings]))
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
    found = []
    for moved, X_BF, closing in zip(inside, X, closings, strict=True):
        *pad, region = sides[1.0 if moved @ front >= 0.0 else -1.0]
        place, normal, towards = ((X_BF[:, :3, :3] @ v[:, None])[..., 0] for v in pad)
        points = place + X_BF[:, :3, 3]
        moves = np.gradient(points, axis=0)
        first = int(np.flatnonzero(closing.gain)[0])
        found.append(
            Finger(
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
    return found


def _outward(model: VendorModel, palm: str, joints: Sequence[VendorJoint]) -> Array:
    """Return the direction (3,) from the palm to a sliding fingertip, across its slide."""
    (_, X), axis = chain_poses(joints, np.zeros(len(joints))), joints[-1].axis
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


def find_grips(fingers: Sequence[Sequence[Finger]]) -> list[Grip]:
    """Return the best grips of fingers against one of them, the best first.

    The other joints of fingers are at rest; only the finger that opposes may turn its other joints.

    Args:
        fingers: Each finger with each of its closings.
    """
    resting = [[way for way in ways if way.closing.at_rest] for ways in fingers]
    ranked: list[tuple[float, list[Finger], Finger]] = []
    for t, ways in enumerate(fingers):
        others = [own for o, own in enumerate(resting) if o != t and own]
        for last in ways:
            pinches = [_pinch_costs(last, own).min(axis=(1, 2)) for own in others]
            for group in _groups(others):
                cost, chosen = _cheapest([pinches[o] for o in group])
                ranked.append((cost, [others[group[i]][way] for i, way in chosen], last))
    ranked.sort(key=lambda entry: entry[0])

    # Keep the best grips that differ in the last finger's positions.
    grips: dict[tuple[str, tuple[float, ...]], Grip] = {}
    for cost, chosen_fingers, last in ranked:
        key = last.tip, tuple(np.round(last.closing.q0, 2).tolist())
        if key not in grips and len(grips) < GRIPS:
            grips[key] = _grip(chosen_fingers, last, cost)
    return list(grips.values())


def _groups(others: Sequence[Sequence[Finger]]) -> list[list[int]]:
    """Return groups of fingers that may close together: those with equally many closings."""
    sizes = [len(ways) for ways in others]
    groups = [[o for o, size in enumerate(sizes) if size == own] for own in sorted(set(sizes))]
    wanted = min(len(others), FINGERS - 1)
    return [group for group in groups if len(group) >= wanted] or [list(range(len(others)))]


def _cheapest(pinches: Sequence[Array]) -> tuple[float, list[tuple[int, int]]]:
    """Return the mean cost of the cheapest fingers of a group, each with the closing it has.

    Args:
        pinches: For each finger the cost (a,) of each of its closings. If fingers have the same
            closings, all of them take the same one.
    """
    ways = np.array([int(costs.argmin()) for costs in pinches])
    wanted = min(len(pinches), FINGERS - 1)
    if len({len(costs) for costs in pinches}) == 1:
        ways[:] = np.sort(np.array(pinches), axis=0)[:wanted].mean(axis=0).argmin()
    costs = np.array([own[way] for own, way in zip(pinches, ways, strict=True)])
    order = np.argsort(costs, kind="stable")[:wanted]
    return float(costs[order].mean()), [(i, int(ways[i])) for i in sorted(order.tolist())]


def _pinch_costs(last: Finger, ways: Sequence[Finger]) -> Array:
    """Return J (a, s, s) of one closing of a finger with each of `ways` of another, by steps [rad].

    The steps are those of the other finger, then of the finger that opposes.
    """
    points, moves = (np.stack([getattr(w, key) for w in ways]) for key in ("points", "moves"))
    line = last.points - points[:, :, None]
    gap = np.linalg.norm(line, axis=-1)
    u = line / np.maximum(gap, 1e-6)[..., None]
    normals = np.stack([way.normals for way in ways])
    cosines = [
        np.einsum("arsi,asti->arst", normals, u).max(axis=1),
        np.einsum("rti,asti->arst", last.normals, -u).max(axis=1),
        np.einsum("asi,asti->ast", moves, u),
        np.einsum("ti,asti->ast", last.moves, -u),
    ]
    angle = np.mean(np.arccos(np.clip(cosines, -1.0, 1.0)), axis=0)

    # What the pinch lacks.
    share = np.linspace(0.0, 1.0, STEPS)
    held = (np.abs(gap - WIDTH) <= TOLERANCE) & (np.maximum(share[:, None], share) <= LATE)
    lacks = (gap.min(axis=(1, 2)) > MEETING).astype(float) + (gap[:, 0, 0] < OPENING)
    lacks += float(not last.closing.usual) + np.array([not way.closing.usual for way in ways])
    away = last.closing.away + np.array([way.closing.away for way in ways])
    per_way = np.pi * lacks + REST * away
    uneven = np.abs(share[:, None] - share)
    return np.asarray(angle + uneven + np.pi * ~held + per_way[:, None, None])


def _grip(others: Sequence[Finger], last: Finger, cost: float) -> Grip:
    """Return the grip of some fingers against one, each with its closing."""
    tables = [_pinch_costs(last, [other])[0] for other in others]
    at = int(np.stack(tables).min(axis=1).sum(axis=0).argmin())
    steps = [int(table[:, at].argmin()) for table in tables]

    # The pad points in the pinch: the last finger's point, and the mean of the others.
    points = np.array([other.points[s] for other, s in zip(others, steps, strict=True)])
    end, start = last.points[at], points.mean(axis=0)
    return Grip(
        fingers=(*others, last),
        step=(*steps, at),
        cost=cost,
        axis=(end - start) / np.linalg.norm(end - start),
        middle=(end + start) / 2.0,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class PalmFrame:
    """A palm frame.

    Attributes:
        p_BG: (3,), origin of G in B [m].
        rpy_deg: (3,), roll, pitch and yaw of G in B [deg].
        height: Height of the pinch above the palm [m].
        rank: What it lacks, then its angle to the line from the palm to the pinch [rad]: the
            smallest is the best.
    """

    p_BG: Array
    rpy_deg: Array
    height: float
    rank: tuple[int, float]

    @property
    def X_BG(self) -> Array:
        """The pose X_BG (4, 4)."""
        R = RollPitchYaw(np.deg2rad(self.rpy_deg)).ToRotationMatrix().matrix()
        return make_pose(R, self.p_BG)


def find_palm_frames(
    model: VendorModel,
    palm: str,
    grip: Grip,
    postures: Sequence[Mapping[str, float]],
) -> list[PalmFrame]:
    """Return the palm frames of a grip, the best first; empty if the palm faces no pinch.

    Args:
        model: The model.
        palm: Link B.
        grip: The fingers.
        postures: Positions of all joints, from the open to the closed hand.
    """

    # The corners of each shape in B, in a posture.
    def placed(posture: Mapping[str, float]) -> list[Array]:
        return [
            transform_points(model.pose(name, posture, palm), shape.corners())
            for name, link in model.links.items()
            if name == palm or model.carries(palm, name)
            for shape in link.collisions
        ]

    opened = placed(postures[0])
    cloud = np.concatenate([c for posture in postures for c in placed(posture)])
    parts = [shape.corners() for shape in model.links[palm].collisions] or opened
    frames = []
    centre = np.concatenate(parts).mean(axis=0)
    for direction, aside in _directions(grip, centre):
        found = _origin(grip, direction, parts)
        if found is None:
            continue
        p_BG, beside = found
        y = grip.axis - (grip.axis @ direction) * direction
        y /= np.linalg.norm(y)
        X_BG = make_pose(np.column_stack([np.cross(y, direction), y, direction]), p_BG)
        inside = [transform_points(invert_pose(X_BG), corners) for corners in opened]
        if max(map(ray_end, inside)) > PALM_DEPTH:
            continue
        beyond = float((cloud @ direction).max() - grip.middle @ direction)
        oblique = np.arccos(min(float(np.abs(direction).max()), 1.0)) > 1e-3
        rpy = RotationMatrix.ProjectToRotationMatrix(X_BG[:3, :3]).ToRollPitchYaw().vector()
        frames.append(
            PalmFrame(
                p_BG=np.round(X_BG[:3, 3], 4) + 0.0,
                rpy_deg=np.round(np.rad2deg(rpy), 1) + 0.0,
                height=float((grip.middle - p_BG) @ direction),
                # An axis of the palm may be one step farther from the line.
                rank=(int(beside) + int(beyond > BEYOND), aside + oblique * np.deg2rad(STEP_DEG)),
            )
        )
    return sorted(frames, key=lambda frame: frame.rank)


def _directions(grip: Grip, centre: Array) -> list[tuple[Array, float]]:
    """Return possible unit directions (3,) of Gz, with angles to the line palm-pinch [rad]."""
    axis = grip.axis
    line = grip.middle - centre
    line = line - (line @ axis) * axis
    if np.linalg.norm(line) < 1e-6:
        line = np.cross(axis, np.roll(axis, 1))
    line /= np.linalg.norm(line)
    third = np.cross(axis, line)
    turns = np.deg2rad(np.arange(-165, 181, STEP_DEG))
    found = [np.cos(t) * line + np.sin(t) * third for t in turns]
    found += [own for own in (*np.eye(3), *-np.eye(3)) if abs(own @ axis) < np.sin(ALIGNED)]
    return [(d, float(np.arccos(np.clip(d @ line, -1.0, 1.0)))) for d in found]


def _origin(grip: Grip, direction: Array, parts: list[Array]) -> tuple[Array, bool] | None:
    """Return the origin (3,) of G below the pinch, and whether the palm is beside the ray."""
    # Find where the ray to the pinch leaves the palm, or else the palm's foremost point.
    spans = [ray_span(corners, grip.middle, direction) for corners in parts]
    leaves = [span[1] for span in spans if span is not None]
    if leaves:
        back = max(leaves)
    else:
        ahead = max(float((corners @ direction).max()) for corners in parts)
        back = min(ahead - float(grip.middle @ direction), -2.0 * AHEAD)
    return (grip.middle + back * direction, not leaves) if back <= -AHEAD else None
