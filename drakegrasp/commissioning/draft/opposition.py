"""Which fingers close against which, and from which positions of the joints that do not close.

In: the chains of a model's fingers. Out: `Grip`s, the best first: a finger, often a thumb, and one
or two that it meets. Every way to close of every finger is compared with those of every other one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from drakegrasp.commissioning.draft.closings import Closing
from drakegrasp.commissioning.draft.fingers import STEPS, Chain
from drakegrasp.commissioning.draft.pads import Pad, end_of, find_pad, snapped, surface_points
from drakegrasp.frames import Array
from drakegrasp.hand.draft.model import VendorJoint, VendorModel

#: Width of what is pinched [m], and how far from it costs nothing.
WIDTH, TOLERANCE = 0.04, 0.01
#: What it costs if one finger has closed fully and the other not at all, if pads come no nearer
#: than they should [1/m], and if they pinch at another width [1/m].
UNEVEN, APART, OFF_WIDTH = 0.5, 20.0, 40.0
#: What it costs that a pad passes the other one instead of coming towards it.
PASSING = 0.5
#: What it costs to pinch near the end of the way, from this share on, and to open less far [1/m].
LATE, LATE_COST, OPENING, NARROW = 0.75, 2.0, 0.06, 10.0
#: Pads that come so close meet [m].
MEETING = 0.006
#: Angles by which a contact may be nearer to a fingertip's end than its pad [rad], and their cost.
ROUND, ROUND_COST = np.deg2rad([0.0, 30.0, 60.0]), 0.2
#: A finger that turns about its own direction has no side by which it closes, as a cosine.
SQUARE = 0.3
#: Grips that are returned at most.
GRIPS = 40
#: A hand of more fingers than this grasps with so many.
FINGERS = 3


@dataclass(frozen=True, kw_only=True, eq=False)
class Reach:
    """The ways to close of a finger: pads (c, s, 3) in the palm link at each of s steps.

    Attributes:
        chain: The finger.
        closings: The ways.
        points: Where the pad is, for each of c ways to close.
        moves: Unit directions in which it moves.
        normals: (r, c, s, 3), where it faces: a fingertip's end is round.
        pads: The pad of each way.
    """

    chain: Chain
    closings: list[Closing]
    points: Array
    moves: Array
    normals: Array
    pads: list[Pad]

    def at_rest(self) -> Reach:
        """Return the ways to close whose other joints are at rest: only one finger opposes."""
        kept = [i for i, closing in enumerate(self.closings) if closing.at_rest]
        return replace(
            self,
            closings=[self.closings[i] for i in kept],
            points=self.points[kept],
            moves=self.moves[kept],
            normals=self.normals[:, kept],
            pads=[self.pads[i] for i in kept],
        )

    def costs(self) -> Array:
        """Return what is unusual about each way to close, (c,)."""
        return np.array([closing.cost for closing in self.closings])


@dataclass(frozen=True, kw_only=True, eq=False)
class Member:
    """A finger of a grip, and how it closes."""

    chain: Chain
    closing: Closing
    pad: Pad
    points: Array  # (s, 3), of the pad in the palm link, from open to closed

    @property
    def first(self) -> int:
        """The number of the joint that the motor drives: the first that closes."""
        return int(np.flatnonzero(self.closing.gain)[0])

    @property
    def joint(self) -> VendorJoint:
        """That joint, in the vendor's positions."""
        return self.chain.joints[self.first]

    @property
    def sign(self) -> float:
        """Sense of that joint's positions in which it closes."""
        return float(np.sign(self.closing.gain[self.first]))

    @property
    def zero(self) -> float:
        """That joint's position in the open hand [rad or m]."""
        return float(self.closing.q0[self.first])

    def followers(self) -> dict[str, tuple[float, float]]:
        """Return ratio and offset, to the driven joint, of the finger's joints that follow it."""
        rows = zip(self.chain.joints, self.closing.gain, self.closing.q0, strict=True)
        return {j.name: (float(g), float(q)) for j, g, q in rows if g != 0.0 and j != self.joint}


