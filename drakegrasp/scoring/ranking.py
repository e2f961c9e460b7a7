"""Ranking: which of several grasps to try, by closing the hand on the points that a camera saw.

In: grasps that anybody proposes, and an object's visible points in {T}, whose table is z = 0. Out:
a score of each. Nothing is simulated and nothing is learned: the points become solids
(`mesh.cloud`), and the hand's geometry says where each finger stops (`hand.finger_sweep`). A score
is a mean over the solids and over small moves of the palm. `scoring.proposals` has grasps to begin
with.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import Array, dot, multiply, norm
from drakegrasp.errors import GraspError, HandError
from drakegrasp.frames import read_pose
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.finger_sweep import FingerPath, HandPaths, hand_paths
from drakegrasp.mesh.cloud import Solid, column_solid, hull_solid, read_cloud
from drakegrasp.simulation.attempt import Attempt
from drakegrasp.simulation.attempts import Attempts
from drakegrasp.simulation.posture import start_of
from drakegrasp.simulation.screen import PointLookup, points_at
from drakegrasp.table import Table

#: Moves of the palm along its axes [m] over which a score is a mean; the first is none.
MOVES = 0.005 * np.array([[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1]])
#: Spreads are rounded to multiples of this [rad]: the paths of a hand cost half a second.
SPREAD_STEP = np.deg2rad(2.5)
#: Of a pad every so many-th point counts, and of the rest of the hand.
PAD_STRIDE, STRIDE = 2, 4
#: A finger has met what is nearer than this [m]; it is there after so many steps at most.
TOUCH, STEPS = 2e-4, 60
#: Distances count up to this [m].
FAR = 0.02
#: A pad touches if it is so near when its finger stops [m].
PAD_GAP = 0.003
#: The open hand is free unless it is deeper than this in object or table [m]: the solids are rough.
DEEP = 0.003
#: A moment counts as a force at this lever [m].
LEVER = 0.05
#: Rounds and rate of the search for the shares of the fingers.
ROUNDS, RATE = 100, 1.0
#: Logistic weights of `push`, `opposition`, `arm` [1/m] and `gap` [1/m], and the constant: fitted
#: to lifts of the Barrett hand, see docs/results/choice.md.
WEIGHTS = {"push": 4.0, "opposition": 2.0, "arm": -20.0, "gap": -50.0}
CONSTANT = -3.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Ranking:
    """The scores of n proposals, and what they follow from.

    Attributes:
        score: (n,), 0 to 1, greater is better: an estimate of how likely the hand holds; -1 of a
            row that is no posture.
        order: (n,), the proposals, best first; of equal ones the earlier.
        features: Columns, each a mean over solids and moves; NaN of a row that is no posture:
            `clearance` (n,) of the open hand from the object, negative inside, up to 20 mm [m];
            `table` (n,), likewise from the table;
            `touch` (n, k), whether each finger's pad is at the object where the finger stops;
            `gap` (n,), distance of the farthest required pad from the object then, up to 20 mm [m];
            `push` (n,), cosine between the motion of a required pad and the surface's inward normal
            there: the least;
            `opposition` (n,), how well the contacts' normals balance, 0 to 1;
            `arm` (n,), horizontal distance of the contacts' middle from the object's [m];
            `robust` (n,), share in which the open hand is free and all required pads touch.
    """

    score: Array
    order: npt.NDArray[np.int64]
    features: Table


def rank(
    proposals: Attempts | npt.ArrayLike,
    cloud: npt.ArrayLike,
    hand: Hand | str | None = None,
    *,
    spread: float = 0.0,
) -> Ranking:
    """Return which proposals to try first, by closing the hand on what a camera saw.

    Of a posture the palm's pose, the spread and the pregrasp count. From there each finger closes
    as the hand file says, until it meets the object or the table.

    Args:
        proposals: Postures of `propose` or `make_attempts`, in {T} or with their X_TO; or palm
            poses X_TG (n, 4, 4) or (4, 4), for which the hand is open.
        cloud: (n, 3), points of the object alone in {T} [m]; the table is z = 0.
        hand: A hand, or what `load_hand` takes; the default one if None.
        spread: Of palm poses [rad].

    Raises:
        GraspError: If the cloud or the poses are none, or postures are in {O} without X_TO.
        HandError: If the hand cannot be used, or several of its fingers move one link.
    """
    points, hand = read_cloud(cloud), chosen_hand(hand)
    if not isinstance(proposals, Attempts):
        proposals = read_pose(proposals, "proposals").reshape(-1, 4, 4)
    starts = _starts(proposals, hand, spread)
    solids = hull_solid(points), column_solid(points)

    # The paths of the fingers depend on preshape and spread.
    groups: dict[tuple[int | None, float], list[int]] = {}
    for i, start in starts.items():
        near = round(start.spread / SPREAD_STEP) * SPREAD_STEP
        groups.setdefault((start.preshape, near), []).append(i)
    count = len(proposals)
    columns = {"score": np.full(count, -1.0)}
    for (preshape, near), rows in groups.items():
        chosen = [starts[i] for i in rows]
        for name, values in _closed(solids, hand.at(preshape), near, chosen).items():
            nothing = np.full((count, *values.shape[1:]), np.nan)
            columns.setdefault(name, nothing)[rows] = values
    score = columns.pop("score")
    return Ranking(score=score, order=np.argsort(-score, kind="stable"), features=Table(columns))


def chosen_hand(hand: Hand | str | None) -> Hand:
    """Return a hand as it is, the one of a name or a file, or the default one."""
    if isinstance(hand, Hand):
        return hand
    return load_hand() if hand is None else load_hand(hand)


def closed_on(points: Array, hand: Hand, X_TG: Array, spread: float) -> Array:
    """Return closing positions (n, k) of a hand that opens at palm poses and closes on a cloud.

    Args:
        points: (n, 3), see `read_cloud`.
        hand: In one of its preshapes.
        X_TG: (n, 4, 4).
        spread: [rad].

    Raises:
        GraspError: If the points lie in a vertical plane.
        HandError: If several of its fingers move one link.
    """
    paths = _paths(hand, spread)
    lookup = PointLookup(hull_solid(points).field, np.eye(4), X_TG)
    return _places(hand, paths, lookup, np.zeros((len(X_TG), hand.num_fingers))) * _steps(paths)


def _starts(proposals: Attempts | Array, hand: Hand, spread: float) -> dict[int, Attempt]:
    """Return how each proposal begins, with {T} as its object's frame; rows that are none lack."""
    if not isinstance(proposals, Attempts):
        preshape = 0 if hand.preshapes else None
        made = (Attempt(X_OG=X, spread=spread, preshape=preshape) for X in proposals)
        return dict(enumerate(made))
    starts = {}
    for i in np.flatnonzero([not reason for reason in proposals.invalid]).tolist():
        X_TO = proposals.X_TO[i]
        if np.isnan(X_TO).any():
            if proposals.frame in ("object", "mesh"):
                raise GraspError(
                    f"proposals must be in the frame table, or say X_TO, got {proposals.frame}"
                )
            X_TO = np.eye(4)
        start = start_of(proposals.posture(i, X_TO), hand)
        starts[i] = replace(start, X_OG=multiply(X_TO, start.X_OG))
    return starts


