"""Drafts a hand file and its model from a grip and its palm frame.

Input: a `VendorModel`, a `Grip` and a `PalmFrame`. Output: the model, in which a positive position
of a closing joint closes the finger, from 0 in the open hand; and the keys of a hand file, each
with the reason for its value.

A fingertip presses as hard as its weakest motor allows. With the motion dp/dc of the pad point as
the finger closes, u = dp/dc / |dp/dc|, and the lever arm l_m of motor m (the motion of the pad
point along u per motion of the motor's joint), the closing joint's limit is

    T = |dp/dc| · min_m (effort_m / l_m).

For a finger with one motor, this is the motor's effort. If two fingers press against one, the
stronger side is limited to the other: a motor cannot press harder than the opposing fingers resist.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product, takewhile
from typing import Any

import numpy as np

from drakegrasp.commissioning.draft.fingers import Answers, find_closings, find_palm, find_tips
from drakegrasp.commissioning.draft.grips import Grip, Member
from drakegrasp.commissioning.draft.model import VendorModel
from drakegrasp.commissioning.draft.palm import PalmFrame
from drakegrasp.config import Config, apply_override
from drakegrasp.errors import ConfigError, HandError
from drakegrasp.frames import Array, invert_pose, transform_points
from drakegrasp.hand.file_format import VERSION
from drakegrasp.hand.parsing import Mimic
from drakegrasp.simulation.construction import FINGER_DAMPING

#: Possible efforts of a finger's motor: turning [N m], sliding [N]. Other values are placeholders.
POSSIBLE = {False: (0.005, 20.0), True: (0.5, 1000.0)}
#: Fingers that share a motor must be open together, within this tolerance [rad or m].
SAME = 1e-6
#: A motor whose lever arm is shorter than this does not affect the grasp [m/rad].
LEVER = 1e-3
#: Usual closing speeds [rad/s], [m/s].
TURNING, SLIDING = np.deg2rad(60.0), 0.1
#: Holding effort of a worm divided by its motor's effort, for a gear of about 70 % efficiency.
HOLDING = 2.0
#: Stand-offs as fractions of the height of the pinch above the palm.
STANDOFFS = (0.45, 0.65, 0.8)
#: Payload as a fraction of the mass that friction supports.
PAYLOAD = 0.5
#: Tested spreads if two joints spread fingers [deg], and minimum range of such joints
#: [rad].
SPREADS_DEG, SPREADING = [0.0, 11.25, 22.5], 0.9
#: Names of fingers, found in the names of their links.
NAMES = ("thumb", "index", "middle", "ring", "pinky", "little")
SIDES = ("left", "right")
#: Fraction of a joint's range below which an unused part gets no note.
NOTED = 0.01
#: By index of a finger: the finger whose motor closes it, and its closing per that finger's
#: closing.
_Drivers = Mapping[int, tuple[int, float]]


@dataclass(frozen=True, kw_only=True, eq=False)
class Draft:
    """A drafted hand file.

    Attributes:
        model: The model of the hand.
        tree: Keys and values of the hand file.
        reasons: Reason for a value, by the path of its key, as in "palm.p_BG".
        changed: Lines for the comment at the top of the model; they name the joints whose positions
            differ from the vendor's.
        grip: The fingers that grasp; joint positions are those of the vendor's model.
    """

    model: VendorModel
    tree: dict[str, Any]
    reasons: dict[str, str]
    changed: list[str]
    grip: Grip


def positions(model: VendorModel, grip: Grip, share: float) -> dict[str, float]:
    """Return the position of each joint if the fingers have closed by a fraction of their range."""
    led = {name: 0.0 for name in model.joints if name not in model.mimics}
    closed: dict[str, float] = {}
    for member in grip.members:
        q = member.closing.q0 + member.closing.gain * share * member.closing.limit
        rows = zip(member.joints, q.tolist(), member.closing.gain, strict=True)
        closed |= {joint.name: at for joint, at, gain in rows if gain != 0.0}
        led |= member.closing.preshape
    led |= {name: at for name, at in closed.items() if name in led}
    found = {}
    for name, joint in model.joints.items():
        mimic = model.mimic(name)
        found[name] = float(np.clip(mimic.ratio * led[mimic.leader] + mimic.offset, *joint.limits))
    return found | closed


def draft_tree(
    model: VendorModel, palm: str, grip: Grip, frame: PalmFrame, answers: Answers, config: Config
) -> Draft:
    """Return the hand file of a grip.

    Raises:
        HandError: If no effort of the motors is known, or a setting is malformed.
    """
    grip = _in_order(grip, frame)
    limits, forces = _closing_limits(model, grip, answers.effort)
    reasons = _reasons(model, grip, frame, answers)
    tree: dict[str, Any] = {"version": VERSION, "model": ""}
    tree["palm"] = {"link": palm, "p_BG": frame.p_BG.tolist(), "rpy_deg": frame.rpy_deg.tolist()}

    # The fingers. By virtual work, a motor's limit is the sum over the fingers that it moves.
    coupled, drivers = _couplings(model, grip), _shared_motors(model, grip)
    limits = np.array([0.0 if i in drivers else limit for i, limit in enumerate(limits)]) + [
        sum(ratio * limits[i] for i, (driver, ratio) in drivers.items() if driver == d)
        for d in range(len(limits))
    ]
    tree["fingers"] = _fingers(grip, limits, drivers, coupled)

    # Joints that are not driven keep a position.
    driven = {m.joint.name for m in grip.members} | {j for own in coupled for j in own}
    spread = _spread(grip, frame, driven)
    opened = positions(model, grip, 0.0)
    kept = {n: round(q, 5) for n, q in opened.items() if n not in driven and n not in spread}
    if spread:
        tree |= {"spread": {"joints": list(spread)}, "spreads_deg": SPREADS_DEG}
    if kept:
        tree["preshape"] = kept

    # Drive, speeds, and the hand's use.
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

    # Joints that differ from the vendor's.
    changed = [
        f"joint {m.joint.name}: position is {m.sign:+g} * (the vendor's - {m.zero:g})"
        for m in grip.members
        if m.sign != 1.0 or m.zero != 0.0
    ]
    rebased = _rebased(model, grip, coupled, drivers, spread)
    return Draft(model=rebased, tree=tree, reasons=reasons, changed=changed, grip=grip)


def _in_order(grip: Grip, frame: PalmFrame) -> Grip:
    """Return the grip with fingers counter-clockwise about +Gz, the one that opposes last."""
    points = np.array([member.points[0] for member in grip.members])
    p_GP = transform_points(invert_pose(frame.X_BG), points)[:, :2]
    centred = p_GP - p_GP.mean(axis=0)
    angles = np.arctan2(centred[:, 1], centred[:, 0])
    turns = np.mod(angles - angles[-1], 2.0 * np.pi)
    turns[-1] = 2.0 * np.pi
    order = np.argsort(turns)
    members, step = (tuple(own[i] for i in order) for own in (grip.members, grip.step))
    return replace(grip, members=members, step=step)


def _fingers(
    grip: Grip,
    limits: Array,
    drivers: _Drivers,
    coupled: Sequence[Mapping[str, tuple[float, float]]],
) -> list[dict[str, Any]]:
    """Return the keys of the fingers, with the limits of their motors and what follows them."""
    names, fingers = _finger_names(grip), []
    for i, (member, name, limit) in enumerate(zip(grip.members, names, limits, strict=True)):
        joint = member.joint
        finger: dict[str, Any] = {
            "name": name, "fingertip": member.tip, "closing_joint": joint.name
        }  # fmt: skip

        # Its own motor, or that of another finger.
        if i in drivers:
            driver, ratio = drivers[i]
            finger["driven_by"] = {"finger": names[driver], "ratio": round(ratio, 5)}
        else:
            kind, most = "force" if joint.slides else "torque", float(f"{limit:.3g}")
            finger[f"{kind}_limit"] = most
            finger[f"holding_{kind}"] = float(f"{HOLDING * most:.3g}")
        if coupled[i]:
            finger["coupled"] = [
                {"joint": follower, "ratio": round(ratio, 5), "offset": round(offset, 5)}
                for follower, (ratio, offset) in coupled[i].items()
            ]
        finger |= {"pad_region": member.pad_region, "pad_point": member.pad_point.tolist()}
        fingers.append(finger)
    return fingers


def _finger_names(grip: Grip) -> list[str]:
    """Return a name for each finger: a usual one, a side, or the differing part of its link."""
    tips = [member.tip for member in grip.members]
    for words in (NAMES, SIDES):
        found = []
        for member in grip.members:
            texts = [member.tip, *(joint.name for joint in reversed(member.joints))]
            texts += [joint.child for joint in member.joints]
            found += [word for text in texts for word in words if word in text.lower()][:1]
        if len(set(found)) == len(tips):
            return found
    # The common end of all names is not informative.
    alike = (len(set(letters)) == 1 for letters in zip(*(tip[::-1] for tip in tips), strict=False))
    end = sum(1 for _ in takewhile(bool, alike))
    short = [tip[: len(tip) - end].rstrip("_-.") for tip in tips]
    return short if all(short) else tips


def _couplings(model: VendorModel, grip: Grip) -> list[dict[str, tuple[float, float]]]:
    """Return the followers of each closing joint: ratio and offset by joint, in new positions."""
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


def _shared_motors(model: VendorModel, grip: Grip) -> dict[int, tuple[int, float]]:
    """Return the fingers that another finger's motor closes, according to mimics of the model."""
    found: dict[int, tuple[int, float]] = {}
    for (d, driver), (i, member) in combinations(enumerate(grip.members), 2):
        relation = model.relation(member.joint.name, driver.joint.name)
        if relation is None or d in found or i in found:
            continue

        # Both must close together, starting where both are open.
        ratio = member.sign * driver.sign * relation[0]
        if ratio > 0.0 and abs(relation[0] * driver.zero + relation[1] - member.zero) < SAME:
            found[i] = d, ratio
    return found


