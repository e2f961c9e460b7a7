"""Random streams: frozen numbers, and the distributions that they promise."""

from __future__ import annotations

import itertools

import numpy as np
import numpy.typing as npt
import pytest

from drakegrasp.seeding import Stream

#: What Stream(7, 1, 2) draws first; a change here changes every dataset.
WORDS = [0x7A98DF51990736C9, 0x24258EE255688DBA, 0xEEDA9BD217E77A5A]
NORMAL = ["-0x1.b193614000000p-5", "-0x1.13300f3a00000p+0", "0x1.7faa44d700000p+0"]

LARGEST = 2**64 - 1


def stream() -> Stream:
    return Stream(7, 1, 2)


def drawing(monkeypatch: pytest.MonkeyPatch, words: list[int]) -> Stream:
    """Return a stream that draws the given words."""

    def given_words(self: Stream, count: int) -> npt.NDArray[np.uint64]:
        assert count == len(words)
        return np.array(words, dtype=np.uint64)

    monkeypatch.setattr(Stream, "words", given_words)
    return stream()


def test_words_without_a_place_are_those_of_the_reference_implementation() -> None:
    """The first lines of NumPy's own test vector for PCG64."""
    assert Stream(0xDEADBEAF).words(2).tolist() == [0x60D24054E17A0698, 0xD5E79D89856E4F12]


def test_draws_follow_from_the_words_as_stated() -> None:
    assert stream().uniform(3).tolist() == [(word >> 11) / 2**53 for word in WORDS]
    assert stream().integers(1000, 3).tolist() == [word % 1000 for word in WORDS]
    assert stream().permutation(3).tolist() == [1, 0, 2]
    assert [x.hex() for x in stream().normal(3).tolist()] == NORMAL


def test_drawing_goes_on_where_it_stopped() -> None:
    parts = stream()
    np.testing.assert_array_equal(np.r_[parts.words(3), parts.words(4)], stream().words(7))
    assert stream().words(0).size == stream().normal(0).size == 0


def test_streams_of_other_seeds_and_places_differ() -> None:
    streams = [
        Stream(seed, *place)
        for seed in (0, 1, 2, 12)
        for place in ((), (0,), (1,), (2,), (12,), (0, 0), (1, 0), (0, 1), (1, 2), (2, 1))
    ]
    assert len({s.key for s in streams}) == len(streams)
    firsts = [s.words(100) for s in streams]
    assert len(np.unique(firsts)) == 100 * len(streams)
    # Unlike neighbours of a counter, they are uncorrelated: about half of all bits differ.
    shares = [np.unpackbits((a ^ b).view(np.uint8)).mean() for a, b in itertools.pairwise(firsts)]
    assert min(shares) > 0.47 and max(shares) < 0.53


def test_permutation_keeps_the_order_of_equal_words(monkeypatch: pytest.MonkeyPatch) -> None:
    assert drawing(monkeypatch, [5, 3] * 20).permutation(40).tolist() == [
        *range(1, 40, 2),
        *range(0, 40, 2),
    ]


def test_uniform_and_normal_have_values_at_the_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    ends = drawing(monkeypatch, [0, LARGEST])
    assert ends.uniform(2).tolist() == [0.0, 1.0 - 2.0**-53]
    low, high = ends.normal(2).tolist()
    assert low == pytest.approx(-8.29, abs=0.01)
    assert high == pytest.approx(8.21, abs=0.01)
