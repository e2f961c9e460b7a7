"""Stage "screen": what geometry says about attempts before anything is simulated.

In: attempts at an object on the table. Out: a `Prediction` for each. Points on the hand's
surface are looked up in the object's distance field: with the hand open at the start pose, and
while each finger closes by itself. Closing has the object and the wrist static and every
finger has one freedom, so which link meets the object first, and where, is geometry, but for
the compliance of the contact, the grid's spacing and the spacing of the points: `margin`.

An attempt is called lost only where it is lost by more than the margin. Everything is done point by
point, so a prediction depends on its attempt alone, not on those that are predicted with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import multiply
from drakegrasp.config import ScreenConfig
from drakegrasp.frames import Array
from drakegrasp.hand.description import Hand
from drakegrasp.hand.finger_sweep import GAP_STRIDE, FingerPath, HandPaths, Points, hand_paths
from drakegrasp.mesh.distance_field import DistanceField
from drakegrasp.objects.model import ObjectModel
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation.candidates import Pregrasp

Counts = npt.NDArray[np.int64]

#: Attempts that are looked at together: few enough for a cache to hold their points; for closing
#: fingers, whose attempts end one after the other, enough for each look to be worth its call.
START_CHUNK, SWEEP_CHUNK = 8, 128
#: Of the open hand's points every so many are looked at first.
START_STRIDE = 8
#: Half of the largest spacing for which the margins stand as they are [m].
COVERED = 1.25e-3
#: Fingertips nearer to each other than this while they would be skipped forward may meet [m].
FINGER_GAP = 0.01


@dataclass(frozen=True, kw_only=True, eq=False)
class Prediction:
    """What geometry says about one attempt of a hand with k fingers.

    Attributes:
        outcome: `start_collision` or `screened` where the attempt is lost for certain, else None.
        clear: Whether the open hand is farther from object and table than the margin.
        closing: (k,), closing angles up to which nothing is met [rad]; empty with an outcome.
        last: (k,), closing angles beyond which a fingertip meets the object no more [rad];
            empty with an outcome.
    """

    outcome: Outcome | None
    clear: bool
    closing: Array
    last: Array


def predict(
    model: ObjectModel,
    hand: Hand,
    X_TO: npt.ArrayLike,
    attempts: Sequence[Pregrasp],
    config: ScreenConfig,
) -> list[Prediction | None]:
    """Return what geometry says about attempts; None where it is not asked.

    It is not asked where the palm ray misses, where the attempt begins with closed fingers,
    for hands of which `finger_sweep` knows nothing, and if the mode is off.

    Args:
        model: The object.
        hand: The hand.
        X_TO: Resting pose of the object in the table-top frame, (4, 4).
        attempts: Of the object.
        config: The margins.
    """
    found: list[Prediction | None] = [None] * len(attempts)
    if config.mode == "off":
        return found
    rows: dict[float, list[int]] = {}
    for row, attempt in enumerate(attempts):
        if attempt.ray_hits and attempt.closing is None:
            rows.setdefault(attempt.spread, []).append(row)
    for spread, group in rows.items():
        paths = hand_paths(hand, spread)
        if paths is None:
            continue
        poses = np.stack([attempts[row].X_OG for row in group])
        view = _View(model.field, np.asarray(X_TO, dtype=float), poses)
        margins = _widened(config, model.field)
        for row, prediction in zip(group, _predict(view, paths, margins), strict=True):
            found[row] = prediction
    return found


def extra_margin(field: DistanceField) -> float:
    """Return what a margin [m] must be wider by, where a field's grid is coarse."""
    return max(0.0, field.blur - COVERED)


def _widened(config: ScreenConfig, field: DistanceField) -> ScreenConfig:
    """Return the margins for a field whose grid is coarser than those they were measured on."""
    more = extra_margin(field)
    names = ("start_margin", "reach_margin", "block_margin", "clearance")
    return config.model_copy(update={name: getattr(config, name) + more for name in names})


class _View:
    """Looks up points of the palm's frame for a chunk of attempts."""

    def __init__(self, field: DistanceField, X_TO: Array, X_OG: Array) -> None:
        self.field = field
        self._X_OG = X_OG.astype(np.float32)
        self._up = multiply(X_TO, X_OG)[:, 2].astype(np.float32)

    def __len__(self) -> int:
        return len(self._X_OG)

    def heights(self, rows: Counts, p_GQ: Points) -> Points:
        """Return the heights above the table (a, n) [m] of points (a, n, 3) or (n, 3)."""
        return _affine(self._up[rows], p_GQ)

    def distances(self, rows: Counts, p_GQ: Points, below: float) -> Points:
        """Return the distances (a, n) [m] of points (a, n, 3) or (n, 3) from the object.

        They are too small by up to twice the grid's error, but for the least of a row where that
        is below a limit [m].
        """
        field, X = self.field, self._X_OG[rows]
        x, y, z = (_affine(X[:, axis], p_GQ) for axis in range(3))
        error = np.float32(field.error)
        found = field.nearest(x, y, z)
        found -= error
        least = found.min(axis=1)
        close = np.flatnonzero(least <= np.float32(below))
        if len(close):
            at, point = np.nonzero(found[close] <= (least[close] + 2 * error)[:, None])
            row = close[at]
            found[row, point] = field.interpolate(x[row, point], y[row, point], z[row, point])
        return found


def _affine(row: Points, p: Points) -> Points:
    """Return a.p + b (a, n) for rows [a, b] (a, 4) and points (a, n, 3) or (n, 3)."""
    r = row[:, :, None]
    # In place, which costs a tenth less of a screen than fresh arrays do.
    found = r[:, 0] * p[..., 0]
    part = r[:, 1] * p[..., 1]
    found += part
    np.multiply(r[:, 2], p[..., 2], out=part)
    found += part
    found += r[:, 3]
    return np.asarray(found)