def _spread(grip: Grip, frame: PalmFrame, driven: set[str]) -> dict[str, float]:
    """Return the sign of each of two joints that spread fingers about Gz, or an empty mapping."""
    found: dict[str, float] = {}
    for member in grip.members:
        joint = member.joints[0]
        along = abs(float((joint.X_PJ[:3, :3] @ joint.axis) @ frame.X_BG[:3, 2]))
        lower, upper = joint.limits
        one_way = lower > -1e-6 if upper > SPREADING else upper < 1e-6 and lower < -SPREADING
        if joint.slides or joint.name in driven or along < 0.98 or not one_way:
            continue
        if member.closing.preshape.get(joint.name) == 0.0:
            found[joint.name] = 1.0 if upper > SPREADING else -1.0
    return found if len(found) == 2 else {}


def _speeds(grip: Grip, limits: Array, config: Config) -> dict[str, float]:
    """Return the closing speeds: usual ones at which motors can reach their limits in time."""
    speeds: dict[str, float] = {}
    for member, limit in zip(grip.members, limits, strict=True):
        joint, unit, key, usual = member.joint, 1.0, "closing_speed_deg", float(TURNING)
        if joint.slides:
            unit, key, usual = 0.1, "closing_speed", SLIDING
        stalled = 1.05 * float(limit) * unit**2 / FINGER_DAMPING
        least = max(stalled, 1.1 * member.closing.limit / config.close.max_time)
        speed = max(min(usual, joint.velocity if joint.velocity > 0.0 else usual), least)
        shown = speed if joint.slides else float(np.rad2deg(speed))
        speeds[key] = max(speeds.get(key, 0.0), float(f"{shown:.3g}"))
    return speeds


