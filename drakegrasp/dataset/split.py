"""Postprocessing: which samples are for training, validation and test, by class or by object.

Pure functions of names and numbers. The rule by class is that of the paper (Veres et al.): one
object of each class is for testing. By object, whole objects are drawn among those that have
samples, and once an object is in a split, it stays there.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Literal, TypeAlias, get_args

import numpy as np
import numpy.typing as npt

from drakegrasp.config import SplitConfig
from drakegrasp.seeding import Draw, Stream, object_key

#: A split, and the splits in the order of the files.
Home: TypeAlias = Literal["train", "valid", "test"]
SPLIT_NAMES: tuple[Home, ...] = get_args(Home)
Rows = npt.NDArray[np.int64]


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
    homes: Mapping[str, Home],
    config: SplitConfig,
    seed: int,
) -> dict[str, Rows]:
    """Return the indices of the samples of each split, in rising order.

    Args:
        objects: (n,), row of /objects of each sample.
        names: Names of the objects, by row.
        classes: Classes of the objects, by row.
        groups: Groups of the objects, by row, equal for variants of the same mesh.
        homes: Split of each group of a split by object, see `find_homes`.
        config: The rule and the fractions of the splits.
        seed: Seed of the dataset, which draws the split by class.
    """
    if config.by == "class":
        return _split_by_class(objects, names, classes, config, seed)
    members = {split: [g for g, home in homes.items() if home == split] for split in SPLIT_NAMES}
    return {split: _rows_of(objects, groups, chosen) for split, chosen in members.items()}


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
        stream = Stream(seed, object_key(class_name), 0, Draw.SPLIT_OF_CLASS)
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
    return float(Stream(seed, object_key(group), 0, Draw.SPLIT_OF_GROUP).uniform(1)[0])


def home_by_rank(group: str, config: SplitConfig) -> Home:
    """Return the split of a group of objects without samples, in a split by object."""
    rank = rank_in_split(group, config.seed)
    if rank < config.test_fraction:
        return "test"
    return "valid" if rank >= 1.0 - config.valid_fraction else "train"


def find_homes(
    present: Collection[str], known: Mapping[str, Home], config: SplitConfig
) -> dict[str, Home]:
    """Return the split of each group of objects that has samples, in a split by object.

    A group that is in a split stays there. The others fill up the fractions of the groups: each
    draws a number from its name, the lowest are for testing and the highest for validation.

    Args:
        present: Groups that have samples.
        known: Splits of groups that have been in a split before.
        config: The fractions, and the seed of the draw.
    """
    homes = {group: known[group] for group in present if group in known}
    new = sorted(set(present) - set(homes), key=lambda g: (rank_in_split(g, config.seed), g))
    splits = list(homes.values())

    # At least one group is for training before any other is tested or validates.
    tested, valid = _shares(len(present), config)
    room = len(new) - ("train" not in splits)
    tested = max(0, min(tested - splits.count("test"), room))
    valid = max(0, min(valid - splits.count("valid"), room - tested))
    last = len(new) - valid
    for i, group in enumerate(new):
        homes[group] = "test" if i < tested else "valid" if i >= last else "train"
    return homes


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
