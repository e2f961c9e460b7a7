"""Measures of a set of predictions from their verdicts, as means over objects with intervals.

A row is one image of one object; an object's value is the mean over its rows, and a set's the mean
over objects, so an object with many rows counts no more than another. Intervals are those of a
paired bootstrap: objects are drawn with replacement, the same ones for every set of predictions, so
a difference of two sets has an interval of its own. Where several training seeds are given they are
drawn, too, apart from the objects (a two-level bootstrap). The draws come from `seeding`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from drakegrasp.frames import Array
from drakegrasp.scoring.verdict import Verdict
from drakegrasp.seeding import Stream, object_key
from drakegrasp.simulation.attempts import Attempts

#: Resamples, and the share of them that an interval holds.
RESAMPLES, LEVEL = 2000, 0.95
#: Decimals of values, so that sums in another order give the same text.
DIGITS = 6


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """A mean over objects and its interval.

    Attributes:
        value: The mean.
        low, high: Ends of the interval of `LEVEL`.
    """

    value: float
    low: float
    high: float

    def __neg__(self) -> Estimate:
        """Return the estimate of the negative mean."""
        return Estimate(value=0.0 - self.value, low=0.0 - self.high, high=0.0 - self.low)


@dataclass(frozen=True, eq=False)
class Resampling:
    """Draws of objects that all sets of a score share.

    Attributes:
        weights: (B, objects), share of each object in each resample; a row sums to 1.
        seed: Of the draws.
    """

    weights: Array
    seed: int

    def estimate(self, table: Array) -> Estimate:
        """Return the mean of a table (training seeds, objects) over both, with its interval."""
        return _estimate(float(table.mean()), self._means(table, "training seeds"))

    def difference(self, table: Array, other: Array) -> Estimate:
        """Return by how much the mean of a table is above that of another, of the same objects.

        The training seeds of both are drawn, apart from each other.
        """
        values = self._means(table, "training seeds") - self._means(other, "other training seeds")
        return _estimate(float(table.mean() - other.mean()), values)

    def _means(self, table: Array, draws: str) -> Array:
        """Return (B,), the mean of a table (training seeds, objects) in each resample."""
        seeds = self._seed_weights(len(table), draws)
        return np.asarray(np.einsum("bs,so,bo->b", seeds, table, self.weights))

    def _seed_weights(self, count: int, draws: str) -> Array:
        """Return (B, count), share of each training seed in each resample, by draws of a name."""
        resamples = len(self.weights)
        if count == 1:
            return np.ones((resamples, 1))
        stream = Stream(self.seed, object_key(draws), count)
        drawn = stream.integers(count, resamples * count).reshape(resamples, count)
        return _shares(drawn, count)


def _estimate(value: float, resampled: Array) -> Estimate:
    """Return a value and the interval of its resamples (B,)."""
    low, high = np.quantile(resampled, [(1.0 - LEVEL) / 2.0, (1.0 + LEVEL) / 2.0])
    rounded = [round(float(v), DIGITS) + 0.0 for v in (value, low, high)]
    return Estimate(value=rounded[0], low=rounded[1], high=rounded[2])


def resample(clusters: Sequence[str], seed: int = 0) -> Resampling:
    """Return draws of objects.

    Args:
        clusters: Of each object what is drawn as one: its name, or its class.
        seed: Of the draws.
    """
    # How often each cluster is drawn.
    names, members = np.unique(np.asarray(clusters), return_inverse=True)
    stream = Stream(seed, object_key("bootstrap"), len(names))
    drawn = stream.integers(len(names), RESAMPLES * len(names)).reshape(RESAMPLES, len(names))

    # All objects of a cluster count as often as it was drawn.
    weights = _shares(drawn, len(names))[:, members]
    return Resampling(weights / weights.sum(axis=1, keepdims=True), seed)


def _shares(drawn: np.ndarray, count: int) -> Array:
    """Return (B, count), the share of each number 0..count-1 in each row (B, n)."""
    offset = np.arange(len(drawn))[:, None] * count
    counts = np.bincount((drawn + offset).ravel(), minlength=len(drawn) * count)
    return counts.reshape(len(drawn), count) / drawn.shape[1]


#: Numbers of predictions per row for which success is told.
KS = (1, 2, 5, 10, 20, 50, 100)
#: Distances d between asked and reached contacts of the curve held(d) [mm].
CURVE_MM = tuple(range(0, 61, 5))
#: Predictions are put in so many groups of equal size by their stated confidence.
BINS = 5
#: Components of the diversity, as in DexGraspBench.
COMPONENTS = 5
#: A grasp covers another if its contacts are on average nearer than this [m].
COVER = 0.02
#: Measures of a row's best-ranked prediction, by name.
FIRST: Mapping[str, Callable[[Verdict], bool]] = {
    "headline": lambda v: v.counted,
    "success": lambda v: v.success,
    "sample": lambda v: v.sample,
    "held": lambda v: v.held,
    "precision": lambda v: v.precision,
    "stable": lambda v: v.stable,
    "held_any": lambda v: v.held_any,
}


@dataclass(frozen=True, kw_only=True, eq=False)
class Judged:
    """A set of predictions and their verdicts, one list per training seed.

    Attributes:
        name: Of the set.
        ranked: The predictions, by training seed.
        verdicts: Theirs, in the same order.
    """

    name: str
    ranked: tuple[Attempts, ...]
    verdicts: tuple[tuple[Verdict, ...], ...]

    def by_row(self) -> list[dict[int, list[Verdict]]]:
        """Return by training seed the verdicts of each row, by rank."""
        found = []
        for ranked, verdicts in zip(self.ranked, self.verdicts, strict=True):
            rows: dict[int, list[Verdict]] = {}
            for row, verdict in zip(ranked.of_row.tolist(), verdicts, strict=True):
                rows.setdefault(row, []).append(verdict)
            found.append(rows)
        return found


@dataclass(frozen=True, kw_only=True, eq=False)
class Grouping:
    """The rows of a score by object.

    Attributes:
        rows: Scored, in order.
        objects: (rows,), index of the object of each.
        names: Of the objects.
        classes: Of the objects.
    """

    rows: tuple[int, ...]
    objects: npt.NDArray[np.int64]
    names: tuple[str, ...]
    classes: tuple[str, ...]

    def means(self, values: npt.ArrayLike) -> Array:
        """Return (..., objects) means over the rows of each object of values (..., rows)."""
        member = np.eye(len(self.names))[self.objects]
        return np.asarray(np.asarray(values, dtype=float) @ member / member.sum(axis=0))

    def best(self, values: npt.ArrayLike) -> Array:
        """Return (..., objects) the largest value of each object's rows."""
        array = np.asarray(values, dtype=float)
        members = [self.objects == index for index in range(len(self.names))]
        return np.stack([array[..., own].max(axis=-1) for own in members], axis=-1)


