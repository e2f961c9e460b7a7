"""The fingers of a vendor's model, and the ways in which each may close.

In: a `VendorModel`. Out: its palm, a chain of joints per finger, and for each finger some
`Closing`: straight lines in the space of its joints, from open to closed.

Joints that turn about the same axis as the last one of a finger, at zero, bend it: they close
together. The others (a spread, an abduction, a thumb's opposition) keep a position.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from drakegrasp.commissioning.draft.answers import Answers
from drakegrasp.errors import HandError
from drakegrasp.frames import Array, rotation_about
from drakegrasp.hand.vendor.model import VendorJoint, VendorModel

#: Cosine from which two axes count as parallel.
PARALLEL = 0.94
#: Joints that keep a position are tried at several if they can turn so far [rad], else at 0.
WIDE, POSITIONS = 0.8, 5
#: Ratios of the second and later bending joints to the first, where each has a motor.
RATIOS = {1: ((),), 2: ((1.0,), (0.5,)), 3: ((1.0, 0.5), (1.0, 1.0), (0.5, 0.25))}
#: How far the second bending joint is bent in the open hand [rad].
BENT = (0.0, 0.3)
#: Postures on the way from open to closed.
STEPS = 12
#: A link of the same motor that reaches less than this share of the farthest is no finger.
REACH = 0.8
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
    preshape: dict[str, float]
    at_rest: bool
    cost: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Chain:
    """The joints from the palm to a fingertip link, and the ways in which they may close."""

    tip: str
    joints: list[VendorJoint]
    closings: list[Closing]

    @property
    def closing_joint(self) -> VendorJoint:
        """The joint that the motor drives: the first that closes."""
        moves = self.closings[0].gain != 0.0
        return self.joints[int(np.flatnonzero(moves)[0])]

    def poses(self, q: Array) -> Array:
        """Return the poses (..., 4, 4) of the fingertip link in the palm link at (..., m)."""
        X = np.broadcast_to(np.eye(4), (*q.shape[:-1], 4, 4))
        for j, joint in enumerate(self.joints):
            X = X @ joint.X_PJ @ _motions(joint, q[..., j])
        return np.asarray(X)

    def path(self, closing: Closing) -> Array:
        """Return the positions (`STEPS`, m) from open to closed."""
        c = np.linspace(0.0, closing.limit, STEPS)[:, None]
        return closing.q0 + closing.gain * c


def _motions(joint: VendorJoint, positions: Array) -> Array:
    X = np.zeros((*positions.shape, 4, 4))
    X[..., 3, 3] = 1.0
    if joint.slides:
        X[..., :3, :3] = np.eye(3)
        X[..., :3, 3] = positions[..., None] * joint.axis
    else:
        X[..., :3, :3] = rotation_about(joint.axis, positions)
    return X


def find_palm(model: VendorModel, answers: Answers) -> str:
    """Return the link from which the fingers branch.

    Raises:
        HandError: If there is none, or the answer is no link.
    """
    if answers.palm is not None:
        if answers.palm not in model.links:
            raise HandError(f"--palm must be one of {', '.join(model.links)}, got {answers.palm!r}")
        return answers.palm
    link = model.root
    while True:
        bearing = [j.child for j in model.joints.values() if j.parent == link]
        bearing = [child for child in bearing if _has_shapes(model, child)]
        if not bearing:
            raise HandError(
                "model: must have two fingers or more, got one chain of links: say which link "
                f"carries the fingers with --palm LINK ({', '.join(model.links)})"
            )
        if len(bearing) > 1:
            return link
        link = bearing[0]


def find_chains(model: VendorModel, palm: str, answers: Answers) -> list[Chain]:
    """Return the fingers, in the order of the model.

    Raises:
        HandError: If there are fewer than two, or an answer names none of them.
    """
    leaves = [name for name in model.links if name != palm and _is_leaf(model, name, palm)]
    if unknown := [name for name in answers.fingers if name not in model.links]:
        raise HandError(f"--fingers must be of {', '.join(leaves)}, got {unknown[0]!r}")
    chosen = list(answers.fingers) or _without_linkages(model, palm, leaves)
    chains = []
    for tip in chosen:
        joints = model.chain(tip, palm)
        if not joints or joints[0].parent != palm:
            raise HandError(f"--fingers must be links beyond the palm {palm!r}, got {tip!r}")
        closings = find_closings(model, joints, answers)
        if closings:
            chains.append(Chain(tip=tip, joints=joints, closings=closings))
    if len(chains) < 2:
        raise HandError(
            f"model: must have two fingers that can close from the palm {palm!r}, got "
            f"{len(chains)}: name the palm with --palm LINK, fingertips with --fingers LINK,LINK"
        )
    return chains


def _has_shapes(model: VendorModel, link: str) -> bool:
    """Return whether a link, or one that it carries, has a shape."""
    below = [joint.child for joint in model.joints.values() if joint.parent == link]
    return bool(model.links[link].collisions) or any(_has_shapes(model, name) for name in below)


def _is_leaf(model: VendorModel, link: str, palm: str) -> bool:
    """Return whether a link is the last one with shapes of a chain from the palm."""
    chain = model.chain(link, palm)
    below = [joint.child for joint in model.joints.values() if joint.parent == link]
    return (
        bool(chain)
        and chain[0].parent == palm
        and bool(model.links[link].collisions)
        and not any(_has_shapes(model, name) for name in below)
    )


def _without_linkages(model: VendorModel, palm: str, leaves: Sequence[str]) -> list[str]:
    """Return the leaves without the bars of linkages.

    Those are moved by a motor that moves others, and have fewer joints or reach less far.
    """
    reach, motors, joined = {}, {}, {}
    for leaf in leaves:
        X = model.pose(leaf, {}, palm)
        corners = model.links[leaf].corners() @ X[:3, :3].T + X[:3, 3]
        reach[leaf] = float(np.linalg.norm(corners, axis=1).max())
        joints = model.chain(leaf, palm)
        joined[leaf] = len(joints)
        motors[leaf] = {
            model.mimics[j.name].leader if j.name in model.mimics else j.name for j in joints
        }
    return [
        leaf
        for leaf in leaves
        if not any(
            motors[leaf] <= motors[other]
            and (joined[leaf] < joined[other] or reach[leaf] < REACH * reach[other])
            for other in leaves
        )
    ]


def find_closings(
    model: VendorModel, joints: Sequence[VendorJoint], answers: Answers
) -> list[Closing]:
    """Return the ways in which a finger may close."""
    # Joints in groups that one leader moves, with ratio and offset to it.
    groups: dict[str, list[tuple[int, float, float]]] = {}
    for j, joint in enumerate(joints):
        mimic = model.mimics.get(joint.name)
        leader = joint.name if mimic is None else mimic.leader
        ratio, offset = (1.0, 0.0) if mimic is None else (mimic.ratio, mimic.offset)
        groups.setdefault(leader, []).append((j, ratio, offset))
    axes = _axes(joints)
    last = next(leader for leader, group in groups.items() if group[-1][0] == len(joints) - 1)
    slides = joints[-1].slides
    bending = [
        leader
        for leader, group in groups.items()
        if leader == last
        or (
            not slides
            and not joints[group[0][0]].slides
            and abs(axes[group[0][0]] @ axes[-1]) > PARALLEL
        )
    ]

    # Their ranges, and what the others may be at.
    kept = [leader for leader in groups if leader not in bending]
    choices = [_positions(model, leader, answers) for leader in kept]
    rests = tuple(positions[0] for positions in choices)
    found = []
    for sign in (1.0, -1.0):
        if joints[groups[bending[0]][0][0]].name in answers.reverse and sign > 0.0:
            continue
        bends = _bends(joints, [groups[leader] for leader in bending], axes, sign)
        for positions in product(*choices):
            preshape = dict(zip(kept, positions, strict=True))
            q0 = np.zeros(len(joints))
            unusual = 0.0
            for leader, position in preshape.items():
                for j, ratio, offset in groups[leader]:
                    q0[j] = np.clip(ratio * position + offset, *joints[j].limits)
                unusual += AWAY * abs(position)
            for start, gain, limit, cost in bends:
                found.append(
                    Closing(
                        q0=q0 + start,
                        gain=gain,
                        limit=limit,
                        preshape=preshape,
                        at_rest=positions == rests,
                        cost=cost + unusual,
                    )
                )
    return found


def _axes(joints: Sequence[VendorJoint]) -> Array:
    """Return the axes (m, 3) of joints in the palm link, with all at zero."""
    X, axes = np.eye(4), []
    for joint in joints:
        X = X @ joint.X_PJ
        axes.append(X[:3, :3] @ joint.axis)
    return np.array(axes)


def _positions(model: VendorModel, leader: str, answers: Answers) -> list[float]:
    """Return the positions at which a joint that does not close is tried."""
    if leader in answers.joints:
        return [answers.joints[leader]]
    joint = model.joints[leader]
    lower, upper = joint.limits
    rest = float(np.clip(0.0, lower, upper))
    if joint.slides or not np.isfinite(upper - lower) or upper - lower < WIDE:
        return [rest]
    return sorted({rest, *np.round(np.linspace(lower, upper, POSITIONS), 3).tolist()}, key=abs)


def _bends(
    joints: Sequence[VendorJoint],
    groups: Sequence[Sequence[tuple[int, float, float]]],
    axes: Array,
    sign: float,
) -> list[tuple[Array, Array, float, float]]:
    """Return start (m,), gain (m,), limit and cost of the ways to bend a finger in a sense."""
    # Each group moves with the position of its first joint, in the sense of the first group's.
    spans = []
    for group in groups:
        first, ratio, offset = group[0]
        own = [(j, r / ratio, o - offset * r / ratio) for j, r, o in group]
        lower, upper = -np.inf, np.inf
        for j, r, o in own:
            ends = np.sort((_finite(joints[j]) - o) / r)
            lower, upper = max(lower, ends[0]), min(upper, ends[1])
        sense = sign * (1.0 if axes[first] @ axes[groups[0][0][0]] >= 0.0 else -1.0)
        c = np.sort(np.array([lower, upper]) * sense)
        spans.append((own, sense, c[0], c[1]))

    # The first starts at zero if it can close from there, else at its end.
    _, _, low, high = spans[0]
    least = max(0.25 * (high - low), LEAST[joints[groups[0][0][0]].slides])
    start, cost = (0.0, 0.0) if low <= 1e-9 and high >= least else (low, NOT_ZERO)
    cost = 0.0 if joints[groups[0][0][0]].slides else cost
    start = max(start, low)
    if high - start < LEAST[joints[groups[0][0][0]].slides]:
        return []
    cost += SMALLER * (1.0 - (high - start) / max(high - low, 1e-9))

    found = []
    ranges = tuple((h - max(0.0, lo)) / (high - start) for _, _, lo, h in spans[1:])
    sets = [*RATIOS.get(len(groups), ()), ranges] if len(groups) > 1 else [()]
    for bent in BENT if len(groups) > 1 else (0.0,):
        for ratios in sets:
            q0, gain, limit = np.zeros(len(joints)), np.zeros(len(joints)), high - start
            for g, (own, sense, lo, h) in enumerate(spans):
                share = 1.0 if g == 0 else ratios[g - 1]
                at = start if g == 0 else float(np.clip(bent if g == 1 else 0.0, lo, h))
                if share <= 0.0:
                    limit = 0.0
                    break
                limit = min(limit, (h - at) / share)
                for j, r, o in own:
                    q0[j] = r * sense * at + o
                    gain[j] = r * sense * share
            if limit > 0.5 * (high - start) or limit > 0.5:
                found.append((q0, gain, float(limit), cost + 0.1 * bent))
    return found


def _finite(joint: VendorJoint) -> Array:
    return np.where(np.isfinite(joint.limits), joint.limits, [-UNLIMITED, UNLIMITED])
