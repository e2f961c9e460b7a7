"""How the fingertips of a hand close on something between them.

In: a hand. Out: its `Opposition`, two groups of fingers that close against each other, and the
`Pinch` in which they hold something of a given width. Geometry only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from drakegrasp.frames import Array, transform_points
from drakegrasp.hand.description import Hand
from drakegrasp.hand.finger_sweep import link_points, pad_points
from drakegrasp.hand.kinematics import closed_positions, fingertip_poses, link_poses

#: Postures of each group of fingers that are tried.
STEPS = 60
#: What it costs if one group has closed fully and the other not at all [rad].
UNEVEN = 1.0
#: Points this close behind the foremost one are as far in front [m].
FLAT = 2e-4
#: Largest difference between the width of a pinch and the one that is asked for [m].
WIDTH_ERROR = 0.004


@dataclass(frozen=True, kw_only=True, eq=False)
class Opposition:
    """Two groups of fingers that close against each other along a line.

    Attributes:
        axis: (3,), unit, across Gz: the fingers of the group move along it, the others against it.
        group: (k,), whether each finger is of the first group.
    """

    axis: Array
    group: npt.NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True, eq=False)
class Pinch:
    """A posture in which the fingertips hold something.

    Attributes:
        closing: (k,), closing positions [rad or m].
        p_GQ: (k, 3), the foremost points of the pads along the opposition [m].
        p_GM: (3,), the middle between the two groups [m].
        width: Distance between the two groups along the opposition [m].
        tilt: Angle between the line from one group to the other and the opposition [rad].
    """

    closing: Array
    p_GQ: Array
    p_GM: Array
    width: float
    tilt: float


def find_opposition(hand: Hand) -> Opposition:
    """Return along which line the fingers close, from the motion of their pad points."""
    # Velocity of each pad point across Gz, on its way from the open hand to the limits.
    paths = _pad_point_paths(hand)
    motion = np.diff(paths, axis=0)[:, :, :2].reshape(-1, 2)
    _, vectors = np.linalg.eigh(motion.T @ motion)
    axis = np.array([*vectors[:, 1], 0.0])

    # The last finger, often a thumb, closes against the axis.
    moved = (paths[-1] - paths[0]) @ axis
    if moved[-1] > 0.0:
        axis, moved = -axis, -moved
    return Opposition(axis=axis, group=moved > 0.0)


def find_pinch(hand: Hand, width: float) -> Pinch | None:
    """Return the straightest pinch of a width [m]; None if the fingers have none."""
    # The foremost point of each pad along the opposition, at each posture.
    opposition = find_opposition(hand)
    if opposition.group.all() or not opposition.group.any():
        return None
    closing, front = pad_fronts(hand, opposition)

    # All pairs of a posture of the first group and one of the second.
    first, second = front[:, opposition.group], front[:, ~opposition.group]
    along_first = (first @ opposition.axis).max(axis=1)
    along_second = (second @ opposition.axis).min(axis=1)
    gap = along_second[None, :] - along_first[:, None]
    line = second.mean(axis=1)[None] - first.mean(axis=1)[:, None]
    along = line @ opposition.axis
    across = np.linalg.norm(line - along[..., None] * opposition.axis, axis=-1)
    tilt = np.arctan2(across, np.maximum(along, 1e-6))

    # Of those with the width, in front of the palm, the straightest in which all fingers have
    # closed by about the same.
    share = np.linspace(0.0, 1.0, STEPS)
    cost = tilt + UNEVEN * np.abs(share[:, None] - share)
    cost[np.abs(gap - width) > WIDTH_ERROR] = np.inf
    motors = hand.motor_of
    if set(motors[opposition.group]) & set(motors[~opposition.group]):
        # Groups that share a motor close together.
        cost[~np.eye(STEPS, dtype=np.bool_)] = np.inf
    cost[(first[..., 2].min(axis=1) <= 0.0)] = np.inf
    cost[:, second[..., 2].min(axis=1) <= 0.0] = np.inf
    i, j = np.unravel_index(np.argmin(cost), cost.shape)
    if not np.isfinite(cost[i, j]):
        return None

    p_GQ = np.where(opposition.group[:, None], front[i], front[j])
    middle = (
        front[i][opposition.group].mean(axis=0) + front[j][~opposition.group].mean(axis=0)
    ) / 2
    shift = (along_first[i] + along_second[j]) / 2.0 - middle @ opposition.axis
    return Pinch(
        closing=np.where(opposition.group, closing[i], closing[j]),
        p_GQ=p_GQ,
        p_GM=middle + shift * opposition.axis,
        width=float(gap[i, j]),
        tilt=float(tilt[i, j]),
    )


def reach(hand: Hand, direction: Array) -> float:
    """Return how far the closing hand reaches along a direction (3,) in {G} from its origin [m]."""
    surfaces, closing, farthest = link_points(hand), closing_path(hand, STEPS), -np.inf
    for link in hand.link_chains:
        if not len(surfaces[link]):
            continue
        X_GL = link_poses(hand, link, spread=0.0, closing=closing)
        along = np.einsum("nab,b->na", np.swapaxes(X_GL[:, :3, :3], -1, -2), direction)
        heights = along @ surfaces[link].T + (X_GL[:, :3, 3] @ direction)[:, None]
        farthest = max(farthest, float(heights.max()))
    return farthest


def closing_path(hand: Hand, steps: int) -> Array:
    """Return closing positions (steps, k) from the open hand to the limits [rad or m]."""
    return np.linspace(0.0, 1.0, steps)[:, None] * closed_positions(hand)


def pad_points_at(hand: Hand, closing: Array) -> Array:
    """Return the pad points (k, 3) in {G} at closing positions (k,) [m]."""
    X_GF = fingertip_poses(hand, spread=0.0, closing=closing)
    points = [finger.p_FiP[None] for finger in hand.fingers]
    return np.concatenate([transform_points(X, p) for X, p in zip(X_GF, points, strict=True)])


def _pad_point_paths(hand: Hand) -> Array:
    """Return the pad points (steps, k, 3) in {G} from the open hand to the limits [m]."""
    X_GF = fingertip_poses(hand, spread=0.0, closing=closing_path(hand, STEPS))
    points = np.array([finger.p_FiP for finger in hand.fingers])
    return np.einsum("nkab,kb->nka", X_GF[..., :3, :3], points) + X_GF[..., :3, 3]


def pad_fronts(hand: Hand, opposition: Opposition) -> tuple[Array, Array]:
    """Return closing positions (n, k), and the foremost point of each pad there (n, k, 3) [m].

    The positions go from the open hand to the limits; foremost is along the opposition, in {G}.
    """
    closing = closing_path(hand, STEPS)
    X_GF = fingertip_poses(hand, spread=0.0, closing=closing)
    front = np.zeros((len(closing), hand.num_fingers, 3))
    for i, points in enumerate(pad_points(hand)):
        sign = 1.0 if opposition.group[i] else -1.0
        for n, X in enumerate(X_GF[:, i]):
            p_GQ = transform_points(X, points)
            along = sign * p_GQ @ opposition.axis
            # A flat pad has many foremost points: their middle counts.
            front[n, i] = p_GQ[along >= along.max() - FLAT].mean(axis=0)
    return closing, front


def across_angle(hand: Hand) -> float:
    """Return the direction across the opposition, as an angle about Gz from Gx [rad]."""
    axis = find_opposition(hand).axis
    return float(np.arctan2(-axis[0], axis[1]))