def _closed(
    solids: Sequence[Solid], hand: Hand, spread: float, starts: Sequence[Attempt]
) -> dict[str, Array]:
    """Return score and features (n, ...) of starts at a spread, the means over solids and moves."""
    # Each start, moved.
    X_TG = np.array([start.X_OG for start in starts])
    moved = np.repeat(X_TG, len(MOVES), axis=0)
    moved[:, :3, 3] += multiply(MOVES, np.swapaxes(X_TG[:, :3, :3], 1, 2)).reshape(-1, 3)
    opened = np.zeros(hand.num_fingers)
    closing = np.array([opened if s.closing is None else s.closing for s in starts])
    closing = np.repeat(closing, len(MOVES), axis=0)

    paths = _paths(hand, spread)
    found = [_features(solid, hand, paths, moved, closing) for solid in solids]
    mean = {}
    for name in found[0]:
        values = np.stack([each[name] for each in found])
        shape = len(solids), len(starts), len(MOVES), *values.shape[2:]
        mean[name] = values.reshape(shape).mean(axis=(0, 2))
    return mean


def _features(
    solid: Solid, hand: Hand, paths: HandPaths, X_TG: Array, closing: Array
) -> dict[str, Array]:
    """Return score and features of palm poses (n, 4, 4) where fingers (n, k) start [rad or m]."""
    # The open hand.
    lookup, rows = PointLookup(solid.field, np.eye(4), X_TG), np.arange(len(X_TG))
    starts = closing / _steps(paths)
    opened = [points_at(path, at) for path, at in zip(paths.fingers, starts.T, strict=True)]
    parts = [paths.still, *opened]
    clearance = np.min([lookup.distances(rows, p, FAR).min(axis=1) for p in parts], axis=0)
    table = np.min([lookup.heights(rows, p).min(axis=1) for p in parts], axis=0)

    # The pads, where the fingers stop.
    places = _places(hand, paths, lookup, starts)
    pads = [
        _pad(solid, lookup, path, X_TG, at)
        for path, at in zip(paths.fingers, places.T, strict=True)
    ]
    gaps, p_TQ, n_T, push = (np.stack(each, axis=1) for each in zip(*pads, strict=True))

    # What follows from the contacts.
    touch, needed = gaps < PAD_GAP, hand.required
    opposition, middle = _opposition(p_TQ, n_T, touch)
    free = np.minimum(clearance, table) > -DEEP
    features = {
        "clearance": np.minimum(clearance, FAR),
        "table": np.minimum(table, FAR),
        "touch": touch.astype(float),
        "gap": gaps[:, needed].max(axis=1),
        "push": push[:, needed].min(axis=1),
        "opposition": opposition,
        "arm": norm((middle - solid.middle)[:, :2]),
        "robust": free & touch[:, needed].all(axis=1),
    }
    logit = CONSTANT + sum(weight * features[name] for name, weight in WEIGHTS.items())
    return {"score": free / (1.0 + np.exp(-logit)), **features}


