"""How hard the fingertips of a hand can be loaded.

In: a `Hand` and the drive of its fingers. Out: the largest normal force of each fingertip. NumPy
only.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import Array, multiply, norm
from drakegrasp.frames import transform_points
from drakegrasp.hand.description import Hand
from drakegrasp.hand.file_format import Drive, with_efforts
from drakegrasp.hand.kinematics import coordinate_limits, fingertip_poses, joint_frames


def fingertip_forces(hand: Hand, drive: Drive) -> Array:
    """Return the largest force that each fingertip carries at its pad point, (k,) [N].

    It is the torque (or force, of a joint that slides) that the finger carries at its closing joint
    over the lever of the pad point, `closing_levers`, in the middle of the closing joint's range.
    At the ends of the range the Barrett Hand's differs by -10 and +19 %.

    Only motors press. What a worm carries beyond its own motor's torque comes from the motors of
    the other fingers, which press on it through the object: so a finger carries at most what they
    give together, and never more than its `holding_effort`. With the efforts τ_i of the motors and
    the levers l_i:

        N_i = τ_i / l_i                                                     (torque)
        N_i = min(max(τ_i / l_i, Σ_{j≠i} τ_j / l_j), `holding_effort` / l_i)   (worm, locked)

    Fingers that share a motor share its effort: then τ_i is the motor's, and l_i the sum of
    `Hand.closing_ratio` times the levers of all of them, as if they pressed equally.

    Args:
        hand: Of k fingers.
        drive: What keeps the closing joints from being pushed open. A motor alone carries its
            `effort_limit`. A locked joint carries what a worm does, without a `holding_effort` any
            load by the others.
    """
    # A joint without a limit counts as limited by 0, the open hand.
    limits = coordinate_limits(hand)[1:]
    middle = np.where(np.isfinite(limits), limits, 0.0).mean(axis=1)
    levers = multiply(hand.closing_ratio.T, closing_levers(hand, middle))[hand.motor_of]
    own = [hand.fingers[hand.motor_fingers[motor]] for motor in hand.motor_of]
    motors = np.array([finger.effort_limit for finger in own]) / levers
    if drive == "torque":
        return motors

    # The other motors' forces, up to what the finger can hold.
    strongest = [np.inf if f.holding_effort is None else f.holding_effort for f in own]
    return np.minimum(np.maximum(motors, motors.sum() - motors), np.array(strongest) / levers)


def within_load(hand: Hand, load: float | None) -> Hand:
    """Return a hand whose motors are all weaker by one factor, so that it presses less.

    Its strongest fingertip then carries at most `load` [N] at its pad point, by `fingertip_forces`.
    The hand is as it was where it is no stronger, or `load` is None. Worms hold what they did: what
    loads them comes from the motors.
    """
    if load is None:
        return hand
    factor = load / float(fingertip_forces(hand, hand.drive).max())
    if factor >= 1.0:
        return hand
    fingers = [
        with_efforts(f, factor * f.effort_limit, f.holding_effort, slides=f.slides)
        for f in hand.fingers
    ]
    return replace(hand, fingers=tuple(fingers))


def closing_levers(hand: Hand, closing: npt.ArrayLike) -> Array:
    """Return how far each pad point moves with its closing joint, (k,) [m/rad, or m/m].

    With the pad point P, and the axes a_j, origins o_j and ratios r_j of the finger's joints,

        l = |Σ_j r_j a_j × (P − o_j)|,   where a joint that slides along a_j adds r_j a_j instead.

    By virtual work this is the lever of a force along that motion, coupled joints included: the
    same torque that `simulation.drive.opening_torques` measures, over the force.

    Args:
        hand: Of k fingers.
        closing: (k,), closing positions [rad or m]. The spread does not matter.

    Raises:
        ValueError: If `closing` is not one position per finger.
    """
    X_GF = fingertip_poses(hand, spread=0.0, closing=closing)
    levers = []
    for i, (finger, chain) in enumerate(zip(hand.fingers, hand.chains, strict=True)):
        # Each joint turns the pad point about its axis or slides it along, by its gain.
        p_GP = transform_points(X_GF[i], finger.p_FiP[None])[0]
        X_GJ = joint_frames(hand, i, spread=0.0, closing=closing)
        axes = multiply(X_GJ[:, :3, :3], chain.axis[:, :, None])[..., 0]
        turned = np.cross(axes, p_GP - X_GJ[:, :3, 3])
        moved = np.where(chain.slides[:, None], axes, turned)
        levers.append(norm((chain.gain[:, 1 + i, None] * moved).sum(axis=0)))
    return np.array(levers)
