"""The words of a drafted hand file: names of its fingers, and why each value is so."""

from __future__ import annotations

from itertools import takewhile

from drakegrasp.commissioning.draft.answers import Answers
from drakegrasp.commissioning.draft.opposition import Grip
from drakegrasp.commissioning.draft.palm import PalmFrame
from drakegrasp.hand.draft.model import VendorModel

#: Names of fingers, by what the names of their links contain.
NAMES = ("thumb", "index", "middle", "ring", "pinky", "little")
SIDES = ("left", "right")


def finger_names(grip: Grip) -> list[str]:
    """Return a name for each finger: a usual one, a side, or what tells its link from others."""
    tips = [member.chain.tip for member in grip.members]
    for words in (NAMES, SIDES):
        found = []
        for member in grip.members:
            texts = [member.chain.tip, *(joint.name for joint in reversed(member.chain.joints))]
            texts += [joint.child for joint in member.chain.joints]
            found += [word for text in texts for word in words if word in text.lower()][:1]
        if len(set(found)) == len(tips):
            return found
    # What is the same at the end of all names says nothing.
    alike = (len(set(letters)) == 1 for letters in zip(*(tip[::-1] for tip in tips), strict=False))
    end = sum(1 for _ in takewhile(bool, alike))
    short = [tip[: len(tip) - end].rstrip("_-.") for tip in tips]
    return short if all(short) else tips


def reasons_of(
    model: VendorModel, grip: Grip, frame: PalmFrame, answers: Answers
) -> dict[str, str]:
    """Return why the values are so, by the paths of their keys."""
    # Of the whole hand.
    reasons = {
        "palm.link": "given" if answers.palm else "the link from which the fingers branch",
        "palm.p_BG": "on the palm's surface, where a line to the pinch leaves it [m]",
        "palm.rpy_deg": f"{'given' if answers.approach is not None else 'guessed'}: Gz square to "
        f"the closing line, pinch {1e3 * frame.height:.0f} mm ahead; Gy to the last finger",
        "fingers": "counter-clockwise about Gz; the last one opposes the others",
        "spread.joints": "they turn two fingers about Gz, both by the same angle",
        "spreads_deg": "usual ones",
        "drive": "guessed: most gears cannot be pushed open; else `torque`",
        "closing_speed_deg": "usual, or what the motors need",
        "closing_speed": "usual, or what the motors need [m/s]",
        "standoffs": "shares of the height of the pinch above the palm [m]",
        "payload": "half of what friction carries at these efforts [kg]",
    }

    # Of each finger.
    for i, member in enumerate(grip.members):
        key = f"fingers.{i}"
        flipped = member.sign != 1.0 or member.zero != 0.0
        reasons |= {
            f"{key}.fingertip": "the last link with shapes",
            f"{key}.closing_joint": "the first that bends the finger"
            + ("; made to close from 0 on, see the model's head" if flipped else ""),
            f"{key}.coupled": "as in the model"
            if any(j.name in model.mimics for j in member.chain.joints)
            else "guessed: the joints behind it bend along",
            f"{key}.pad_region": "the side that faces the closing motion, near the end",
            f"{key}.pad_point": "on that side [m]",
        }
        effort = f"effort of {answers.effort:g} (given)" if answers.effort else "the model's effort"
        for kind in ("torque", "force"):
            reasons[f"{key}.{kind}_limit"] = f"from {effort}; no side presses more than the other"
            reasons[f"{key}.holding_{kind}"] = "guessed: twice that"
        reasons[f"{key}.driven_by"] = "in the model one motor moves both; its limit is that of both"

    # Of the joints that keep a position.
    closed = {j.name for m in grip.members for j in m.chain.joints}
    for name in model.joints:
        reasons[f"preshape.{name}"] = (
            "given" if name in answers.joints
            else "where the fingers oppose best" if name in closed
            else "out of the way"
        )  # fmt: skip
    return reasons
