"""Drafts a hand file and its model from a grip and its palm frame.

Input: a `VendorModel`, a `Grip` and a `PalmFrame`. Output: the model, in which a positive position
of a closing joint closes the finger, from 0 in the open hand; and the keys of a hand file.

A fingertip presses as hard as its weakest motor allows. With the motion dp/dc of the pad point as
the finger closes, u = dp/dc / |dp/dc|, and the lever arm l_m of motor m (the motion of the pad
point along u per motion of the motor's joint), the closing joint's limit is

    T = |dp/dc| · min_m (effort_m / l_m).

For a finger with one motor, this is the motor's effort. If two fingers press against one, the
stronger side is limited to the other: a motor cannot press harder than the opposing fingers resist.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product
from typing import Any

import numpy as np

from drakegrasp.config import Config
from drakegrasp.errors import HandError
from drakegrasp.frames import GRAVITY, Array, invert_pose, transform_points
from drakegrasp.hand.description import FINGER_DAMPING
from drakegrasp.hand.draft.fingers import Answers
from drakegrasp.hand.draft.grips import Finger, Grip, PalmFrame
from drakegrasp.hand.draft.vendor import VendorModel, chain_poses
from drakegrasp.hand.file_format import VERSION
from drakegrasp.hand.parsing import Mimic

#: Possible efforts of a finger's motor: turning [N m], sliding [N]. Other values are placeholders.
POSSIBLE = {False: (0.005, 20.0), True: (0.5, 1000.0)}
#: Fingers that share a motor must be open together, within this tolerance [rad or m].
SAME = 1e-6
#: A motor whose lever arm is shorter than this does not affect the grasp [m/rad].
LEVER = 1e-3
#: Usual closing speeds [rad/s], [m/s].
TURNING, SLIDING = float(np.deg2rad(60.0)), 0.1
#: Holding effort of a worm divided by its motor's effort, for a gear of about 70 % efficiency.
HOLDING = 2.0
#: Stand-offs as fractions of the height of the pinch above the palm, and the smallest one [m].
STANDOFFS, NEAREST = (0.45, 0.65, 0.8), 0.003
#: Payload as a fraction of the mass that friction supports.
PAYLOAD = 0.5
#: By index of a finger: the finger whose motor closes it, and its closing per that finger's.
_Drivers = Mapping[int, tuple[int, float]]
#: For each finger, the ratio and the offset of the joints that follow its closing joint, by name.
_Followers = Sequence[Mapping[str, tuple[float, float]]]


@dataclass(frozen=True, kw_only=True, eq=False)
class Draft:
    """A drafted hand file.

    Attributes:
        model: The model of the hand.
        tree: Keys and values of the hand file.
        changed: Lines that name the joints whose positions differ from the vendor's.
    """

    model: VendorModel
    tree: dict[str, Any]
    changed: list[str]


def positions(model: VendorModel, grip: Grip, share: float) -> dict[str, float]:
    """Return the position of each joint if the fingers have closed by a fraction of their range."""
    led = {name: 0.0 for name in model.joints if name not in model.mimics}
    closed: dict[str, float] = {}
    for finger in grip.fingers:
        q = finger.closing.q0 + finger.closing.gain * share * finger.closing.limit
        rows = zip(finger.joints, q.tolist(), finger.closing.gain, strict=True)
        closed |= {joint.name: at for joint, at, gain in rows if gain != 0.0}
        led |= finger.closing.preshape
    led |= {name: at for name, at in closed.items() if name in led}
    found = {}
    for name, joint in model.joints.items():
        mimic = model.mimic(name)
        found[name] = float(np.clip(mimic.ratio * led[mimic.leader] + mimic.offset, *joint.limits))
    return found | closed


def draft_file(
    model: VendorModel, palm: str, grip: Grip, frame: PalmFrame, answers: Answers, config: Config
) -> Draft:
    """Return the hand file of a grip.

    Raises:
        HandError: If no effort of the motors is known.
    """
    grip = _in_order(grip, frame)
    limits, forces = _closing_limits(model, grip, answers.effort)
    followers, drivers = _followers(model, grip), _shared_motors(model, grip)

    # By virtual work, a motor's limit is the sum over the fingers that it moves.
    own = np.array([0.0 if i in drivers else limit for i, limit in enumerate(limits)])
    for i, (driver, ratio) in drivers.items():
        own[driver] += ratio * limits[i]
    tree: dict[str, Any] = {
        "version": VERSION,
        "model": "",
        "palm": {"link": palm, "p_BG": frame.p_BG.tolist(), "rpy_deg": frame.rpy_deg.tolist()},
        "fingers": _finger_keys(grip, own, drivers, followers),
    }

    # Joints that are not driven keep a position.
    driven = {f.joint.name for f in grip.fingers} | {name for each in followers for name in each}
    opened = positions(model, grip, 0.0)
    if kept := {name: round(q, 5) for name, q in opened.items() if name not in driven}:
        tree["preshape"] = kept

    # Drive, speeds, and the hand's use.
    carried = PAYLOAD * config.physics.friction_hand * float(forces.sum()) / GRAVITY
    tree |= {
        "drive": "worm",
        **_speeds(grip, own, config),
        "standoffs": [max(round(s * frame.height, 3), NEAREST) for s in STANDOFFS],
        "payload": float(f"{carried:.2g}"),
    }
    changed = [
        f"joint {f.joint.name}: position is {f.sign:+g} * (the vendor's - {f.zero:g})"
        for f in grip.fingers
        if f.sign != 1.0 or f.zero != 0.0
    ]
    return Draft(model=_rebased(model, grip, followers, drivers), tree=tree, changed=changed)


def _in_order(grip: Grip, frame: PalmFrame) -> Grip:
    """Return the grip with fingers counter-clockwise about +Gz, the one that opposes last."""
    points = np.array([finger.points[0] for finger in grip.fingers])
    p_GP = transform_points(invert_pose(frame.X_BG), points)[:, :2]
    centred = p_GP - p_GP.mean(axis=0)
    angles = np.arctan2(centred[:, 1], centred[:, 0])
    turns = np.mod(angles - angles[-1], 2.0 * np.pi)
    turns[-1] = 2.0 * np.pi
    order = np.argsort(turns)
    fingers, step = (tuple(own[i] for i in order) for own in (grip.fingers, grip.step))
    return replace(grip, fingers=fingers, step=step)


def _finger_keys(
    grip: Grip, limits: Array, drivers: _Drivers, followers: _Followers
) -> list[dict[str, Any]]:
    """Return the keys of the fingers, with the limits of their motors and what follows them."""
    names, found = [finger.tip for finger in grip.fingers], []
    for i, (finger, name, limit) in enumerate(zip(grip.fingers, names, limits, strict=True)):
        joint = finger.joint
        keys: dict[str, Any] = {"name": name, "fingertip": finger.tip, "closing_joint": joint.name}
        if i in drivers:
            driver, ratio = drivers[i]
            keys["driven_by"] = {"finger": names[driver], "ratio": round(ratio, 5)}
        else:
            kind, most = "force" if joint.slides else "torque", float(f"{limit:.3g}")
            keys |= {f"{kind}_limit": most, f"holding_{kind}": float(f"{HOLDING * most:.3g}")}
        if followers[i]:
            keys["coupled"] = [
                {"joint": follower, "ratio": round(ratio, 5), "offset": round(offset, 5)}
                for follower, (ratio, offset) in followers[i].items()
            ]
        found.append(
            keys | {"pad_region": finger.pad_region, "pad_point": finger.pad_point.tolist()}
        )
    return found


def _followers(model: VendorModel, grip: Grip) -> list[dict[str, tuple[float, float]]]:
    """Return the followers of each closing joint: ratio and offset by joint, in new positions."""
    found = [finger.followers() for finger in grip.fingers]
    taken = {finger.joint.name for finger in grip.fingers} | {j for own in found for j in own}

    # Bars of linkages beside the fingers follow the motor that their model names.
    for finger, own in zip(grip.fingers, found, strict=True):
        moved = {finger.joint.name: (finger.sign, finger.zero), **finger.followers()}
        for name, (joint, (gain, zero)) in product(model.joints, moved.items()):
            relation = model.relation(name, joint)
            if name not in taken and relation is not None:
                own[name] = relation[0] * gain, relation[0] * zero + relation[1]
                taken.add(name)
    return found


def _shared_motors(model: VendorModel, grip: Grip) -> dict[int, tuple[int, float]]:
    """Return the fingers that another finger's motor closes, according to mimics of the model."""
    found: dict[int, tuple[int, float]] = {}
    for (d, driver), (i, finger) in combinations(enumerate(grip.fingers), 2):
        relation = model.relation(finger.joint.name, driver.joint.name)
        if relation is None or d in found or i in found:
            continue

        # Both must close together, starting where both are open.
        ratio = finger.sign * driver.sign * relation[0]
        if ratio > 0.0 and abs(relation[0] * driver.zero + relation[1] - finger.zero) < SAME:
            found[i] = d, ratio
    return found


