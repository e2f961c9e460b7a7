"""Proposals: grasps from above for what a camera saw, for users who have no network yet.

Input: an object's visible points in {T}, where the table is z = 0. Output: `Attempts`, which
`scoring.ranking` orders, a build tries and a score judges like those of a network. The sampler
`above` draws such palm poses at random around a whole mesh. Here they are few, and the visible
points determine them.
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

#: Turns about the vertical [degree], relative to closing across the narrow side.
TURNS = (0.0, 180.0, 90.0, 270.0)
#: Angle of tilted palms, and the horizontal axes of the tilts, measured from the long side
#: [degree].
TILT, TILTED = 25.0, (0.0, 90.0, 180.0, 270.0)
#: Places along the long side, as fractions of half of it.
ASIDE = (-0.4, 0.4)
#: Smallest distance of a closing hand from the table [m]; distance by which other palms are higher
#: or deeper [m].
TABLE_GAP, DEEPER = 0.006, 0.02
#: Palms that are closer to each other than both limits are the same [m, rad].
SAME = 0.008, np.deg2rad(12.0)


def propose(
    cloud: npt.ArrayLike, hand: Hand | str | None = None, *, name: str = "seen"
) -> Attempts:
    """Return about 30 grasps from above for what a camera saw, the simplest first.

    The smallest rectangle around the points, seen from above, has a long side. The first palm looks
    down on its centre and closes across the long side, as deep as the table and the hand's smallest
    stand-off allow. The other palms are turned by quarters, higher or deeper by 20 mm, shifted
    along the long side, or tilted by 25 degrees. No two palms are within 8 mm and 12 degrees.

    Args:
        cloud: (n, 3), points of the object only, in {T} [m]; the table is z = 0.
        hand: A hand, or an argument of `load_hand`; None for the default hand. Of a hand with
            preshapes, the first preshape is used.
        name: Name of the object in the table.

    Returns:
        Postures in the frame "table". The pregrasp is the open hand, and the grasp has closed on
        the points.

    Raises:
        GraspError: If the cloud is invalid.
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
        """Return X_TG turned [degree], higher [m], aside [fraction] and tilted about an axis."""
        # All poses look at the point at half the height, so they are relative to it.
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
    """Return the poses (m, 4, 4) that are not within `SAME` of an earlier pose, of (n, 4, 4)."""
    kept: list[int] = []
    for i, X in enumerate(X_TG):
        known = X_TG[kept]
        cosine = ((known[:, :3, :3] * X[:3, :3]).sum(axis=(1, 2)) - 1.0) / 2.0
        near = norm(known[:, :3, 3] - X[:3, 3]) < SAME[0]
        if not (near & (cosine > np.cos(SAME[1]))).any():
            kept.append(i)
    return X_TG[kept]
