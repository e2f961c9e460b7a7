"""Which joints of a vendor's model follow which, and how far they may then go.

In: the mimics that a model declares, and its joints. Out: for each joint that follows the one that
leads it in the end, and joints that have room to.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from drakegrasp.errors import HandError
from drakegrasp.hand.draft.model import VendorJoint
from drakegrasp.hand.model_text import Mimic

#: A joint that follows has room if its limits leave it this share of its leader's way.
ROOM = 0.5


def find_leaders(mimics: Sequence[Mimic], joints: Mapping[str, VendorJoint]) -> dict[str, Mimic]:
    """Return what each joint follows, through all that its leader follows.

    Raises:
        HandError: If mimics form a circle, or name what is no joint that moves.
    """
    given = {mimic.joint: mimic for mimic in mimics}
    found: dict[str, Mimic] = {}
    for name, mimic in given.items():
        if name not in joints:
            raise HandError(f"model: joint {name!r} follows another, so it must turn or slide")

        # Up to a joint that follows nothing.
        ratio, offset, leader, seen = mimic.ratio, mimic.offset, mimic.leader, {name}
        while leader in given and leader not in seen:
            seen.add(leader)
            above = given[leader]
            ratio, offset, leader = ratio * above.ratio, offset + ratio * above.offset, above.leader
        if leader in seen:
            raise HandError(
                f"model: joint {name!r} must follow a joint that leads, got a circle of mimics"
            )
        if leader not in joints:
            raise HandError(f"model: joint {name!r} must follow a joint that moves, got {leader!r}")
        if ratio == 0.0:
            raise HandError(f"model: joint {name!r} must follow {leader!r} by a ratio, got 0")
        found[name] = Mimic(joint=name, leader=leader, ratio=ratio, offset=offset)
    return found


def make_room(
    joints: Mapping[str, VendorJoint], mimics: Mapping[str, Mimic]
) -> tuple[dict[str, VendorJoint], list[str]]:
    """Return joints whose limits let them follow, and a note of each whose limits do not.

    Limits of some vendors' mimics have the wrong sign.
    """
    roomy, notes = dict(joints), []
    for name, mimic in mimics.items():
        lower, upper = joints[name].limits
        led = np.sort(mimic.ratio * joints[mimic.leader].limits + mimic.offset)
        shared = min(led[1], upper) - max(led[0], lower)
        if np.isfinite(led).all() and shared < ROOM * (led[1] - led[0]):
            roomy[name] = replace(joints[name], limits=led)
            notes.append(
                f"joint {name}: its limits {lower:g}..{upper:g} bar the way of its mimic; now "
                f"{led[0]:g}..{led[1]:g}"
            )
    return roomy, notes
