"""Checks of a hand's geometry: finger order, palm, and what meets when it closes.

In: a hand that was loaded. Out: a `Finding` per check. Nothing is simulated.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from drakegrasp.commissioning.finding import Finding, judge
from drakegrasp.commissioning.pinch import (
    Opposition,
    closing_path,
    find_opposition,
    find_pinch,
    pad_fronts,
    pad_points_at,
    reach,
)
from drakegrasp.frames import Array, transform_points
from drakegrasp.hand.chains import Chain
from drakegrasp.hand.description import Hand
from drakegrasp.hand.finger_sweep import pad_points
from drakegrasp.hand.kinematics import (
    closed_positions,
    fingertip_poses,
    link_poses,
    still_links,
)
from drakegrasp.hand.shapes import link_shapes, ray_span
from drakegrasp.pictures.still_scene import Poses, StillScene

#: The origin of {G} may lie this deep in the hand [m]: in the Barrett Hand it is 1.35 mm deep.
PALM_DEPTH = 0.005
#: Length of the palm ray that must be free [m].
RAY = 0.3
#: Pads that come so close meet [m].
MEETING = 0.008
#: The hand may reach so far beyond its pinch along +Gz [m]: farther, the palm cannot face a table.
BEYOND_PINCH = 0.1
#: Postures on the way from the open to the closed hand, and of each of two fingers that meet.
POSTURES, MEETING_STEPS = 40, 40
#: Links of different fingers may overlap by so much before their fingertips meet [m].
OVERLAP = 0.002
#: Width of what a hand must at least be able to hold [m].
WIDTH = 0.02


def check_order(hand: Hand) -> Finding:
    """Return whether the fingers are in the order in which they stand around +Gz.

    Seen from the object, which looks at the palm, they run counter-clockwise. For two fingers every
    order does.
    """
    # Angles of the pad points about Gz.
    names = [finger.name for finger in hand.fingers]
    if hand.num_fingers < 3:
        return Finding(name="finger order", ok=True, text=", ".join(names))
    points = pad_points_at(hand, np.zeros(hand.num_fingers))
    centred = points[:, :2] - points[:, :2].mean(axis=0)
    angles = np.arctan2(centred[:, 1], centred[:, 0])

    # From the first one on, they rise to a full turn.
    turns = np.mod(angles - angles[0], 2.0 * np.pi)
    order = np.argsort(turns)
    if (order == np.arange(len(order))).all():
        return Finding(name="finger order", ok=True, text=", ".join(names))
    right = ", ".join(names[i] for i in order)
    return Finding(
        name="finger order",
        ok=False,
        text=f"fingers must run counter-clockwise about +Gz ({right}), got {', '.join(names)}",
    )


def check_palm(hand: Hand) -> Finding:
    """Return whether +Gz leaves the hand at the palm, towards where the fingertips close."""
    # How much of the ray from the origin of {G} along +Gz is within the open hand.
    closing = np.zeros(hand.num_fingers)
    worst, blocked = 0.0, ""
    for link, shapes in link_shapes(hand).items():
        if link not in hand.link_chains:
            continue
        X_GL = link_poses(hand, link, spread=0.0, closing=closing)
        for corners in shapes:
            depth = ray_end(transform_points(X_GL, corners))
            if depth > worst:
                worst, blocked = depth, link
    faults = []
    if not any(len(link_shapes(hand)[link]) for link in still_links(hand)):
        faults.append(
            f"link {hand.palm_link!r}, or one that is fixed to it, must have a collision shape, "
            "got none"
        )
    if worst > PALM_DEPTH:
        faults.append(
            f"the palm ray along +Gz must be free, got link {blocked!r} up to "
            f"{1e3 * worst:.0f} mm from the origin of {{G}}: check palm.p_BG and palm.rpy_deg"
        )

    # The fingertips close in front of the palm.
    height = float(pad_points_at(hand, 0.5 * closed_positions(hand))[:, 2].mean())
    if height <= 0.0:
        faults.append(
            f"+Gz must point to where the fingertips close, got them {-1e3 * height:.0f} mm behind "
            "the palm: check palm.rpy_deg"
        )
    text = f"its ray is free; half-closed fingertips {1e3 * height:.0f} mm ahead"
    pinch = None if faults else find_pinch(hand, WIDTH)
    if pinch is not None:
        # What is beyond the pinch meets the table before the fingertips meet the object.
        beyond = reach(hand, np.array([0.0, 0.0, 1.0])) - float(pinch.p_GM[2])
        text += f"; it reaches {1e3 * beyond:.0f} mm beyond what it pinches"
        if beyond > BEYOND_PINCH:
            faults.append(
                "the palm must be able to face a table, but the hand reaches "
                f"{1e3 * beyond:.0f} mm beyond what it pinches along +Gz: turn "
                "palm.rpy_deg, or keep fingers that do not grasp away with preshape"
            )
    return judge("palm", faults, text)


def check_meeting(hand: Hand) -> Finding:
    """Return whether the pads of opposed fingers meet when the hand closes."""
    opposition = find_opposition(hand)
    first = [f.name for f, is_first in zip(hand.fingers, opposition.group, strict=True) if is_first]
    second = [f.name for f in hand.fingers if f.name not in first]
    if not first or not second:
        return Finding(
            name="fingertips",
            ok=False,
            text="fingers must close against each other, got all of them in one direction: check "
            "the axes of the closing joints",
        )

    # Some pads touch, each comes as far as those opposite, and something fits between them.
    text = f"{' and '.join(first)} against {' and '.join(second)}"
    gap, short = _least_gap(hand, opposition.group), _shortfall(hand, opposition)
    if gap <= MEETING and (short <= MEETING).all() and find_pinch(hand, WIDTH) is not None:
        return Finding(name="fingertips", ok=True, text=f"{text} meet within {1e3 * gap:.1f} mm")
    text = f"pads of {text} must meet when they close"
    for finger, missing in zip(hand.fingers, short, strict=True):
        if missing > MEETING:
            text += f", got that of {finger.name} {1e3 * missing:.0f} mm short"
    if (short <= MEETING).all():
        text += f", got {1e3 * gap:.0f} mm between them, or no posture that pinches"

    # Perhaps a coupling has the wrong sign.
    for i, finger in enumerate(hand.fingers):
        for n, coupling in enumerate(finger.coupled):
            other = _shortfall(_with_other_sign(hand, i, n), opposition)
            if short[i] > MEETING and other[i] <= MEETING:
                text += (
                    f"; it does with the other sign of fingers.{i}.coupled.{n}.ratio "
                    f"({coupling.joint} {coupling.ratio:+g})"
                )
    return Finding(name="fingertips", ok=False, text=text)


def check_overlaps(hand: Hand) -> Finding:
    """Return whether only fingertips of different fingers meet, until the hand is closed.

    In the simulation other links pass through each other, so they must not touch.
    """
    # Close it step by step, until two fingertips meet.
    scene = StillScene(hand)
    movers = {link: _mover(chain) for link, chain in hand.link_chains.items()}
    faults: dict[str, float] = {}
    for closing in closing_path(hand, POSTURES):
        scene.pose(Poses(X_WG=np.eye(4), q=scene.positions(0.0, closing)))
        met = False
        for links, depth in scene.overlaps():
            # What carries the palm is no link of it; the fingers do not move it.
            one, other = (movers.get(link) for link in links)
            if one is None or other is None or one == other:
                continue
            if set(links) <= set(hand.fingertip_links):
                met = True
            elif depth > OVERLAP:
                key = f"links {links[0]!r} and {links[1]!r}"
                faults[key] = max(faults.get(key, 0.0), depth)
        if met:
            break
    texts = [f"{key} must not meet before fingertips do, got {1e3 * depth:.1f} mm of overlap"
             for key, depth in faults.items()]  # fmt: skip
    return judge("self-collision", texts, "fingertips meet before any other links")


def _mover(chain: Chain) -> int | None:
    """Return which finger's closing moves a link; None for none of them."""
    found = np.flatnonzero(chain.gain[:, 1:].any(axis=0))
    return int(found[0]) if len(found) else None


