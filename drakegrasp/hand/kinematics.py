"""Forward kinematics of a hand.

Input: a `Hand` and its coordinates, the spread and the closing of each finger. Output: positions of
the joints, poses of the links, limits of the coordinates. Uses NumPy only. Positions of
revolute joints are angles [rad], positions of prismatic joints are lengths [m].
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import Array, multiply, norm
from drakegrasp.frames import rotation_about, transform_points
from drakegrasp.hand.description import Hand
from drakegrasp.hand.file_format import Drive, with_efforts
from drakegrasp.hand.parsing import Chain


def coordinate_limits(hand: Hand) -> Array:
    """Return the lower and upper limit of each coordinate, (1 + k, 2) [rad or m].

    Row 0 is the spread, row 1 + i the closing of finger i. The limits of a coordinate keep all
    joints that it drives within their limits, including coupled joints and the joints of all
    fingers that share the motor. Without spread joints, row 0 is 0, 0.
    """
    limits = np.tile([-np.inf, np.inf], (1 + hand.num_fingers, 1))
    joints = zip(hand.joint_gain, hand.joint_offset, hand.joint_limits, strict=True)
    for gain, offset, joint_limits in joints:
        # No coordinate drives a joint of the preshape.
        for column in np.flatnonzero(gain):
            lower, upper = np.sort((joint_limits - offset) / gain[column])
            limits[column] = max(limits[column, 0], lower), min(limits[column, 1], upper)
    if not hand.spread.joints:
        limits[0] = 0.0

    # Fingers that share a motor stop together.
    limits[1:, 0] = -open_together(hand, -limits[1:, 0])
    limits[1:, 1] = open_together(hand, limits[1:, 1])
    return limits


def open_together(hand: Hand, closing: npt.ArrayLike) -> Array:
    """Return closing positions (k,) [rad or m] in which fingers that share a motor agree.

    Each finger is opened until it agrees with the most open finger of its motor.
    """
    positions, ratio = np.array(closing, dtype=float), hand.closing_ratio
    for motor in range(ratio.shape[1]):
        own = ratio[:, motor] > 0.0
        if np.count_nonzero(own) > 1:
            own_ratio = ratio[own, motor]
            positions[own] = own_ratio * (positions[own] / own_ratio).min()
    return positions


def closed_positions(hand: Hand) -> Array:
    """Return the closing positions (k,) of the closed hand [rad or m]; 0 if without a limit.

    Closing positions between open and closed hand are given as fractions of these.
    """
    limits = coordinate_limits(hand)[1:, 1]
    return np.where(np.isfinite(limits), np.maximum(limits, 0.0), 0.0)


def still_links(hand: Hand) -> list[str]:
    """Return the links that neither spread nor closing moves: the palm and links fixed to it."""
    return [link for link, chain in hand.link_chains.items() if not chain.gain.any()]


def joint_positions(hand: Hand, spread: float, closing: npt.ArrayLike) -> dict[str, float]:
    """Return each joint's position at a spread [rad] and closing positions (k,) [rad or m].

    Raises:
        ValueError: If `closing` is not one position per finger.
    """
    q = multiply(hand.joint_gain, _coordinates(hand, spread, closing)) + hand.joint_offset
    return dict(zip(hand.joint_names, q.tolist(), strict=True))


def fingertip_poses(hand: Hand, *, spread: npt.ArrayLike, closing: npt.ArrayLike) -> Array:
    """Return the poses X_GFi (k, 4, 4) of the fingertip links in the palm frame.

    Joint limits are not checked.

    Args:
        hand: The hand.
        spread: Angle of the spread joints [rad]; any shape (...,).
        closing: Position of each finger's closing joint (k,) [rad or m]; for many postures
            (..., k), and the result is (..., k, 4, 4).

    Raises:
        ValueError: If `closing` is not one position per finger.
    """
    c = _coordinates(hand, spread, closing)
    return np.stack([_chain_pose(chain, c) for chain in hand.chains], axis=-3)


def link_poses(hand: Hand, link: str, *, spread: npt.ArrayLike, closing: npt.ArrayLike) -> Array:
    """Return the poses X_GL (..., 4, 4) of a link of the palm's tree, in the palm frame.

    Args:
        hand: The hand.
        link: Name of the link, a key of `hand.link_chains`.
        spread: See `fingertip_poses`.
        closing: See `fingertip_poses`.

    Raises:
        ValueError: If `closing` is not one position per finger.
    """
    return _chain_pose(hand.link_chains[link], _coordinates(hand, spread, closing))


def posed_links(hand: Hand, positions: Mapping[str, Array]) -> dict[str, Array]:
    """Return the poses X_GL (..., 4, 4) of all links of the palm's tree, in the palm frame.

    Args:
        hand: The hand.
        positions: Position (...,) of each of its joints [rad or m]; couplings are ignored.
    """
    # Links of a finger share the joints next to the palm, so cache poses by their joints.
    (shape,) = {np.shape(q) for q in positions.values()}
    posed: dict[tuple[str, ...], Array] = {(): np.broadcast_to(np.eye(4), (*shape, 4, 4))}
    for chain in sorted(hand.link_chains.values(), key=lambda chain: len(chain.joints)):
        for j, name in enumerate(chain.joints):
            inner, outer = chain.joints[:j], chain.joints[: j + 1]
            if outer not in posed:
                X = multiply(posed[inner], chain.X_PJ[j])
                posed[outer] = multiply(
                    X, joint_motion(chain.axis[j], positions[name], slides=chain.slides[j])
                )
    return {
        link: multiply(posed[chain.joints], chain.X_JFi) for link, chain in hand.link_chains.items()
    }


def _coordinates(hand: Hand, spread: npt.ArrayLike, closing: npt.ArrayLike) -> Array:
    """Return coordinates (..., 1 + k) from a spread (...,) and closing positions (..., k)."""
    positions = np.asarray(closing, dtype=float)
    k = hand.num_fingers
    if positions.shape[-1:] != (k,):
        raise ValueError(f"closing must have shape (..., {k}), got {positions.shape}")
    first = np.asarray(spread, dtype=float)
    shape = np.broadcast_shapes(first.shape, positions.shape[:-1])
    return np.concatenate(
        [np.broadcast_to(first, shape)[..., None], np.broadcast_to(positions, (*shape, k))], axis=-1
    )


def _chain_pose(chain: Chain, c: Array) -> Array:
    """Return the poses (..., 4, 4) of a chain's link in {G} at coordinates (..., 1 + k)."""
    return _chain_frames(chain, c)[1]


