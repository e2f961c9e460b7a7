"""Measures of a set of predictions from their verdicts, as means over objects with intervals.

A row is one image of one object; an object's value is the mean over its rows, and a set's the mean
over objects, so an object with many rows counts no more than another. Intervals are those of a
paired bootstrap: objects are drawn with replacement, the same ones for every set of predictions, so
a difference of two sets has an interval of its own. Where several training seeds are given they are
drawn, too, apart from the objects (a two-level bootstrap). The draws come from `seeding`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from drakegrasp.frames import Array
from drakegrasp.scoring.verdict import Verdict
from drakegrasp.seeding import Stream, object_key
from drakegrasp.simulation.attempts import Attempts
from drakegrasp.table import Table

#: A mean over objects by "value", and the ends of its interval by "low" and "high".
Estimate: TypeAlias = dict[str, float]
#: Resamples, the share of them that an interval holds, and the seed of their draws.
RESAMPLES, LEVEL, SEED = 2000, 0.95, 0
#: Decimals of values, so that sums in another order give the same text.
DIGITS = 6


def resample(clusters: Sequence[str]) -> Array:
    """Return draws of objects: (B, objects), share of each in each resample; a row sums to 1.

    Args:
        clusters: Of each object what is drawn as one: its name, or its class.
    """
    # How often each cluster is drawn; all its objects count as often.
    names, members = np.unique(np.asarray(clusters), return_inverse=True)
    shares = _drawn(len(names), "bootstrap", RESAMPLES)[:, members]
    return np.asarray(shares / shares.sum(axis=1, keepdims=True))


def _drawn(count: int, name: str, resamples: int) -> Array:
    """Return (B, count), share of each of so many things in each resample, by draws of a name."""
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
#: Measures of a row's best-ranked prediction.
FIRST = ("headline", "success", "sample", "held", "precision", "stable", "held_any")


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

    @cached_property
    def table(self) -> Table:
        """All predictions of all seeds: `seed`, `row` and `rank`, and what their verdicts say.

        That is each attribute of `Verdict`, NaN for None, and `headline`: whether it counts in it.
        """
        flat = [verdict for verdicts in self.verdicts for verdict in verdicts]
        said: dict[str, Any] = {
            f.name: [getattr(verdict, f.name) for verdict in flat] for f in fields(Verdict)
        }
        lengths = {name: np.array(said[name], float) for name in ("contact_error", "penetration")}
        several = {name: np.fromiter(said[name], object) for name in ("contacts", "posture")}
        return Table(
            said | lengths | several,
            seed=np.repeat(np.arange(len(self.ranked)), [len(each) for each in self.ranked]),
            row=np.concatenate([each.of_row for each in self.ranked]),
            rank=np.concatenate([each.rank for each in self.ranked]),
            headline=[verdict.counted for verdict in flat],
        )


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

    def best_of_rows(self, judged: Judged, good: npt.ArrayLike, most: int = 1) -> Array:
        """Return (training seeds, rows), whether one of the `most` best of each row is good.

        Args:
            judged: The set; a row without prediction fails.
            good: Of all its predictions, in the order of its table.
            most: So many of each row count.
        """
        table, found = judged.table, np.zeros((len(judged.ranked), len(self.rows)))
        kept = table[np.asarray(good, dtype=bool) & (table.rank < most)]
        found[kept.seed, np.searchsorted(self.rows, kept.row)] = 1.0
        return found

    def means(self, values: npt.ArrayLike) -> Array:
        """Return (..., objects) means over the rows of each object of values (..., rows)."""
        member = np.eye(len(self.names))[self.objects]
        return np.asarray(np.asarray(values, dtype=float) @ member / member.sum(axis=0))


def estimates(
    judged: Judged, grouping: Grouping, draws: Array, *, oracle: bool
) -> dict[str, Estimate]:
    """Return the measures of a set that have intervals, by name.

    Beside those of `FIRST`: `success@k` for the k that the set has, whether any of the k best of a
    row counts in the headline; `objects`, the share of objects with one that does.

    Args:
        judged: The set.
        grouping: Of the rows.
        draws: Of objects, see `resample`.
        oracle: Whether more wrist poses than the first were tried.
    """
    table, by_row = judged.table, dict[str, Array]()
    for name in FIRST:
        if name != "held_any" or oracle:
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

    The training seeds of both are drawn, apart from each other.
    """
    ours, theirs = _headlines(one, grouping), _headlines(other, grouping)
    resampled = _means(ours, draws) - _means(theirs, draws, "other training seeds")
    return _estimate(float(ours.mean() - theirs.mean()), resampled)


def _headlines(judged: Judged, grouping: Grouping) -> Array:
    """Return (training seeds, objects), the headline of each object."""
    return grouping.means(grouping.best_of_rows(judged, judged.table.headline))


def curve(judged: Judged, grouping: Grouping) -> list[float]:
    """Return held(d) at `CURVE_MM`: held with every contact within d of the one asked for."""
    table, values = judged.table, []
    for limit in CURVE_MM:
        within = table.held & (table.contact_error <= 1e-3 * limit)
        values.append(_rounded(grouping.means(grouping.best_of_rows(judged, within)).mean()))
    return values


def calibration(judged: Judged) -> list[dict[str, float]]:
    """Return mean confidence and share that counts, of groups of predictions; empty if none stated.

    All predictions whose confidence is a finite number are in it, whatever their rank, in groups of
    equal size by confidence.
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
    """Return shares of variance in the first 1 to 5 principal components of what counts.

    Of palm position [m], rotation vector [rad] and joints in {O}, over all predictions that count
    in the headline, as DexGraspBench does (JYChen18/DexGraspBench, 1e7a5a6); the lower, the more
    diverse. None if fewer than three count.
    """
    kept = [posture for posture in judged.table.posture[judged.table.headline] if posture]
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
    kept = judged.table[judged.table.headline & judged.table.contacts.astype(bool)]
    objects = grouping.objects[np.searchsorted(grouping.rows, kept.row)]
    counted: dict[int, list[Array]] = {}
    for index, contacts in zip(objects.tolist(), kept.contacts, strict=True):
        counted.setdefault(index, []).append(np.array(contacts).reshape(-1, 3))

    # Which own grasps have one near.
    covered = []
    for row, index in zip(grouping.rows, grouping.objects.tolist(), strict=True):
        points = own[row].reshape(-1, 3)
        away = [np.linalg.norm(points - other, axis=1).mean() for other in counted.get(index, [])]
        covered.append(float(bool(away) and min(away) <= COVER))
    return _rounded(grouping.means([covered]).mean())


def by_name(judged: Judged, grouping: Grouping, names: Sequence[str]) -> dict[str, float]:
    """Return the mean of the headline over the objects of each name, that of a class or its own."""
    values, array = _headlines(judged, grouping).mean(axis=0), np.array(names)
    return {name: _rounded(values[array == name].mean()) for name in sorted(set(names))}


def _rounded(value: float | np.floating) -> float:
    return round(float(value), DIGITS) + 0.0