def _rebased(
    model: VendorModel,
    grip: Grip,
    coupled: Sequence[Mapping[str, tuple[float, float]]],
    drivers: _Drivers,
    spread: Mapping[str, float],
) -> VendorModel:
    """Return the model in which closing joints close from 0, and spread joints open from 0."""
    joints, mimics = dict(model.joints), {}
    for member, own in zip(grip.members, coupled, strict=True):
        joint = member.joint
        joints[joint.name] = joint.rebased(member.sign, member.zero)
        for name, (ratio, offset) in own.items():
            if name in model.mimics or joint.name in model.mimics:
                mimics[name] = Mimic(joint=name, leader=joint.name, ratio=ratio, offset=offset)
    for i, (driver, ratio) in drivers.items():
        name, leader = grip.members[i].joint.name, grip.members[driver].joint.name
        mimics[name] = Mimic(joint=name, leader=leader, ratio=ratio, offset=0.0)
    for name, sign in spread.items():
        joints[name] = joints[name].rebased(sign, 0.0)
    return replace(model, joints=joints, mimics=mimics)


def _closing_limits(model: VendorModel, grip: Grip, effort: float | None) -> tuple[Array, Array]:
    """Return the effort limit (k,) at each closing joint [N m or N], and the forces (k,) [N].

    Raises:
        HandError: If the model gives no possible effort of a motor.
    """
    found, force = np.zeros((2, len(grip.members)))
    for i, (member, step) in enumerate(zip(grip.members, grip.step, strict=True)):
        motion, levers = _levers(model, member, step)
        force[i] = min(
            _effort(model, leader, effort) / lever if lever > LEVER else np.inf
            for leader, lever in levers.items()
        )
        found[i] = force[i] * motion

    # Both sides must press equally.
    sides = force[:-1].sum(), force[-1]
    share = np.ones(len(force))
    share[:-1] *= min(1.0, sides[1] / sides[0])
    share[-1] *= min(1.0, sides[0] / sides[1])
    return found * share, force * share


def _effort(model: VendorModel, leader: str, effort: float | None) -> float:
    """Return the effort of a joint's motor, from the model or from the answer."""
    joint = model.joints[leader]
    given = joint.effort if effort is None else effort
    least, most = POSSIBLE[joint.slides]
    if least <= given <= most:
        return given

    # Report where the value comes from.
    unit = "N" if joint.slides else "N m"
    must = f"must be {least:g}..{most:g} {unit}"
    if effort is not None:
        raise HandError(f"--effort {must} for joint {leader!r}, got {given:g}")
    got = f"{given:g} in the model" if given else "none in the model"
    raise HandError(
        f"the effort of joint {leader!r} {must}, got {got}: say what its motor gives with "
        f"--effort {unit.replace(' ', '')}"
    )


