"""Postures: a wrist pose with or without the positions of all joints, and the attempt at it.

Input: a `Posture`, checked and in {O}. Output: the `Attempt` of its trial. If a wrist pose has no
joints, the open hand closes, as in an attempt of a sampler. If the joints follow the couplings of
the hand file, the hand's own motors close the hand, as in every attempt. Otherwise each joint has
its own motor, which moves from the pregrasp to the grasp and on to the squeeze.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from drakegrasp.errors import GraspError
from drakegrasp.frames import Array, read_pose
from drakegrasp.hand.description import Hand
from drakegrasp.hand.kinematics import coordinate_limits, open_together
from drakegrasp.simulation.attempt import Attempt

#: A joint follows the hand file if it is at most this far from where the file has it (coupled
#: joint) or from another spread joint, in units of its finger's closing joint.
COUPLED = np.deg2rad(1.0)
#: Without a pregrasp, fingers are opened by this, in units of a closing joint.
OPENED = np.deg2rad(20.0)
#: Without a squeeze, the joint that moved most from the pregrasp to the grasp moves on by this, and
#: the others in proportion. A slide of 0.1 m is treated as equal to 1 rad.
SQUEEZED = np.deg2rad(20.0)
#: A rotation with a smaller error is exact except for rounding.
EXACT = 1e-12
#: Requirement for a pregrasp or a squeeze, in messages.
BESIDE_GRASP = "given together with q_grasp, got it alone"
#: A closing joint this close to zero is open [rad or m].
OPEN = 1e-6


@dataclass(frozen=True, eq=False)
class Posture:
    """A wrist pose and joint positions of a hand with j joints, in the plant's order.

    The order is that of the stored `closed_q`; `Hand.joint_order` names the joints. Without joints,
    the hand closes from its open posture.

    Attributes:
        X_OG: Pose of the palm (4, 4).
        q_grasp: (j,), positions in which the fingers hold the object [rad or m]; None if unknown.
        q_pregrasp: (j,), start of the trial; None for the grasp, opened by 20 degrees.
        q_squeeze: (j,), target of the motors, which press; None for a target beyond the grasp.
        preshape: Name of the hand's preshape, whose fingers alone close and must touch; None if all
            fingers close.
    """

    X_OG: Array
    q_grasp: Array | None = None
    q_pregrasp: Array | None = None
    q_squeeze: Array | None = None
    preshape: str | None = None


def preshape_index(hand: Hand, name: str | None) -> int | None:
    """Return the index of a preshape by its name; None for None.

    Raises:
        GraspError: If the hand has no such preshape.
    """
    if name is None:
        return None
    if name not in hand.preshape_names:
        known = f"one of {', '.join(hand.preshape_names)}" if hand.preshapes else "left out"
        raise GraspError(f"preshape must be {known} for the hand {hand.name}, got {name!r}")
    return hand.preshape_names.index(name)


def exact_pose(X: npt.ArrayLike, name: str) -> Array:
    """Return one pose (4, 4) with an exact rotation; an exact pose keeps its bits.

    Raises:
        GraspError: If X is not a pose.
    """
    pose = read_pose(X, name)
    if pose.shape != (4, 4):
        raise GraspError(f"{name} must be one pose, got an array of shape {pose.shape}")
    given = np.asarray(X, dtype=float)
    return given if given.shape == (4, 4) and np.abs(pose - given).max() < EXACT else pose


def start_of(posture: Posture, hand: Hand) -> Attempt:
    """Return what the trial of a posture starts from.

    The rule has three cases. Without joints, the open hand closes in the posture's preshape and at
    the hand's first spread. Otherwise the hand file's motors close the fingers if each given vector
    follows the hand file to within 1 degree: each coupled joint is where its finger's closing joint
    puts it, and all spread joints agree. If not, each joint has its own motor. Fingers that the
    preshape leaves out have no motor.

    Raises:
        GraspError: If the hand has no such preshape.
    """
    preshape = preshape_index(hand, posture.preshape)
    start = _start_of(posture, hand.at(preshape))
    return replace(start, preshape=preshape, unused=hand.unused_in(preshape))


def _start_of(posture: Posture, hand: Hand) -> Attempt:
    """Return what the trial of a posture starts from; all fingers of the given hand close."""
    if posture.q_grasp is None:
        return Attempt(X_OG=posture.X_OG, spread=float(np.deg2rad(hand.spreads_deg[0])))
    given = [q for q in (posture.q_pregrasp, posture.q_grasp, posture.q_squeeze) if q is not None]
    start = opened(posture.q_grasp, hand) if posture.q_pregrasp is None else posture.q_pregrasp
    own_motors = not all(follows_couplings(q, hand) for q in given)
    index = {name: i for i, name in enumerate(hand.joint_order)}
    # If spread joints differ, use the first one.
    spread = float(posture.q_grasp[index[hand.spread.joints[0]]]) if hand.spread.joints else 0.0
    spread = float(np.clip(spread, *coordinate_limits(hand)[0]))
    closing = np.array([start[index[finger.closing_joint]] for finger in hand.fingers])
    closing = open_together(hand, np.clip(closing, *coordinate_limits(hand)[1:].T))

    # A posture that the hand file can describe is an attempt like any other.
    still = [abs(posture.q_grasp[index[n]] - at) <= OPEN for n, at in hand.preshape.items()]
    if not own_motors and all(still):
        return Attempt(
            X_OG=posture.X_OG,
            spread=spread,
            closing=None if np.abs(closing).max() <= OPEN else closing,
        )

    # Joints without a motor are locked at their positions in the grasp.
    start = start.copy()
    moved = hand.own_motors
    idle = tuple(name for name in hand.joint_names if name not in moved)
    for name in idle if own_motors else hand.locked_joints:
        start[index[name]] = posture.q_grasp[index[name]]
    # No joint is beyond its limits.
    limits = dict(zip(hand.joint_names, hand.joint_limits, strict=True))
    lower, upper = np.array([limits[name] for name in index]).T
    start, grasp = np.clip(start, lower, upper), np.clip(posture.q_grasp, lower, upper)
    squeeze = squeezed(start, grasp, hand) if posture.q_squeeze is None else posture.q_squeeze
    squeeze = np.clip(squeeze, lower, upper)
    return Attempt(
        X_OG=posture.X_OG,
        spread=spread,
        closing=closing,
        path=np.stack([start, grasp, squeeze]),
        own_motors=own_motors,
    )


def follows_couplings(q: Array, hand: Hand) -> bool:
    """Return whether the hand file's motors can reach joint positions (j,)."""
    index = {name: i for i, name in enumerate(hand.joint_order)}
    spreads = [q[index[name]] for name in hand.spread.joints]
    if spreads and np.ptp(spreads) > COUPLED:
        return False
    for i in hand.motor_fingers:
        closing, unit = q[index[hand.fingers[i].closing_joint]], float(hand.closing_unit[i])
        for c in hand.followers(i):
            if abs(q[index[c.joint]] - (c.ratio * closing + c.offset)) > COUPLED * unit:
                return False
    return True


