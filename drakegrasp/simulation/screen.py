"""Stage "screen": what geometry decides about attempts before anything is simulated.

Input: attempts at an object on the table. Output: a `Screening` for each. Points on the hand's
surface are looked up in the object's distance field: with the hand open at the start pose, and
while each finger closes by itself. While the hand closes, object and wrist are static and each
finger has one degree of freedom. Geometry therefore decides which link meets the object first, and
where. Its errors come from the compliance of the contact, the spacing of the grid, and the spacing
of the points. The margins of `ScreenConfig` cover these errors.

An attempt counts as lost only if it is lost by more than the margin. Every step treats each point
separately, so a screening depends on its attempt alone, and not on the other attempts in the call.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import multiply
from drakegrasp.config import ScreenConfig
from drakegrasp.frames import Array
from drakegrasp.hand.description import Hand
from drakegrasp.hand.finger_sweep import GAP_STRIDE, FingerPath, HandPaths, Points, hand_paths
from drakegrasp.hand.kinematics import open_together
from drakegrasp.mesh.distance_field import DistanceField
from drakegrasp.objects.model import ObjectModel
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation.attempt import Attempt

Counts = npt.NDArray[np.int64]

#: Number of attempts that are evaluated together. It is small for the open hand, so that their
#: points fit a CPU's cache. It is large for closing fingers, because attempts drop out and each
#: call has its overhead.
START_CHUNK, SWEEP_CHUNK = 8, 128
#: The first test of the open hand uses every `START_STRIDE`-th point.
START_STRIDE = 8
#: Largest blur of a field for which the configured margins suffice without an addition [m].
COVERED = 1.25e-3
#: Fingertips that come closer to each other than this may touch [m].
FINGER_GAP = 0.01


@dataclass(frozen=True, kw_only=True, eq=False)
class Screening:
    """What geometry decides about one attempt of a hand with k fingers.

    Attributes:
        outcome: `start_collision` or `screened` if the attempt is certainly lost, else None.
        clear: Whether the open hand is farther from object and table than the margin.
        closing: (k,), closing angles up to which the fingers meet nothing [rad, or m if they
            slide]; empty with an outcome.
        last: (k,), closing angles beyond which a fingertip's pad can no longer meet the object
            [rad or m]; empty with an outcome.
    """

    outcome: Outcome | None
    clear: bool
    closing: Array
    last: Array


def screen(
    model: ObjectModel,
    hand: Hand,
    X_TO: npt.ArrayLike,
    attempts: Sequence[Attempt],
    config: ScreenConfig,
) -> list[Screening | None]:
    """Return what geometry decides about attempts; None for an attempt that is not screened.

    Attempts are not screened if their palm ray misses, their fingers start closed, `finger_sweep`
    cannot describe the hand, or `config.mode` is off.

    Args:
        model: The object.
        hand: The hand.
        X_TO: Resting pose of the object in the table-top frame, (4, 4), or that of each attempt,
            (n, 4, 4). One call for all attempts is much faster than one for each pose.
        attempts: Attempts at the object, n.
        config: The margins.
    """
    screenings: list[Screening | None] = [None] * len(attempts)
    if config.mode == "off":
        return screenings

    # The paths of the fingers depend on the spread: screen attempts with one spread together.
    rows_by_spread: dict[float, list[int]] = {}
    for row, attempt in enumerate(attempts):
        if attempt.ray_hits and attempt.closing is None:
            rows_by_spread.setdefault(attempt.spread, []).append(row)
    each_X_TO = np.broadcast_to(np.asarray(X_TO, dtype=float), (len(attempts), 4, 4))
    for spread, rows in rows_by_spread.items():
        paths = hand_paths(hand, spread)
        if paths is None:
            continue
        X_OG = np.stack([attempts[row].X_OG for row in rows])
        lookup = PointLookup(model.field, each_X_TO[rows], X_OG)
        screened = _screen_spread(lookup, paths, _widened(config, model.field))
        for row, found in zip(rows, screened, strict=True):
            # Fingers that share a motor start together.
            starts = open_together(hand, found.closing) if found.outcome is None else found.closing
            screenings[row] = replace(found, closing=starts)
    return screenings


def extra_margin(field: DistanceField) -> float:
    """Return the margin that is added to each configured margin for a coarse field [m]."""
    return max(0.0, field.blur - COVERED)


def _widened(config: ScreenConfig, field: DistanceField) -> ScreenConfig:
    """Return a configuration whose margins also cover the errors of this field."""
    extra = extra_margin(field)
    names = ("start_margin", "reach_margin", "block_margin", "clearance")
    return config.model_copy(update={name: getattr(config, name) + extra for name in names})


class PointLookup:
    """Looks up points of the palm frame for n attempts at once."""

    def __init__(self, field: DistanceField, X_TO: Array, X_OG: Array) -> None:
        self._field = field
        self._X_OG = X_OG.astype(np.float32)
        self._up_G = multiply(X_TO, X_OG)[:, 2].astype(np.float32)

    def __len__(self) -> int:
        return len(self._X_OG)

    def heights(self, rows: Counts, p_GQ: Points) -> Points:
        """Return the heights above the table (a, n) [m] of points (a, n, 3) or (n, 3)."""
        return _affine(self._up_G[rows], p_GQ)

    def distances(self, rows: Counts, p_GQ: Points, below: float) -> Points:
        """Return the distances (a, n) [m] of points (a, n, 3) or (n, 3) from the object.

        They are lower bounds, too small by at most twice the grid's error. The smallest distance of
        each row is interpolated if it is below the limit `below` [m].
        """
        # Transform the points into {O} and read the nearest grid points.
        field, X_OG = self._field, self._X_OG[rows]
        x, y, z = (_affine(X_OG[:, axis], p_GQ) for axis in range(3))
        error = np.float32(field.error)
        distances = field.nearest(x, y, z)
        distances -= error

        # Only points that may be the closest point of a row need the exact value.
        least = distances.min(axis=1)
        close = np.flatnonzero(least <= np.float32(below))
        if len(close):
            at, point = np.nonzero(distances[close] <= (least[close] + 2 * error)[:, None])
            row = close[at]
            distances[row, point] = field.interpolate(x[row, point], y[row, point], z[row, point])
        return distances


def _affine(row: Points, p: Points) -> Points:
    """Return a.p + b (a, n) for rows [a, b] (a, 4) and points (a, n, 3) or (n, 3)."""
    r = row[:, :, None]
    # In place: a screen is a tenth faster than with fresh arrays.
    values = r[:, 0] * p[..., 0]
    term = r[:, 1] * p[..., 1]
    values += term
    np.multiply(r[:, 2], p[..., 2], out=term)
    values += term
    values += r[:, 3]
    return np.asarray(values)


def _screen_spread(lookup: PointLookup, paths: HandPaths, config: ScreenConfig) -> list[Screening]:
    """Return the screenings of attempts with one spread."""
    # Drop attempts whose open hand is certainly in collision. A subset of the points suffices to
    # reject an attempt, because the minimum over all points can only be smaller.
    margin = config.start_margin
    opened = np.concatenate([paths.still, *(path.points[0] for path in paths.fingers)])
    distance = _open_distance(lookup, np.arange(len(lookup)), opened[::START_STRIDE], margin)
    alive = np.flatnonzero(distance >= -margin)
    distance[alive] = _open_distance(lookup, alive, opened, margin)
    alive = alive[distance[alive] >= -margin]
    collision = Screening(
        outcome=Outcome.START_COLLISION, clear=False, closing=_NO_ANGLES, last=_NO_ANGLES
    )
    screenings = [collision] * len(lookup)

    # Close the fingers of the remaining attempts.
    for rows in _chunks(alive, SWEEP_CHUNK):
        angles = _closing_angles(lookup, paths, rows, config)
        for row in rows.tolist():
            closing, last = angles.get(row, (_NO_ANGLES, _NO_ANGLES))
            screenings[row] = Screening(
                outcome=None if row in angles else Outcome.SCREENED,
                clear=bool(distance[row] > margin),
                closing=closing,
                last=last,
            )
    return screenings


_NO_ANGLES = np.zeros(0)


def _closing_angles(
    lookup: PointLookup, paths: HandPaths, rows: Counts, config: ScreenConfig
) -> dict[int, tuple[Array, Array]]:
    """Return `closing` and `last` of a `Screening` for attempts with all fingertips in reach."""
    # One required finger that does not arrive decides, so the next finger skips these attempts.
    sweeps = []
    for path in paths.fingers:
        sweeps.append(_sweep_finger(lookup, path, rows, config))
        if path.required:
            rows = rows[sweeps[-1].arrives]

    # Collect the fingers of each remaining attempt, as indices (n, k) into their paths.
    places = [np.searchsorted(sweep.rows, rows) for sweep in sweeps]
    pairs = list(zip(sweeps, places, strict=True))
    starts = np.stack([sweep.start[place] for sweep, place in pairs], axis=1)
    lasts = np.stack([sweep.last[place] for sweep, place in pairs], axis=1)
    starts = _clear_starts(paths, starts)
    return {
        int(row): (_angles(paths, start), _angles(paths, last))
        for row, start, last in zip(rows, starts, lasts, strict=True)
    }


def _chunks(rows: Counts, size: int) -> list[Counts]:
    return [rows[start : start + size] for start in range(0, len(rows), size)]


def _angles(paths: HandPaths, indices: Counts) -> Array:
    return np.array([path.angles[k] for path, k in zip(paths.fingers, indices, strict=True)])


def _open_distance(lookup: PointLookup, rows: Counts, opened: Points, margin: float) -> Points:
    """Return the distance (a,) of the open hand from object and table, exact below the margin."""
    distance = np.zeros(len(rows), dtype=np.float32)
    for at in _chunks(np.arange(len(rows)), START_CHUNK):
        to_object = lookup.distances(rows[at], opened, margin).min(axis=1)
        distance[at] = np.minimum(to_object, lookup.heights(rows[at], opened).min(axis=1))
    return distance


@dataclass(frozen=True, kw_only=True, eq=False)
class _Sweep:
    """The closing of one finger in each of a attempts; angles are indices into the finger's path.

    Attributes:
        rows: (a,), the attempts, ascending.
        start: (a,), last evaluated angle up to which the finger keeps its clearance.
        arrives: (a,), whether the fingertip's pad comes within reach of the object before the
            finger is blocked.
        last: (a,), last evaluated angle with the pad within reach.
    """

    rows: Counts
    start: Counts
    arrives: npt.NDArray[np.bool_]
    last: Counts


def _sweep_finger(
    lookup: PointLookup, path: FingerPath, rows: Counts, config: ScreenConfig
) -> _Sweep:
    """Close one finger from the open hand until it is blocked or at its limit.

    A point moves by at most its `travel` from one angle to the next. Its distance to a threshold
    therefore limits how many angles the finger may advance before the point can cross the
    threshold. The angles in between need no evaluation (sphere tracing; Hart 1996).
    """
    count, end = len(rows), len(path.angles) - 1
    start, last = np.zeros(count, dtype=np.int64), np.full(count, end)
    arrives = np.zeros(count, dtype=np.bool_)

    # All attempts start from the open hand, and all points have their clearance.
    k, active = np.zeros(count, dtype=np.int64), np.arange(count)
    starting = np.ones(count, dtype=np.bool_)
    clearance, reach = np.float32(config.clearance), np.float32(config.reach_margin)
    block = np.float32(config.block_margin)
    rate, pad_rate = 1.0 / path.travel, 1.0 / path.travel[: path.pad]
    while len(active):
        # Distances of the finger's points now: from the object, and from object and table.
        points = path.points[k[active]]
        to_object = lookup.distances(rows[active], points, config.clearance)
        to_pad = to_object[:, : path.pad]
        to_any = np.minimum(to_object, lookup.heights(rows[active], points))
        least = to_any.min(axis=1)

        # As long as all points are beyond the clearance, the simulation can start later.
        far = starting[active] & (least > clearance)
        start[active[far]] = k[active[far]]
        starting[active] = far

        # Note attempts whose pad is within reach of the object.
        within = to_pad.min(axis=1) <= reach
        arrives[active[within]] = True
        last[active[within]] = k[active[within]]

        # Advance until a point may be blocked, the pad may be within reach, or the start is found.
        room = ((to_any + block) * rate).min(axis=1)
        to_reach = np.where(within, 0, ((to_pad - reach) * pad_rate).min(axis=1))
        np.minimum(room, to_reach, out=room)
        if far.any():
            room[far] = np.minimum(room[far], ((to_any[far] - clearance) * rate).min(axis=1))
        step = np.maximum(1, np.floor(room)).astype(np.int64)

        # Attempts that are blocked or at the finger's limit are done.
        done = (least < -block) | (k[active] == end)
        k[active] = np.minimum(k[active] + step, end)
        active = active[~done]
    return _Sweep(rows=rows, start=start, arrives=arrives, last=last)


def _clear_starts(paths: HandPaths, starts: Counts) -> Counts:
    """Return start angles (n, k), reduced to before two fingertips may touch on the way.

    All fingers close at the same speed; a finger waits at its start angle for the others.
    """
    if not starts.size:
        return starts

    # Let all fingers close together and test the gaps of each pair of fingertips.
    time = np.arange(0, int(starts.max()) + GAP_STRIDE, GAP_STRIDE)
    index = np.minimum(time[None, :, None], starts[:, None, :]) // GAP_STRIDE
    clear = np.ones(index.shape[:2], dtype=np.bool_)
    for (a, b), gap in paths.gaps.items():
        clear &= gap[index[..., a], index[..., b]] > FINGER_GAP

    # Start one test before the first gap that is too small.
    first = np.where(clear.all(axis=1), len(time), np.argmin(clear, axis=1))
    return np.minimum(starts, np.maximum(0, GAP_STRIDE * (first - 1))[:, None])