def _chain_frames(chain: Chain, c: Array) -> tuple[list[Array], Array]:
    """Return the poses (..., 4, 4) in {G} of a chain's joints before they move, and of its link.

    Args:
        chain: A chain of m joints.
        c: (..., 1 + k), coordinates.
    """
    q = multiply(c[..., None, :], chain.gain.T)[..., 0, :] + chain.offset
    X, frames = np.broadcast_to(np.eye(4), (*q.shape[:-1], 4, 4)), []
    for j, X_PJ in enumerate(chain.X_PJ):
        frames.append(multiply(X, X_PJ))
        motion = joint_motion(chain.axis[j], q[..., j], slides=chain.slides[j])
        X = multiply(frames[-1], motion)
    return frames, multiply(X, chain.X_JFi)


def joint_motion(axis: Array, positions: npt.ArrayLike, *, slides: bool) -> Array:
    """Return the poses (..., 4, 4) of a joint's child at positions (...,), relative to position 0.

    Args:
        axis: (3,), unit.
        positions: Positions [rad or m].
        slides: Whether the joint slides along the axis; else it turns about it.
    """
    positions = np.asarray(positions, dtype=float)
    X = np.zeros((*positions.shape, 4, 4)) + np.eye(4)
    if slides:
        X[..., :3, 3] = positions[..., None] * axis
    else:
        X[..., :3, :3] = rotation_about(axis, positions)
    return X


