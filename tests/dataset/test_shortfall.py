"""What is said of objects without samples, and of a split that is not as asked."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from drakegrasp.config import SplitConfig
from drakegrasp.dataset.statistics import (
    SplitCount,
    count_funnel,
    objects_without_samples,
    split_shortfall,
    why_no_sample,
)
from drakegrasp.filters import Removal
from drakegrasp.hand.settings import load_config
from drakegrasp.outcomes import Outcome


@pytest.mark.parametrize(
    ("outcomes", "removals", "reason"),
    [
        (
            {Outcome.START_COLLISION: 842, Outcome.SCREENED: 358},
            {},
            "842 of 1,200 attempts (70%) end in start_collision, "
            f"{Outcome.START_COLLISION.text}; the hand never closed on it",
        ),
        ({Outcome.SCREENED: 9, Outcome.HAND_CONTACT: 1}, {}, "; 1 closed, none lifted"),
        ({Outcome.START_COLLISION: 9, Outcome.MOVED: 3}, {}, "; 3 were lifted, none held"),
        (
            {Outcome.DROPPED: 9, Outcome.SCREENED: 3},
            {},
            "9 of 12 attempts (75%) end in dropped, the hand loses the object during the lift",
        ),
        ({Outcome.DROPPED: 9, Outcome.SUCCESS: 2}, {Removal.TURNED: 2}, "mostly turned (2)"),
    ],
)
def test_reason_is_what_most_attempts_met_and_how_far_the_best_came(
    outcomes: dict[Outcome, int], removals: dict[Removal, int], reason: str
) -> None:
    tried, removed = np.zeros(1 + max(Outcome), int), np.zeros(1 + max(Removal), int)
    tried[list(outcomes)] = list(outcomes.values())
    removed[list(removals)] = list(removals.values())
    assert why_no_sample(tried, removed, load_config()).reason.endswith(reason)


def test_advice_names_no_way_that_was_gone_already() -> None:
    tried, removed = np.zeros(1 + max(Outcome), int), np.zeros(1 + max(Removal), int)
    tried[Outcome.START_COLLISION] = 10
    ways = ("candidates.method=normals", "objects.resting_poses=4", "hand=NAME")
    first = why_no_sample(tried, removed, load_config()).advice
    assert all(way in first for way in ways)
    config = load_config(overrides=["candidates.method=normals", "objects.resting_poses=3"])
    then = why_no_sample(tried, removed, config).advice
    assert [way in then for way in ways] == [False, False, True]
    assert "--candidates" in then
    tried[Outcome.SUCCESS] = removed[Removal.FLAT_DEPTH] = 2
    assert "filters.min_depth_variance=0`" in why_no_sample(tried, removed, config).advice


def test_refined_samples_are_samples(sound: Path) -> None:
    funnel = count_funnel(sound)
    funnel.removals[1, Removal.KEPT] = 0
    assert list(objects_without_samples(funnel, load_config())) == [funnel.names[1]]
    funnel.refined[1, 2] = 1
    assert not objects_without_samples(funnel, load_config())


def counts(train: int, valid: int, test: int) -> list[SplitCount]:
    numbers = {"train": train, "valid": valid, "test": test}
    return [
        SplitCount(split=name, samples=n, effective=float(n), objects=min(n, 1), classes=1)
        for name, n in numbers.items()
    ]


def test_split_that_is_not_as_asked_is_told() -> None:
    config = SplitConfig()
    told = split_shortfall(counts(24, 43, 8), "object", config)
    assert "train 32% (asked 75%), valid 57% (asked 10%), test 11% (asked 15%)" in told
    assert "3 have samples" in told
    assert "valid 0% (asked 10%)" in split_shortfall(counts(60, 0, 15), "object", config)
    assert split_shortfall(counts(75, 10, 15), "object", config) == ""
    none = SplitConfig(valid_fraction=0.0)
    assert split_shortfall(counts(85, 0, 15), "object", none) == ""

    # By class the test has the share that it has, but a part may be empty.
    assert split_shortfall(counts(20, 2, 90), "class", config) == ""
    assert "no sample is in valid." in split_shortfall(counts(4, 0, 2), "class", config)
    assert "no sample is for training" in split_shortfall(counts(0, 0, 9), "class", config)
    assert split_shortfall(counts(0, 0, 0), "class", config) == ""