def first_table(judged: Judged, grouping: Grouping, name: str) -> Array:
    """Return (training seeds, rows) of a measure of `FIRST`; a row without prediction fails."""
    measure = FIRST[name]
    return np.array(
        [
            [float(row in rows and measure(rows[row][0])) for row in grouping.rows]
            for rows in judged.by_row()
        ]
    )


def estimates(
    judged: Judged, grouping: Grouping, draws: Resampling, *, oracle: bool
) -> dict[str, Estimate]:
    """Return the measures of a set that have intervals, by name.

    Beside those of `FIRST`: `success@k` for the k that the set has, whether any of the k best of a
    row counts in the headline; `objects`, the share of objects with one that does.

    Args:
        judged: The set.
        grouping: Of the rows.
        draws: Of objects.
        oracle: Whether more wrist poses than the first were tried.
    """
    found = {}
    for name in FIRST:
        if name == "held_any" and not oracle:
            continue
        found[name] = draws.estimate(grouping.means(first_table(judged, grouping, name)))

    # The k best of each row, and an object's best row.
    most = max(int(ranked.rank.max()) + 1 for ranked in judged.ranked)
    seeds = judged.by_row()
    for k in KS:
        if 1 < k <= most:
            table = [
                [float(any(v.counted for v in rows.get(row, [])[:k])) for row in grouping.rows]
                for rows in seeds
            ]
            found[f"success@{k}"] = draws.estimate(grouping.means(table))
    best = grouping.best(first_table(judged, grouping, "headline"))
    return found | {"objects": draws.estimate(best)}


def difference(one: Judged, other: Judged, grouping: Grouping, draws: Resampling) -> Estimate:
    """Return by how much the headline of a set is above that of another, object by object."""
    tables = [grouping.means(first_table(each, grouping, "headline")) for each in (one, other)]
    return draws.difference(*tables)


