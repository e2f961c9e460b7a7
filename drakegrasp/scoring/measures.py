"""Measures of a set of predictions from their verdicts, as means over objects with intervals.

A row is one image of one object. An object's value is the mean over its rows, and a set's value is
the mean over objects, so an object with many rows has no more weight than another. Intervals come
from a paired bootstrap: objects are drawn with replacement, the same ones for every set of
predictions, so a difference of two sets has its own interval. If there are several training seeds,
they are drawn independently of the objects (a two-level bootstrap). The draws come from `seeding`.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from drakegrasp.frames import Array
from drakegrasp.scoring.verdict import Verdict
from drakegrasp.seeding import Stream, object_key
from drakegrasp.simulation.attempts import GraspRows
from drakegrasp.table import Table

#: A mean over objects by "value", and the ends of its interval by "low" and "high".
Estimate: TypeAlias = dict[str, float]
#: Number of resamples, fraction of them within an interval, and seed of their draws.
RESAMPLES, LEVEL, SEED = 2000, 0.95, 0
#: Decimals of values, so that sums in another order give the same text.
DIGITS = 6


def resample(clusters: Sequence[str]) -> Array:
    """Return draws of objects (B, objects): weight of each in each resample; a row sums to 1.

    Args:
        clusters: For each object the cluster that is drawn as one: the object's name, or its class.
    """
    # Count how often each cluster is drawn; all its objects count as often.
    names, members = np.unique(np.asarray(clusters), return_inverse=True)
    shares = _drawn(len(names), "bootstrap", RESAMPLES)[:, members]
    return np.asarray(shares / shares.sum(axis=1, keepdims=True))


def _drawn(count: int, name: str, resamples: int) -> Array:
    """Return draws (B, count): weight of each item in each resample, seeded by a name."""
    stream = Stream(SEED, object_key(name), count)
    drawn = stream.integers(count, resamples * count).reshape(resamples, count)
    offset = np.arange(resamples)[:, None] * count
    counts = np.bincount((drawn + offset).ravel(), minlength=resamples * count)
    return counts.reshape(resamples, count) / count


def _means(table: Array, draws: Array, name: str = "training seeds") -> Array:
    """Return (B,), the mean of a table (training seeds, objects) in each resample."""
    count, resamples = len(table), len(draws)
    seeds = np.ones((resamples, 1)) if count == 1 else _drawn(count, name, resamples)
    return np.asarray(np.einsum("bs,so,bo->b", seeds, table, draws))


def _estimate(value: float, resampled: Array) -> Estimate:
    """Return a value and the interval of its resamples (B,)."""
    low, high = np.quantile(resampled, [(1.0 - LEVEL) / 2.0, (1.0 + LEVEL) / 2.0])
    return {"value": _rounded(value), "low": _rounded(low), "high": _rounded(high)}


#: Numbers of predictions per row for which success is reported.
KS = (1, 2, 5, 10, 20, 50, 100)
#: Distances d between requested and reached contacts of the curve lifted(d) [mm].
CURVE_MM = tuple(range(0, 61, 5))
#: Number of groups of equal size into which predictions are sorted by their stated confidence.
BINS = 5
#: Number of components of the diversity, as in DexGraspBench.
COMPONENTS = 5
#: Measures of a row's best-ranked prediction.
FIRST = ("headline", "matches", "kept", "clean", "lifted", "precision", "stable", "lifted_any")
#: The same if an arm was asked.
OF_ARM = ("reachable", "reached")


@dataclass(frozen=True, kw_only=True, eq=False)
class Judged:
    """A set of predictions and their verdicts, one list per training seed.

    Attributes:
        name: Name of the set.
        ranked: The predictions, by training seed.
        verdicts: Verdicts on the predictions, in the same order.
    """

    name: str
    ranked: tuple[GraspRows, ...]
    verdicts: tuple[tuple[Verdict, ...], ...]

    @cached_property
    def table(self) -> Table:
        """All predictions of all seeds: `seed`, `row`, `rank`, and the contents of their verdicts.

        The contents are each attribute of `Verdict`, with NaN for None, and `headline`: whether the
        prediction counts in the headline, and `reached`, whether an arm also reaches it.
        """
        flat = [verdict for verdicts in self.verdicts for verdict in verdicts]
        said: dict[str, Any] = {
            f.name: [getattr(verdict, f.name) for verdict in flat] for f in fields(Verdict)
        }
        lengths = {name: np.array(said[name], float) for name in ("contact_error", "penetration")}
        said["posture"] = np.fromiter(said["posture"], object)
        said["reachable"] = [bool(reachable) for reachable in said["reachable"]]
        return Table(
            said | lengths,
            seed=np.repeat(np.arange(len(self.ranked)), [len(each) for each in self.ranked]),
            row=np.concatenate([each.of_row for each in self.ranked]),
            rank=np.concatenate([each.rank for each in self.ranked]),
            headline=[verdict.counted for verdict in flat],
            reached=[verdict.reached for verdict in flat],
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Grouping:
    """The rows of a score by object.

    Attributes:
        rows: The scored rows, in order.
        objects: (rows,), index of each row's object.
        names: Names of the objects.
        classes: Classes of the objects.
    """

    rows: tuple[int, ...]
    objects: npt.NDArray[np.int64]
    names: tuple[str, ...]
    classes: tuple[str, ...]

    def best_of_rows(self, judged: Judged, good: npt.ArrayLike, most: int = 1) -> Array:
        """Return (training seeds, rows), whether one of the `most` best of each row is good.

        Args:
            judged: The set; a row without predictions fails.
            good: Whether each prediction is good, in the order of the set's table.
            most: Number of predictions that count per row.
        """
        table, found = judged.table, np.zeros((len(judged.ranked), len(self.rows)))
        kept = table[np.asarray(good, dtype=bool) & (table.rank < most)]
        found[kept.seed, np.searchsorted(self.rows, kept.row)] = 1.0
        return found

    def means(self, values: npt.ArrayLike) -> Array:
        """Return means (..., objects) of values (..., rows) over the rows of each object."""
        member = np.eye(len(self.names))[self.objects]
        return np.asarray(np.asarray(values, dtype=float) @ member / member.sum(axis=0))


def estimates(
    judged: Judged, grouping: Grouping, draws: Array, measures: Collection[str]
) -> dict[str, Estimate]:
    """Return the measures of a set that have intervals, by name.

    They are those of `FIRST` and `OF_ARM` that are asked for, and two more. `success@k`, for each k
    that the set has, is whether any of the k best predictions of a row counts in the headline.
    `objects` is the fraction of objects with a prediction that counts.

    Args:
        judged: The set.
        grouping: Grouping of the rows.
        draws: Draws of objects, see `resample`.
        measures: Names of the measures that are asked for.
    """
    table, by_row = judged.table, dict[str, Array]()
    for name in (*FIRST, *OF_ARM):
        if name in measures:
            by_row[name] = grouping.best_of_rows(judged, table[name])
    for k in KS:
        if 1 < k <= int(table.rank.max()) + 1:
            by_row[f"success@{k}"] = grouping.best_of_rows(judged, table.headline, k)
    by_object = {name: grouping.means(values) for name, values in by_row.items()}
    by_object["objects"] = (by_object["headline"] > 0.0).astype(float)
    return {
        name: _estimate(float(values.mean()), _means(values, draws))
        for name, values in by_object.items()
    }


def difference(one: Judged, other: Judged, grouping: Grouping, draws: Array) -> Estimate:
    """Return by how much the headline of a set is above that of another, object by object.

    The training seeds of the two sets are drawn independently.
    """
    ours, theirs = _headlines(one, grouping), _headlines(other, grouping)
    resampled = _means(ours, draws) - _means(theirs, draws, "other training seeds")
    return _estimate(float(ours.mean() - theirs.mean()), resampled)


def _headlines(judged: Judged, grouping: Grouping) -> Array:
    """Return (training seeds, objects), the headline of each object."""
    return grouping.means(grouping.best_of_rows(judged, judged.table.headline))


def curve(judged: Judged, grouping: Grouping) -> list[float]:
    """Return lifted(d) at `CURVE_MM`: lifted, with every contact within d of the requested one."""
    table, values = judged.table, []
    for limit in CURVE_MM:
        within = table.lifted & (table.contact_error <= 1e-3 * limit)
        values.append(_rounded(grouping.means(grouping.best_of_rows(judged, within)).mean()))
    return values


def calibration(judged: Judged) -> list[dict[str, float]]:
    """Return mean confidence and counting fraction of groups of predictions, or an empty list.

    It has all predictions with a finite confidence, of any rank, in groups of equal size by
    confidence. It is empty if a training seed states no confidence.
    """
    if any(ranked.confidence is None for ranked in judged.ranked):
        return []
    stated = np.concatenate([ranked.confidence for ranked in judged.ranked])
    order = np.argsort(stated, kind="stable")
    order = order[np.isfinite(stated[order])]
    return [
        {
            "confidence": _rounded(stated[group].mean()),
            "share": _rounded(judged.table.headline[group].mean()),
            "count": len(group),
        }
        for group in np.array_split(order, BINS)
        if len(group)
    ]


def penetration(judged: Judged) -> float | None:
    """Return the mean over tried predictions of the deepest penetration after closing [m]."""
    depths = judged.table.penetration
    depths = depths[~np.isnan(depths)]
    return _rounded(depths.mean()) if depths.size else None


def diversity(judged: Judged) -> list[float] | None:
    """Return the fractions of variance in the first 1 to 5 principal components.

    The variance is that of palm position [m], rotation vector [rad] and joints in {O}, over all
    predictions that count in the headline, as in DexGraspBench (JYChen18/DexGraspBench, 1e7a5a6).
    Lower is more diverse. The result is None if fewer than three predictions count.
    """
    kept = [posture for posture in judged.table.posture[judged.table.headline] if posture]
    if len(kept) < 3:
        return None
    postures = np.array(kept)
    singular = np.linalg.svd(postures - postures.mean(axis=0), compute_uv=False)
    shares = np.cumsum(singular**2) / max(float((singular**2).sum()), 1e-300)
    return [_rounded(share) for share in shares[:COMPONENTS]]


def by_name(judged: Judged, grouping: Grouping, names: Sequence[str]) -> dict[str, float]:
    """Return the mean of the headline over the objects with the same name or class, by `names`."""
    values, array = _headlines(judged, grouping).mean(axis=0), np.array(names)
    return {name: _rounded(values[array == name].mean()) for name in sorted(set(names))}


def _rounded(value: float | np.floating) -> float:
    return round(float(value), DIGITS) + 0.0
