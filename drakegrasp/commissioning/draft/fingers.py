"""The fingers of a vendor's model: its palm, and a chain of joints per finger.

In: a `VendorModel`. Out: `Chain`s, each with the ways in which it may close.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drakegrasp.commissioning.draft.answers import Answers
from drakegrasp.commissioning.draft.closings import Closing, find_closings
from drakegrasp.errors import HandError
from drakegrasp.frames import Array
from drakegrasp.hand.draft.model import VendorJoint, VendorModel

#: Postures on the way from open to closed.
STEPS = 12
#: A link of the same motor that reaches less than this share of the farthest is no finger.
REACH = 0.8


@dataclass(frozen=True, kw_only=True, eq=False)
class Chain:
    """The joints from the palm to a fingertip link, and the ways in which they may close."""

    tip: str
    joints: list[VendorJoint]
    closings: list[Closing]

    def poses(self, q: Array) -> Array:
        """Return the poses (..., 4, 4) of the fingertip link in the palm link at (..., m)."""
        X = np.broadcast_to(np.eye(4), (*q.shape[:-1], 4, 4))
        for j, joint in enumerate(self.joints):
            X = X @ joint.X_PJ @ joint.motion(q[..., j])
        return np.asarray(X)

    def path(self, closing: Closing) -> Array:
        """Return the positions (`STEPS`, m) from open to closed."""
        c = np.linspace(0.0, closing.limit, STEPS)[:, None]
        return closing.q0 + closing.gain * c


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
    chains = []
    for tip in find_tips(model, palm, answers):
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


def find_tips(model: VendorModel, palm: str, answers: Answers) -> list[str]:
    """Return the last links of fingers.

    Raises:
        HandError: If an answer is no link.
    """
    leaves = [name for name in model.links if name != palm and _is_leaf(model, name, palm)]
    if unknown := [name for name in answers.fingers if name not in model.links]:
        raise HandError(f"--fingers must be of {', '.join(leaves)}, got {unknown[0]!r}")
    return list(answers.fingers) or _without_linkages(model, palm, leaves)


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
        motors[leaf] = {model.mimic(joint.name).leader for joint in joints}
    return [
        leaf
        for leaf in leaves
        if not any(
            motors[leaf] <= motors[other]
            and (joined[leaf] < joined[other] or reach[leaf] < REACH * reach[other])
            for other in leaves
        )
    ]
