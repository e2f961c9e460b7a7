"""The split of made-up samples, by class and by object."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drakegrasp.config import SplitConfig
from drakegrasp.dataset.assembly.split import (
    may_train,
    split_rule,
    split_samples,
)

NAMES = ["a1", "a2", "a3", "b1", "c1", "c2"]
CLASSES = ["a", "a", "a", "b", "c", "c"]
OBJECTS = np.repeat(np.arange(6), 50).astype(np.int32)


@given(seed=st.integers(0, 2**32))
def test_split_is_a_partition_without_leaks(seed: int) -> None:
    split = split_samples(OBJECTS, NAMES, CLASSES, NAMES, SplitConfig(), seed)
    together = np.sort(np.concatenate(list(split.values())))
    assert np.array_equal(together, np.arange(len(OBJECTS)))
    tested = set(OBJECTS[split["test"]])
    assert not tested & set(OBJECTS[np.concatenate([split["train"], split["valid"]])])
    by_class = {c: {i for i in tested if CLASSES[i] == c} for c in set(CLASSES)}
    assert {c: len(found) for c, found in by_class.items()} == {"a": 1, "b": 1, "c": 1}
    assert len(split["valid"]) == 10 + 5


def test_split_depends_on_the_seed_and_on_nothing_else() -> None:
    one = split_samples(OBJECTS, NAMES, CLASSES, NAMES, SplitConfig(), 3)
    two = split_samples(OBJECTS, NAMES, CLASSES, NAMES, SplitConfig(), 3)
    assert all(np.array_equal(one[k], two[k]) for k in one)
    others = [
        split_samples(OBJECTS, NAMES, CLASSES, NAMES, SplitConfig(), s)["test"] for s in range(20)
    ]
    assert any(not np.array_equal(one["test"], other) for other in others)


def test_a_named_class_trains_with_its_only_object() -> None:
    split = split_samples(OBJECTS, NAMES, CLASSES, NAMES, SplitConfig(train_classes=("b",)), 0)
    trained = np.concatenate([split["train"], split["valid"]])
    assert set(OBJECTS[trained]) == {3}
    assert len(split["valid"]) == 5
    assert set(OBJECTS[split["test"]]) == {0, 1, 2, 4, 5}


@pytest.mark.parametrize(
    ("named", "count", "trains"),
    [(None, 1, False), (None, 2, True), (("a",), 1, True), (("b",), 9, False)],
)
def test_which_classes_train(named: tuple[str, ...] | None, count: int, trains: bool) -> None:
    assert may_train("a", count, SplitConfig(train_classes=named)) is trains


def test_another_class_does_not_change_a_classs_draw() -> None:
    whole = split_samples(OBJECTS, NAMES, CLASSES, NAMES, SplitConfig(), 1)
    part = split_samples(OBJECTS[:150], NAMES, CLASSES, NAMES, SplitConfig(), 1)
    assert np.array_equal(part["valid"], whole["valid"][whole["valid"] < 150])


def test_no_samples_make_empty_splits() -> None:
    split = split_samples(np.zeros(0, np.int32), [], [], [], SplitConfig(), 0)
    assert {k: len(v) for k, v in split.items()} == {"train": 0, "valid": 0, "test": 0}


@pytest.mark.parametrize(
    ("classes", "groups", "config", "rule"),
    [
        # auto: whether a class has objects of two meshes, and whether one is named.
        ("ab", "12", SplitConfig(), "object"),
        ("aab", "112", SplitConfig(), "object"),
        ("aab", "123", SplitConfig(), "class"),
        ("ab", "12", SplitConfig(train_classes=("a",)), "class"),
        # What is stated holds.
        ("ab", "12", SplitConfig(by="class"), "class"),
        ("aab", "123", SplitConfig(by="object"), "object"),
    ],
)
def test_auto_is_by_object_where_a_class_has_one_mesh(
    classes: str, groups: str, config: SplitConfig, rule: str
) -> None:
    assert split_rule(config, classes, groups) == rule


def by_object(
    groups: list[str], seed: int = 0, config: SplitConfig | None = None
) -> dict[str, set[str]]:
    """Return the groups in each split by object; each group is an object with three samples."""
    objects = np.repeat(np.arange(len(groups)), 3).astype(np.int32)
    config = config or SplitConfig(by="object")
    split = split_samples(objects, groups, groups, groups, config, seed)
    assert np.array_equal(np.sort(np.concatenate(list(split.values()))), np.arange(len(objects)))
    return {name: {groups[i] for i in objects[rows]} for name, rows in split.items()}


def meshes(count: int) -> list[str]:
    return [f"{i}_mesh" for i in range(count)]


@pytest.mark.parametrize(
    ("count", "numbers"),
    [(1, (1, 0, 0)), (2, (1, 0, 1)), (3, (1, 1, 1)), (9, (7, 1, 1)), (20, (15, 2, 3))],
)
def test_by_object_the_shares_are_of_objects_and_no_split_is_empty_early(
    count: int, numbers: tuple[int, int, int]
) -> None:
    """Train, valid and test: each has whole objects, and one before another has two."""
    split = by_object(meshes(count))
    assert tuple(len(split[name]) for name in ("train", "valid", "test")) == numbers
    assert sum(numbers) == len(set().union(*split.values()))


def test_by_object_a_share_may_be_large_or_nothing() -> None:
    large = by_object(meshes(3), config=SplitConfig(by="object", test_fraction=0.8))
    assert [len(members) for members in large.values()] == [1, 1, 1]
    none = SplitConfig(by="object", test_fraction=0, valid_fraction=0)
    assert by_object(meshes(3), config=none)["train"] == set(meshes(3))


@given(seed=st.integers(0, 2**32), count=st.integers(1, 30))
def test_by_object_one_object_more_moves_two_at_most(seed: int, count: int) -> None:
    before, after = by_object(meshes(count), seed), by_object(meshes(count + 1), seed)
    assert sum(len(before[name] - after[name]) for name in before) <= 2
    assert not before["test"] & after["valid"] and not before["valid"] & after["test"]


def test_by_object_the_seed_draws_and_the_order_of_the_objects_does_not() -> None:
    assert by_object(meshes(9), 1) == by_object(meshes(9)[::-1], 1)
    assert len({frozenset(by_object(meshes(9), seed)["test"]) for seed in range(20)}) > 3


def test_by_object_what_is_of_one_mesh_stays_together() -> None:
    groups = [name for name in meshes(3) for _ in range(2)]
    names = [f"{i}_morph" for i in range(6)]
    objects = np.repeat(np.arange(6), 4).astype(np.int32)
    split = split_samples(objects, names, names, groups, SplitConfig(by="object"), 0)
    found = {name: {groups[i] for i in objects[rows]} for name, rows in split.items()}
    assert found == by_object(meshes(3))


def test_by_object_what_has_no_samples_takes_no_place() -> None:
    names = meshes(9)
    objects = np.repeat([1, 4, 7], 5).astype(np.int32)
    split = split_samples(objects, names, names, names, SplitConfig(by="object"), 0)
    assert {name: len(rows) for name, rows in split.items()} == {"train": 5, "valid": 5, "test": 5}


@pytest.mark.parametrize(("pool", "valid"), [(7, 1), (23, 2), (26, 3), (4, 0), (6, 1)])
def test_share_of_validation_is_rounded_to_the_nearest(pool: int, valid: int) -> None:
    objects = np.zeros(pool, dtype=np.int32)
    config = SplitConfig(train_classes=("a",), valid_fraction=0.1)
    split = split_samples(objects, ["a1"], ["a"], ["a1"], config, 0)
    assert (len(split["train"]), len(split["valid"])) == (pool - valid, valid)
