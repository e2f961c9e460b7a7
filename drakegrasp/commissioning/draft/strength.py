"""Motors of a grip: their efforts, from those of the model's joints, and which fingers share one.

A fingertip presses with what its weakest motor gives. With the motion dp/dc of the pad point as the
finger closes, u = dp/dc / |dp/dc|, and the lever l_m of motor m, the motion of the pad point along
u per its joint's, the closing joint's limit is

    T = |dp/dc| · min_m (effort_m / l_m),

which for a finger of one motor is its effort. Where two fingers press against one, what is more is
taken off: one motor cannot press harder than those opposite resist.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from drakegrasp.commissioning.draft.opposition import Grip, Member
from drakegrasp.errors import HandError
from drakegrasp.frames import Array
from drakegrasp.hand.draft.model import VendorModel

#: Efforts that a finger's motor can have: turning [N m], sliding [N]. Others are placeholders.
POSSIBLE = {False: (0.005, 20.0), True: (0.5, 1000.0)}
#: Fingers that share a motor are open together, within so much [rad or m].
SAME = 1e-6
#: A motor whose lever is shorter than this does not bear on the grasp [m/rad].
LEVER = 1e-3


def closing_limits(model: VendorModel, grip: Grip, effort: float | None) -> tuple[Array, Array]:
    """Return the effort limit (k,) at each closing joint [N m or N], and the forces (k,) [N].

    Args:
        model: The model.
        grip: The fingers.
        effort: Of all motors, where the model's is not to be used.

    Raises:
        HandError: If the model gives no effort that a motor can have.
    """
    limits, forces = [], []
    for member, step in zip(grip.members, grip.step, strict=True):
        motion, levers = _levers(model, member, step)
        strongest = min(
            _effort(model, leader, effort) / lever if lever > LEVER else np.inf
            for leader, lever in levers.items()
        )
        limits.append(strongest * motion)
        forces.append(strongest)
    found, force = np.array(limits), np.array(forces)

    # Both sides press equally.
    sides = force[:-1].sum(), force[-1]
    share = np.ones(len(force))
    share[:-1] *= min(1.0, sides[1] / sides[0])
    share[-1] *= min(1.0, sides[0] / sides[1])
    return found * share, force * share


@dataclass(frozen=True)
class Driver:
    """The finger whose motor moves another one too, and that one's closing per its closing."""

    finger: int
    ratio: float


def shared_motors(model: VendorModel, grip: Grip) -> dict[int, Driver]:
    """Return by which finger's motor others are closed, as mimics of the model say."""
    found: dict[int, Driver] = {}
    for d, i in combinations(range(len(grip.members)), 2):
        driver, member = grip.members[d], grip.members[i]
        relation = model.relation(member.joint.name, driver.joint.name)
        if relation is None or d in found or i in found:
            continue

        # Both must close together, from where both are open.
        ratio = member.sign * driver.sign * relation[0]
        if ratio > 0.0 and abs(relation[0] * driver.zero + relation[1] - member.zero) < SAME:
            found[i] = Driver(d, ratio)
    return found


def motor_limits(limits: Array, drivers: Mapping[int, Driver]) -> Array:
    """Return the effort limit (k,) of each finger's motor at its closing joint; 0 without one.

    By virtual work it is what the fingers that it moves press with, each by its ratio.
    """
    own = np.array([0.0 if i in drivers else limit for i, limit in enumerate(limits)])
    for i, by in drivers.items():
        own[by.finger] += by.ratio * limits[i]
    return own


def _effort(model: VendorModel, leader: str, effort: float | None) -> float:
    joint = model.joints[leader]
    given = joint.effort if effort is None else effort
    least, most = POSSIBLE[joint.slides]
    if least <= given <= most:
        return given

    # Say where it is from.
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
    """Return |dp/dc| and the lever of each motor at a step [m/rad, or m/m]."""
    chain, closing = member.chain, member.closing
    q = chain.path(closing)[step]
    point = member.points[step]
    columns, X = [], np.eye(4)
    for joint, position in zip(chain.joints, q, strict=True):
        axis = (X @ joint.X_PJ)[:3, :3] @ joint.axis
        origin = (X @ joint.X_PJ)[:3, 3]
        columns.append(axis if joint.slides else np.cross(axis, point - origin))
        X = X @ joint.pose(float(position))
    motion = (np.array(columns) * closing.gain[:, None]).sum(axis=0)
    along = motion / np.linalg.norm(motion)

    # A motor moves its joints in the ratios in which they close.
    motors: dict[str, Array] = {}
    rates: dict[str, float] = {}
    for joint, gain, column in zip(chain.joints, closing.gain, columns, strict=True):
        if gain == 0.0:
            continue
        leader = model.mimic(joint.name).leader
        rate = rates.setdefault(leader, abs(float(gain)))
        motors[leader] = motors.get(leader, np.zeros(3)) + gain / rate * column
    return float(np.linalg.norm(motion)), {m: abs(float(v @ along)) for m, v in motors.items()}
