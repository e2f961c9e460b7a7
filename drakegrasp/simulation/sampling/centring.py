"""Palm poses of hands whose opposed fingers share a motor: both sides meet the object at once.

In: attempts at an object. Out: the same attempts, the palm moved along the direction in which the
fingers close. Where one finger meets an object first, the other of a shared motor stops with it.
A real gripper then pushes the object, or gives way, until both touch; here the object is clamped
while the hand closes, so the palm is moved before. How far follows from the object's distance field
along the paths of the closing fingers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import dot, norm
from drakegrasp.frames import Array
from drakegrasp.hand.description import Hand
from drakegrasp.hand.finger_sweep import FingerPath, hand_paths
from drakegrasp.objects.model import ObjectModel
from drakegrasp.simulation.candidates import Attempt, Pregrasp, Source
from drakegrasp.simulation.screen import PointLookup

#: Moves of the palm; after the first one sliding jaws are centred.
MOVES = 3
#: A finger meets the object where it is nearer than this [m], after so many steps at most.
TOUCH, STEPS = 5e-5, 40
#: Points this far from the object need no exact distance [m].
FAR = 0.02

_A = TypeVar("_A", bound=Pregrasp)


def centred(model: ObjectModel, hand: Hand, attempts: Sequence[_A]) -> list[_A]:
    """Return attempts whose fingers of one motor meet the object together, where they can.

    An attempt is as it was if its palm ray misses, its fingers start closed, one side of the
    fingers does not meet the object, or no motor of the hand drives opposed fingers. So is one of
    a posture, which is tried as it is given.

    Args:
        model: The object.
        hand: The hand.
        attempts: At the object.
    """
    # The paths of the fingers depend on preshape and spread.
    found = list(attempts)
    groups: dict[tuple[int | None, float], list[int]] = {}
    for row, attempt in enumerate(found):
        given = isinstance(attempt, Attempt) and attempt.source is Source.POSTURES
        if attempt.ray_hits and attempt.closing is None and not given:
            groups.setdefault((attempt.preshape, attempt.spread), []).append(row)

    # Move the palms for each motor that moves several fingers.
    for (preshape, spread), rows in groups.items():
        shaped = hand.at(preshape)
        shared = [np.flatnonzero(row) for row in shaped.closing_ratio.T > 0.0]
        shared = [fingers for fingers in shared if len(fingers) > 1]
        paths = hand_paths(shaped, spread) if shared else None
        if paths is None:
            continue
        X_OG = np.stack([found[row].X_OG for row in rows])
        for fingers in shared:
            own = [paths.fingers[i] for i in fingers]
            ratio = shaped.closing_ratio[fingers].max(axis=1)
            for _ in range(MOVES):
                X_OG[:, :3, 3] += _move(model, X_OG, own, ratio)
        for row, X in zip(rows, X_OG, strict=True):
            found[row] = replace(found[row], X_OG=X)
    return found


def _move(model: ObjectModel, X_OG: Array, paths: Sequence[FingerPath], ratio: Array) -> Array:
    """Return by how much (n, 3) palms move in {O} [m]; 0 where one side meets nothing."""
    # Positions of the motor at which each finger meets the object, and the motion of its pad there.
    lookup = PointLookup(model.field, np.eye(4), X_OG)
    ends = [_meeting(lookup, path) for path in paths]
    closing = [path.angles[1] * end for path, end in zip(paths, ends, strict=True)]
    at = np.stack(closing) / ratio[:, None]
    motion = np.stack([_pad_motion(path, end) for path, end in zip(paths, ends, strict=True)])
    motion *= ratio[:, None, None]

    # One side is what moves with the first finger, and its first finger to touch counts.
    # A pad that stays where it is has no direction, and nothing is on a side.
    u = motion[0] / np.maximum(norm(motion[0]), np.finfo(float).tiny)[:, None]
    speed = dot(motion, u)
    first, rate = [], []
    for side in (speed > 0.0, speed < 0.0):
        where = np.where(side, at, np.inf)
        nearest = where.argmin(axis=0)[None]
        first.append(np.take_along_axis(where, nearest, axis=0)[0])
        rate.append(np.abs(np.take_along_axis(speed, nearest, axis=0)[0]))
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (first[0] - first[1]) / (1.0 / rate[0] + 1.0 / rate[1])
    distance = np.where(np.isfinite(distance), distance, 0.0)
    along = (X_OG[:, :3, :3] * u[:, None, :]).sum(axis=2)
    return np.asarray(distance[:, None] * along)


def _meeting(lookup: PointLookup, path: FingerPath) -> Array:
    """Return the place (n,) on a path, in steps, at which a finger meets the object; inf: nowhere.

    It is negative for a finger that is within the object when the hand is open: as far as it would
    have to open. No point moves by more per step than the largest `travel`, so the least distance
    says how many steps are free (sphere tracing; Hart 1996).
    """
    rate, end = float(path.travel.max()), len(path.angles) - 1
    place, active = np.zeros(len(lookup)), np.arange(len(lookup))
    for _ in range(STEPS):
        if not len(active):
            break
        least = lookup.distances(active, _points(path, place[active]), FAR).min(axis=1)
        place[active] += least / rate
        going = (np.abs(least) > TOUCH) & (place[active] >= 0.0) & (place[active] <= end)
        active = active[going]
    return np.where(place > end, np.inf, place)


def _points(path: FingerPath, place: Array) -> npt.NDArray[np.float32]:
    """Return the points (n, p, 3) in {G} at places on a path, between its steps in proportion."""
    before = np.clip(np.floor(place).astype(np.int64), 0, len(path.points) - 2)
    share = (place - before).astype(np.float32)[:, None, None]
    points = path.points[before] * (np.float32(1.0) - share)
    return np.asarray(points + path.points[before + 1] * share)


def _pad_motion(path: FingerPath, place: Array) -> Array:
    """Return the motion (n, 3) of the middle of the pad per closing position, in {G}."""
    near = np.clip(np.where(np.isfinite(place), place, 0.0), 0, len(path.points) - 2)
    before = near.astype(np.int64)
    middle = path.points[:, : path.pad].astype(float).mean(axis=1)
    return np.asarray((middle[before + 1] - middle[before]) / path.angles[1])
