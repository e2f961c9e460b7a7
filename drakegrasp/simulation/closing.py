"""Closing the hand on a solid by geometry: where each finger stops, and how well that would hold.

Input: a solid, which may be a guess from a cloud (`mesh.cloud`) or the surface of an object, and
palm poses. Output: features of each pose and a score. Nothing is simulated. The same numbers are
computed on every machine (`arithmetic`), since samplers decide by them.

`centred` applies to hands in which opposed fingers share a motor. It moves the palm along the
closing direction so that both sides meet the object at the same time. If one finger meets the
object first, the other finger of the motor stops with it. A real gripper then pushes the object, or
gives way, until both fingers touch. Here the object is clamped while the hand closes, so the palm
is moved before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import Array, dot, norm
from drakegrasp.errors import HandError
from drakegrasp.hand.description import Hand
from drakegrasp.hand.finger_sweep import KEPT, FingerPath, HandPaths, hand_paths
from drakegrasp.mesh.cloud import Solid
from drakegrasp.objects.model import ObjectModel
from drakegrasp.simulation.attempt import Attempt, Source
from drakegrasp.simulation.screen import PointLookup

#: Strides of the points that are used: of a pad, and of the rest of the hand.
PAD_STRIDE, STRIDE = 2, 4
#: A finger stops closer than this to an obstacle [m]; largest number of steps of the search.
TOUCH, STEPS = 2e-4, 60
#: Larger distances are cut to this [m].
FAR = 0.02
#: Number of moves of the palm that centre it; sliding jaws are centred after the first move.
MOVES = 3
#: A finger meets the object for centring if it is closer than this [m]; largest number of steps of
#: the search.
MEETING, MEETING_STEPS = 5e-5, 40
#: A pad touches if it is closer than this when its finger stops [m].
PAD_GAP = 0.003
#: The open hand is free unless it is deeper than this in object or table [m]; the solids are rough.
DEEP = 0.003
#: Lever arm by which a moment is divided to be compared with a force [m].
LEVER = 0.05
#: Rounds of the search for the fractions of force of the fingers, and its rate.
ROUNDS, RATE = 100, 1.0
#: An exponential is computed as a power of this power of two of a small one.
SQUARINGS = 4
#: Logistic weights of `push`, `opposition`, `arm` [1/m] and `gap` [1/m], and the constant. They
#: were fitted to lifts of the Barrett Hand at 24 built-in objects, see "The fixed weights" in
#: docs/results/choice.md.
WEIGHTS = {"push": 4.0, "opposition": 2.0, "arm": -20.0, "gap": -50.0}
CONSTANT = -3.0
_NO_MOTION = np.eye(4)


def closing_features(
    solid: Solid,
    hand: Hand,
    spread: float,
    X_SG: Array,
    *,
    X_TS: Array = _NO_MOTION,
    closing: Array | None = None,
) -> dict[str, Array]:
    """Return features of n palms whose fingers close until each meets the solid or the table.

    Args:
        solid: The solid, in its frame {S}.
        hand: The hand in one of its preshapes, with k fingers.
        spread: Spread [rad].
        X_SG: (n, 4, 4), palm poses.
        X_TS: (4, 4), pose of the solid on the table; by default {S} is {T}.
        closing: (n, k), closing positions of the open hand [rad or m]; 0 by default.

    Returns:
        Features by name, (n,) unless another shape is given:
            `score`, how well the hand would hold, 0 to 1, an order only; 0 if it is not free;
            `clearance`, `table`, distances of the open hand from solid and table [m], negative
            inside, at most `FAR`;
            `touch` (n, k), whether each pad touches; `robust`, whether the hand is free, at most
            `DEEP` inside, and all required pads touch;
            `gap`, distance of the farthest required pad [m];
            `push`, smallest cosine between the motion of a required pad and the inward normal;
            `opposition`, how well the normals balance, 0 to 1;
            `arm`, horizontal distance of the contacts' centre from the solid's [m].

    Raises:
        HandError: If several fingers move one link.
    """
    # The open hand.
    paths = coarse_paths(hand, spread)
    lookup, rows = PointLookup(solid.field, X_TS, X_SG), np.arange(len(X_SG))
    starts = np.zeros((len(X_SG), hand.num_fingers)) if closing is None else closing / _steps(paths)
    opened = [points_at(path, at) for path, at in zip(paths.fingers, starts.T, strict=True)]
    parts = [paths.still, *opened]
    clearance = np.min([lookup.distances(rows, p, FAR).min(axis=1) for p in parts], axis=0)
    table = np.min([lookup.heights(rows, p).min(axis=1) for p in parts], axis=0)

    # The pads, in the places where the fingers stop.
    places = _places(hand, paths, lookup, starts)
    pads = [
        _pad(solid, lookup, path, X_SG, at)
        for path, at in zip(paths.fingers, places.T, strict=True)
    ]
    gaps, p_SQ, n_S, push = (np.stack(each, axis=1) for each in zip(*pads, strict=True))

    # The features of the contacts.
    touch, needed = gaps < PAD_GAP, hand.required
    opposition, middle = _opposition(p_SQ, n_S, touch)
    free = np.minimum(clearance, table) > -DEEP
    p_middle_T = dot((middle - solid.middle)[:, None], X_TS[:2, :3])
    features = {
        "clearance": np.minimum(clearance, FAR),
        "table": np.minimum(table, FAR),
        "touch": touch.astype(float),
        "gap": gaps[:, needed].max(axis=1),
        "push": push[:, needed].min(axis=1),
        "opposition": opposition,
        "arm": norm(p_middle_T),
        "robust": free & touch[:, needed].all(axis=1),
    }
    logit = np.full(len(X_SG), CONSTANT)
    for name, weight in WEIGHTS.items():
        logit = logit + weight * features[name]
    return {"score": free / (1.0 + _decay(logit)), **features}


def closing_positions(solid: Solid, hand: Hand, spread: float, X_SG: Array) -> Array:
    """Return closing positions (n, k) [rad or m] of a hand that is open at n palm poses and closes.

    Args:
        solid: The solid, in {T}.
        hand: The hand in one of its preshapes.
        spread: Spread [rad].
        X_SG: (n, 4, 4), palm poses.

    Raises:
        HandError: If several fingers move one link.
    """
    paths = coarse_paths(hand, spread)
    lookup = PointLookup(solid.field, _NO_MOTION, X_SG)
    return _places(hand, paths, lookup, np.zeros((len(X_SG), hand.num_fingers))) * _steps(paths)


def _places(hand: Hand, paths: HandPaths, lookup: PointLookup, starts: Array) -> Array:
    """Return the places (n, k) on their paths, in steps, at which fingers stop."""
    fingers = zip(paths.fingers, starts.T, strict=True)
    steps = _steps(paths)
    closing = np.column_stack([_stop(lookup, path, at) for path, at in fingers]) * steps

    # Fingers that share a motor close together: the first finger to stop stops them all.
    for ratio in hand.closing_ratio.T:
        own = ratio > 0.0
        closing[:, own] = ratio[own] * (closing[:, own] / ratio[own]).min(axis=1, keepdims=True)
    return closing / steps


def _stop(lookup: PointLookup, path: FingerPath, start: Array) -> Array:
    """Return the place (n,) on a path, in steps, at which a finger meets the solid or the table.

    No point moves by more than the largest `travel` per step, so the smallest distance limits the
    number of free steps (sphere tracing; Hart 1996).
    """
    rate, end = float(path.travel.max()), len(path.angles) - 1
    place, active = start.astype(float), np.arange(len(lookup))
    for _ in range(STEPS):
        points = points_at(path, place[active])
        least = lookup.distances(active, points, FAR).min(axis=1)
        least = np.minimum(least, lookup.heights(active, points).min(axis=1))
        going = (least > TOUCH) & (place[active] < end)
        active = active[going]
        if not len(active):
            break
        place[active] = np.minimum(place[active] + least[going] / rate, end)
    return place


def _pad(
    solid: Solid, lookup: PointLookup, path: FingerPath, X_SG: Array, place: Array
) -> tuple[Array, Array, Array, Array]:
    """Return the point of a pad that is closest to the solid, at places (n,) on its path.

    Returns:
        Its distance (n,), 0 to `FAR` [m]; the point p_SQ (n, 3) [m]; the solid's inward normal
        (n, 3) there, in {S}; and the cosine (n,) between the pad's motion and that normal.
    """
    rows, points = np.arange(len(X_SG)), points_at(path, place)[:, : path.pad]
    distances = lookup.distances(rows, points, FAR)
    nearest = distances.argmin(axis=1)
    before = np.clip(place, 0, len(path.points) - 2).astype(np.int64)
    motion = (path.points[before + 1, nearest] - path.points[before, nearest]).astype(float)
    R_SG = X_SG[:, :3, :3]
    p_SQ = dot(points[rows, nearest].astype(float)[:, None], R_SG) + X_SG[:, :3, 3]
    inward = -solid.normals(p_SQ)
    motion = dot(motion[:, None], R_SG) / norm(motion)[:, None]
    return np.clip(distances[rows, nearest], 0.0, FAR), p_SQ, inward, dot(motion, inward)


def _opposition(p_SQ: Array, n_S: Array, touch: npt.NDArray[np.bool_]) -> tuple[Array, Array]:
    """Return how well contacts balance (n,), and their centre (n, 3) [m].

    Each touching finger presses along its normal, with the fraction of force that minimises the
    total force and the moment about the contacts' mean. The balance is 1 minus this minimum: 1 if
    forces and moments cancel, and 0 for one finger. The centre is the mean weighted by these
    fractions.

    Args:
        p_SQ: (n, k, 3), contacts [m].
        n_S: (n, k, 3), unit normals into the solid.
        touch: (n, k), whether each finger touches; if no finger touches, all are used.
    """
    counted = (touch | ~touch.any(axis=1, keepdims=True)).astype(float)
    shares: Array = counted / _sum(counted)[:, None]
    mean = _sum(shares[:, None] * np.swapaxes(p_SQ, 1, 2))
    moments = np.cross(p_SQ - mean[:, None], n_S) / LEVER
    wrenches = np.concatenate([n_S, moments], axis=2)
    products = dot(wrenches[:, :, None], wrenches[:, None])

    # Exponentiated gradient keeps the fractions positive (Kivinen and Warmuth 1997).
    for _ in range(ROUNDS):
        shares = shares * _decay(RATE * dot(products, shares[:, None]))
        shares = shares / _sum(shares)[:, None]
    left = np.sqrt(dot(shares, dot(products, shares[:, None])).clip(0.0, 1.0))
    opposition = np.where(_sum(touch.astype(float)) > 1.0, 1.0 - left, 0.0)
    return opposition, _sum(shares[:, None] * np.swapaxes(p_SQ, 1, 2))


def _decay(x: Array) -> Array:
    """Return about exp(-x) for |x| < 2^(SQUARINGS + 1), with the same bits on every machine."""
    # A Pade approximant of a fraction of x, which is then squared.
    half = x / 2.0 ** (SQUARINGS + 1)
    power = (1.0 - half) / (1.0 + half)
    for _ in range(SQUARINGS):
        power = power * power
    return np.asarray(power)


def _sum(values: Array) -> Array:
    """Return the sums over the last axis, added in its order."""
    return dot(values, np.ones(values.shape[-1]))


def _steps(paths: HandPaths) -> Array:
    """Return the closing (k,) from one place of each path to the next [rad or m]."""
    return np.array([path.angles[1] for path in paths.fingers])


@lru_cache(maxsize=KEPT)
def coarse_paths(hand: Hand, spread: float) -> HandPaths:
    """Return the paths of a hand's fingers with fewer points; points of a pad still come first.

    Raises:
        HandError: If several fingers move one link.
    """
    paths = hand_paths(hand, spread)
    if paths is None:
        raise HandError(f"hand must be one whose fingers share no link, got {hand.name}")
    fingers = []
    for path in paths.fingers:
        kept = np.r_[0 : path.pad : PAD_STRIDE, path.pad : len(path.travel) : STRIDE]
        pad = int(np.count_nonzero(kept < path.pad))
        points, travel = np.ascontiguousarray(path.points[:, kept]), path.travel[kept]
        tip = int(np.count_nonzero(kept < path.tip))
        fingers.append(replace(path, points=points, travel=travel, pad=pad, tip=tip))
    return replace(paths, still=paths.still[::STRIDE], fingers=tuple(fingers))


# The palm between fingers that share a motor


def centred(model: ObjectModel, hand: Hand, attempts: Sequence[Attempt]) -> list[Attempt]:
    """Return attempts whose fingers that share a motor meet the object together, if they can.

    An attempt is unchanged if its palm ray misses, its fingers start closed, one side of the
    fingers does not meet the object, or no motor of the hand drives opposed fingers. An attempt of
    a posture is also unchanged, because it is tried as given.

    Args:
        model: The object.
        hand: The hand.
        attempts: Attempts at the object.
    """
    # The paths of the fingers depend on preshape and spread.
    found = list(attempts)
    groups: dict[tuple[int | None, float], list[int]] = {}
    for row, attempt in enumerate(found):
        is_given = attempt.source is Source.POSTURES
        if attempt.ray_hits and attempt.closing is None and not is_given:
            groups.setdefault((attempt.preshape, attempt.spread), []).append(row)

    for (preshape, spread), rows in groups.items():
        given = np.stack([found[row].X_OG for row in rows])
        X_OG = centre(model, hand.at(preshape), spread, given)
        if X_OG is not given:
            for row, X in zip(rows, X_OG, strict=True):
                found[row] = replace(found[row], X_OG=X)
    return found


def centre(model: ObjectModel, hand: Hand, spread: float, X_OG: Array) -> Array:
    """Return palm poses (n, 4, 4) at which fingers that share a motor meet the object together.

    These are the given ones if no motor drives several fingers.

    Args:
        model: The object.
        hand: The hand in one of its preshapes.
        spread: Spread [rad].
        X_OG: (n, 4, 4), palm poses.
    """
    shared = [np.flatnonzero(row) for row in hand.closing_ratio.T > 0.0]
    shared = [fingers for fingers in shared if len(fingers) > 1]
    paths = hand_paths(hand, spread) if shared else None
    if paths is None:
        return X_OG
    X_OG = X_OG.copy()
    for fingers in shared:
        own = [paths.fingers[i] for i in fingers]
        ratio = hand.closing_ratio[fingers].max(axis=1)
        for _ in range(MOVES):
            X_OG[:, :3, 3] += _move(model, X_OG, own, ratio)
    return X_OG


def _move(model: ObjectModel, X_OG: Array, paths: Sequence[FingerPath], ratio: Array) -> Array:
    """Return the motion (n, 3) of palms in {O} [m]; 0 if one side of the fingers meets nothing."""
    # Positions of the motor at which each finger meets the object, and the motion of its pad there.
    lookup = PointLookup(model.field, np.eye(4), X_OG)
    ends = [_meeting(lookup, path) for path in paths]
    closing = [path.angles[1] * end for path, end in zip(paths, ends, strict=True)]
    at = np.stack(closing) / ratio[:, None]
    motion = np.stack([_pad_motion(path, end) for path, end in zip(paths, ends, strict=True)])
    motion *= ratio[:, None, None]

    # The first side has the fingers that move with the first finger. On each side, the finger that
    # touches first decides. A pad that does not move has no direction and belongs to no side.
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
    """Return at which step (n,) of its path a finger meets the object; inf if it never does.

    For a finger that is within the object when the hand is open, the place is negative: how far the
    finger would have to open. No point moves by more than the largest `travel` per step, so the
    smallest distance limits the number of free steps (sphere tracing; Hart 1996).
    """
    rate, end = float(path.travel.max()), len(path.angles) - 1
    place, active = np.zeros(len(lookup)), np.arange(len(lookup))
    for _ in range(MEETING_STEPS):
        if not len(active):
            break
        least = lookup.distances(active, points_at(path, place[active]), FAR).min(axis=1)
        place[active] += least / rate
        going = (np.abs(least) > MEETING) & (place[active] >= 0.0) & (place[active] <= end)
        active = active[going]
    return np.where(place > end, np.inf, place)


def points_at(path: FingerPath, place: Array) -> npt.NDArray[np.float32]:
    """Return the points (n, p, 3) in {G} at places on a path, interpolated between its steps."""
    before = np.clip(np.floor(place).astype(np.int64), 0, len(path.points) - 2)
    share = (place - before).astype(np.float32)[:, None, None]
    points = path.points[before] * (np.float32(1.0) - share)
    return np.asarray(points + path.points[before + 1] * share)


def _pad_motion(path: FingerPath, place: Array) -> Array:
    """Return the motion (n, 3) of the pad's centre per closing position, in {G}."""
    near = np.clip(np.where(np.isfinite(place), place, 0.0), 0, len(path.points) - 2)
    before = near.astype(np.int64)
    middle = path.points[:, : path.pad].astype(float).mean(axis=1)
    return np.asarray((middle[before + 1] - middle[before]) / path.angles[1])
