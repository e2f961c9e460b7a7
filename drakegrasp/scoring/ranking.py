"""Ranking: the order in which to try grasps, by closing the hand on points that a camera saw.

Input: grasps that anybody proposes, and an object's visible points in {T}, where the table is z =
0. Output: a score of each. Nothing is simulated. The points become solids (`mesh.cloud`), and the
hand's geometry determines where each finger stops (`simulation.closing`). A score is a mean over
the solids and over small moves of the palm, or the chance that a learned `scoring.judge` computes
from all of them. `scoring.proposals` proposes grasps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import Array, multiply
from drakegrasp.errors import GraspError
from drakegrasp.frames import read_pose
from drakegrasp.grasp import unused_fingers
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.kinematics import coordinate_limits
from drakegrasp.mesh.cloud import Solid, column_solid, hull_solid, read_cloud
from drakegrasp.scoring.judge import Judge, features_of, load_judge
from drakegrasp.simulation.attempt import Attempt
from drakegrasp.simulation.attempts import Attempts
from drakegrasp.simulation.closing import close_on
from drakegrasp.simulation.posture import start_of
from drakegrasp.table import Table

#: Moves of the palm along its axes [m] over which a score is averaged; the first is no move.
MOVES = 0.005 * np.array([[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1]])
#: Spreads are rounded to multiples of this [rad], because the paths of a hand take half a second.
SPREAD_STEP = np.deg2rad(2.5)
#: Scores that are equal to this number of decimals keep the order of their rows.
DECIMALS = 9
#: Columns of a ranking, see `Ranking`.
COLUMNS = ("clearance", "table", "touch", "gap", "push", "opposition", "arm", "robust")


@dataclass(frozen=True, kw_only=True, eq=False)
class Ranking:
    """The scores of n proposals, and the features that determine them.

    Attributes:
        score: (n,), 0 to 1, greater is better: by the fixed weights only an order, with a judge
            the chance that the grasp is a sample; -1 for a row that is not a posture.
        order: (n,), indices of the proposals, best first; of equal ones the earlier is first.
        features: Columns, each a mean over solids and moves; NaN for a row that is not a posture:
            `clearance` (n,), distance of the open hand from the object [m], negative inside, at
            most 20 mm;
            `table` (n,), distance of the open hand from the table [m], negative inside, at most
            20 mm;
            `touch` (n, k), whether each finger's pad is at the object when the finger stops; NaN
            for a finger that the preshape does not use;
            `gap` (n,), distance of the farthest required pad from the object then [m], at most
            20 mm;
            `push` (n,), smallest cosine between the motion of a required pad and the surface's
            inward normal there;
            `opposition` (n,), how well the contacts' normals balance, 0 to 1;
            `arm` (n,), horizontal distance of the contacts' centre from the object's [m];
            `robust` (n,), fraction in which the open hand is free and all required pads touch;
            `held` (n,), only with a judge: the chance that the hand holds.
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
    judge: Judge | str | Path | None = None,
) -> Ranking:
    """Return the order in which to try proposals, by closing the hand on what a camera saw.

    Palm pose, spread and pregrasp of a posture are used. From there each finger closes as the hand
    file specifies, until it meets the object or the table.

    Args:
        proposals: Postures of `propose` or `make_attempts`, in {T} or with their X_TO; or palm
            poses X_TG (n, 4, 4) or (4, 4), for which the hand starts open.
        cloud: (n, 3), points of the object only, in {T} [m]; the table is z = 0.
        hand: A hand, or an argument of `load_hand`; None for the default hand.
        spread: Spread of palm poses [rad].
        judge: Name or file of a judge of the hand, which then determines the scores; None for the
            fixed weights, which any hand can use.

    Raises:
        GraspError: If the cloud, the poses or the spread are invalid, postures are in {O} without
            X_TO or have other joints than the hand, or there is no such judge.
        HandError: If the hand cannot be used, the judge is for another hand, or several of the
            hand's fingers move one link.
    """
    points, hand = read_cloud(cloud), chosen_hand(hand)
    judge = None if judge is None else load_judge(judge)
    if judge is not None:
        judge.refuse_other_hand(hand)
    columns = measured(proposals, points, hand, spread=spread)
    score, known = columns["score"], ~np.isnan(columns["score"])
    if judge is not None:
        columns["held"], score = np.full((2, len(score)), np.nan)
        if known.any():
            columns["held"], score = judge.chances(columns).T
    score = np.where(known, score, -1.0)
    features = {name: columns[name] for name in (*COLUMNS, "held") if name in columns}
    # The last bits of a score depend on the other rows, and must not decide.
    order = np.argsort(-np.round(score, DECIMALS), kind="stable")
    return Ranking(score=score, order=order, features=Table(features))


