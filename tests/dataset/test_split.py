"""The split of made-up samples, by class and by object."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drakegrasp.config import SplitConfig
from drakegrasp.dataset.split import SPLIT_NAMES, Home, find_homes, split_samples

BY_CLASS = SplitConfig(by="class")
NAMES = ["a1", "a2", "a3", "b1", "c1", "c2"]
CLASSES = ["a", "a", "a", "b", "c", "c"]
OBJECTS = np.repeat(np.arange(6), 50).astype(np.int32)


@given(seed=st.integers(0, 2**32))
def test_split_is_a_partition_without_leaks(seed: int) -> None:
    split = split_samples(OBJECTS, NAMES, CLASSES, NAMES, {}, BY_CLASS, seed)
    together = np.sort(np.concatenate(list(split.values())))
    assert np.array_equal(together, np.arange(len(OBJECTS)))
    tested = set(OBJECTS[split["test"]])
    assert not tested & set(OBJECTS[np.concatenate([split["train"], split["valid"]])])
    by_class = {c: {i for i in tested if CLASSES[i] == c} for c in set(CLASSES)}
    assert {c: len(found) for c, found in by_class.items()} == {"a": 1, "b": 1, "c": 1}
    assert len(split["valid"]) == 10 + 5


def test_split_depends_on_the_seed_and_on_nothing_else() -> None:
    one = split_samples(OBJECTS, NAMES, CLASSES, NAMES, {}, BY_CLASS, 3)
    two = split_samples(OBJECTS, NAMES, CLASSES, NAMES, {}, BY_CLASS, 3)
    assert all(np.array_equal(one[k], two[k]) for k in one)
    others = [
        split_samples(OBJECTS, NAMES, CLASSES, NAMES, {}, BY_CLASS, s)["test"] for s in range(20)
    ]
    assert any(not np.array_equal(one["test"], other) for other in others)


def test_a_named_class_trains_with_its_only_object() -> None:
    config = SplitConfig(by="class", train_classes=("b",))
    split = split_samples(OBJECTS, NAMES, CLASSES, NAMES, {}, config, 0)
    trained = np.concatenate([split["train"], split["valid"]])
    assert set(OBJECTS[trained]) == {3}
    assert len(split["valid"]) == 5
    assert set(OBJECTS[split["test"]]) == {0, 1, 2, 4, 5}


def test_another_class_does_not_change_a_classs_draw() -> None:
    whole = split_samples(OBJECTS, NAMES, CLASSES, NAMES, {}, BY_CLASS, 1)
    part = split_samples(OBJECTS[:150], NAMES, CLASSES, NAMES, {}, BY_CLASS, 1)
    assert np.array_equal(part["valid"], whole["valid"][whole["valid"] < 150])


def test_no_samples_make_empty_splits() -> None:
    split = split_samples(np.zeros(0, np.int32), [], [], [], {}, BY_CLASS, 0)
    assert {k: len(v) for k, v in split.items()} == {"train": 0, "valid": 0, "test": 0}


@pytest.mark.parametrize(("pool", "valid"), [(7, 1), (23, 2), (26, 3), (4, 0), (6, 1)])
def test_share_of_validation_is_rounded_to_the_nearest(pool: int, valid: int) -> None:
    objects = np.zeros(pool, dtype=np.int32)
    config = SplitConfig(by="class", train_classes=("a",), valid_fraction=0.1)
    split = split_samples(objects, ["a1"], ["a"], ["a1"], {}, config, 0)
    assert (len(split["train"]), len(split["valid"])) == (pool - valid, valid)


def meshes(count: int) -> list[str]:
    return [f"{i}_mesh" for i in range(count)]


def members(homes: Mapping[str, Home]) -> dict[str, set[str]]:
    """Return the groups of each split."""
    return {name: {g for g, home in homes.items() if home == name} for name in SPLIT_NAMES}


def numbers(homes: Mapping[str, Home]) -> tuple[int, ...]:
    """Return the numbers of groups in train, valid and test."""
    return tuple(map(len, members(homes).values()))


@pytest.mark.parametrize(
    ("count", "due"),
    [(1, (1, 0, 0)), (2, (1, 0, 1)), (3, (1, 1, 1)), (9, (7, 1, 1)), (20, (15, 2, 3))],
)
def test_shares_are_of_objects_and_three_fill_all_splits(
    count: int, due: tuple[int, int, int]
) -> None:
    assert numbers(find_homes(meshes(count), {}, SplitConfig())) == due


def test_a_share_may_be_large_or_nothing() -> None:
    large = SplitConfig(test_fraction=0.8)
    assert numbers(find_homes(meshes(3), {}, large)) == (1, 1, 1)
    none = SplitConfig(test_fraction=0, valid_fraction=0)
    assert numbers(find_homes(meshes(3), {}, none)) == (3, 0, 0)


@given(seed=st.integers(0, 2**32), steps=st.lists(st.integers(1, 9), min_size=2, max_size=5))
def test_who_is_in_a_split_stays_there_whatever_comes(seed: int, steps: list[int]) -> None:
    """However a dataset grows, its shares are as if it had been drawn at once, or one beside."""
    config, homes, count = SplitConfig(seed=seed), dict[str, Home](), 0
    for more in steps:
        count += more
        grown = find_homes(meshes(count), homes, config)
        assert homes.items() <= grown.items()
        homes = grown
        at_once = numbers(find_homes(meshes(count), {}, config))
        assert all(abs(a - b) <= 1 for a, b in zip(numbers(homes), at_once, strict=True))
        assert count < 3 or min(numbers(homes)) > 0


def test_what_has_no_samples_any_more_takes_no_place_and_keeps_its_own() -> None:
    a, b, c, d = meshes(4)
    known: dict[str, Home] = {a: "test", b: "train", c: "valid"}
    homes = find_homes([b, c, d], known, SplitConfig())
    assert homes == {b: "train", c: "valid", d: "test"}
    assert find_homes([a, b, c, d], known | homes, SplitConfig())[a] == "test"


def test_something_trains_before_it_is_tested() -> None:
    a, b, c = meshes(3)
    homes = find_homes([a, b, c], {a: "test"}, SplitConfig())
    assert numbers(homes) == (1, 1, 1)
    assert find_homes([a, b], {a: "test"}, SplitConfig())[b] == "train"


def test_seed_draws_and_order_does_not() -> None:
    nine = meshes(9)
    config = SplitConfig(seed=1)
    assert find_homes(nine, {}, config) == find_homes(nine[::-1], {}, config)
    drawn = (members(find_homes(nine, {}, SplitConfig(seed=s)))["test"] for s in range(20))
    assert len(set(map(frozenset, drawn))) > 3


def test_samples_are_where_their_group_is() -> None:
    """Six objects of three groups; each has four samples."""
    groups = [name for name in meshes(3) for _ in range(2)]
    names, objects = meshes(6), np.repeat(np.arange(6), 4).astype(np.int32)
    homes: dict[str, Home] = dict(zip(meshes(3), ("test", "train", "valid"), strict=True))
    split = split_samples(objects, names, names, groups, homes, SplitConfig(), 0)
    rows = {name: own.tolist() for name, own in split.items()}
    assert rows == {"train": [*range(8, 16)], "valid": [*range(16, 24)], "test": [*range(8)]}