@dataclass(frozen=True, kw_only=True, eq=False)
class Grip:
    """Fingers that close against one.

    Attributes:
        members: The fingers; the last one opposes the others.
        step: Of each, at which a thing of `WIDTH` is pinched.
        cost: How far the pinch is from a straight and even one.
    """

    members: tuple[Member, ...]
    step: tuple[int, ...]
    cost: float

    @property
    def axis(self) -> Array:
        """(3,), unit, from the fingers to the last one, in the palm link."""
        points = self.pinched()
        line = points[-1] - points[:-1].mean(axis=0)
        return np.asarray(line / np.linalg.norm(line))

    def pinched(self) -> Array:
        """Return the pad points (k, 3) of the pinch."""
        return np.array([m.points[s] for m, s in zip(self.members, self.step, strict=True)])

    @property
    def middle(self) -> Array:
        """(3,), between the fingers and the last one."""
        points = self.pinched()
        return np.asarray((points[-1] + points[:-1].mean(axis=0)) / 2.0)


def find_reach(model: VendorModel, palm: str, chain: Chain) -> Reach:
    """Return where a finger's pad comes, for every way to close."""
    # The end of the fingertip, and where it goes.
    q = np.stack([chain.path(closing) for closing in chain.closings])
    X = chain.poses(q)
    parts = [shape.corners() for shape in model.links[chain.tip].collisions]
    surface = surface_points(parts)
    last = chain.joints[-1]
    end, along = end_of(surface, _outward(model, palm, chain) if last.slides else None)
    ends = X[..., :3, :3] @ end + X[..., :3, 3]
    motion = np.diff(ends, axis=1)
    inside = (np.swapaxes(X[:, :-1, :3, :3], -1, -2) @ motion[..., None])[..., 0].mean(axis=1)

    # It faces its motion, square to the finger and to the axis about which it turns.
    front = last.axis if last.slides else np.cross(last.axis, along)
    if np.linalg.norm(front) < SQUARE:
        front = inside.mean(axis=0) - (inside.mean(axis=0) @ along) * along
    sides = {sign: find_pad(parts, surface, sign * front, along) for sign in (1.0, -1.0)}
    pads = [sides[1.0 if moves @ front >= 0.0 else -1.0] for moves in inside]
    points = np.array([pad.point for pad in pads])[:, None, :, None]
    directions = [np.array([getattr(p, name) for p in pads]) for name in ("normal", "along")]
    normals, alongs = ((X[..., :3, :3] @ d[:, None, :, None])[..., 0] for d in directions)
    places = (X[..., :3, :3] @ points)[..., 0] + X[..., :3, 3]
    moves = np.gradient(places, axis=1)
    return Reach(
        chain=chain,
        closings=chain.closings,
        points=places,
        moves=moves / np.linalg.norm(moves, axis=-1, keepdims=True),
        normals=np.stack([np.cos(r) * normals + np.sin(r) * alongs for r in ROUND]),
        pads=pads,
    )


def _outward(model: VendorModel, palm: str, chain: Chain) -> Array:
    """Return the direction (3,) from the palm to a sliding fingertip, across its slide."""
    X = chain.poses(np.zeros(len(chain.joints)))
    corners = model.links[chain.tip].corners() @ X[:3, :3].T + X[:3, 3]
    line = X[:3, :3].T @ (corners.mean(axis=0) - model.links[palm].corners().mean(axis=0))
    axis = chain.joints[-1].axis
    line = line - (line @ axis) * axis
    return np.asarray(snapped(line))


