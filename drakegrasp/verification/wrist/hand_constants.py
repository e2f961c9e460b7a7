"""A hand as stacked arrays, so that the wrist problem treats all fingers at once.

In: a hand. Out: its joints, pads and corners as arrays over the fingers, computed once per hand.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from drakegrasp.errors import HandError
from drakegrasp.frames import Array
from drakegrasp.hand.description import Hand
from drakegrasp.hand.kinematics import coordinate_limits
from drakegrasp.hand.shapes import link_shapes, pad_surfaces
from drakegrasp.verification.wrist.pads import Pads, make_pads

#: A vector times this, reshaped to 3 x 3, is the matrix of its cross product.
_SKEW = np.array([np.cross(e, np.eye(3)).T for e in np.eye(3)]).reshape(3, 9)


@dataclass(frozen=True, kw_only=True, eq=False)
class HandConstants:
    """A hand of k fingers with chains of m joints as stacked arrays; shorter chains are padded.

    Attributes:
        X_PJ: (m, k, 4, 4), pose of each joint in the moving frame of the joint before it; that
            of the first joint is in {G}.
        axis: (m, k, 3), unit axis in the joint's frame.
        cross, cross2: (m, k, 4, 4), matrix of the cross product by the axis, and its square.
        gain: (m, k, 1 + k), joint angle per coordinate.
        finger_gain: (k, m, 1 + k), the same by finger.
        closing_gain: (m, k), joint angle per closing angle of the joint's own finger.
        X_JFi: (k, 4, 4), pose of the fingertip link in the moving frame of the last joint.
        pads: The fingertips' surfaces.
        pad_points: (k, 3), nominal contact points in {Fi} [m].
        limits: (1 + k, 2), of the coordinates [rad].
        fingertips: (k, n, 3), corners of the fingertips in {Fi} [m].
        palm: (n, 3), corners of the palm link in {G} [m].
    """

    X_PJ: Array
    axis: Array
    cross: Array
    cross2: Array
    gain: Array
    finger_gain: Array
    closing_gain: Array
    X_JFi: Array
    pads: Pads
    pad_points: Array
    limits: Array
    fingertips: Array
    palm: Array


@lru_cache(maxsize=4)
def hand_constants(hand: Hand) -> HandConstants:
    """Return the constants of a hand.

    Raises:
        HandError: If its palm or a fingertip has no shape, or one that is not convex.
    """
    # The palm and the fingertips need shapes.
    shapes = link_shapes(hand)
    for link in (hand.palm_link, *hand.fingertip_links):
        if not shapes[link]:
            raise HandError(f"{hand.sdf_path}: link {link!r} must have a collision shape, got none")

    # Corners of the fingertips, stacked.
    corners = [np.concatenate(shapes[finger.fingertip]) for finger in hand.fingers]
    most = max(map(len, corners))
    # n copies of a corner lower the smooth minimum by at most its rounding times log n.
    padded = np.stack([np.pad(c, ((0, most - len(c)), (0, 0)), mode="edge") for c in corners])

    # Corners of the palm, from its link's frame {B} to {G}.
    X_GB = np.linalg.inv(hand.X_BG)
    palm = np.concatenate(shapes[hand.palm_link]) @ X_GB[:3, :3].T + X_GB[:3, 3]

    chains = _stack_chains(hand)
    return HandConstants(
        **chains,
        pads=make_pads(corners, [finger.pad_region for finger in hand.fingers], pad_surfaces(hand)),
        pad_points=np.array([finger.p_FiP for finger in hand.fingers]),
        limits=coordinate_limits(hand),
        fingertips=padded,
        palm=palm,
    )


def _stack_chains(hand: Hand) -> dict[str, Array]:
    """Return the attributes of `HandConstants` that describe the joints, by name."""
    # Pad all chains to the length of the longest.
    m = max(len(chain.axis) for chain in hand.chains)
    X_PJ, axis, gain = [], [], []
    for chain in hand.chains:
        # Padding joints come last and do not move, so they have no effect.
        missing = m - len(chain.axis)
        X_PJ.append(np.concatenate([chain.X_PJ, np.tile(np.eye(4), (missing, 1, 1))]))
        axis.append(np.concatenate([chain.axis, np.tile([0.0, 0.0, 1.0], (missing, 1))]))
        gain.append(np.pad(chain.gain, ((0, missing), (0, 0))))

    # The matrices of the cross products by the axes, with room for a position.
    a, k = np.stack(axis, axis=1), len(hand.chains)
    cross = np.zeros((m, k, 4, 4))
    cross[..., :3, :3] = skew(a)

    return {
        "X_PJ": np.stack(X_PJ, axis=1),
        "axis": a,
        "cross": cross,
        "cross2": cross @ cross,
        "gain": np.stack(gain, axis=1),
        "finger_gain": np.stack(gain),
        "closing_gain": np.stack(gain, axis=1)[:, range(k), 1 + np.arange(k)],
        "X_JFi": np.stack([chain.X_JFi for chain in hand.chains]),
    }


def skew(a: Array) -> Array:
    """Return the matrices (..., 3, 3) of the cross products by a (..., 3)."""
    return np.asarray((a @ _SKEW).reshape(*a.shape, 3))
