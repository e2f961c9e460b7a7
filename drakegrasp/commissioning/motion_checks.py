"""Checks of a hand's geometry: finger order, palm, pads, and what meets when it closes.

In: a hand that was loaded. Out: a `Finding` per check. Nothing is simulated.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import trimesh
from scipy.spatial import ConvexHull

from drakegrasp.commissioning.finding import Finding, judge
from drakegrasp.commissioning.pinch import (
    Opposition,
    closing_path,
    find_opposition,
    find_pinch,
    pad_fronts,
    reach,
)
from drakegrasp.frames import Array, transform_points
from drakegrasp.hand.chains import Chain
from drakegrasp.hand.description import Hand
from drakegrasp.hand.file_format import Finger
from drakegrasp.hand.finger_sweep import pad_points
from drakegrasp.hand.kinematics import (
    closed_positions,
    fingertip_poses,
    link_poses,
    still_links,
)
from drakegrasp.hand.shapes import hull_triangles, link_shapes, pad_surfaces
from drakegrasp.visualization.still_scene import Poses, StillScene

#: The origin of {G} may lie this deep in the hand [m]: in the Barrett Hand it is 1.35 mm deep.
PALM_DEPTH = 0.005
#: Length of the palm ray that must be free [m].
RAY = 0.3
#: A plane whose normal has less of Gz than this is parallel to it.
PARALLEL = 1e-9
#: A pad point lies on its fingertip within this distance, and pads that come so close meet [m].
ON_SURFACE, MEETING = 0.003, 0.008
#: Room behind a pad's face [m], and the cosine from which a border is parallel to it.
LEEWAY, FACING = 0.003, 0.95
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
    points = _pad_points(hand, np.zeros(hand.num_fingers))
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
    height = float(_pad_points(hand, 0.5 * closed_positions(hand))[:, 2].mean())
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


def check_pads(hand: Hand) -> Finding:
    """Return whether each pad lies on its fingertip's surface and faces where the finger closes."""
    # Distance of the pad points from the surface.
    shapes, faults, areas = link_shapes(hand), [], []
    facing = _facing(hand)
    for i, (finger, pad) in enumerate(zip(hand.fingers, pad_surfaces(hand), strict=True)):
        parts = [hull_triangles(corners) for corners in shapes[finger.fingertip]]
        if not parts:
            faults.append(f"link {finger.fingertip!r} must have a collision shape, got none")
            continue
        distance = min(_surface_distance(triangles, finger.p_FiP) for triangles in parts)
        if distance > ON_SURFACE:
            faults.append(
                f"fingers.{i}.pad_point must lie on the surface of link {finger.fingertip!r}, "
                f"got one {1e3 * distance:.1f} mm away"
            )
        if not len(pad):
            faults.append(f"fingers.{i}.pad_region must hold a part of the surface, got none of it")
            continue

        # The pad must face the way that it moves, and have room behind its face.
        if facing[i] <= 0.0:
            faults.append(
                f"the pad of finger {finger.name!r} must face where the finger closes, got its "
                f"back: {_turned_round(hand, i)}"
            )
        faults += _tight_borders(i, finger, pad)
        areas.append(1e6 * float(trimesh.triangles.area(pad).sum()))
    return judge("pads", faults, f"{', '.join(f'{area:.0f}' for area in areas)} mm²")


def _turned_round(hand: Hand, i: int) -> str:
    """Return how to mend a finger that moves away from its pad's side."""
    # A joint that opens moves the pad away from those of the other fingers.
    start = _pad_points(hand, np.zeros(hand.num_fingers))
    moved = _pad_points(hand, 0.1 * closed_positions(hand))
    others = np.delete(start, i, axis=0).mean(axis=0)
    finger = hand.fingers[i]
    if np.linalg.norm(moved[i] - others) <= np.linalg.norm(start[i] - others):
        return "check the pad_region, and the axis of the closing joint"
    lower, upper = hand.joint_limits[hand.joint_names.index(finger.closing_joint)]
    return (
        f"a positive position of joint {finger.closing_joint!r} opens the hand; reverse its axis, "
        f"limits ({-upper + 0.0:g}..{-lower + 0.0:g}) and origin, or take `drakegrasp hand new`"
    )


