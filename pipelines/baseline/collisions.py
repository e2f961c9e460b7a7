"""What a view refutes: proposals whose open hand would be in the object or in the table.

Palm poses of a network are off by some millimetres, and a hand that starts in the object never
closes. The view is enough to tell: a point of the hand just behind the surface that the camera sees
is in the object.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from drakegrasp.arithmetic import multiply
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.frames import invert_pose
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.finger_sweep import link_points
from drakegrasp.hand.kinematics import link_poses

#: A point is in the object from so far behind its surface to so far [m]: less may be an error of
#: the depth, and more may be behind the object.
BEHIND = (0.004, 0.03)
#: The hand is in the object with so many of its points, which are 3 to 5 mm apart.
FEW = 3
#: The hand is in the table from such a depth [m].
SUNK = 0.002


def hand_of_scenes(path: Path) -> Hand | None:
    """Return the hand of a file of scenes that lies in its dataset; None of one that does not."""
    alone = not (path.parent / "manifest.json").is_file()
    return None if alone else load_hand(read_manifest(path.parent).config.hand_source)


def refuted(
    p_GQ: np.ndarray, X_TG: np.ndarray, X_TC: np.ndarray, images: Mapping[str, np.ndarray]
) -> bool:
    """Return whether a view shows that a hand is in the object, or the hand is in the table.

    Args:
        p_GQ: (n, 3), points on the hand [m].
        X_TG: Pose of the palm, (4, 4).
        X_TC: Pose of the camera, (4, 4).
        images: `depth` (h, w) [m], 0 where there is none, `mask` (h, w), not 0 on the object, and
            the camera matrix `K` (3, 3) [px].
    """
    p_TQ = p_GQ @ X_TG[:3, :3].T + X_TG[:3, 3]
    if p_TQ[:, 2].min() < -SUNK:
        return True

    # The pixels at which the points are, and how far behind them.
    X_CT, (height, width) = invert_pose(X_TC), images["depth"].shape
    z = p_TQ @ X_CT[2, :3] + X_CT[2, 3]
    p_CQ = (p_TQ @ X_CT[:3, :3].T + X_CT[:3, 3])[z > 0.0]
    uv = np.rint((p_CQ @ images["K"].T)[:, :2] / p_CQ[:, 2:]).astype(int)
    seen = ((uv >= 0) & (uv < (width, height))).all(axis=1)
    (u, v), z = uv[seen].T, p_CQ[seen, 2]
    behind = np.where(images["mask"][v, u] > 0, z - images["depth"][v, u], 0.0)
    return int(((behind > BEHIND[0]) & (behind < BEHIND[1])).sum()) >= FEW


def hand_points(hand: Hand, joints: Sequence[str], q: Any) -> np.ndarray:
    """Return points on the hand, p_GQ (n, 3) [m], with its joints (j,) at q [rad or m]."""
    at = dict(zip(joints, np.asarray(q, dtype=float).tolist(), strict=True))
    spread = at[hand.spread.joints[0]] if hand.spread.joints else 0.0
    closing = [at[finger.closing_joint] for finger in hand.fingers]
    found = []
    for link, points in link_points(hand).items():
        X_GL = link_poses(hand, link, spread=spread, closing=closing)
        found.append(multiply(points, X_GL[:3, :3].T) + X_GL[:3, 3])
    return np.concatenate(found)
