"""How hard the fingertips of a hand can be loaded.

In: a `Hand` and the drive of its fingers. Out: the largest normal force of each fingertip. NumPy
only.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import Array, multiply, norm
from drakegrasp.frames import transform_points
from drakegrasp.hand.description import Drive, Finger, Hand
from drakegrasp.hand.kinematics import coordinate_limits, fingertip_poses, joint_frames


def fingertip_forces(hand: Hand, drive: Drive) -> Array:
    """Return the largest force that each fingertip carries at its pad point, (k,) [N].

    It is the torque that the finger carries at its closing joint over the lever of the pad point,
    `closing_levers`, in the middle of the closing joint's range. At the ends of the range the
    Barrett Hand's differs by -10 and +19 %.

    Args:
        hand: Of k fingers.
        drive: What keeps the closing joints from being pushed open. A worm carries its
            `holding_torque`, a motor its `torque_limit`. A locked joint is an idealisation of the
            worm: it carries the `holding_torque` where the hand file gives one.
    """
    # A joint without a limit counts as limited by 0, the open hand.
    limits = coordinate_limits(hand)[1:]
    middle = np.where(np.isfinite(limits), limits, 0.0).mean(axis=1)
    torques = np.array([_carried_torque(finger, drive) for finger in hand.fingers])
    return torques / closing_levers(hand, middle)


def closing_levers(hand: Hand, closing: npt.ArrayLike) -> Array:
    """Return how far each pad point moves per angle of its closing joint, (k,) [m/rad].

    By virtual work this is the lever of a force along that motion, coupled joints included: the
    same torque that `simulation.drive.holding_torques` measures, over the force.

    Args:
        hand: Of k fingers.
        closing: (k,), closing angles [rad]. The spread does not matter.

    Raises:
        ValueError: If `closing` is not one angle per finger.
    """
    X_GF = fingertip_poses(hand, spread=0.0, closing=closing)
    levers = []
    for i, (finger, chain) in enumerate(zip(hand.fingers, hand.chains, strict=True)):
        # Each joint turns the pad point about its axis, by its share of the closing angle.
        p_GP = transform_points(X_GF[i], finger.p_FiP[None])[0]
        X_GJ = joint_frames(hand, i, spread=0.0, closing=closing)
        axes = multiply(X_GJ[:, :3, :3], chain.axis[:, :, None])[..., 0]
        velocity = chain.gain[:, 1 + i, None] * np.cross(axes, p_GP - X_GJ[:, :3, 3])
        levers.append(norm(velocity.sum(axis=0)))
    return np.array(levers)


def _carried_torque(finger: Finger, drive: Drive) -> float:
    """Return the torque that a finger carries at its closing joint [N m]."""
    if drive == "torque" or finger.holding_torque is None:
        return finger.torque_limit
    return finger.holding_torque
