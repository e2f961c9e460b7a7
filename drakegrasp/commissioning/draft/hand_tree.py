"""A hand file and its model, from a grip and its palm frame.

In: a `VendorModel`, a `Grip` and a `PalmFrame`. Out: the model, in which a positive position of a
closing joint closes, from 0, the open hand; and the keys of a hand file, each with why it is so.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from drakegrasp.commissioning.draft.answers import Answers
from drakegrasp.commissioning.draft.opposition import Grip, Member
from drakegrasp.commissioning.draft.palm import PalmFrame
from drakegrasp.commissioning.draft.strength import (
    Driver,
    closing_limits,
    motor_limits,
    shared_motors,
)
from drakegrasp.commissioning.draft.wording import finger_names, reasons_of
from drakegrasp.config import Config, apply_override
from drakegrasp.errors import ConfigError, HandError
from drakegrasp.frames import Array, invert_pose, transform_points
from drakegrasp.hand.draft.model import VendorModel
from drakegrasp.hand.file_format import VERSION
from drakegrasp.hand.model_text import Mimic
from drakegrasp.simulation.construction import FINGER_DAMPING

#: Usual closing speeds [rad/s], [m/s].
TURNING, SLIDING = np.deg2rad(60.0), 0.1
#: A worm holds so many times what its motor gives: that of a gear of about 70 % efficiency.
HOLDING = 2.0
#: Stand-offs as shares of the height of the pinch above the palm.
STANDOFFS = (0.45, 0.65, 0.8)
#: Share of what friction carries that is the payload.
PAYLOAD = 0.5
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
        grip: Its fingers, in the vendor's positions.
    """

    model: VendorModel
    tree: dict[str, Any]
    reasons: dict[str, str]
    changed: list[str]
    grip: Grip


def positions(model: VendorModel, grip: Grip, share: float) -> dict[str, float]:
    """Return the position of each joint when the fingers have closed by a share of their way."""
    led = {name: 0.0 for name in model.joints if name not in model.mimics}
    for member in grip.members:
        led |= member.closing.preshape
    for member in grip.members:
        led |= {n: q for n, q in _closed(member, share).items() if n in led}
    found = {}
    for name, joint in model.joints.items():
        mimic = model.mimic(name)
        at = mimic.ratio * led[mimic.leader] + mimic.offset
        found[name] = float(np.clip(at, *joint.limits))
    for member in grip.members:
        found |= _closed(member, share)
    return found


def _closed(member: Member, share: float) -> dict[str, float]:
    """Return the positions of the joints that bend a finger, at a share of its way."""
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
    reasons = reasons_of(model, grip, frame, answers)
    tree: dict[str, Any] = {"version": VERSION, "model": ""}
    tree["palm"] = {"link": palm, "p_BG": frame.p_BG.tolist(), "rpy_deg": frame.rpy_deg.tolist()}

    # The fingers; joints that nothing else drives keep a position.
    coupled, names, drivers = (
        _couplings(model, grip),
        finger_names(grip),
        shared_motors(model, grip),
    )
    limits = motor_limits(limits, drivers)
    motors = [_motor(i, grip, limits, names, drivers) for i in range(len(names))]
    rows = zip(grip.members, names, motors, coupled, strict=True)
    tree["fingers"] = [_finger(*row) for row in rows]
    driven = {m.joint.name for m in grip.members} | {j for own in coupled for j in own}
    spread = _spread(grip, frame, driven)
    opened = positions(model, grip, 0.0)
    kept = {n: round(q, 5) for n, q in opened.items() if n not in driven and n not in spread}
    if spread:
        tree |= {"spread": {"joints": list(spread)}, "spreads_deg": SPREADS_DEG}
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

    # What is not as the vendor has it.
    changed = [
        f"joint {m.joint.name}: position is {m.sign:+g} * (the vendor's - {m.zero:g})"
        for m in grip.members
        if m.sign != 1.0 or m.zero != 0.0
    ]
    rebased = _rebased(model, grip, coupled, drivers, spread)
    return Draft(model=rebased, tree=tree, reasons=reasons, changed=changed, grip=grip)


def _motor(
    i: int, grip: Grip, limits: Array, names: Sequence[str], drivers: Mapping[int, Driver]
) -> dict[str, Any]:
    """Return the keys of a finger's motor, or the finger whose motor moves it."""
    if i in drivers:
        driver = drivers[i]
        return {"driven_by": {"finger": names[driver.finger], "ratio": round(driver.ratio, 5)}}
    kind = "force" if grip.members[i].joint.slides else "torque"
    limit = float(f"{limits[i]:.3g}")
    return {f"{kind}_limit": limit, f"holding_{kind}": float(f"{HOLDING * limit:.3g}")}


def _finger(
    member: Member, name: str, motor: dict[str, Any], coupled: dict[str, tuple[float, float]]
) -> dict[str, Any]:
    """Return the keys of a finger, from those of its motor and what follows its joint."""
    finger: dict[str, Any] = {
        "name": name,
        "fingertip": member.chain.tip,
        "closing_joint": member.joint.name,
    }
    finger |= motor
    if coupled:
        finger["coupled"] = [
            {"joint": follower, "ratio": round(ratio, 5), "offset": round(offset, 5)}
            for follower, (ratio, offset) in coupled.items()
        ]
    return finger | {"pad_region": member.pad.region(), "pad_point": member.pad.point.tolist()}


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
    found = [member.followers() for member in grip.members]
    taken = {member.joint.name for member in grip.members} | {j for own in found for j in own}

    # Bars of linkages beside the fingers follow the motor that their model names.
    for member, own in zip(grip.members, found, strict=True):
        moved = {member.joint.name: (member.sign, member.zero), **member.followers()}
        for name, (joint, (gain, zero)) in product(model.joints, moved.items()):
            relation = model.relation(name, joint)
            if name not in taken and relation is not None:
                own[name] = relation[0] * gain, relation[0] * zero + relation[1]
                taken.add(name)
    return found


def _rebased(
    model: VendorModel,
    grip: Grip,
    coupled: Sequence[dict[str, tuple[float, float]]],
    drivers: Mapping[int, Driver],
    spread: dict[str, float],
) -> VendorModel:
    """Return the model in which closing joints close from 0 on, and spreads open from 0 on."""
    joints, mimics = dict(model.joints), {}
    for member, own in zip(grip.members, coupled, strict=True):
        joint = member.joint
        joints[joint.name] = joint.rebased(member.sign, member.zero)
        for name, (ratio, offset) in own.items():
            if name in model.mimics or joint.name in model.mimics:
                mimics[name] = Mimic(joint=name, leader=joint.name, ratio=ratio, offset=offset)
    for i, by in drivers.items():
        name, leader = grip.members[i].joint.name, grip.members[by.finger].joint.name
        mimics[name] = Mimic(joint=name, leader=leader, ratio=by.ratio, offset=0.0)
    for name, sign in spread.items():
        joints[name] = joints[name].rebased(sign, 0.0)
    return replace(model, joints=joints, mimics=mimics)


def _spread(grip: Grip, frame: PalmFrame, driven: set[str]) -> dict[str, float]:
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
        joint = member.joint
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
