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
        values = np.einsum("bs,so,bo->b", self._seed_weights(len(table)), table, self.weights)
        low, high = np.quantile(values, [(1.0 - LEVEL) / 2.0, (1.0 + LEVEL) / 2.0])
        rounded = [round(float(v), DIGITS) + 0.0 for v in (table.mean(), low, high)]
        return Estimate(value=rounded[0], low=rounded[1], high=rounded[2])

    def _seed_weights(self, count: int) -> Array:
        """Return (B, count), share of each training seed in each resample."""
        resamples = len(self.weights)
        if count == 1:
            return np.ones((resamples, 1))
        stream = Stream(self.seed, object_key("training seeds"), count)
        drawn = stream.integers(count, resamples * count).reshape(resamples, count)
        return _shares(drawn, count)


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
