"""Proposals: grasps for what a camera saw, for users who have no network yet.

Input: an object's visible points in {T}, where the table is z = 0. Output: `Attempts`, which
`scoring.ranking` orders, a build tries and a score judges like those of a network. The sampler
`above` draws such palm poses at random around a whole mesh. Here they are few, and the visible
points determine them.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import Array, dot, multiply, norm, sin_cos_deg
from drakegrasp.frames import make_pose, rotation_about
from drakegrasp.hand.description import Hand
from drakegrasp.hand.finger_sweep import across, reach
from drakegrasp.hand.kinematics import joint_positions
from drakegrasp.mesh.cloud import read_cloud, smallest_rectangle
from drakegrasp.scoring.ranking import chosen_hand, closed_on
from drakegrasp.simulation.attempts import Attempts, make_attempts
from drakegrasp.simulation.posture import joint_order

#: Turns about the vertical [degree], relative to closing across the narrow side; and turns that are
#: tried at one height only.
TURNS, DIAGONAL = (0.0, 180.0, 90.0, 270.0), (45.0, 135.0, 225.0, 315.0)
#: Angle of tilted palms, and the horizontal axes of the tilts, measured from the long side
#: [degree].
TILT, TILTED = 25.0, (0.0, 90.0, 180.0, 270.0)
#: Places along the long side, as fractions of half of it.
ASIDE = (-0.4, 0.4)
#: Angle of slanted palms from the vertical, and the directions from which they come, measured from
#: the long side [degree].
SLANTED, SLANTED_FROM = 55.0, (0.0, 90.0, 180.0, 270.0)
#: Directions from which horizontal palms come, measured from the long side [degree].
BESIDE = (0.0, 45.0, 90.0, 135.0, 180.0, 225.0, 270.0, 315.0)
#: Palms from the side aim at half the object's height, or if the table is in the way, at most at
#: this fraction of it.
HIGHEST = 0.8
#: Smallest distance of a closing hand from the table [m]; distance by which other palms are higher
#: or deeper [m].
TABLE_GAP, DEEPER = 0.006, 0.02
#: Palms that are closer to each other than both limits are the same [m, rad].
SAME = 0.008, np.deg2rad(12.0)


class Palm(NamedTuple):
    """A palm pose X_TG (4, 4), the spread [rad] with which the hand closes, and its origin."""

    X_TG: Array
    spread: float
    said: str


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
    palms = distinct([*_from_above(points, shaped), *_from_the_side(points, shaped)])

    # Close the hand on the points, with one spread at a time.
    names, count = joint_order(shaped), len(palms)
    poses, spreads = np.array([palm.X_TG for palm in palms]), [palm.spread for palm in palms]
    q_opened, q_grasp = np.zeros((2, count, len(names)))
    for spread in dict.fromkeys(spreads):
        rows = np.flatnonzero(np.array(spreads) == spread)
        closing = closed_on(points, shaped, poses[rows], spread)
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


def _spreads(hand: Hand) -> tuple[float, ...]:
    """Return the first and the last usual spread [rad], or 0 for a hand without spread."""
    usual = np.deg2rad(hand.spreads_deg) if hand.spread.joints else np.zeros(1)
    return tuple(dict.fromkeys((float(usual[0]), float(usual[-1]))))


def _from_above(points: Array, hand: Hand) -> Iterator[Palm]:
    """Yield the palms that look down on the object."""
    axes, middle, half = smallest_rectangle(points)
    ahead = multiply(_rotation_to(axes[0]), _rotation_to(across(hand)).T)
    top, least = float(points[:, 2].max()), min(hand.standoffs)
    standoff = max(least, reach(hand, np.array([0.0, 0.0, 1.0])) + TABLE_GAP - top)

    def palm(turn: float, higher: float, aside: float = 0.0, tilt: float | None = None) -> Array:
        """Return X_TG turned [degree], higher [m], aside [fraction] and tilted about an axis."""
        # All poses look at the point at half the height, so they are relative to it.
        R = multiply(multiply(ahead, _rotation_z(turn)), np.diag([1.0, -1.0, -1.0]))
        X = make_pose(R, [0.0, 0.0, top / 2.0 + standoff + higher])
        if tilt is not None:
            about = multiply(ahead, _rotation_z(tilt)[:, 0])
            X = multiply(make_pose(rotation_about(about, np.deg2rad(TILT)), np.zeros(3)), X)
        target = middle + aside * half[0] * axes[0]
        return multiply(make_pose(np.eye(3), [*target, top / 2.0]), X)

    deepest, (spread, *wider) = -min(DEEPER, standoff - least), _spreads(hand)
    for turn in TURNS:
        for higher in (0.0, DEEPER, deepest):
            yield Palm(palm(turn, higher), spread, "from above")
    for turn in DIAGONAL:
        yield Palm(palm(turn, 0.0), spread, "from above")
    for turn in TURNS[:2]:
        for aside in ASIDE:
            yield Palm(palm(turn, 0.0, aside), spread, "from above, beside the middle")
    for tilt in TILTED:
        for turn in TURNS[:2]:
            for higher in (0.0, DEEPER):
                yield Palm(palm(turn, higher, tilt=tilt), spread, "from above, tilted")
    for other in wider:
        for turn in TURNS:
            for higher in (0.0, DEEPER):
                yield Palm(palm(turn, higher), other, "from above, spread")


def _from_the_side(points: Array, hand: Hand) -> Iterator[Palm]:
    """Yield the palms that come from the side, slanted or horizontal, and close across Tz."""
    axes, middle, _ = smallest_rectangle(points)
    top, turned = float(points[:, 2].max()), _rotation_to(across(hand)).T
    target = np.array([*middle, top / 2.0])
    palms = [(SLANTED, each, "slanted") for each in SLANTED_FROM]
    palms += [(90.0, each, "from the side") for each in BESIDE]
    down_to: dict[tuple[float, ...], float] = {}
    for slant, where, said in palms:
        outward = multiply(_rotation_to(axes[0]), _rotation_z(where)[:, 0])
        sine, cosine = sin_cos_deg(slant)
        approach = -sine * outward - cosine * np.array([0.0, 0.0, 1.0])
        front = float(dot(points - target, -approach).max())
        origin = target - (front + min(hand.standoffs)) * approach
        for sign in (1.0, -1.0):
            # The palm looks along the approach, and the table limits how low it can be.
            y = sign * np.array([-outward[1], outward[0], 0.0])
            R = multiply(np.column_stack([np.cross(y, approach), y, approach]), turned)
            down = -R[2].round(6) + 0.0
            if (key := tuple(down.tolist())) not in down_to:
                down_to[key] = reach(hand, down)
            raised = max(0.0, down_to[key] + TABLE_GAP - origin[2])
            if target[2] + raised <= HIGHEST * top:
                X_TG = make_pose(R, origin + np.array([0.0, 0.0, raised]))
                yield Palm(X_TG, _spreads(hand)[0], said)


def _rotation_z(degrees: float) -> Array:
    return rotation_about([0.0, 0.0, 1.0], np.deg2rad(degrees))


def _rotation_to(direction: Array) -> Array:
    """Return the rotation about Tz that turns Tx to a horizontal unit direction (2,) or (3,)."""
    x, y = direction[:2]
    return np.array([[x, -y, 0.0], [y, x, 0.0], [0.0, 0.0, 1.0]])


def distinct(palms: list[Palm]) -> list[Palm]:
    """Return the palms that are not within `SAME` of an earlier one with the same spread."""
    kept: list[Palm] = []
    for palm in palms:
        X, known = palm.X_TG, [k.X_TG for k in kept if k.spread == palm.spread]
        poses = np.reshape(known, (-1, 4, 4))
        cosine = ((poses[:, :3, :3] * X[:3, :3]).sum(axis=(1, 2)) - 1.0) / 2.0
        near = norm(poses[:, :3, 3] - X[:3, 3]) < SAME[0]
        if not (near & (cosine > np.cos(SAME[1]))).any():
            kept.append(palm)
    return kept
