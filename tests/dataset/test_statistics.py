"""Counts of a dataset, finished and not, and what is said of what it lacks."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
from helpers.datasets import SUCCESS, TRIALS, change, make_dataset

from drakegrasp.cli.tables import approach_line, funnel_table
from drakegrasp.dataset.assemble import assemble
from drakegrasp.dataset.statistics import (
    count_funnel,
    counts_as_dict,
)
from drakegrasp.filters import Removal
from drakegrasp.frames import invert_pose, make_pose, pack_pose, rotation_about, unpack_pose
from drakegrasp.outcomes import Outcome


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


def test_outcomes_and_words_are_counted_by_object(out: Path) -> None:
    """One attempt of the third object has another outcome than its row in the others."""
    with h5py.File(out / TRIALS) as file:
        last = len(file["trials/outcome"]) - 1
        before = Outcome(int(file["trials/outcome"][last]))
    change(out, TRIALS, "trials/outcome", last, lambda _: Outcome.CRASHED)
    # A palm pose is counted once, at its first stand-off.
    change(out, TRIALS, "trials/standoff_index", 0, lambda _: 1)
    # Of the successes of the first object two lose a word.
    for word, row in (("stable", SUCCESS), ("precision", SUCCESS), ("stable", 3)):
        change(out, TRIALS, f"trials/{word}", row, lambda _: False)
    funnel = count_funnel(out)
    outcomes = funnel.outcomes
    assert funnel.candidates.tolist() == [3, 4, 4]
    assert outcomes.sum(axis=1).tolist() == [12, 12, 12]
    assert outcomes[:, Outcome.CRASHED].tolist() == [0, 0, 1]
    assert outcomes[2, before] == outcomes[1, before] - 1
    assert (funnel.precision[:2].tolist(), funnel.stable[:2].tolist()) == ([2, 3], [1, 3])


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

    # In the table and its line, of each split, and in JSON.
    table = funnel_table(funnel)
    assert list(table.columns[-1].cells) == [*map(str, funnel.distinct.tolist()), str(total)]
    assert approach_line(funnel).startswith(f"{total} distinct grasps in ")
    assert sum(split.distinct for split in count_funnel(out).splits) == total
    said = counts_as_dict(out)
    assert said["objects"][0]["distinct"] == said["objects"][0]["approach_cells"] == 2
    assert said["objects"][0]["elevations"] == {"0-30": 1, "30-60": 0, "60-90": 1}
    assert sum(split["distinct"] for split in said["splits"]) == total

    # In another resting pose it is another grasp.
    change(out, TRIALS, "trials/resting", int(rows[1]), lambda _: 1)
    assert count_funnel(out).distinct[0] == 3


def test_splits_are_counted(out: Path) -> None:
    """By object each has one; by class the only one of a class is tested, and one of two others."""
    assert [(c.samples, c.objects, c.classes) for c in count_funnel(out).splits] == 3 * [(3, 1, 1)]
    assemble(out, overrides=["split.by=class"])
    counts = {c.split: (c.samples, c.objects, c.classes) for c in count_funnel(out).splits}
    assert counts["test"] == (6, 2, 2)
    assert counts["train"][0] + counts["valid"][0] == 3
    assert counts["train"][1:] == counts["valid"][1:] == (1, 1)


def test_objects_of_one_class_are_one_class(tmp_path: Path) -> None:
    """Two objects of three are boxes, and all three train."""
    shares = ("split.by=object", "split.test_fraction=0", "split.valid_fraction=0")
    out = make_dataset(tmp_path / "out", tmp_path / "meshes", overrides=shares)
    (train,) = (count for count in count_funnel(out).splits if count.split == "train")
    assert (train.samples, train.objects, train.classes) == (9, 3, 2)
