"""Intervals of means over objects, by a paired bootstrap.

Objects are drawn with replacement, the same ones for every set of predictions, so a difference of
two sets has an interval of its own. Where several training seeds are given they are drawn, too,
apart from the objects (a two-level bootstrap). The draws come from `seeding`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drakegrasp.frames import Array
from drakegrasp.seeding import Stream, object_key

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