def _tight_borders(i: int, finger: Finger, pad: Array) -> list[str]:
    """Return the borders of a pad region that lie on the pad's face, and how to mend them.

    What is pressed sinks in, by a millimetre or two; behind the border it is no contact of the pad.
    """
    areas = trimesh.triangles.area(pad)
    normals = np.cross(pad[:, 1] - pad[:, 0], pad[:, 2] - pad[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    faults = []
    for n, (*direction, offset) in enumerate(finger.pad_region):
        length = float(np.linalg.norm(direction))
        along = np.array(direction) / length
        depth = pad.mean(axis=1) @ along - offset / length
        on_face = (np.abs(normals @ along) > FACING) & (depth < LEEWAY / 2.0)
        if areas[on_face].sum() > 0.5 * areas.sum():
            mended = [round(float(x), 5) for x in (*direction, offset - LEEWAY * length)]
            faults.append(
                f"fingers.{i}.pad_region.{n} must leave room behind the pad's face, into which "
                f"objects sink, got none: {1e3 * LEEWAY:.0f} mm are in {mended}"
            )
    return faults


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


def _pad_points(hand: Hand, closing: Array) -> Array:
    """Return the pad points (k, 3) in {G} at closing positions (k,) [m]."""
    X_GF = fingertip_poses(hand, spread=0.0, closing=closing)
    points = [finger.p_FiP[None] for finger in hand.fingers]
    return np.concatenate([transform_points(X, p) for X, p in zip(X_GF, points, strict=True)])


def _facing(hand: Hand) -> Array:
    """Return the cosine (k,) of the angle between each pad's normal and its motion, halfway."""
    # Motion of the pad points as the fingers close.
    half, step = 0.5 * closed_positions(hand), 1e-4 * hand.closing_unit
    motion = _pad_points(hand, half + step) - _pad_points(hand, half)

    # Mean normal of each pad's surface, out of the fingertip.
    X_GF, shapes, cosines = fingertip_poses(hand, spread=0.0, closing=half), link_shapes(hand), []
    for i, pad in enumerate(pad_surfaces(hand)):
        corners = shapes[hand.fingers[i].fingertip]
        if not len(pad) or not corners:
            cosines.append(0.0)
            continue
        normals = np.cross(pad[:, 1] - pad[:, 0], pad[:, 2] - pad[:, 0])
        centre = np.concatenate(corners).mean(axis=0)
        inward = np.einsum("ij,ij->i", normals, pad.mean(axis=1) - centre) < 0.0
        normals[inward] *= -1.0
        normal = X_GF[i, :3, :3] @ normals.sum(axis=0)
        length = np.linalg.norm(normal) * np.linalg.norm(motion[i])
        cosines.append(float(normal @ motion[i] / length) if length > 0.0 else 0.0)
    return np.array(cosines)


def ray_end(corners: Array) -> float:
    """Return where the ray along +Gz leaves a hull of corners (n, 3) in {G} [m]; 0 if it misses."""
    # On the ray p = t z each plane n.p + d <= 0 of the hull is a limit of t.
    equations = ConvexHull(corners).equations
    slope, offset = equations[:, 2], equations[:, 3]
    if (offset[np.abs(slope) < PARALLEL] > 0.0).any():
        return 0.0
    leaves, enters = slope >= PARALLEL, slope <= -PARALLEL
    end = float((-offset[leaves] / slope[leaves]).min())
    start = max(0.0, float((-offset[enters] / slope[enters]).max()))
    return end if start <= end and start <= RAY else 0.0


def _surface_distance(triangles: Array, point: Array) -> float:
    near = trimesh.triangles.closest_point(triangles, np.tile(point, (len(triangles), 1)))
    return float(np.linalg.norm(near - point, axis=1).min())


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
