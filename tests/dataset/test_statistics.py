"""Counts of a dataset, finished and not."""

from __future__ import annotations

from pathlib import Path

import h5py
import pytest
from helpers.datasets import MISSING, SLIPPED, SUCCESS, TRIALS, change, make_dataset
from helpers.hands import write_with_preshapes

from drakegrasp.dataset.assemble import assemble
from drakegrasp.dataset.schema import NO_PRESHAPE
from drakegrasp.dataset.statistics import (
    NO_NAME,
    PreshapeCount,
    count_funnel,
    count_splits,
    count_unfinished,
    preshapes_of,
    why_no_samples,
)
from drakegrasp.hand.settings import load_config
from drakegrasp.outcomes import Outcome, Removal


def test_words_are_counted_by_object(out: Path) -> None:
    """Of the nine successes two of the first object lose a word; a lost lift never has one."""
    change(out, TRIALS, "trials/stable", SUCCESS, lambda _: False)
    change(out, TRIALS, "trials/precision", SUCCESS, lambda _: False)
    change(out, TRIALS, "trials/stable", 3, lambda _: False)
    funnel = count_funnel(out)
    assert funnel.outcomes[:, Outcome.SUCCESS].tolist() == [3, 3, 3]
    assert funnel.precision.tolist() == [2, 3, 3]
    assert funnel.stable.tolist() == [1, 3, 3]
    assert SLIPPED not in (SUCCESS, 3)


def test_words_of_a_build_that_runs_are_those_of_its_shards(out: Path) -> None:
    """The second shard of an object has one of its successes."""
    (out / TRIALS).unlink()
    (out / "shards/2_box_b/0000002-0000004.h5").unlink()
    unfinished = count_unfinished(out)
    assert unfinished is not None
    assert unfinished.funnel.precision.tolist() == [3, 2, 3]
    assert unfinished.funnel.stable.tolist() == [3, 2, 3]
    assert not unfinished.funnel.removals[:, Removal.KEPT].any()


def test_audited_attempts_of_the_first_round_are_counted(out: Path) -> None:
    """Of the first object a sample, a lost lift and a missed one; the fourth is refined."""
    for row in (SUCCESS, SLIPPED, MISSING, 3):
        change(out, TRIALS, "trials/audited", row, lambda _: True)
    change(out, TRIALS, "trials/generation", 3, lambda _: 1)
    assert count_funnel(out).audited.tolist() == [[2, 1, 1, 1], [0] * 4, [0] * 4]


def test_attempts_of_the_first_round_are_counted_by_preshape(out: Path, tmp_path: Path) -> None:
    """Of the second preshape a success that is stable and one that is not, and a missed attempt."""
    for row in (SUCCESS, 3, MISSING):
        change(out, TRIALS, "trials/preshape", row, lambda _: 1)
    change(out, TRIALS, "trials/stable", 3, lambda _: False)
    change(out, TRIALS, "trials/preshape", SLIPPED, lambda _: NO_PRESHAPE)
    funnel = count_funnel(out)
    hand = write_with_preshapes(tmp_path, all="F1 F2 F3", pair="F1 F3")
    counts = preshapes_of(funnel, load_config(overrides=[f"hand={hand}"]))
    assert counts == [
        PreshapeCount("all", 32, 7, 7, 7),
        PreshapeCount("pair", 3, 2, 1, 2),
        PreshapeCount(NO_NAME, 1, 0, 0, 0),
    ]
    assert preshapes_of(funnel, load_config()) == []
    change(out, TRIALS, "trials/generation", 3, lambda _: 1)
    assert count_funnel(out).preshapes[1].tolist() == [2, 1, 1, 1]


def test_removals_are_counted_by_object(out: Path) -> None:
    """Two grasps of the second object are rejected, and one of the third slides."""
    with h5py.File(out / TRIALS) as file:
        rows = file["successes/trial_id"][:]
        objects = file["trials/object"][:][rows]
    assemble(out, rejected=rows[objects == 1][:2].tolist())
    removals = count_funnel(out).removals
    assert removals[:, Removal.KEPT].tolist() == [3, 1, 3]
    assert removals[:, Removal.REJECTED].tolist() == [0, 2, 0]
    assert removals.sum() == len(rows)


def test_outcomes_are_counted_by_object(out: Path) -> None:
    """One attempt of the third object has another outcome than its row in the others."""
    with h5py.File(out / TRIALS) as file:
        last = len(file["trials/outcome"]) - 1
        before = Outcome(int(file["trials/outcome"][last]))
    change(out, TRIALS, "trials/outcome", last, lambda _: Outcome.CRASHED)
    outcomes = count_funnel(out).outcomes
    assert outcomes.sum(axis=1).tolist() == [12, 12, 12]
    assert outcomes[:, Outcome.CRASHED].tolist() == [0, 0, 1]
    assert outcomes[2, before] == outcomes[1, before] - 1


def test_splits_are_counted(out: Path) -> None:
    """A class with one object is tested whole; of the other class one object is."""
    counts = {c.split: (c.samples, c.objects, c.classes) for c in count_splits(out)}
    assert counts["test"] == (6, 2, 2)
    assert counts["train"][0] + counts["valid"][0] == 3
    assert counts["train"][1:] == counts["valid"][1:] == (1, 1)


@pytest.mark.parametrize(
    ("outcomes", "removals", "why"),
    [
        ({Outcome.START_COLLISION: 8, Outcome.SCREENED: 2}, {}, "never reached, the open hand"),
        ({Outcome.START_COLLISION: 2, Outcome.SCREENED: 8}, {}, "never reached: no palm pose"),
        ({Outcome.SCREENED: 9, Outcome.HAND_CONTACT: 1}, {}, "never gripped: the hand closed 1 "),
        ({Outcome.HAND_CONTACT: 9, Outcome.MOVED: 3}, {}, "always lost: 3 lifts"),
        ({Outcome.HAND_CONTACT: 9, Outcome.NOT_LIFTED: 3}, {}, "never lifted: 3 hands"),
        ({Outcome.DROPPED: 9, Outcome.SUCCESS: 2}, {Removal.TURNED: 2}, "2 held, none a sample"),
    ],
)
def test_object_without_samples_says_how_far_it_came(
    sound: Path, outcomes: dict[Outcome, int], removals: dict[Removal, int], why: str
) -> None:
    funnel = count_funnel(sound)
    assert not why_no_samples(funnel)
    for counts, row in ((funnel.outcomes, outcomes), (funnel.removals, removals)):
        counts[1] = 0
        counts[1, list(row)] = list(row.values())
    assert list(why_no_samples(funnel)) == [funnel.names[1]]
    assert why_no_samples(funnel)[funnel.names[1]].startswith(why)


def test_objects_of_one_class_are_one_class(tmp_path: Path) -> None:
    """Two objects of three are boxes, and all three train."""
    shares = ("split.by=object", "split.test_fraction=0", "split.valid_fraction=0")
    out = make_dataset(tmp_path / "out", tmp_path / "meshes", *shares)
    (train,) = (count for count in count_splits(out) if count.split == "train")
    assert (train.samples, train.objects, train.classes) == (9, 3, 2)