def fingertip_forces(hand: Hand, drive: Drive) -> Array:
    """Return the largest force that each fingertip supports at its pad point, (k,) [N].

    It is the torque (or force, for a prismatic joint) that the finger supports at its closing
    joint, divided by the lever arm of the pad point, which is that of `closing_levers` at the
    centre of the closing joint's range. At the ends of the range, the Barrett Hand's force differs
    by -10 and +19 %.

    Only motors press. A load on a worm beyond its own motor's torque comes from the motors of the
    other fingers, which press through the object. So a finger supports at most the sum of their
    forces, and never more than its `holding_effort`. With the efforts τ_i of the motors and the
    lever arms l_i:

        N_i = τ_i / l_i                                                     (torque)
        N_i = min(max(τ_i / l_i, Σ_{j≠i} τ_j / l_j), `holding_effort` / l_i)   (worm, locked)

    Fingers that share a motor share its effort, as if they pressed equally. Then τ_i is the effort
    of the motor, and l_i the sum of the lever arms of all its fingers, each times its
    `Hand.closing_ratio`.

    Args:
        hand: A hand with k fingers.
        drive: What keeps the closing joints from being pushed open. A motor alone ("torque")
            supports its `effort_limit`. A locked joint supports what a worm does; without a
            `holding_effort` it supports any load from the other fingers.
    """
    # A joint without a limit is treated as limited to 0, the open hand.
    limits = coordinate_limits(hand)[1:]
    middle = np.where(np.isfinite(limits), limits, 0.0).mean(axis=1)
    levers = multiply(hand.closing_ratio.T, closing_levers(hand, middle))[hand.motor_of]
    own = [hand.fingers[hand.motor_fingers[motor]] for motor in hand.motor_of]
    motors = np.array([finger.effort_limit for finger in own]) / levers
    if drive == "torque":
        return motors

    # The forces of the other motors, up to what the finger can hold.
    strongest = [np.inf if f.holding_effort is None else f.holding_effort for f in own]
    return np.minimum(np.maximum(motors, motors.sum() - motors), np.array(strongest) / levers)


def within_load(hand: Hand, load: float | None) -> Hand:
    """Return a hand whose motors are all weakened by one factor, so that it presses less.

    Its strongest fingertip then supports at most `load` [N] at its pad point, see
    `fingertip_forces`. The hand is unchanged if it is no stronger than that or `load` is None.
    Worms keep their holding efforts, because their load comes from the motors.
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
    """Return how far each pad point moves per motion of its closing joint, (k,) [m/rad, or m/m].

    With the pad point P, and the axes a_j, origins o_j and ratios r_j of the finger's joints,

        l = |Σ_j r_j a_j × (P − o_j)|,   where a joint that slides along a_j adds r_j a_j instead.

    By virtual work, this is the lever arm of a force along that motion, with coupled joints
    included: the torque that `simulation.drive.opening_torques` measures, divided by the force.

    Args:
        hand: A hand with k fingers.
        closing: (k,), closing positions [rad or m]. The spread does not matter.

    Raises:
        ValueError: If `closing` is not one position per finger.
    """
    c, levers = _coordinates(hand, 0.0, closing), []
    for i, (finger, chain) in enumerate(zip(hand.fingers, hand.chains, strict=True)):
        # By its gain, each joint turns the pad point about its axis or moves it along the axis.
        frames, X_GF = _chain_frames(chain, c)
        X_GJ, p_GP = np.array(frames), transform_points(X_GF, finger.p_FiP[None])[0]
        axes = multiply(X_GJ[:, :3, :3], chain.axis[:, :, None])[..., 0]
        turned = np.cross(axes, p_GP - X_GJ[:, :3, 3])
        moved = np.where(chain.slides[:, None], axes, turned)
        levers.append(norm((chain.gain[:, 1 + i, None] * moved).sum(axis=0)))
    return np.array(levers)
