"""Proposals: grasps from above of what a camera saw, for a hand whose user has no network yet.

In: an object's visible points in {T}, whose table is z = 0. Out: `Attempts`, which
`scoring.ranking` orders, a build tries and a score judges as those of a network. The sampler
`above` draws such palms at random about a whole mesh; here they are few, and fixed by what is seen.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import Array, multiply, norm
from drakegrasp.frames import make_pose, rotation_about
from drakegrasp.hand.description import Hand
from drakegrasp.hand.finger_sweep import across_angle, reach
from drakegrasp.hand.kinematics import joint_positions
from drakegrasp.mesh.cloud import read_cloud, smallest_rectangle
from drakegrasp.scoring.ranking import chosen_hand, closed_on
from drakegrasp.simulation.attempts import Attempts, make_attempts
from drakegrasp.simulation.posture import joint_order

#: Turns about the vertical [degree], from where the hand closes across the narrow side.
TURNS = (0.0, 180.0, 90.0, 270.0)
#: Of tilted palms: by how much, and about which horizontal axes, from the long side [degree].
TILT, TILTED = 25.0, (0.0, 90.0, 180.0, 270.0)
#: Places along the long side, as shares of half of it.
ASIDE = (-0.4, 0.4)
#: A fully closing hand comes so near to the table [m]; others are so much higher or deeper.
TABLE_GAP, DEEPER = 0.006, 0.02
#: Palms that are nearer to each other than both are one [m, rad].
SAME = 0.008, np.deg2rad(12.0)


def propose(
    cloud: npt.ArrayLike, hand: Hand | str | None = None, *, name: str = "seen"
) -> Attempts:
    """Return some 30 grasps from above of what a camera saw, the plainest first.

    The smallest rectangle about the points, seen from above, has a long side. The first palm looks
    down on its middle and closes across it, as deep as the table and the hand's smallest stand-off
    allow. The others are turned by quarters, higher or deeper by 20 mm, aside along the long side,
    or tilted by 25 degrees. No two are within 8 mm and 12 degrees.

    Args:
        cloud: (n, 3), points of the object alone in {T} [m]; the table is z = 0.
        hand: A hand, or what `load_hand` takes; the default one if None. Of one with preshapes the
            first is used.
        name: Name of the object in the table.

    Returns:
        Postures in the frame "table": the pregrasp is the open hand, the grasp has closed on the
        points.

    Raises:
        GraspError: If the cloud is none.
        HandError: If the hand cannot be used, or several of its fingers move one link.
    """
    points, hand = read_cloud(cloud), chosen_hand(hand)
    preshape = hand.preshape_names[0] if hand.preshapes else None
    shaped = hand.at(0)
    poses = distinct(_palms(points, shaped))

    spread = float(np.deg2rad(hand.spreads_deg[0])) if hand.spread.joints else 0.0
    closing = closed_on(points, shaped, poses, spread)
    names = joint_order(shaped)
    q = [joint_positions(shaped, spread, each) for each in [np.zeros(closing.shape[1]), *closing]]
    opened, *grasps = [[each[joint] for joint in names] for each in q]
    return make_attempts(
        hand,
        [name] * len(poses),
        poses,
        grasps,
        q_pregrasp=[opened] * len(poses),
        joints=names,
        frame="table",
        said=["from above"] * len(poses),
        preshape=[preshape] * len(poses),
    )


def _palms(points: Array, hand: Hand) -> Array:
    """Return the palm poses X_TG (n, 4, 4) of `propose`."""
    axes, middle, half = smallest_rectangle(points)
    heading = np.rad2deg(np.arctan2(axes[0, 1], axes[0, 0]) - across_angle(hand))
    top, least = float(points[:, 2].max()), min(hand.standoffs)
    standoff = max(least, reach(hand, np.array([0.0, 0.0, 1.0])) + TABLE_GAP - top)

    def palm(turn: float, higher: float, aside: float = 0.0, tilt: float | None = None) -> Array:
        """Return X_TG turned [degree], higher [m], aside [share] and tilted about an axis."""
        # About the point at half the height, at which the palm looks.
        R = multiply(_rotation_z(heading + turn), np.diag([1.0, -1.0, -1.0]))
        X = make_pose(R, [0.0, 0.0, top / 2.0 + standoff + higher])
        if tilt is not None:
            about = multiply(_rotation_z(heading + tilt), [1.0, 0.0, 0.0])
            X = multiply(make_pose(rotation_about(about, np.deg2rad(TILT)), np.zeros(3)), X)
        target = middle + aside * half[0] * axes[0]
        return multiply(make_pose(np.eye(3), [*target, top / 2.0]), X)

    deepest = -min(DEEPER, standoff - least)
    upright = [palm(turn, higher) for turn in TURNS for higher in (0.0, DEEPER, deepest)]
    beside = [palm(turn, 0.0, aside) for turn in TURNS[:2] for aside in ASIDE]
    tilted = [
        palm(turn, higher, tilt=tilt)
        for tilt in TILTED
        for turn in TURNS[:2]
        for higher in (0.0, DEEPER)
    ]
    return np.array([*upright, *beside, *tilted])


def _rotation_z(degrees: float) -> Array:
    return rotation_about([0.0, 0.0, 1.0], np.deg2rad(degrees))


def distinct(X_TG: Array) -> Array:
    """Return those (m, 4, 4) of poses (n, 4, 4) that are not within `SAME` of one before them."""
    kept: list[int] = []
    for i, X in enumerate(X_TG):
        known = X_TG[kept]
        cosine = ((known[:, :3, :3] * X[:3, :3]).sum(axis=(1, 2)) - 1.0) / 2.0
        near = norm(known[:, :3, 3] - X[:3, 3]) < SAME[0]
        if not (near & (cosine > np.cos(SAME[1]))).any():
            kept.append(i)
    return X_TG[kept]