def find_grips(reaches: Sequence[Reach]) -> list[Grip]:
    """Return the best ways in which fingers close against one of them."""
    # What each way to close the last finger costs with each way to close the others.
    ranked: list[tuple[float, int, int, list[tuple[int, int]]]] = []
    resting = [reach.at_rest() for reach in reaches]
    for t, last in enumerate(reaches):
        others = [o for o in range(len(reaches)) if o != t]
        costs = {o: _pair_costs(last, resting[o]) for o in others}
        for group in _alike(resting, others):
            for b in range(len(last.points)):
                total, chosen = _cheapest(group, costs, b)
                ranked.append((total + float(last.costs()[b]), t, b, chosen))
    ranked.sort(key=lambda entry: entry[:3])

    # The best ones that differ in the last finger's positions.
    grips: list[Grip] = []
    seen: set[tuple[int, tuple[float, ...]]] = set()
    for cost, t, b, chosen in ranked:
        key = t, tuple(np.round(reaches[t].closings[b].q0, 2).tolist())
        if key in seen:
            continue
        seen.add(key)
        grips.append(_grip([(resting[o], a) for o, a in chosen], (reaches[t], b), cost))
        if len(grips) == GRIPS:
            break
    return grips


def _alike(reaches: Sequence[Reach], others: Sequence[int]) -> list[list[int]]:
    """Return which fingers may close together: those with as many ways to, or else all."""
    wanted = min(len(others), FINGERS - 1)
    counts = [len(reaches[o].points) for o in others]
    groups = [
        [o for o, own in zip(others, counts, strict=True) if own == count]
        for count in sorted(set(counts))
    ]
    return [group for group in groups if len(group) >= wanted] or [list(others)]


def _cheapest(
    group: Sequence[int], costs: dict[int, Array], b: int
) -> tuple[float, list[tuple[int, int]]]:
    """Return the cheapest fingers of a group against one, which close alike if they can."""
    wanted = min(len(costs), FINGERS - 1)
    rows = [costs[o][b] for o in group]
    if len({len(row) for row in rows}) == 1:
        table = np.array(rows)
        best = np.sort(table, axis=0)[:wanted].mean(axis=0)
        a = int(best.argmin())
        order = np.argsort(table[:, a], kind="stable")[:wanted]
        return float(best[a]), [(group[i], a) for i in sorted(order.tolist())]
    least = np.array([row.min() for row in rows])
    order = np.argsort(least, kind="stable")[:wanted]
    chosen = [(group[i], int(rows[i].argmin())) for i in sorted(order.tolist())]
    return float(least[order].mean()), chosen


def _pair_costs(last: Reach, other: Reach) -> Array:
    """Return the cost (b, a) of each way to close one finger with each of another."""
    own = other.costs()
    return np.stack(
        [_costs(last, b, other).min(axis=(1, 2)) + own for b in range(len(last.points))]
    )


def _costs(last: Reach, b: int, other: Reach) -> Array:
    """Return the cost (a, s, s) of one way to close a finger, with each of another, by steps."""
    # Pads that face each other along the line between them.
    line = last.points[b][None, None] - other.points[:, :, None]
    gap = np.linalg.norm(line, axis=-1)
    unit = line / np.maximum(gap, 1e-6)[..., None]
    toll = ROUND_COST * ROUND[:, None, None, None]
    facing = (np.einsum("rasi,asti->rast", other.normals, unit) - toll).max(axis=0)
    faced = (-np.einsum("rti,asti->rast", last.normals[:, b], unit) - toll).max(axis=0)
    nearing = np.einsum("asi,asti->ast", other.moves, unit)
    neared = -np.einsum("ti,asti->ast", last.moves[b], unit)
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


def _grip(others: Sequence[tuple[Reach, int]], last: tuple[Reach, int], cost: float) -> Grip:
    """Return the grip of some fingers against one, each with one of its ways to close."""
    costs = np.stack([_costs(*last, other)[a] for other, a in others])
    at = int(costs.min(axis=1).sum(axis=0).argmin())
    steps = [int(table[:, at].argmin()) for table in costs]
    members = tuple(
        Member(chain=r.chain, closing=r.closings[a], pad=r.pads[a], points=r.points[a])
        for r, a in (*others, last)
    )
    return Grip(members=members, step=(*steps, at), cost=cost)
