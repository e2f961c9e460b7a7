"""Inverse kinematics: all joint positions that put a flange to a pose, and their ways along paths.

Input: the chain of an arm, limits of its joints and poses of its flange. Output: configurations,
each of which meets its pose. A damped Newton iteration (Levenberg and Marquardt) runs from many
starts at once, so that one call finds all branches of a pose: the eight of an arm with six joints,
and points of the curves of one with seven. The starts are the same for every pose and every arm of
so many joints. So a result depends on nothing but its pose.

A branch is followed along a path of poses from one pose to the next, by the same iteration. It ends
where the next pose cannot be met, or where a joint would jump.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from drakegrasp.frames import Array
from drakegrasp.hand.parsing import Chain
from drakegrasp.seeding import Stream

#: Number of starts for a pose; see docs/results/reach.md for what more of them find.
STARTS = 64
#: Largest number of steps from a start, and from the pose before on a path.
STEPS, PATH_STEPS = 40, 8
#: A pose is met within these [m], [rad]: far less than what an arm repeats.
POSITION, ANGLE = 1e-5, 1e-4
#: Length that makes an angle comparable to a distance [m/rad]: about that of a hand.
LEVER = 0.2
#: Damping: this part of the squared error, and at least that.
DAMPING, LEAST_DAMPING = 0.1, 1e-9
#: Longest step of a joint in the iteration [rad or m].
LONGEST = 0.5
#: Configurations that differ by less than this in every joint are one [rad or m].
SAME = 0.05

Mask: TypeAlias = npt.NDArray[np.bool_]


def find_branches(chain: Chain, limits: Array, X_TF: Array) -> Array:
    """Return configurations (n, a) that put the flange to a pose, those far from limits first.

    Args:
        chain: The a joints between {T} and the flange.
        limits: (a, 2), limits of the joints [rad or m].
        X_TF: Pose (4, 4) of the flange.
    """
    q, met = solve(chain, limits, X_TF, _starts(chain, limits), STEPS)
    q = _unwound(q[met], chain, limits)

    # The branch in the middle of its joints has most room to move on.
    middle, half = limits.mean(axis=1), np.diff(limits, axis=1)[:, 0] / 2.0
    q = q[np.argsort(np.abs((q - middle) / half).max(axis=1), kind="stable")]
    found = np.zeros((0, len(chain.joints)))
    for row in q:
        if not (np.abs(found - row) < SAME).all(axis=1).any():
            found = np.concatenate([found, row[None]])
    return found


def follow(chain: Chain, limits: Array, path: Array, q: Array, jump: float) -> tuple[Array, Mask]:
    """Return the configurations (m, n, a) of n branches along a path of m poses.

    Args:
        chain: The joints.
        limits: (a, 2), limits of the joints [rad or m].
        path: (m, 4, 4), poses of the flange.
        q: (n, a), configurations just before the first pose.
        jump: Largest motion of a joint from one pose to the next [rad or m].

    Returns:
        The configurations, and which branches (n,) reach the end; the others stay where they ended.
    """
    found, alive = np.zeros((len(path), *q.shape)), np.ones(len(q), dtype=np.bool_)
    q = q.copy()
    for k, X_TF in enumerate(path):
        rows = np.flatnonzero(alive)
        new, met = solve(chain, limits, X_TF, q[rows], PATH_STEPS)
        met &= (np.abs(new - q[rows]) <= jump).all(axis=1)
        q[rows[met]] = new[met]
        alive[rows[~met]] = False
        found[k] = q
    return found, alive


def solve(chain: Chain, limits: Array, X_TF: Array, q: Array, steps: int) -> tuple[Array, Mask]:
    """Return configurations (n, a) near given ones (n, a) that meet a pose, and which (n,) do.

    Args:
        chain: The joints.
        limits: (a, 2), limits of the joints [rad or m].
        X_TF: Pose (4, 4) of the flange.
        q: Configurations from which the iteration starts.
        steps: Largest number of steps.
    """
    q, met, weight = q.copy(), np.zeros(len(q), dtype=np.bool_), np.array([1.0] * 3 + [LEVER] * 3)
    active, unit = np.arange(len(q)), np.eye(q.shape[1])
    for step in range(steps + 1):
        X, J = flange_poses(chain, q[active])
        error = _pose_error(X, X_TF)
        near = (np.abs(error[:, :3]).max(axis=1) < POSITION) & (
            np.abs(error[:, 3:]).max(axis=1) < ANGLE
        )
        met[active[near]] = True
        far = ~near
        active, J, error = active[far], J[far] * weight[:, None], error[far] * weight
        if step == steps or not len(active):
            break

        # (J'J + d) dq = J'e, with a damping that vanishes with the error; limits cut the step.
        Jt = np.swapaxes(J, 1, 2)
        damping = DAMPING * (error**2).sum(axis=1) + LEAST_DAMPING
        A = Jt @ J + damping[:, None, None] * unit
        dq = np.linalg.solve(A, Jt @ error[:, :, None])[:, :, 0]
        dq *= np.minimum(1.0, LONGEST / np.maximum(np.abs(dq).max(axis=1), LONGEST))[:, None]
        q[active] = np.clip(q[active] + dq, limits[:, 0], limits[:, 1])
    return q, met


def flange_poses(chain: Chain, q: Array) -> tuple[Array, Array]:
    """Return the poses X_TF (n, 4, 4) of the flange, and its Jacobians (n, 6, a) in {T}.

    The rows of a Jacobian are the velocity of F's origin [m/s], then the angular velocity [rad/s].
    """
    X, axes, origins = np.broadcast_to(np.eye(4), (len(q), 4, 4)), [], []
    for j, (X_PJ, axis) in enumerate(zip(chain.X_PJ, chain.axis, strict=True)):
        X = X @ X_PJ
        axes.append(X[:, :3, :3] @ axis)
        X = X @ _motions(chain, j, q[:, j])
        origins.append(X[:, :3, 3])
    X = X @ chain.X_JFi
    axis_T, p_TJ = np.stack(axes, axis=1), np.stack(origins, axis=1)
    turning = np.cross(axis_T, X[:, None, :3, 3] - p_TJ)
    slides = chain.slides[:, None]
    linear, angular = np.where(slides, axis_T, turning), np.where(slides, 0.0, axis_T)
    return X, np.swapaxes(np.concatenate([linear, angular], axis=2), 1, 2)


def _motions(chain: Chain, j: int, q: Array) -> Array:
    """Return the motions (n, 4, 4) of joint j at positions (n,)."""
    x, y, z = chain.axis[j]
    X = np.zeros((len(q), 4, 4))
    X[:] = np.eye(4)
    if chain.slides[j]:
        X[:, :3, 3] = q[:, None] * chain.axis[j]
        return X
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    s, c = np.sin(q)[:, None, None], np.cos(q)[:, None, None]
    X[:, :3, :3] += s * K + (1.0 - c) * (K @ K)
    return X


def _pose_error(X: Array, X_goal: Array) -> Array:
    """Return (n, 6) how far poses (n, 4, 4) must move [m] and turn [rad] to a goal (4, 4)."""
    R = X_goal[:3, :3] @ np.swapaxes(X[:, :3, :3], 1, 2)
    # The vector has length 2 sin(angle): its direction is the axis, except for half turns.
    v = np.stack(
        [R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1
    )
    length = np.sqrt((v**2).sum(axis=1))
    angle = np.arctan2(length, np.trace(R, axis1=1, axis2=2) - 1.0)
    turn = v * (angle / np.maximum(length, 1e-12))[:, None]
    return np.concatenate([X_goal[:3, 3] - X[:, :3, 3], turn], axis=1)


@lru_cache
def _drawn(count: int) -> Array:
    """Return the starts (STARTS, a) as fractions of the ranges of a joints."""
    return Stream(0, count).uniform(STARTS * count).reshape(STARTS, count)


def _starts(chain: Chain, limits: Array) -> Array:
    """Return configurations (STARTS, a), within one turn of each joint."""
    lower = np.where(chain.slides, limits[:, 0], np.maximum(limits[:, 0], -np.pi))
    upper = np.where(chain.slides, limits[:, 1], np.minimum(limits[:, 1], np.pi))
    lower, upper = np.where(lower < upper, (lower, upper), limits.T)
    return lower + _drawn(len(limits)) * (upper - lower)


def _unwound(q: Array, chain: Chain, limits: Array) -> Array:
    """Return configurations (n, a) without whole turns of joints that can do without them."""
    turned = q - 2.0 * np.pi * np.rint(q / (2.0 * np.pi))
    within = (turned >= limits[:, 0]) & (turned <= limits[:, 1]) & ~chain.slides
    return np.where(within, turned, q)