def opened(q_grasp: Array, hand: Hand) -> Array:
    """Return the joint positions (j,) of a grasp whose fingers are opened by `OPENED`.

    Each closing joint opens by this and coupled joints by their ratios, but not beyond their
    limits.
    """
    order, q = hand.joint_order, q_grasp.copy()
    least = coordinate_limits(hand)[1:, 0]
    limits = dict(zip(hand.joint_names, hand.joint_limits, strict=True))
    for i, finger in enumerate(hand.fingers):
        at = order.index(finger.closing_joint)
        margin = OPENED * hand.closing_unit[i]
        q[at] = min(max(q[at] - margin, least[i]), q[at])
        moved = q_grasp[at] - q[at]
        for c in finger.coupled:
            at = order.index(c.joint)
            q[at] = np.clip(q[at] - c.ratio * moved, *limits[c.joint])
    return q


def squeezed(start: Array, grasp: Array, hand: Hand) -> Array:
    """Return the joint positions (j,) that lie beyond a grasp by `SQUEEZED`."""
    order = hand.joint_order
    slides = np.array([hand.joint_units[name] == "m" for name in order])
    units = np.where(slides, 0.1, 1.0)
    most = float((np.abs(grasp - start) / units).max())
    return grasp if most == 0.0 else grasp + (grasp - start) * (SQUEEZED / most)
