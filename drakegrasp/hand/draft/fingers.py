"""The fingers of a vendor's model: its palm, the joints of each finger, and how it may close.

Input: a `VendorModel`, and a person's answers. Output: the joints of each finger, with its
`Closing`s: straight lines in the space of its joints, from open to closed.

Joints that turn about the same axis as the last joint, at zero, bend the finger and close together.
The other joints (a spread, an abduction, a thumb's opposition) keep a position.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np

from drakegrasp.errors import HandError
from drakegrasp.frames import Array, transform_points
from drakegrasp.hand.draft.vendor import VendorJoint, VendorModel, chain_poses

#: Cosine above which two axes are parallel.
PARALLEL = 0.94
#: Joints that keep a position are tried at several positions if their range is this large [rad], or
#: else only at 0.
WIDE, POSITIONS = 0.8, 5
#: Ratios of the second and later bending joints to the first, if each has a motor.
RATIOS = {2: ((1.0,), (0.5,)), 3: ((1.0, 0.5), (1.0, 1.0), (0.5, 0.25))}
#: Positions of the second bending joint in the open hand [rad].
BENT = (0.0, 0.3)
#: Smallest motion of a closing joint, turning [rad] and sliding [m]; assumed motion of a turning
#: joint without limits [rad].
LEAST, UNLIMITED = {False: 0.15, True: 0.004}, np.pi / 2.0
#: Fraction of its range through which a finger usually closes.
MOST = 0.5
#: Number of postures from open to closed.
STEPS = 12
#: A link of the same motor is not a finger if it reaches less than this fraction of the farthest.
REACH = 0.8
#: Joints of a finger that a motor moves: index of each joint, ratio and offset of its position.
_Moved = list[tuple[int, float, float]]


@dataclass(frozen=True, kw_only=True)
class Answers:
    """A person's answers that override the guesses; names are those of the vendor's model.

    Attributes:
        palm: The link from which the fingers branch.
        fingers: Fingertip links of all fingers that grasp.
        effort: Largest effort of the motors [N m or N], if it is the same for all.
    """

    palm: str | None = None
    fingers: tuple[str, ...] = ()
    effort: float | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Closing:
    """A method of closing a finger with m joints: positions q0 + gain * c, for c in 0..limit.

    Attributes:
        q0, gain: (m,), in the vendor's positions.
        limit: Closing at which a joint reaches its own limit [rad or m].
        preshape: Position of each joint that does not close and follows no other joint.
        at_rest: Whether those joints are as near to zero as possible.
        usual: Whether the finger is open at zero and closes through most of its range.
        away: Sum of the positions that the other joints, and bent ones, keep in the open hand
            [rad or m].
    """

    q0: Array
    gain: Array
    limit: float
    preshape: dict[str, float] = field(default_factory=dict)
    at_rest: bool = True
    usual: bool = True
    away: float = 0.0

    def path(self) -> Array:
        """Return the positions (`STEPS`, m) from open to closed."""
        return self.q0 + self.gain * np.linspace(0.0, self.limit, STEPS)[:, None]


def find_palm(model: VendorModel, answers: Answers) -> str:
    """Return the link from which the fingers branch.

    Raises:
        HandError: If there is no such link, or the answer is not a link.
    """
    if answers.palm is not None:
        if answers.palm not in model.links:
            raise HandError(f"--palm must be one of {', '.join(model.links)}, got {answers.palm!r}")
        return answers.palm
    link = model.root
    while len(bearing := [child for child in model.below(link) if model.has_shapes(child)]) == 1:
        link = bearing[0]
    if not bearing:
        raise HandError(
            "model: must have two fingers or more, got one chain of links: name the "
            f"link from which the fingers branch with --palm LINK ({', '.join(model.links)})"
        )
    return link


def find_fingers(
    model: VendorModel, palm: str, answers: Answers
) -> list[tuple[list[VendorJoint], list[Closing]]]:
    """Return the fingers in the order of the model: joints from the palm, and closings.

    Raises:
        HandError: If there are fewer than two, or an answer names a link that is not a finger's.
    """
    fingers = []
    for tip in find_tips(model, palm, answers):
        joints = model.chain(tip, palm)
        if not joints or joints[0].parent != palm:
            raise HandError(f"--fingers must be links beyond the palm {palm!r}, got {tip!r}")
        if closings := find_closings(model, joints):
            fingers.append((joints, closings))
    if len(fingers) < 2:
        raise HandError(
            f"model: must have two fingers that can close from the palm {palm!r}, got "
            f"{len(fingers)}: name the palm with --palm LINK, fingertips with --fingers LINK,LINK"
        )
    return fingers


def find_tips(model: VendorModel, palm: str, answers: Answers) -> list[str]:
    """Return the last links of fingers: links with shapes and no further links with shapes.

    Raises:
        HandError: If an answer is not a link.
    """
    leaves = [
        name
        for name, link in model.links.items()
        if model.carries(palm, name) and link.collisions
        if not any(map(model.has_shapes, model.below(name)))
    ]
    if unknown := [name for name in answers.fingers if name not in model.links]:
        raise HandError(f"--fingers must be of {', '.join(leaves)}, got {unknown[0]!r}")
    return list(answers.fingers) or _without_linkages(model, palm, leaves)


def _without_linkages(model: VendorModel, palm: str, leaves: Sequence[str]) -> list[str]:
    """Return the leaves without the bars of linkages.

    A bar is moved by a motor that also moves another leaf, and has fewer joints or reaches less
    far.
    """
    facts = {}
    for leaf in leaves:
        corners = transform_points(model.pose(leaf, {}, palm), model.links[leaf].corners())
        joints = model.chain(leaf, palm)
        motors = {model.mimic(joint.name).leader for joint in joints}
        facts[leaf] = motors, len(joints), float(np.linalg.norm(corners, axis=1).max())

    def is_bar(leaf: str, other: str) -> bool:
        (motors, joined, reach), (others, most, farthest) = facts[leaf], facts[other]
        return motors <= others and (joined < most or reach < REACH * farthest)

    return [leaf for leaf in leaves if not any(is_bar(leaf, other) for other in leaves)]


def find_closings(model: VendorModel, joints: Sequence[VendorJoint]) -> list[Closing]:
    """Return the methods by which a finger may close."""
    # Find the motors that bend it, and the possible positions of the other motors.
    motors: dict[str, _Moved] = {}
    for j, joint in enumerate(joints):
        mimic = model.mimic(joint.name)
        motors.setdefault(mimic.leader, []).append((j, mimic.ratio, mimic.offset))
    frames, _ = chain_poses(joints, np.zeros(len(joints)))
    axes = [X[:3, :3] @ joint.axis for X, joint in zip(frames, joints, strict=True)]
    bending = {
        leader: moved for leader, moved in motors.items() if _bends_finger(moved, joints, axes)
    }
    if not bending:
        return []
    kept = {leader: moved for leader, moved in motors.items() if leader not in bending}
    choices = [_positions(model.joints[leader]) for leader in kept]
    rests = tuple(positions[0] for positions in choices)

    # Try both directions.
    found, lead = [], next(iter(bending.values()))[0][0]
    for sign in (1.0, -1.0):
        senses = [sign * (1.0 if axes[m[0][0]] @ axes[lead] >= 0.0 else -1.0)
                  for m in bending.values()]  # fmt: skip
        bends = _bends(joints, list(bending.values()), senses)
        for positions in product(*choices):
            q0 = np.zeros(len(joints))
            for moved, position in zip(kept.values(), positions, strict=True):
                for j, ratio, offset in moved:
                    q0[j] = np.clip(ratio * position + offset, *joints[j].limits)
            preshape = dict(zip(kept, positions, strict=True))
            away, at_rest = float(np.abs(positions).sum()), positions == rests
            found += [
                replace(b, q0=q0 + b.q0, preshape=preshape, at_rest=at_rest, away=b.away + away)
                for b in bends
            ]
    return found


def _bends_finger(moved: _Moved, joints: Sequence[VendorJoint], axes: Sequence[Array]) -> bool:
    """Return whether a motor moves the last joint, or a joint with the same axis (3,)."""
    first, last = moved[0][0], len(joints) - 1
    turns = not (joints[last].slides or joints[first].slides)
    return moved[-1][0] == last or (turns and bool(abs(axes[first] @ axes[-1]) > PARALLEL))


def _positions(joint: VendorJoint) -> list[float]:
    """Return the positions at which a joint that does not close is tried, its rest first."""
    lower, upper = joint.limits
    rest = float(np.clip(0.0, lower, upper))
    if joint.slides or not WIDE <= upper - lower < np.inf:
        return [rest]
    return sorted({rest, *np.round(np.linspace(lower, upper, POSITIONS), 3).tolist()}, key=abs)


def _bends(
    joints: Sequence[VendorJoint], motors: Sequence[_Moved], senses: Sequence[float]
) -> list[Closing]:
    """Return the methods to bend a finger by motors in given directions, other joints at 0."""
    # The first motor starts at zero if the finger can close from there, or else at its end.
    spans = [_span(joints, *motor) for motor in zip(motors, senses, strict=True)]
    _, low, high = spans[0]
    slides = joints[motors[0][0][0]].slides
    from_zero = low <= 1e-9 and high >= max(0.25 * (high - low), LEAST[slides])
    start = max(0.0, low) if from_zero else low
    if high - start < LEAST[slides]:
        return []
    usual = (from_zero or slides) and high - start >= MOST * (high - low)

    # The other motors follow in usual ratios, or each through its whole range.
    whole = tuple((top - max(0.0, bottom)) / (high - start) for _, bottom, top in spans[1:])
    ratios = [*RATIOS.get(len(spans), ()), whole]
    found = []
    for bent, own in product(BENT if len(spans) > 1 else (0.0,), ratios):
        q0, gain, limit = np.zeros(len(joints)), np.zeros(len(joints)), np.inf
        for g, ((moved, bottom, top), ratio) in enumerate(zip(spans, (1.0, *own), strict=True)):
            at = start if g == 0 else float(np.clip(bent if g == 1 else 0.0, bottom, top))
            limit = min(limit, (top - at) / ratio) if ratio > 0.0 else 0.0
            for j, r, offset in moved:
                q0[j], gain[j] = r * at + offset, r * ratio
        if limit > 0.5 * min(high - start, 1.0):
            found.append(Closing(q0=q0, gain=gain, limit=float(limit), usual=usual, away=bent))
    return found


def _span(
    joints: Sequence[VendorJoint], moved: _Moved, sense: float
) -> tuple[_Moved, float, float]:
    """Return how joints move with the first one in a given direction, and its range."""
    _, ratio, offset = moved[0]
    own, ends = [(j, r / ratio, o - offset * r / ratio) for j, r, o in moved], []
    for j, r, o in own:
        limits, most = joints[j].limits, 0.0 if joints[j].slides else UNLIMITED
        finite = np.where(np.isfinite(limits), limits, [-most, most])
        ends.append(np.sort((finite - o) / r))
    low, high = np.sort(np.array([np.max(ends, axis=0)[0], np.min(ends, axis=0)[1]]) * sense)
    return [(j, r * sense, o) for j, r, o in own], float(low), float(high)
