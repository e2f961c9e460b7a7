"""Counts of a dataset, finished and not, and what is said of what it lacks."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.datasets import MISSING, SLIPPED, SUCCESS, TRIALS, change, make_dataset
from helpers.hands import write_with_preshapes

from drakegrasp.cli.tables import approach_line, funnel_table, unfinished_line
from drakegrasp.config import SplitConfig
from drakegrasp.dataset.assemble import assemble
from drakegrasp.dataset.card import card_content
from drakegrasp.dataset.manifest import read_manifest, write_manifest
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.schema import NO_PRESHAPE, SPLITS
from drakegrasp.dataset.statistics import (
    NO_NAME,
    PreshapeCount,
    SplitCount,
    count_funnel,
    count_splits,
    count_unfinished,
    counts_as_dict,
    objects_without_samples,
    preshapes_of,
    split_shortfall,
    why_no_sample,
)
from drakegrasp.dataset.trials import NONE
from drakegrasp.errors import DataError
from drakegrasp.filters import Removal
from drakegrasp.frames import invert_pose, make_pose, pack_pose, rotation_about, unpack_pose
from drakegrasp.hand.settings import load_config
from drakegrasp.outcomes import Outcome
from drakegrasp.page.catalog import read_snapshot
from drakegrasp.pictures.figures import NUMBERS_FILE, write_figures


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


def test_build_with_a_target_runs_as_many_units_as_it_needs(out: Path) -> None:
    """Its number of units is not known before; what was tried is counted, not what was drawn."""
    (out / "shards/2_box_b/0000002-0000004.h5").unlink()
    manifest = read_manifest(out)
    manifest = replace(manifest, config=manifest.config.model_copy(update={"samples": 9}))
    write_manifest(manifest, out)
    unfinished = count_unfinished(out)
    assert unfinished is not None
    assert (unfinished.done, unfinished.total) == (5, None)
    assert unfinished.funnel.candidates.tolist() == [4, 2, 4]
    assert unfinished_line(unfinished) == (
        "not finished: 5 work units are done; samples are chosen at the end"
    )
    assert counts_as_dict(out)["unfinished"] == {"done": 5, "total": None}

    # When it is met, the number is known.
    met = tuple(replace(entry, tried=2) for entry in manifest.objects)
    write_manifest(replace(manifest, objects=met), out)
    unfinished = count_unfinished(out)
    assert unfinished is not None
    assert (unfinished.done, unfinished.total) == (3, 3)
    assert "`drakegrasp assemble` writes them" in unfinished_line(unfinished)


def test_attempts_are_counted_by_preshape(out: Path, tmp_path: Path) -> None:
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


def test_samples_are_as_many_wherever_they_are_counted(
    out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def leave_out(*_: object) -> None:
        raise DataError("it counts no samples")

    for name in ("_approaches", "_distributions"):
        monkeypatch.setattr(f"drakegrasp.pictures.figures.{name}", leave_out)

    # The data file says which are samples.
    found: Counter[str] = Counter()
    for split in SPLITS:
        data = GraspDataset(out / "grasping_oto.hdf5", split=split)
        found.update(map(str, data.column("object_props/object_name")))
    funnel = count_funnel(out)
    assert dict(zip(funnel.names, funnel.samples.tolist(), strict=True)) == found
    total = found.total()
    assert sum(row.samples for row in count_splits(out)) == total

    # The table, and `stats --json`.
    columns = {column.header: column for column in funnel_table(funnel).columns}
    last = dict(zip(columns["object"].cells, columns["samples"].cells, strict=True))
    assert last == {**{name: str(n) for name, n in found.items()}, "all": str(total)}
    counts = counts_as_dict(out)
    assert {each["name"]: each["samples"] for each in counts["objects"]} == found

    # The card, the figures and the page.
    card = card_content(out)["counts"]
    assert {name: row["samples"] for name, row in card["objects"].items()} == found
    assert card["all"]["samples"] == total
    write_figures(out, tmp_path / "figures")
    numbers = json.loads((tmp_path / "figures" / NUMBERS_FILE).read_text())
    assert {name: row["samples"] for name, row in numbers["objects"].items()} == found
    assert numbers["hold"]["samples"] == numbers["outcomes"]["samples"] == total
    distinct = sum(row.distinct for row in count_splits(out))
    assert numbers["hold"]["distinct"] == distinct
    assert sum(row["distinct"] for row in numbers["objects"].values()) == distinct
    assert np.count_nonzero(read_snapshot(out).table.split != NONE) == total


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


def test_samples_that_are_distinct_are_counted(out: Path) -> None:
    """Of the first object one from above, one 15 mm beside it, and one from the side."""
    with h5py.File(out / TRIALS) as file:
        rows = file["successes/trial_id"][:]
        rows = rows[file["trials/object"][:][rows] == 0]
        X_OT = invert_pose(unpack_pose(file["trials/X_TO"][int(rows[0])]))
    before = count_funnel(out)
    from_above, from_the_side = (rotation_about([1, 0, 0], np.deg2rad(a)) for a in (180, 90))
    for row, R_TG, x in zip(
        rows, (from_above, from_above, from_the_side), (0, 0.015, 0), strict=True
    ):
        X_OG = pack_pose(X_OT @ make_pose(R_TG, [x, 0.0, 0.3]))
        change(out, TRIALS, "trials/X_OG", int(row), lambda _, to=X_OG: to)

    funnel = count_funnel(out)
    assert funnel.samples.tolist() == [3, 3, 3]
    assert funnel.elevations[0].tolist() == [1, 0, 1]
    assert (funnel.distinct[0], funnel.approach_cells[0]) == (2, 2)
    assert funnel.elevations[1:].tolist() == before.elevations[1:].tolist()
    total = int(funnel.distinct.sum())

    # In the table and its line, of each split, in JSON and on the card.
    table = funnel_table(funnel)
    assert list(table.columns[-1].cells) == [*map(str, funnel.distinct.tolist()), str(total)]
    assert approach_line(funnel).startswith(f"{total} distinct grasps in ")
    assert sum(split.distinct for split in count_splits(out)) == total
    said = counts_as_dict(out)
    assert said["objects"][0]["distinct"] == said["objects"][0]["approach_cells"] == 2
    assert said["objects"][0]["elevations"] == {"0-30": 1, "30-60": 0, "60-90": 1}
    assert sum(split["distinct"] for split in said["splits"]) == total
    card = card_content(out)["counts"]
    assert card["objects"]["1_box_a"]["distinct"] == 2
    assert card["all"]["distinct"] == sum(card["approaches"]["elevations"].values()) == total
    assert sum(split["distinct"] for split in card["splits"].values()) == total

    # In another resting pose it is another grasp.
    change(out, TRIALS, "trials/resting", int(rows[1]), lambda _: 1)
    assert count_funnel(out).distinct[0] == 3


def test_splits_are_counted(out: Path) -> None:
    """By object each has one; by class the only one of a class is tested, and one of two others."""
    assert [(c.samples, c.objects, c.classes) for c in count_splits(out)] == 3 * [(3, 1, 1)]
    assemble(out, overrides=["split.by=class"])
    counts = {c.split: (c.samples, c.objects, c.classes) for c in count_splits(out)}
    assert counts["test"] == (6, 2, 2)
    assert counts["train"][0] + counts["valid"][0] == 3
    assert counts["train"][1:] == counts["valid"][1:] == (1, 1)


def test_objects_of_one_class_are_one_class(tmp_path: Path) -> None:
    """Two objects of three are boxes, and all three train."""
    shares = ("split.by=object", "split.test_fraction=0", "split.valid_fraction=0")
    out = make_dataset(tmp_path / "out", tmp_path / "meshes", overrides=shares)
    (train,) = (count for count in count_splits(out) if count.split == "train")
    assert (train.samples, train.objects, train.classes) == (9, 3, 2)


@pytest.mark.parametrize(
    ("outcomes", "removals", "reason"),
    [
        (
            {Outcome.START_COLLISION: 842, Outcome.SCREENED: 358},
            {},
            "842 of 1,200 attempts (70%) end in start_collision, "
            f"{Outcome.START_COLLISION.text}; the hand never closed on it",
        ),
        ({Outcome.SCREENED: 9, Outcome.HAND_CONTACT: 1}, {}, "; closed: 1, none lifted"),
        ({Outcome.START_COLLISION: 9, Outcome.MOVED: 3}, {}, "; lifted: 3, none held"),
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


def test_objects_without_samples_are_named(sound: Path) -> None:
    funnel = count_funnel(sound)
    assert not objects_without_samples(funnel, load_config())
    funnel.removals[1, Removal.KEPT] = 0
    assert list(objects_without_samples(funnel, load_config())) == [funnel.names[1]]


def counts(train: int, valid: int, test: int) -> list[SplitCount]:
    numbers = {"train": train, "valid": valid, "test": test}
    return [
        SplitCount(split=name, samples=n, distinct=n, objects=min(n, 1), classes=1)
        for name, n in numbers.items()
    ]


def test_split_that_is_not_as_asked_is_told() -> None:
    config = SplitConfig()
    (told,) = split_shortfall(counts(24, 43, 8), "object", config)
    assert "train 32% (75%), valid 57% (10%), test 11% (15%)" in told
    assert "3 objects have samples" in told
    assert split_shortfall(counts(75, 10, 15), "object", config) == []

    # By class the test has the share that it has.
    assert split_shortfall(counts(20, 2, 90), "class", config) == []


def test_each_empty_split_has_a_line() -> None:
    config, none = SplitConfig(), SplitConfig(valid_fraction=0.0)
    few = "has samples, and three fill all splits"
    assert split_shortfall(counts(60, 0, 0), "object", config) == [
        f"split {name} is empty: 1 object {few}" for name in ("valid", "test")
    ]
    # There are enough objects, but they were in other splits.
    more = [replace(count, objects=3 * count.objects) for count in counts(60, 0, 15)]
    (line,) = split_shortfall(more, "object", config)
    assert line.startswith("split valid is empty: objects stay in the split in which they were ")
    assert "assemble OUT --set split.seed=1" in line
    assert split_shortfall(counts(85, 0, 15), "object", none) == []

    # By class, too.
    (line,) = split_shortfall(counts(4, 0, 2), "class", config)
    assert line.startswith("split valid is empty: more samples ")
    (train, valid) = split_shortfall(counts(0, 0, 9), "class", config)
    assert train.startswith("split train is empty: a class trains if two of its objects ")
    assert valid.startswith("split valid is empty: ")
    assert split_shortfall(counts(0, 0, 0), "class", config) == []