def _places(hand: Hand, paths: HandPaths, lookup: PointLookup, starts: Array) -> Array:
    """Return the places (n, k) on their paths, in steps, at which fingers stop."""
    fingers = zip(paths.fingers, starts.T, strict=True)
    steps = _steps(paths)
    closing = np.column_stack([_stop(lookup, path, at) for path, at in fingers]) * steps

    # Those of one motor have closed alike: the first to stop stops them all.
    for ratio in hand.closing_ratio.T:
        own = ratio > 0.0
        closing[:, own] = ratio[own] * (closing[:, own] / ratio[own]).min(axis=1, keepdims=True)
    return closing / steps


def _stop(lookup: PointLookup, path: FingerPath, start: Array) -> Array:
    """Return the place (n,) on a path, in steps, at which a finger meets the object or the table.

    No point moves by more per step than the largest `travel`, so the least distance says how many
    steps are free (sphere tracing; Hart 1996).
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
    solid: Solid, lookup: PointLookup, path: FingerPath, X_TG: Array, place: Array
) -> tuple[Array, Array, Array, Array]:
    """Return of a pad at places (n,) on its path what is nearest to the object.

    Returns:
        Its distance (n,), 0 to `FAR` [m]; the point p_TQ (n, 3) [m]; the object's inward normal
        (n, 3) there, in {T}; and the cosine (n,) between the pad's motion and that normal.
    """
    rows, points = np.arange(len(X_TG)), points_at(path, place)[:, : path.pad]
    distances = lookup.distances(rows, points, FAR)
    nearest = distances.argmin(axis=1)
    before = np.clip(place, 0, len(path.points) - 2).astype(np.int64)
    motion = (path.points[before + 1, nearest] - path.points[before, nearest]).astype(float)
    R_TG = X_TG[:, :3, :3]
    p_TQ = dot(points[rows, nearest].astype(float)[:, None], R_TG) + X_TG[:, :3, 3]
    inward = -solid.normals(p_TQ)
    motion = dot(motion[:, None], R_TG) / norm(motion)[:, None]
    return np.clip(distances[rows, nearest], 0.0, FAR), p_TQ, inward, dot(motion, inward)


def _opposition(p_TQ: Array, n_T: Array, touch: npt.NDArray[np.bool_]) -> tuple[Array, Array]:
    """Return how well contacts balance (n,), and their middle (n, 3) [m].

    Each touching finger presses along its normal, with shares that leave the least force and moment
    about the contacts' mean. 1 minus that least is 1 where they cancel; of one finger it is 0. The
    middle is the mean by these shares.

    Args:
        p_TQ: (n, k, 3), contacts [m].
        n_T: (n, k, 3), unit normals into the object.
        touch: (n, k), whether each finger touches; of those where none does, all count.
    """
    counted = (touch | ~touch.any(axis=1, keepdims=True)).astype(float)
    shares: Array = counted / counted.sum(axis=1, keepdims=True)
    mean = np.einsum("nk,nka->na", shares, p_TQ)
    moments = np.cross(p_TQ - mean[:, None], n_T) / LEVER
    wrenches = np.concatenate([n_T, moments], axis=2)
    products = np.einsum("nia,nja->nij", wrenches, wrenches)

    # Exponentiated gradient keeps the shares positive (Kivinen and Warmuth 1997).
    for _ in range(ROUNDS):
        shares = shares * np.exp(-RATE * np.einsum("nij,nj->ni", products, shares))
        shares /= shares.sum(axis=1)[:, None]
    left = np.sqrt(np.einsum("ni,nij,nj->n", shares, products, shares).clip(0.0, 1.0))
    opposition = np.where(touch.sum(axis=1) > 1, 1.0 - left, 0.0)
    return opposition, np.einsum("nk,nka->na", shares, p_TQ)


def _steps(paths: HandPaths) -> Array:
    """Return the closing (k,) from one place of each path to the next [rad or m]."""
    return np.array([path.angles[1] for path in paths.fingers])


def _paths(hand: Hand, spread: float) -> HandPaths:
    """Return the paths of a hand's fingers, with fewer points: a pad's come first, and stay so."""
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
