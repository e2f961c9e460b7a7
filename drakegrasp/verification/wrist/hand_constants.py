"""A hand as stacked arrays, so that the wrist problem treats all fingers at once.

In: a hand. Out: its joints, pads and corners as arrays over the fingers, computed once per hand.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt
from scipy.linalg import block_diag

from drakegrasp.errors import HandError
from drakegrasp.frames import Array, transform_points
from drakegrasp.hand.description import Hand
from drakegrasp.hand.kinematics import coordinate_limits, link_poses, still_links
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
        axis: (m, k, 3), unit axis in the joint's frame; zero if the joint slides.
        slide: (m, k, 3), unit direction in the joint's frame; zero if the joint turns.
        slides: (m, k), whether the joint slides.
        twist, twist2: (m, k, 4, 4), matrix of the joint's motion per position, and its square: of
            the cross product by its axis, or of its direction.
        gain: (m, k, 1 + k), joint position per coordinate.
        offset: (m, k), joint positions at zero coordinates [rad or m].
        finger_gain: (k, m, 1 + k), the gain by finger.
        closing_gain: (m, k), joint position per closing position of the joint's own finger.
        X_JFi: (k, 4, 4), pose of the fingertip link in the moving frame of the last joint.
        pads: The fingertips' surfaces.
        pad_points: (k, 3), nominal contact points in {Fi} [m].
        limits: (1 + m, 2), of the coordinates: the spread, and the closing of each finger that has
            a motor [rad or m].
        units: (1 + m,), what counts as a radian of each coordinate [rad or m].
        fingertips: (k, n, 3), corners of the fingertips in {Fi} [m].
        closing_ratio: (k, m), see `Hand.closing_ratio`.
        motor_of: (k,), the motor that moves each finger.
        palm: (n, 3), corners of the palm and of what is fixed to it, in {G} [m].
    """

    X_PJ: Array
    axis: Array
    slide: Array
    slides: Array
    twist: Array
    twist2: Array
    gain: Array
    offset: Array
    finger_gain: Array
    closing_gain: Array
    X_JFi: Array
    pads: Pads
    pad_points: Array
    limits: Array
    units: Array
    fingertips: Array
    palm: Array
    closing_ratio: Array
    motor_of: npt.NDArray[np.int64]


@lru_cache(maxsize=4)
def hand_constants(hand: Hand) -> HandConstants:
    """Return the constants of a hand.

    Raises:
        HandError: If its palm or a fingertip has no shape, or one that is not convex.
    """
    # The palm and the fingertips need shapes; those of a palm may be on links fixed to it.
    shapes = link_shapes(hand)
    still = [link for link in still_links(hand) if shapes[link]]
    missing = [] if still else [hand.palm_link]
    missing += [link for link in hand.fingertip_links if not shapes[link]]
    if missing:
        raise HandError(
            f"{hand.model.path}: link {missing[0]!r} must have a collision shape, got none"
        )

    # Corners of the fingertips, stacked.
    corners = [np.concatenate(shapes[finger.fingertip]) for finger in hand.fingers]
    most = max(map(len, corners))
    # n copies of a corner lower the smooth minimum by at most its rounding times log n.
    padded = np.stack([np.pad(c, ((0, most - len(c)), (0, 0)), mode="edge") for c in corners])

    # Corners of the palm, from the links' frames to {G}.
    open_hand = np.zeros(hand.num_fingers)
    palm = np.concatenate(
        [
            transform_points(
                link_poses(hand, link, spread=0.0, closing=open_hand), np.concatenate(shapes[link])
            )
            for link in still
        ]
    )

    chains = _stack_chains(hand)
    moved = [0, *(1 + i for i in hand.motor_fingers)]
    return HandConstants(
        **chains,
        pads=make_pads(corners, [finger.pad_region for finger in hand.fingers], pad_surfaces(hand)),
        pad_points=np.array([finger.p_FiP for finger in hand.fingers]),
        limits=coordinate_limits(hand)[moved],
        units=np.r_[1.0, hand.closing_unit][moved],
        closing_ratio=hand.closing_ratio,
        motor_of=hand.motor_of,
        fingertips=padded,
        palm=palm,
    )


def _stack_chains(hand: Hand) -> dict[str, Array]:
    """Return the attributes of `HandConstants` that describe the joints, by name."""
    # Pad all chains to the length of the longest.
    m = max(len(chain.axis) for chain in hand.chains)
    X_PJ, axis, slides, gain, offset = [], [], [], [], []
    for chain in hand.chains:
        # Padding joints come last and do not move, so they have no effect.
        missing = m - len(chain.axis)
        X_PJ.append(np.concatenate([chain.X_PJ, np.tile(np.eye(4), (missing, 1, 1))]))
        axis.append(np.concatenate([chain.axis, np.tile([0.0, 0.0, 1.0], (missing, 1))]))
        slides.append(np.pad(chain.slides, (0, missing)))
        gain.append(np.pad(chain.gain, ((0, missing), (0, 0))))
        offset.append(np.pad(chain.offset, (0, missing)))

    # The motions of the joints as matrices: the cross product by an axis, or a translation.
    along, sliding = np.stack(axis, axis=1), np.stack(slides, axis=1)
    turn = np.where(sliding[..., None], 0.0, along)
    slide = np.where(sliding[..., None], along, 0.0)
    k = len(hand.chains)
    by_motor = block_diag(1.0, hand.closing_ratio)
    twist = np.zeros((m, k, 4, 4))
    twist[..., :3, :3] = skew(turn)
    twist[..., :3, 3] = slide

    return {
        "X_PJ": np.stack(X_PJ, axis=1),
        "axis": turn,
        "slide": slide,
        "slides": sliding,
        "twist": twist,
        "twist2": twist @ twist,
        "gain": np.stack(gain, axis=1) @ by_motor,
        "offset": np.stack(offset, axis=1),
        "finger_gain": np.stack(gain) @ by_motor,
        "closing_gain": np.stack(gain, axis=1)[:, range(k), 1 + np.arange(k)],
        "X_JFi": np.stack([chain.X_JFi for chain in hand.chains]),
    }


def skew(a: Array) -> Array:
    """Return the matrices (..., 3, 3) of the cross products by a (..., 3)."""
    return np.asarray((a @ _SKEW).reshape(*a.shape, 3))