def _speeds(grip: Grip, limits: Array, config: Config) -> dict[str, float]:
    """Return the closing speeds: usual ones at which motors can reach their limits in time."""
    speeds: dict[str, float] = {}
    for finger, limit in zip(grip.fingers, limits, strict=True):
        joint, unit, key, usual = finger.joint, 1.0, "closing_speed_deg", TURNING
        if joint.slides:
            unit, key, usual = 0.1, "closing_speed", SLIDING
        stalled = 1.05 * float(limit) * unit**2 / FINGER_DAMPING
        least = max(stalled, 1.1 * finger.closing.limit / config.close.max_time)
        speed = max(min(usual, joint.velocity if joint.velocity > 0.0 else usual), least)
        shown = speed if joint.slides else float(np.rad2deg(speed))
        speeds[key] = max(speeds.get(key, 0.0), float(f"{shown:.3g}"))
    return speeds


def _rebased(
    model: VendorModel,
    grip: Grip,
    followers: _Followers,
    drivers: _Drivers,
) -> VendorModel:
    """Return the model in which closing joints close from 0."""
    joints, mimics = dict(model.joints), {}
    for finger, own in zip(grip.fingers, followers, strict=True):
        joint = finger.joint
        joints[joint.name] = joint.rebased(finger.sign, finger.zero)
        for name, (ratio, offset) in own.items():
            if name in model.mimics or joint.name in model.mimics:
                mimics[name] = Mimic(joint=name, leader=joint.name, ratio=ratio, offset=offset)
    for i, (driver, ratio) in drivers.items():
        name, leader = grip.fingers[i].joint.name, grip.fingers[driver].joint.name
        mimics[name] = Mimic(joint=name, leader=leader, ratio=ratio, offset=0.0)
    return replace(model, joints=joints, mimics=mimics)