def curve(judged: Judged, grouping: Grouping) -> list[float]:
    """Return held(d) at `CURVE_MM`: held with every contact within d of the one asked for."""
    values = []
    for limit in CURVE_MM:
        table = [
            [float(row in rows and _within(rows[row][0], 1e-3 * limit)) for row in grouping.rows]
            for rows in judged.by_row()
        ]
        values.append(_rounded(grouping.means(table).mean()))
    return values


def _within(verdict: Verdict, limit: float) -> bool:
    error = verdict.contact_error
    return verdict.held and error is not None and error <= limit


def calibration(judged: Judged) -> list[dict[str, float]]:
    """Return mean confidence and share that counts, of groups of predictions; empty if none stated.

    All predictions whose confidence is a finite number are in it, whatever their rank, in groups of
    equal size by confidence.
    """
    if any(ranked.confidence is None for ranked in judged.ranked):
        return []
    stated = np.concatenate([r.confidence for r in judged.ranked if r.confidence is not None])
    counted = np.array([v.counted for verdicts in judged.verdicts for v in verdicts], dtype=float)
    order = np.argsort(stated, kind="stable")
    order = order[np.isfinite(stated[order])]
    return [
        {
            "confidence": _rounded(stated[group].mean()),
            "share": _rounded(counted[group].mean()),
            "count": len(group),
        }
        for group in np.array_split(order, BINS)
        if len(group)
    ]


def penetration(judged: Judged) -> float | None:
    """Return the mean over tried predictions of the deepest penetration after closing [m]."""
    depths = [v.penetration for vs in judged.verdicts for v in vs if v.penetration is not None]
    return _rounded(np.mean(depths)) if depths else None


def diversity(judged: Judged) -> list[float] | None:
    """Return shares of variance in the first 1 to 5 principal components of what counts.

    Of palm position [m], rotation vector [rad] and joints in {O}, over all predictions that count
    in the headline, as DexGraspBench does (JYChen18/DexGraspBench, 1e7a5a6); the lower, the more
    diverse. None if fewer than three count.
    """
    kept = [v.posture for vs in judged.verdicts for v in vs if v.counted and v.posture]
    if len(kept) < 3:
        return None
    postures = np.array(kept)
    singular = np.linalg.svd(postures - postures.mean(axis=0), compute_uv=False)
    shares = np.cumsum(singular**2) / max(float((singular**2).sum()), 1e-300)
    return [_rounded(share) for share in shares[:COMPONENTS]]


def coverage(judged: Judged, own: Mapping[int, Array], grouping: Grouping) -> float:
    """Return the share of own grasps near which a prediction for the same object counts.

    Args:
        judged: The set.
        own: By row (3k,), contact points of its own grasp in {O} [m].
        grouping: Of the rows.
    """
    # What counts, by object.
    place = {row: i for i, row in enumerate(grouping.rows)}
    counted: dict[int, list[Array]] = {}
    for ranked, verdicts in zip(judged.ranked, judged.verdicts, strict=True):
        for row, verdict in zip(ranked.of_row.tolist(), verdicts, strict=True):
            if verdict.counted and verdict.contacts:
                found = counted.setdefault(int(grouping.objects[place[row]]), [])
                found.append(np.array(verdict.contacts).reshape(-1, 3))

    # Which own grasps have one near.
    covered = []
    for row, index in zip(grouping.rows, grouping.objects.tolist(), strict=True):
        points = own[row].reshape(-1, 3)
        away = [np.linalg.norm(points - other, axis=1).mean() for other in counted.get(index, [])]
        covered.append(float(bool(away) and min(away) <= COVER))
    return _rounded(grouping.means([covered]).mean())


def seconds(judged: Judged) -> float:
    """Return the median wall-clock time of a verdict [s]."""
    return float(np.median([v.seconds for vs in judged.verdicts for v in vs]))


def by_class(judged: Judged, grouping: Grouping) -> dict[str, float]:
    """Return the mean of the headline over the objects of each class."""
    return _by(judged, grouping, grouping.classes)


def by_object(judged: Judged, grouping: Grouping) -> dict[str, float]:
    """Return the headline of each object."""
    return _by(judged, grouping, grouping.names)


def _by(judged: Judged, grouping: Grouping, names: Sequence[str]) -> dict[str, float]:
    values = grouping.means(first_table(judged, grouping, "headline")).mean(axis=0)
    array = np.array(names)
    return {name: _rounded(values[array == name].mean()) for name in sorted(set(names))}


def _rounded(value: float | np.floating) -> float:
    return round(float(value), DIGITS) + 0.0
