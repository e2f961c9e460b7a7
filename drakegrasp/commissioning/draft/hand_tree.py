"""A hand file and its model, from a grip and its palm frame.

In: a `VendorModel`, a `Grip` and a `PalmFrame`. Out: the model, in which a positive position of a
closing joint closes, from 0, the open hand; and the keys of a hand file, each with why it is so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from typing import Any

import numpy as np

from drakegrasp.commissioning.draft.answers import Answers
from drakegrasp.commissioning.draft.opposition import Grip, Member
from drakegrasp.commissioning.draft.palm import PalmFrame
from drakegrasp.commissioning.draft.strength import closing_limits
from drakegrasp.config import Config, apply_override
from drakegrasp.errors import ConfigError, HandError
from drakegrasp.frames import Array, invert_pose, transform_points
from drakegrasp.hand.file_format import VERSION
from drakegrasp.hand.model_text import Mimic
from drakegrasp.hand.vendor.model import VendorModel
from drakegrasp.simulation.construction import FINGER_DAMPING

#: Usual closing speeds [rad/s], [m/s].
TURNING, SLIDING = np.deg2rad(60.0), 0.1
#: A worm holds so many times what its motor gives: that of a gear of about 70 % efficiency.
HOLDING = 2.0
#: Stand-offs as shares of the height of the pinch above the palm.
STANDOFFS = (0.45, 0.65, 0.8)
#: Share of what friction carries that is the payload.
PAYLOAD = 0.5
#: Names of fingers, by what the names of their links contain.
NAMES = ("thumb", "index", "middle", "ring", "pinky", "little")
SIDES = ("left", "right")
#: Spreads that are tried if two joints spread fingers [deg], and how far they must turn [rad].
SPREADS_DEG, SPREADING = [0.0, 11.25, 22.5], 0.9


@dataclass(frozen=True, kw_only=True, eq=False)
class Draft:
    """A hand file that was drafted.

    Attributes:
        model: Its model.
        tree: Its keys.
        reasons: Why a value is so, by the path of its key, as in "palm.p_BG".
        changed: Lines for the head of the model: joints whose positions are not the vendor's.
    """

    model: VendorModel
    tree: dict[str, Any]
    reasons: dict[str, str]
    changed: list[str]


def positions(model: VendorModel, grip: Grip, share: float) -> dict[str, float]:
    """Return the position of each joint when the fingers have closed by a share of their way."""
    led = {name: 0.0 for name in model.joints if name not in model.mimics}
    for member in grip.members:
        led |= member.closing.preshape
    for member in grip.members:
        led |= {n: q for n, q in _closed(member, share).items() if n in led}
    found = {}
    for name, joint in model.joints.items():
        mimic = model.mimics.get(name)
        at = led[name] if mimic is None else mimic.ratio * led[mimic.leader] + mimic.offset
        found[name] = float(np.clip(at, *joint.limits))
    for member in grip.members:
        found |= _closed(member, share)
    return found


def _closed(member: Member, share: float) -> dict[str, float]:
    q = member.closing.q0 + member.closing.gain * share * member.closing.limit
    moves = member.closing.gain != 0.0
    names = [joint.name for joint in member.chain.joints]
    return {n: float(p) for n, p, m in zip(names, q, moves, strict=True) if m}


def draft_tree(
    model: VendorModel, palm: str, grip: Grip, frame: PalmFrame, answers: Answers, config: Config
) -> Draft:
    """Return the hand file of a grip.

    Raises:
        HandError: If no effort of the motors is known, or a setting is none.
    """
    grip = _in_order(grip, frame)
    limits, forces = closing_limits(model, grip, answers.effort)
    reasons = _reasons(model, grip, frame, answers)
    tree: dict[str, Any] = {"version": VERSION, "model": ""}
    tree["palm"] = {"link": palm, "p_BG": frame.p_BG.tolist(), "rpy_deg": frame.rpy_deg.tolist()}

    # The fingers; joints that nothing else drives keep a position.
    coupled = _couplings(model, grip)
    names = _names(grip)
    fingers = []
    for i, member in enumerate(grip.members):
        joint = _closing(member)
        kind = "force" if joint.slides else "torque"
        limit = float(f"{limits[i]:.3g}")
        finger: dict[str, Any] = {
            "name": names[i],
            "fingertip": member.chain.tip,
            "closing_joint": joint.name,
            f"{kind}_limit": limit,
            f"holding_{kind}": float(f"{HOLDING * limit:.3g}"),
        }
        if coupled[i]:
            finger["coupled"] = [
                {"joint": j, "ratio": round(r, 5), "offset": round(o, 5)}
                for j, (r, o) in coupled[i].items()
            ]
        finger["pad_region"] = member.pad.region()
        finger["pad_point"] = member.pad.point.tolist()
        fingers.append(finger)
    tree["fingers"] = fingers
    driven = {_closing(m).name for m in grip.members} | {j for own in coupled for j in own}
    spread = _spread(model, grip, frame, driven)
    kept = {
        name: round(q, 5)
        for name, q in positions(model, grip, 0.0).items()
        if name not in driven and name not in spread
    }
    if spread:
        tree["spread"] = {"joints": list(spread)}
        tree["spreads_deg"] = SPREADS_DEG
    if kept:
        tree["preshape"] = kept

    # How it is driven and used.
    tree["drive"] = "worm"
    tree |= _speeds(grip, limits, config)
    tree["standoffs"] = [max(round(s * frame.height, 3), 0.003) for s in STANDOFFS]
    carried = PAYLOAD * config.physics.friction_hand * float(forces.sum()) / 9.81
    tree["payload"] = float(f"{carried:.2g}")
    for setting in answers.settings:
        try:
            apply_override(tree, setting)
        except ConfigError as error:
            raise HandError(str(error)) from None
        reasons[setting.partition("=")[0]] = "given"
    return Draft(
        model=_rebased(model, grip, coupled, spread),
        tree=tree,
        reasons=reasons,
        changed=[
            f"joint {_closing(m).name}: position is {_sign(m):+g} * (the vendor's - {_zero(m):g})"
            for m in grip.members
            if _sign(m) != 1.0 or _zero(m) != 0.0
        ],
    )


def _closing(member: Member) -> Any:
    return member.chain.joints[_first(member)]


def _first(member: Member) -> int:
    return int(np.flatnonzero(member.closing.gain)[0])


def _sign(member: Member) -> float:
    return float(np.sign(member.closing.gain[_first(member)]))


def _zero(member: Member) -> float:
    return float(member.closing.q0[_first(member)])


def _in_order(grip: Grip, frame: PalmFrame) -> Grip:
    """Return the grip with fingers counter-clockwise about +Gz, the one that opposes last."""
    points = np.array([member.points[0] for member in grip.members])
    p_GP = transform_points(invert_pose(frame.X_BG), points)[:, :2]
    centred = p_GP - p_GP.mean(axis=0)
    angles = np.arctan2(centred[:, 1], centred[:, 0])
    turns = np.mod(angles - angles[-1], 2.0 * np.pi)
    turns[-1] = 2.0 * np.pi
    order = np.argsort(turns)
    return replace(
        grip,
        members=tuple(grip.members[i] for i in order),
        step=tuple(grip.step[i] for i in order),
    )


def _couplings(model: VendorModel, grip: Grip) -> list[dict[str, tuple[float, float]]]:
    """Return what follows each closing joint: ratio and offset by joint, in its new positions."""
    found: list[dict[str, tuple[float, float]]] = []
    taken: set[str] = set()
    for member in grip.members:
        own = {}
        for j, joint in enumerate(member.chain.joints):
            gain, q0 = float(member.closing.gain[j]), float(member.closing.q0[j])
            if gain != 0.0 and j != _first(member):
                own[joint.name] = gain, q0
            taken |= {joint.name} if gain != 0.0 else set()
        found.append(own)

    # Bars of linkages beside the fingers follow the motor that their model names.
    for member, own in zip(grip.members, found, strict=True):
        names = [joint.name for joint in member.chain.joints]
        for name, mimic in model.mimics.items():
            if name in taken or mimic.leader not in names:
                continue
            j = names.index(mimic.leader)
            gain = float(member.closing.gain[j])
            if gain != 0.0:
                own[name] = (
                    mimic.ratio * gain,
                    mimic.ratio * float(member.closing.q0[j]) + mimic.offset,
                )
                taken.add(name)
    return found


def _rebased(
    model: VendorModel,
    grip: Grip,
    coupled: Sequence[dict[str, tuple[float, float]]],
    spread: dict[str, float],
) -> VendorModel:
    """Return the model in which closing joints close from 0 on, and spreads open from 0 on."""
    joints, mimics = dict(model.joints), {}
    for member, own in zip(grip.members, coupled, strict=True):
        joint = _closing(member)
        joints[joint.name] = joint.rebased(_sign(member), _zero(member))
        for name, (ratio, offset) in own.items():
            if name in model.mimics or joint.name in model.mimics:
                mimics[name] = Mimic(joint=name, leader=joint.name, ratio=ratio, offset=offset)
    for name, sign in spread.items():
        joints[name] = joints[name].rebased(sign, 0.0)
    return replace(model, joints=joints, mimics=mimics)


def _names(grip: Grip) -> list[str]:
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


def _spread(model: VendorModel, grip: Grip, frame: PalmFrame, driven: set[str]) -> dict[str, float]:
    """Return the sign of each of two joints that spread fingers about Gz; none if not so."""
    found: dict[str, float] = {}
    for member in grip.members:
        joint = member.chain.joints[0]
        along = abs(float((joint.X_PJ[:3, :3] @ joint.axis) @ frame.X_BG[:3, 2]))
        lower, upper = joint.limits
        one_way = lower > -1e-6 if upper > SPREADING else upper < 1e-6 and lower < -SPREADING
        if joint.slides or joint.name in driven or along < 0.98 or not one_way:
            continue
        if member.closing.preshape.get(joint.name) == 0.0:
            found[joint.name] = 1.0 if upper > SPREADING else -1.0
    return found if len(found) == 2 else {}


def _speeds(grip: Grip, limits: Array, config: Config) -> dict[str, float]:
    """Return the closing speeds: usual ones, at which motors reach their limits in time."""
    speeds: dict[str, float] = {}
    for member, limit in zip(grip.members, limits, strict=True):
        joint = _closing(member)
        unit, key, usual = (
            (0.1, "closing_speed", SLIDING)
            if joint.slides
            else (1.0, "closing_speed_deg", float(TURNING))
        )
        least = max(
            1.05 * float(limit) * unit**2 / FINGER_DAMPING,
            1.1 * member.closing.limit / config.close.max_time,
        )
        speed = max(min(usual, joint.velocity if joint.velocity > 0.0 else usual), least)
        shown = speed if joint.slides else float(np.rad2deg(speed))
        speeds[key] = max(speeds.get(key, 0.0), float(f"{shown:.3g}"))
    return speeds


def _reasons(model: VendorModel, grip: Grip, frame: PalmFrame, answers: Answers) -> dict[str, str]:
    """Return why the values are so, by the paths of their keys."""
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
    for i, member in enumerate(grip.members):
        key = f"fingers.{i}"
        flipped = _sign(member) != 1.0 or _zero(member) != 0.0
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
    closed = {j.name for m in grip.members for j in m.chain.joints}
    for name in model.joints:
        reasons[f"preshape.{name}"] = (
            "given" if name in answers.joints
            else "where the fingers oppose best" if name in closed
            else "out of the way"
        )  # fmt: skip
    return reasons
