"""The ways in which a finger of a vendor's model may close.

In: the joints from the palm to a fingertip. Out: `Closing`s: straight lines in the space of its
joints, from open to closed.

Joints that turn about the same axis as the last one, at zero, bend the finger: they close together.
The others (a spread, an abduction, a thumb's opposition) keep a position.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np

from drakegrasp.commissioning.draft.answers import Answers
from drakegrasp.frames import Array
from drakegrasp.hand.draft.model import VendorJoint, VendorModel

#: Cosine from which two axes count as parallel.
PARALLEL = 0.94
#: Joints that keep a position are tried at several if they can turn so far [rad], else at 0.
WIDE, POSITIONS = 0.8, 5
#: Ratios of the second and later bending joints to the first, where each has a motor.
RATIOS = {2: ((1.0,), (0.5,)), 3: ((1.0, 0.5), (1.0, 1.0), (0.5, 0.25))}
#: How far the second bending joint is bent in the open hand [rad], and what that costs [1/rad].
BENT, BENT_COST = (0.0, 0.3), 0.1
#: What it costs to start elsewhere than at zero, to close in the smaller part of a range, and that
#: another joint is away from its rest [1/rad].
NOT_ZERO, SMALLER, AWAY = 1.0, 0.6, 0.08
#: A closing joint moves at least so far [rad, m]; one without limits is taken to move so far [rad].
LEAST, UNLIMITED = {False: 0.15, True: 0.004}, np.pi / 2.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Closing:
    """A way to close a finger of m joints: positions q0 + gain * c, for c of 0..limit.

    Attributes:
        q0, gain: (m,), in the vendor's positions.
        limit: Where a joint is at its own limit [rad or m].
        preshape: Position of each joint that leads others, or none, and does not close.
        at_rest: Whether those joints are as near to zero as they can be.
        cost: How unusual it is.
    """

    q0: Array
    gain: Array
    limit: float
    preshape: dict[str, float] = field(default_factory=dict)
    at_rest: bool = True
    cost: float = 0.0


@dataclass(frozen=True)
class _Motor:
    """Joints that move together, each to ratio * position of the leader + offset.

    Attributes:
        leader: Name of the joint whose position counts.
        moved: Number of each joint in the finger, its ratio and its offset.
    """

    leader: str
    moved: list[tuple[int, float, float]]

    @property
    def first(self) -> int:
        """The number of the joint nearest to the palm."""
        return self.moved[0][0]


@dataclass(frozen=True)
class _Span:
    """How a motor moves when a finger bends.

    Attributes:
        moved: Number of each joint, its ratio to the first one, and its offset.
        sense: Sign of the first one's position that bends the finger.
        low, high: How far that joint can go in this sense.
    """

    moved: list[tuple[int, float, float]]
    sense: float
    low: float
    high: float


def find_closings(
    model: VendorModel, joints: Sequence[VendorJoint], answers: Answers
) -> list[Closing]:
    """Return the ways in which a finger may close."""
    # Which motors bend it, and what the others may be at.
    motors, axes = _motors(model, joints), _axes(joints)
    free = [motor for motor in motors if motor.leader not in answers.joints]
    bending = [motor for motor in free if _bends_finger(motor, joints, axes)]
    if not bending:
        return []
    kept = [motor for motor in motors if motor not in bending]
    choices = [_positions(model, motor.leader, answers) for motor in kept]
    rests = tuple(positions[0] for positions in choices)

    # Both senses, unless a person said which it is.
    found = []
    reversed_by_hand = joints[bending[0].first].name in answers.reverse
    for sign in (-1.0,) if reversed_by_hand else (1.0, -1.0):
        bends = _bends(joints, bending, axes, sign)
        for positions in product(*choices):
            q0 = np.zeros(len(joints))
            for motor, position in zip(kept, positions, strict=True):
                for j, ratio, offset in motor.moved:
                    q0[j] = np.clip(ratio * position + offset, *joints[j].limits)
            found += [
                replace(
                    bend,
                    q0=q0 + bend.q0,
                    preshape={m.leader: p for m, p in zip(kept, positions, strict=True)},
                    at_rest=positions == rests,
                    cost=bend.cost + AWAY * float(np.abs(positions).sum()),
                )
                for bend in bends
            ]
    return found


def _motors(model: VendorModel, joints: Sequence[VendorJoint]) -> list[_Motor]:
    """Return the motors of a finger, from the palm on."""
    moved: dict[str, list[tuple[int, float, float]]] = {}
    for j, joint in enumerate(joints):
        mimic = model.mimic(joint.name)
        moved.setdefault(mimic.leader, []).append((j, mimic.ratio, mimic.offset))
    return [_Motor(leader, own) for leader, own in moved.items()]


def _bends_finger(motor: _Motor, joints: Sequence[VendorJoint], axes: Array) -> bool:
    """Return whether a motor moves the last joint, or one that turns about the same axis."""
    first = motor.first
    if motor.moved[-1][0] == len(joints) - 1:
        return True
    turns = not (joints[-1].slides or joints[first].slides)
    return turns and bool(abs(axes[first] @ axes[-1]) > PARALLEL)


def _axes(joints: Sequence[VendorJoint]) -> Array:
    """Return the axes (m, 3) of joints in the palm link, with all at zero."""
    X, axes = np.eye(4), []
    for joint in joints:
        X = X @ joint.X_PJ
        axes.append(X[:3, :3] @ joint.axis)
    return np.array(axes)


def _positions(model: VendorModel, leader: str, answers: Answers) -> list[float]:
    """Return the positions at which a joint that does not close is tried, its rest first."""
    if leader in answers.joints:
        return [answers.joints[leader]]
    joint = model.joints[leader]
    lower, upper = joint.limits
    rest = float(np.clip(0.0, lower, upper))
    if joint.slides or not WIDE <= upper - lower < np.inf:
        return [rest]
    return sorted({rest, *np.round(np.linspace(lower, upper, POSITIONS), 3).tolist()}, key=abs)


def _bends(
    joints: Sequence[VendorJoint], motors: Sequence[_Motor], axes: Array, sign: float
) -> list[Closing]:
    """Return the ways to bend a finger in a sense, the other joints at 0."""
    # The first starts at zero if it can close from there, else at its end.
    spans = [_span(joints, motor, axes, sign, motors[0].first) for motor in motors]
    low, high = spans[0].low, spans[0].high
    slides = joints[motors[0].first].slides
    from_zero = low <= 1e-9 and high >= max(0.25 * (high - low), LEAST[slides])
    start = max(0.0, low) if from_zero else low
    if high - start < LEAST[slides]:
        return []
    cost = SMALLER * (1.0 - (high - start) / max(high - low, 1e-9))
    cost += 0.0 if from_zero or slides else NOT_ZERO

    # The others follow in usual ratios, or each through its whole range.
    ratios: list[tuple[float, ...]] = [()]
    if len(spans) > 1:
        whole = tuple((s.high - max(0.0, s.low)) / (high - start) for s in spans[1:])
        ratios = [*RATIOS.get(len(spans), ()), whole]
    found = []
    for bent in BENT if len(spans) > 1 else (0.0,):
        for own in ratios:
            closing = _bend(len(joints), spans, (start, bent), (1.0, *own))
            if closing.limit > 0.5 * min(high - start, 1.0):
                found.append(replace(closing, cost=cost + BENT_COST * bent))
    return found


def _span(
    joints: Sequence[VendorJoint], motor: _Motor, axes: Array, sign: float, lead: int
) -> _Span:
    """Return how a motor moves in the sense in which the finger's first bending joint does."""
    first, ratio, offset = motor.moved[0]
    moved = [(j, r / ratio, o - offset * r / ratio) for j, r, o in motor.moved]
    ends = []
    for j, r, o in moved:
        limits = joints[j].limits
        finite = np.where(np.isfinite(limits), limits, [-UNLIMITED, UNLIMITED])
        ends.append(np.sort((finite - o) / r))
    sense = sign * (1.0 if axes[first] @ axes[lead] >= 0.0 else -1.0)
    low, high = np.sort(np.array([np.max(ends, axis=0)[0], np.min(ends, axis=0)[1]]) * sense)
    return _Span(moved, sense, float(low), float(high))


def _bend(
    count: int, spans: Sequence[_Span], starts: tuple[float, float], ratios: Sequence[float]
) -> Closing:
    """Return how some of a finger's joints move by ratios, the first two from where they start."""
    q0, gain, limit = np.zeros(count), np.zeros(count), np.inf
    for g, (span, ratio) in enumerate(zip(spans, ratios, strict=True)):
        start = starts[g] if g < 2 else 0.0
        start = start if g == 0 else float(np.clip(start, span.low, span.high))
        limit = min(limit, (span.high - start) / ratio) if ratio > 0.0 else 0.0
        for j, r, o in span.moved:
            q0[j] = r * span.sense * start + o
            gain[j] = r * span.sense * ratio
    return Closing(q0=q0, gain=gain, limit=float(limit))
