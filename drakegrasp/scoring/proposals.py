"""Proposals: grasps for what a camera saw, for users who have no network yet.

Input: an object's visible points in {T}, where the table is z = 0. Output: `Attempts`, which
`scoring.ranking` orders, a build tries and a score judges like those of a network. The palms are
the fixed ones of `simulation.palms`, which the sampler `closing` also tries on whole objects.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from drakegrasp.hand.description import Hand
from drakegrasp.hand.kinematics import joint_positions
from drakegrasp.mesh.cloud import hull_solid, read_cloud
from drakegrasp.scoring.ranking import chosen_hand
from drakegrasp.simulation.attempts import Attempts, make_attempts
from drakegrasp.simulation.closing import closed_on
from drakegrasp.simulation.palms import Palms
from drakegrasp.simulation.posture import joint_order


def propose(
    cloud: npt.ArrayLike, hand: Hand | str | None = None, *, name: str = "seen"
) -> Attempts:
    """Return 30 to 70 grasps for what a camera saw, the simplest first.

    The smallest rectangle around the points, seen from above, has a long side. The first palm looks
    down on its centre and closes across the long side, as deep as the table and the hand's smallest
    stand-off allow. The other palms from above are turned, higher or deeper by 20 mm, shifted along
    the long side, tilted by 25 degrees, or have another spread. Then follow palms from all sides,
    slanted by 55 degrees or horizontal, which close across the vertical. No two palms of one spread
    are within 8 mm and 12 degrees.

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
    palms = Palms(points, shaped).fixed()

    # Close the hand on the points, with one spread at a time.
    solid = hull_solid(points)
    names, count = joint_order(shaped), len(palms)
    poses, spreads = np.array([palm.X_TG for palm in palms]), [palm.spread for palm in palms]
    q_opened, q_grasp = np.zeros((2, count, len(names)))
    for spread in dict.fromkeys(spreads):
        rows = np.flatnonzero(np.array(spreads) == spread)
        closing = closed_on(solid, shaped, spread, poses[rows])
        for q, closed in ((q_opened, np.zeros_like(closing)), (q_grasp, closing)):
            for row, each in zip(rows, closed, strict=True):
                at = joint_positions(shaped, spread, each)
                q[row] = [at[joint] for joint in names]
    return make_attempts(
        hand,
        [name] * count,
        poses,
        q_grasp,
        q_pregrasp=q_opened,
        joints=names,
        frame="table",
        said=[palm.said for palm in palms],
        preshape=[preshape] * count,
    )
