"""Postprocessing: which samples are for training, validation and test, by class or by object.

Pure functions of names and numbers. The rule by class is that of the paper (Veres et al.): one
object of each class is for testing. The rule by object is for meshes that are each a class of their
own; the rule by class would put all of these into the test split.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
import numpy.typing as npt

from drakegrasp.config import SplitConfig
from drakegrasp.seeding import Stream, object_key

Rule = Literal["class", "object"]
Rows = npt.NDArray[np.int64]


def split_rule(config: SplitConfig, classes: Sequence[str], groups: Sequence[str]) -> Rule:
    """Return the rule of the split: that of the configuration, or the rule that `auto` selects.

    `auto` selects the rule by object if no class has objects of two groups and `train_classes` is
    not given. Objects without samples count as well, so that the rule does not depend on which
    grasps held.

    Args:
        config: Configuration of the split.
        classes: Classes of the objects.
        groups: Group of each object, equal for objects of the same mesh, e.g. its morphs.
    """
    if config.by != "auto":
        return config.by
    one_each = len(set(zip(classes, groups, strict=True))) == len(set(classes))
    return "object" if one_each and config.train_classes is None else "class"


def may_train(class_name: str, count: int, config: SplitConfig) -> bool:
    """Return whether samples of a class of `count` objects may train or validate, by class."""
    if config.train_classes is None:
        return count > 1
    return class_name in config.train_classes


def split_samples(
    objects: npt.NDArray[np.int32],
    names: Sequence[str],
    classes: Sequence[str],
    groups: Sequence[str],
    config: SplitConfig,
    seed: int,
) -> dict[str, Rows]:
    """Return the indices of the samples of each split, in rising order.

    Args:
        objects: (n,), row of /objects of each sample.
        names: Names of the objects' meshes, by row; a mesh with several seeds counts as one object.
        classes: Classes of the objects, by row.
        groups: Groups of the objects, by row, see `split_rule`.
        config: The rule and the fractions of the splits.
        seed: Seed of the dataset.
    """
    if split_rule(config, classes, groups) == "object":
        return _split_by_object(objects, groups, config, seed)
    return _split_by_class(objects, names, classes, config, seed)


def _split_by_class(
    objects: npt.NDArray[np.int32],
    names: Sequence[str],
    classes: Sequence[str],
    config: SplitConfig,
    seed: int,
) -> dict[str, Rows]:
    """Return the indices of the samples of each split by class.

    From each class one object is drawn; all its samples are in the test split. A fraction of the
    samples of the other objects is in the validation split and the rest in the training split. A
    class is in the test split as a whole if only one of its objects has samples and `train_classes`
    does not name the class, or if `train_classes` leaves it out. A class with one object that
    `train_classes` names is not tested. The draw of a class depends only on its own objects.
    """
    # The objects that have samples, by class.
    members: dict[str, set[str]] = {}
    for index in np.unique(objects).tolist():
        members.setdefault(classes[index], set()).add(names[index])

    splits: Mapping[str, list[Rows]] = {"train": [], "valid": [], "test": []}
    for class_name in sorted(members):
        own = sorted(members[class_name])
        # A key of three numbers: it never equals the stream of a candidate of an object so named.
        stream = Stream(seed, object_key(class_name), 0, 1)
        # The test objects: one, all or none.
        if not may_train(class_name, len(own), config):
            tested, others = own, []
        elif len(own) < 2:
            tested, others = [], own
        else:
            tested = [own[int(stream.integers(len(own), 1)[0])]]
            others = [name for name in own if name not in tested]
        splits["test"].append(_rows_of(objects, names, tested))

        # The samples of the other objects, shuffled.
        pool = _rows_of(objects, names, others)
        shuffled = pool[stream.permutation(len(pool))]
        count = round(config.valid_fraction * len(pool))
        splits["valid"].append(shuffled[:count])
        splits["train"].append(shuffled[count:])
    empty = [np.zeros(0, dtype=np.int64)]
    return {name: np.sort(np.concatenate(empty + rows)) for name, rows in splits.items()}


def rank_in_split(group: str, seed: int) -> float:
    """Return the number in [0, 1) of a group of objects; groups with the lowest are tested.

    It is uniform over seeds, so about a fraction x of all groups has a number below x.
    """
    # Not the stream of a class, which may have the same name.
    return float(Stream(seed, object_key(group), 0, 2).uniform(1)[0])


def _split_by_object(
    objects: npt.NDArray[np.int32], groups: Sequence[str], config: SplitConfig, seed: int
) -> dict[str, Rows]:
    """Return the indices of the samples of each split by object.

    Each group of objects draws a number from the seed and its own name. The groups with samples are
    ordered by this number: the first ones are for testing, the last ones for validation, and those
    between for training. An additional group therefore moves at most one other group across each of
    the two borders, and none from test to validation or back.
    """
    # The groups that have samples, in the order of their numbers.
    present = {groups[i] for i in np.unique(objects).tolist()}
    ordered = sorted(present, key=lambda group: (rank_in_split(group, seed), group))

    tested, valid = _shares(len(ordered), config)
    last = len(ordered) - valid
    members = {"train": ordered[tested:last], "valid": ordered[last:], "test": ordered[:tested]}
    return {name: _rows_of(objects, groups, chosen) for name, chosen in members.items()}


def _rows_of(objects: npt.NDArray[np.int32], texts: Sequence[str], chosen: Sequence[str]) -> Rows:
    """Return the indices of the samples whose object's text is among the chosen ones."""
    return np.flatnonzero(np.isin(objects, [i for i, text in enumerate(texts) if text in chosen]))


def _shares(count: int, config: SplitConfig) -> tuple[int, int]:
    """Return the numbers of groups for test and validation: their fractions, but at least one.

    If there are few groups, one is for training before any is tested, and one is tested before any
    validates.
    """
    tested, valid = (
        max(1, round(share * count)) if share else 0
        for share in (config.test_fraction, config.valid_fraction)
    )
    while tested + valid > max(count - 1, 0):
        if valid >= tested:
            valid -= 1
        else:
            tested -= 1
    return tested, valid
