"""Checks of a hand's pads: on their fingertips, facing where the fingers close, with room behind.

In: a hand that was loaded. Out: a `Finding`. Nothing is simulated.
"""

from __future__ import annotations

import numpy as np
import trimesh

from drakegrasp.commissioning.finding import Finding, judge
from drakegrasp.commissioning.pinch import pad_points_at
from drakegrasp.frames import Array
from drakegrasp.hand.description import Hand
from drakegrasp.hand.file_format import Finger
from drakegrasp.hand.kinematics import closed_positions, fingertip_poses
from drakegrasp.hand.shapes import hull_triangles, link_shapes, pad_surfaces

#: A pad point lies on its fingertip within this distance [m].
ON_SURFACE = 0.003
#: Room behind a pad's face [m], and the cosine from which a border is parallel to it.
LEEWAY, FACING = 0.003, 0.95


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
    start = pad_points_at(hand, np.zeros(hand.num_fingers))
    moved = pad_points_at(hand, 0.1 * closed_positions(hand))
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


def _facing(hand: Hand) -> Array:
    """Return the cosine (k,) of the angle between each pad's normal and its motion, halfway."""
    # Motion of the pad points as the fingers close.
    half, step = 0.5 * closed_positions(hand), 1e-4 * hand.closing_unit
    motion = pad_points_at(hand, half + step) - pad_points_at(hand, half)

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


def _surface_distance(triangles: Array, point: Array) -> float:
    near = trimesh.triangles.closest_point(triangles, np.tile(point, (len(triangles), 1)))
    return float(np.linalg.norm(near - point, axis=1).min())
