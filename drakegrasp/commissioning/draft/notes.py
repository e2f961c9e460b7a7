"""What a draft leaves unused of the model: fingers, and parts of the ranges of closing joints."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from drakegrasp.commissioning.draft.answers import Answers
from drakegrasp.commissioning.draft.closings import find_closings
from drakegrasp.commissioning.draft.fingers import find_palm, find_tips
from drakegrasp.commissioning.draft.opposition import Grip
from drakegrasp.hand.draft.model import VendorModel

#: A smaller share of a joint's range is not worth a note.
SHARE = 0.01


def unused_parts(model: VendorModel, grip: Grip, answers: Answers) -> list[str]:
    """Return a line for each finger and each part of a closing joint's range that is not used."""
    return [*_unused_ranges(grip), *_unused_fingers(model, grip, answers)]


def _unused_ranges(grip: Grip) -> Iterator[str]:
    """Yield what of its range a closing joint opens beyond the open hand."""
    for member in grip.members:
        joint = member.joint
        lower, upper = joint.rebased(member.sign, member.zero).limits
        if not np.isfinite([lower, upper]).all() or -lower <= SHARE * (upper - lower):
            continue
        unit = "m" if joint.slides else "rad"
        whole = f"{joint.limits[0]:.4g}..{joint.limits[1]:.4g} {unit}"
        yield (
            f"joint {joint.name}: the hand is open at {member.zero:g} of {whole}, so "
            f"{-lower:.3g} {unit} are not used: to use them, move its zero in the model to where "
            "it is fully open"
        )


def _unused_fingers(model: VendorModel, grip: Grip, answers: Answers) -> Iterator[str]:
    """Yield which fingers do not grasp, and why."""
    palm = find_palm(model, answers)
    used = {member.chain.tip for member in grip.members}
    for tip in find_tips(model, palm, answers):
        if tip in used:
            continue
        joints = model.chain(tip, palm)
        turned = ", ".join(j.name for j in joints if j.name in answers.reverse)
        how = f"with {turned} reversed " if turned else ""
        why = (
            "the others meet better: --fingers says which grasp"
            if find_closings(model, joints, answers)
            else "none of its joints closes it"
        )
        yield f"finger {tip} is not used: {how}{why}"
