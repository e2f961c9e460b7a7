"""Closing the hand on a solid by geometry: where each finger stops, and how well that would hold.

Input: a solid, which may be a guess from a cloud (`mesh.cloud`) or the surface of an object, and
palm poses. Output: features of each pose and a score. Nothing is simulated. The same numbers are
computed on every machine (`arithmetic`), since samplers decide by them.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import Array, dot, norm
from drakegrasp.errors import HandError
from drakegrasp.hand.description import Hand
from drakegrasp.hand.finger_sweep import KEPT, FingerPath, HandPaths, hand_paths
from drakegrasp.mesh.cloud import Solid
from drakegrasp.simulation.screen import PointLookup, points_at

#: Strides of the points that are used: of a pad, and of the rest of the hand.
PAD_STRIDE, STRIDE = 2, 4
#: A finger stops closer than this to an obstacle [m]; largest number of steps of the search.
TOUCH, STEPS = 2e-4, 60
#: Larger distances are cut to this [m].
FAR = 0.02
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