def ray_end(corners: Array) -> float:
    """Return where the ray along +Gz leaves a hull of corners (n, 3) in {G} [m]; 0 if it misses."""
    span = ray_span(corners, np.zeros(3), np.array([0.0, 0.0, 1.0]))
    return 0.0 if span is None or span[0] > RAY else max(span[1], 0.0)


def _least_gap(hand: Hand, group: npt.NDArray[np.bool_]) -> float:
    """Return the least distance between a pad of one group and one of the other [m]."""
    # The pads at each posture of their own finger.
    path = closing_path(hand, MEETING_STEPS)
    X_GF = fingertip_poses(hand, spread=0.0, closing=path)
    clouds = [
        np.stack([transform_points(X, points) for X in X_GF[:, i]])
        for i, points in enumerate(pad_points(hand))
    ]

    # Nearest postures by the middles of the pads, then exactly.
    least = np.inf
    for a in np.flatnonzero(group):
        for b in np.flatnonzero(~group):
            middles = clouds[a].mean(axis=1)[:, None] - clouds[b].mean(axis=1)[None]
            near = np.argsort(np.linalg.norm(middles, axis=2), axis=None)[:20]
            for i, j in zip(*np.unravel_index(near, (MEETING_STEPS, MEETING_STEPS)), strict=True):
                between = clouds[a][i][:, None] - clouds[b][j][None]
                least = min(least, float(np.linalg.norm(between, axis=2).min()))
    return least


def _shortfall(hand: Hand, opposition: Opposition) -> Array:
    """Return by how much each pad (k,) does not come to those opposite, along their line [m]."""
    _, front = pad_fronts(hand, opposition)
    sign = np.where(opposition.group, 1.0, -1.0)
    reached = (front @ opposition.axis * sign).max(axis=0)
    opposite = [-reached[opposition.group != own].max() for own in opposition.group]
    return np.asarray(opposite - reached)


def _with_other_sign(hand: Hand, finger: int, coupling: int) -> Hand:
    """Return a hand with the ratio of a coupling negated."""
    # The gain of the coupled joint, among all joints and in the chain of its fingertip.
    joint = hand.fingers[finger].coupled[coupling].joint
    gain = hand.joint_gain.copy()
    gain[hand.joint_names.index(joint)] *= -1.0
    chains = list(hand.chains)
    own = chains[finger].gain.copy()
    own[[name == joint for name in chains[finger].joints]] *= -1.0
    chains[finger] = replace(chains[finger], gain=own)
    return replace(hand, joint_gain=gain, chains=tuple(chains))