def measured(
    proposals: Attempts | npt.ArrayLike, points: Array, hand: Hand, *, spread: float = 0.0
) -> dict[str, Array]:
    """Return the score by fixed weights and all features (n, ...) of n proposals, by their names.

    Among them are the features of a judge, see `judge.features_of`, unless no row is a posture. A
    row that is not a posture is NaN.

    Args:
        proposals: See `rank`.
        points: (p, 3), see `read_cloud`.
        hand: The hand.
        spread: See `rank`.
    """
    proposals = _read_proposals(proposals, hand, spread)
    starts = _starts(proposals, hand, spread)
    solids = hull_solid(points), column_solid(points)

    # The paths of the fingers depend on preshape and spread.
    groups: dict[tuple[int | None, float], list[int]] = {}
    for i, start in starts.items():
        near = round(start.spread / SPREAD_STEP) * SPREAD_STEP
        groups.setdefault((start.preshape, near), []).append(i)
    count = len(proposals)
    columns = {name: np.full(count, np.nan) for name in ("score", *COLUMNS)}
    columns["touch"] = np.full((count, hand.num_fingers), np.nan)
    for (preshape, near), rows in groups.items():
        chosen = [starts[i] for i in rows]
        closings = _closed(solids, hand.at(preshape), near, chosen)
        found = {name: closings[name].mean(axis=(0, 2)) for name in ("score", *COLUMNS)}
        X_TG = np.array([start.X_OG for start in chosen])
        found |= features_of(closings, points, X_TG, near)
        used = ~unused_fingers(hand.unused_in(preshape), hand.num_fingers)
        columns["touch"][np.array(rows)[:, None], np.flatnonzero(used)] = found.pop("touch")
        for name, values in found.items():
            columns.setdefault(name, np.full(count, np.nan))[rows] = values
    return columns


def _read_proposals(
    proposals: Attempts | npt.ArrayLike, hand: Hand, spread: float
) -> Attempts | Array:
    """Return postures, or palm poses (n, 4, 4), that fit a hand.

    Raises:
        GraspError: If they or the spread do not.
    """
    if isinstance(proposals, Attempts):
        joints, expected = proposals.q_grasp.shape[1], len(hand.joint_names)
        if joints != expected:
            raise GraspError(
                f"proposals must be of the hand {hand.name} with {expected} joints, got {joints}"
            )
        return proposals
    low, high = coordinate_limits(hand)[0]
    if not low <= spread <= high:
        raise GraspError(
            f"spread must be {low:.3g} to {high:.3g} rad for the hand {hand.name}, got {spread:g}"
        )
    return read_pose(proposals, "proposals").reshape(-1, 4, 4)


def chosen_hand(hand: Hand | str | None) -> Hand:
    """Return a given hand, the hand of a name or a file, or the default hand."""
    if isinstance(hand, Hand):
        return hand
    return load_hand() if hand is None else load_hand(hand)


def _starts(proposals: Attempts | Array, hand: Hand, spread: float) -> dict[int, Attempt]:
    """Return the start of each valid proposal, by its index, with {T} as its object's frame."""
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
    """Return score and features (s, n, m, ...) of n starts on s solids, with m moves of each."""
    # Apply each move to each start.
    X_TG = np.array([start.X_OG for start in starts])
    moved = np.repeat(X_TG, len(MOVES), axis=0)
    moved[:, :3, 3] += multiply(MOVES, np.swapaxes(X_TG[:, :3, :3], 1, 2)).reshape(-1, 3)
    opened = np.zeros(hand.num_fingers)
    closing = np.array([opened if s.closing is None else s.closing for s in starts])
    closing = np.repeat(closing, len(MOVES), axis=0)

    found = [close_on(solid, hand, spread, moved, closing=closing) for solid in solids]
    shape = len(solids), len(starts), len(MOVES)
    return {
        name: np.reshape([each[name] for each in found], (*shape, *values.shape[1:]))
        for name, values in found[0].items()
    }