def _closing_limits(model: VendorModel, grip: Grip, effort: float | None) -> tuple[Array, Array]:
    """Return the effort limit (k,) at each closing joint [N m or N], and the forces (k,) [N].

    Raises:
        HandError: If the model gives no possible effort of a motor.
    """
    found, force = np.zeros((2, len(grip.fingers)))
    for i, (finger, step) in enumerate(zip(grip.fingers, grip.step, strict=True)):
        motion, levers = _levers(model, finger, step)
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


def _levers(model: VendorModel, finger: Finger, step: int) -> tuple[float, dict[str, float]]:
    """Return |dp/dc| and the lever arm of each motor at a step [m/rad, or m/m]."""
    closing, columns = finger.closing, []
    frames, _ = chain_poses(finger.joints, closing.path()[step])
    for joint, X_BJ in zip(finger.joints, frames, strict=True):
        axis, arm = X_BJ[:3, :3] @ joint.axis, finger.points[step] - X_BJ[:3, 3]
        columns.append(axis if joint.slides else np.cross(axis, arm))
    motion = (np.array(columns) * closing.gain[:, None]).sum(axis=0)
    along = motion / np.linalg.norm(motion)

    # A motor moves its joints in the ratios in which they close.
    motors: dict[str, Array] = {}
    rates: dict[str, float] = {}
    for joint, gain, column in zip(finger.joints, closing.gain, columns, strict=True):
        if gain != 0.0:
            leader = model.mimic(joint.name).leader
            rate = rates.setdefault(leader, abs(float(gain)))
            motors[leader] = motors.get(leader, np.zeros(3)) + gain / rate * column
    return float(np.linalg.norm(motion)), {m: abs(float(v @ along)) for m, v in motors.items()}