def _predict(view: _View, paths: HandPaths, config: ScreenConfig) -> list[Prediction]:
    every, margin = np.arange(len(view)), config.start_margin
    opened = np.concatenate([paths.still, *(path.points[0] for path in paths.fingers)])
    # What some of the points decide, all of them would: the nearest of all is no farther.
    nearest = _open_distance(view, every, opened[::START_STRIDE], margin)
    alive = np.flatnonzero(nearest >= -margin)
    nearest[alive] = _open_distance(view, alive, opened, margin)
    alive = alive[nearest[alive] >= -margin]
    predictions = [
        Prediction(outcome=Outcome.START_COLLISION, clear=False, closing=_NOTHING, last=_NOTHING)
    ] * len(view)
    for rows in _chunks(alive, SWEEP_CHUNK):
        # A finger that does not arrive decides, and the others need not be looked at.
        left, sweeps = rows, []
        for path in paths.fingers:
            sweeps.append(_Sweep(view, path, left, config))
            left = left[sweeps[-1].arrives]
        among = [np.searchsorted(sweep.rows, left) for sweep in sweeps]
        starts = np.stack([s.start[i] for s, i in zip(sweeps, among, strict=True)], axis=1)
        lasts = np.stack([s.last[i] for s, i in zip(sweeps, among, strict=True)], axis=1)
        angles = {
            int(row): (_angles(paths, start), _angles(paths, last))
            for row, start, last in zip(left, _clear_starts(paths, starts), lasts, strict=True)
        }
        for row in rows.tolist():
            closing, last = angles.get(row, (_NOTHING, _NOTHING))
            predictions[row] = Prediction(
                outcome=None if row in angles else Outcome.SCREENED,
                clear=bool(nearest[row] > margin),
                closing=closing,
                last=last,
            )
    return predictions


_NOTHING = np.zeros(0)


def _chunks(rows: Counts, size: int) -> list[Counts]:
    return [rows[start : start + size] for start in range(0, len(rows), size)]


def _angles(paths: HandPaths, indices: Counts) -> Array:
    return np.array([path.angles[k] for path, k in zip(paths.fingers, indices, strict=True)])


def _open_distance(view: _View, rows: Counts, opened: Points, margin: float) -> Points:
    """Return the distance (a,) of the open hand from object and table, where it is small."""
    found = np.zeros(len(rows), dtype=np.float32)
    for at in _chunks(np.arange(len(rows)), START_CHUNK):
        to_object = view.distances(rows[at], opened, margin).min(axis=1)
        found[at] = np.minimum(to_object, view.heights(rows[at], opened).min(axis=1))
    return found


class _Sweep:
    """One finger closing, for many attempts: indices into the angles of its path.

    At each angle the finger may close on by as many angles as no point of it can come to a
    threshold in, as a point moves by at most its `travel` from one angle to the next.

    Attributes:
        rows: The attempts, ascending.
        start: Last angle that was looked at with everything farther away than the clearance.
        arrives: Whether the fingertip comes within reach of the object before the finger
            is blocked.
        last: Last angle that was looked at with the fingertip within reach.
    """

    def __init__(self, view: _View, path: FingerPath, rows: Counts, config: ScreenConfig) -> None:
        self.rows = rows
        count, end = len(rows), len(path.angles) - 1
        self.start = np.zeros(count, dtype=np.int64)
        self.last = np.full(count, end)
        self.arrives = np.zeros(count, dtype=np.bool_)
        starting = np.ones(count, dtype=np.bool_)
        k, active = np.zeros(count, dtype=np.int64), np.arange(count)
        clearance, reach = np.float32(config.clearance), np.float32(config.reach_margin)
        block = np.float32(config.block_margin)
        pace, tip_pace = 1.0 / path.travel, 1.0 / path.travel[: path.tip]
        while len(active):
            at, points = rows[active], path.points[k[active]]
            to_object = view.distances(at, points, config.clearance)
            tip = to_object[:, : path.tip]
            meets = np.minimum(to_object, view.heights(at, points))
            least = meets.min(axis=1)
            far = starting[active] & (least > clearance)
            self.start[active[far]] = k[active[far]]
            starting[active] = far
            here = tip.min(axis=1) <= reach
            self.arrives[active[here]] = True
            self.last[active[here]] = k[active[here]]
            room = ((meets + block) * pace).min(axis=1)
            np.minimum(room, np.where(here, 0, ((tip - reach) * tip_pace).min(axis=1)), out=room)
            if far.any():
                room[far] = np.minimum(room[far], ((meets[far] - clearance) * pace).min(axis=1))
            done = (least < -block) | (k[active] == end)
            step = np.maximum(1, np.floor(room)).astype(np.int64)
            k[active] = np.minimum(k[active] + step, end)
            active = active[~done]


def _clear_starts(paths: HandPaths, starts: Counts) -> Counts:
    """Return start angles (n, k) cut back to before two fingertips may meet on the way.

    All fingers close at the same speed; one that is at its start angle waits there.
    """
    if not starts.size:
        return starts
    time = np.arange(0, int(starts.max()) + GAP_STRIDE, GAP_STRIDE)
    way = np.minimum(time[None, :, None], starts[:, None, :]) // GAP_STRIDE
    clear = np.ones(way.shape[:2], dtype=np.bool_)
    for (a, b), gap in paths.gaps.items():
        clear &= gap[way[..., a], way[..., b]] > FINGER_GAP
    first = np.where(clear.all(axis=1), len(time), np.argmin(clear, axis=1))
    return np.minimum(starts, np.maximum(0, GAP_STRIDE * (first - 1))[:, None])