def _levers(model: VendorModel, member: Member, step: int) -> tuple[float, dict[str, float]]:
    """Return |dp/dc| and the lever arm of each motor at a step [m/rad, or m/m]."""
    closing, columns, X = member.closing, [], np.eye(4)
    for joint, position in zip(member.joints, closing.path()[step], strict=True):
        X_BJ = X @ joint.X_PJ
        axis, arm = X_BJ[:3, :3] @ joint.axis, member.points[step] - X_BJ[:3, 3]
        columns.append(axis if joint.slides else np.cross(axis, arm))
        X = X @ joint.pose(float(position))
    motion = (np.array(columns) * closing.gain[:, None]).sum(axis=0)
    along = motion / np.linalg.norm(motion)

    # A motor moves its joints in the ratios in which they close.
    motors: dict[str, Array] = {}
    rates: dict[str, float] = {}
    for joint, gain, column in zip(member.joints, closing.gain, columns, strict=True):
        if gain != 0.0:
            leader = model.mimic(joint.name).leader
            rate = rates.setdefault(leader, abs(float(gain)))
            motors[leader] = motors.get(leader, np.zeros(3)) + gain / rate * column
    return float(np.linalg.norm(motion)), {m: abs(float(v @ along)) for m, v in motors.items()}


def _reasons(model: VendorModel, grip: Grip, frame: PalmFrame, answers: Answers) -> dict[str, str]:
    """Return the reasons for the values, by the paths of their keys."""
    # For the whole hand.
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
        "standoffs": "fractions of the height of the pinch above the palm [m]",
        "payload": "half of the mass that friction supports at these efforts [kg]",
    }

    # For each finger.
    effort = f"effort of {answers.effort:g} (given)" if answers.effort else "the model's effort"
    limit = f"{effort}, reduced where one side would press harder than the other"
    for i, member in enumerate(grip.members):
        flipped = member.sign != 1.0 or member.zero != 0.0
        in_model = any(joint.name in model.mimics for joint in member.joints)
        coupled = "as in the model" if in_model else "guessed: the joints behind it bend along"
        own = {
            "fingertip": "the last link with shapes",
            "closing_joint": "the first that bends the finger"
            + ("; made to close from 0 on, see the model's head" if flipped else ""),
            "coupled": coupled,
            "pad_region": "the side that faces the closing motion, near the end",
            "pad_point": "on that side [m]",
            **{f"{kind}_limit": limit for kind in ("torque", "force")},
            **{f"holding_{kind}": "guessed: twice that" for kind in ("torque", "force")},
            "driven_by": "in the model one motor moves both; its limit is that of both",
        }
        reasons |= {f"fingers.{i}.{key}": why for key, why in own.items()}

    # For the joints that keep a position.
    closed = {joint.name for member in grip.members for joint in member.joints}
    for name in model.joints:
        guess = "where the fingers oppose best" if name in closed else "out of the way"
        reasons[f"preshape.{name}"] = "given" if name in answers.joints else guess
    return reasons


def unused_parts(model: VendorModel, grip: Grip, answers: Answers) -> Iterator[str]:
    """Yield a line for each finger and each part of a closing joint's range that is not used."""
    # Find the part of a closing joint's range beyond the open hand.
    for member in grip.members:
        joint = member.joint
        lower, upper = joint.rebased(member.sign, member.zero).limits
        if not np.isfinite([lower, upper]).all() or -lower <= NOTED * (upper - lower):
            continue
        unit = "m" if joint.slides else "rad"
        whole = f"{joint.limits[0]:.4g}..{joint.limits[1]:.4g} {unit}"
        yield (
            f"joint {joint.name}: the open hand is at {member.zero:g} in the range {whole}, so "
            f"{-lower:.3g} {unit} of the range are not used; to use them, move the joint's zero in "
            "the model to where the hand is fully open"
        )

    # Find the fingers that do not grasp, with the reason.
    palm, used = find_palm(model, answers), {member.tip for member in grip.members}
    for tip in find_tips(model, palm, answers):
        if tip in used:
            continue
        joints = model.chain(tip, palm)
        turned = ", ".join(j.name for j in joints if j.name in answers.reverse)
        how = f"with {turned} reversed " if turned else ""
        why = "none of its joints closes it"
        if find_closings(model, joints, answers):
            why = "the others meet better: --fingers says which grasp"
        yield f"finger {tip} is not used: {how}{why}"
