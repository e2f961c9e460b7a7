"""Random numbers that are the same on every machine and with every release of NumPy.

NumPy guarantees the raw stream of PCG64 and the mixing of `SeedSequence`. The results of its
`Generator` may change from release to release. So all random numbers are computed from the raw
64-bit words, by the rules below.
"""

from __future__ import annotations

import hashlib
from enum import IntEnum
from statistics import NormalDist

import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import Array

#: Normal numbers are rounded to multiples of this. Their tails need the C library's logarithm,
#: whose last bits differ between machines by far less than this.
_NORMAL_GRID = 2.0**-32


class Draw(IntEnum):
    """What a stream is for: the last number of its place, which tells streams of one seed apart.

    Places whose last numbers are equal have different lengths.
    """

    CONDITIONS = 0  # of an attempt: an object's candidate and stand-off
    SPLIT_OF_CLASS = 1  # which objects of a class are tested, which samples validate
    SPLIT_OF_GROUP = 2  # the rank of a group of objects, in a split by object
    SAMPLER = 2  # palms at a resting pose; for a user-defined sampler its key follows
    DROP = 3  # the orientation in which an object falls
    SCENE = 4  # an object's place, appearance and cameras
    REPEAT = 5  # whether an attempt is repeated
    CLUTTER = 6  # the objects of a scene, how they fall, and which grasps are tried


class Stream:
    """A stream of random numbers, determined by a seed and the place where it is used."""

    def __init__(self, seed: int, *place: int) -> None:
        """Start the stream.

        Args:
            seed: Seed of the dataset; not negative.
            place: What the stream is for, e.g. object and candidate, each 0..2^32-1. Streams of
                different places are independent.
        """
        self._sequence = np.random.SeedSequence(seed, spawn_key=place)
        self._bits = np.random.PCG64(self._sequence)

    @property
    def key(self) -> int:
        """A 64-bit number that identifies the stream; drawing does not change it."""
        return int(self._sequence.generate_state(1, np.uint64)[0])

    def words(self, count: int) -> npt.NDArray[np.uint64]:
        """Return (count,) words of 64 random bits."""
        return np.asarray(self._bits.random_raw(count), dtype=np.uint64)

    def uniform(self, count: int) -> Array:
        """Return (count,) numbers in [0, 1), multiples of 2^-53."""
        return (self.words(count) >> np.uint64(11)).astype(np.float64) * 2.0**-53

    def integers(self, bound: int, count: int) -> npt.NDArray[np.int64]:
        """Return (count,) integers in 0..bound-1; the bias is below bound / 2^64."""
        return (self.words(count) % np.uint64(bound)).astype(np.int64)

    def permutation(self, count: int) -> npt.NDArray[np.int64]:
        """Return 0..count-1 (count,) in random order: sorted by one random word per number."""
        return np.argsort(self.words(count), kind="stable").astype(np.int64)

    def normal(self, count: int) -> Array:
        """Return (count,) normal numbers of mean 0 and standard deviation 1, multiples of 2^-32."""
        # Add half a step, because the inverse of the distribution has no value at 0. It has no
        # value at 1 either, to which the largest number would be rounded.
        share = np.minimum(self.uniform(count) + 2.0**-54, 1.0 - 2.0**-53)
        drawn = np.array([NormalDist().inv_cdf(u) for u in share.tolist()])
        return np.asarray(np.rint(drawn / _NORMAL_GRID) * _NORMAL_GRID)


def object_key(name: str) -> int:
    """Return the integer in 0..2^32-1 that identifies an object or a class in a stream's place.

    It depends only on the name, so adding a mesh to a directory does not change other objects.
    """
    return int.from_bytes(hashlib.sha256(name.encode()).digest()[:4], "big")
