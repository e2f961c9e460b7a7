"""Counts of a dataset, finished and not, and what is said of what it lacks."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.datasets import SUCCESS, TRIALS, change, make_dataset

from drakegrasp.cli.tables import approach_line, funnel_table, print_stats
from drakegrasp.dataset.assemble import assemble
from drakegrasp.dataset.schema import NOT_TRIED
from drakegrasp.dataset.statistics import Funnel, count_funnel, counts_as_dict
from drakegrasp.dataset.trials import Trials
from drakegrasp.filters import Removal
from drakegrasp.frames import invert_pose, make_pose, pack_pose, rotation_about, unpack_pose
from drakegrasp.outcomes import Outcome
from drakegrasp.pictures.figures import NUMBERS_FILE, write_figures


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


def test_objects_of_one_class_are_one_class(tmp_path: Path) -> None:
    """Two objects of three are boxes, and all three train."""
    shares = ("split.by=object", "split.test_fraction=0", "split.valid_fraction=0")
    out = make_dataset(tmp_path / "out", tmp_path / "meshes", overrides=shares)
    (train,) = (count for count in count_funnel(out).splits if count.split == "train")
    assert (train.samples, train.objects, train.classes) == (9, 3, 2)


# Grasps among other objects are counted alike by stats and figures


#: Labels of grasps among others, besides whether they were tried.
LABELS = ("free", "kept", "clean")


@pytest.mark.sim
def test_grasps_among_others_are_counted_by_surroundings(
    small_clutter: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """In text, as JSON and in the figures."""
    with h5py.File(small_clutter / "clutter.hdf5") as file:
        around = file["scenes/surroundings"].asstr()[:]
        grasps = {name: file["grasps"][name][:] for name in ("scene", "outcome", *LABELS)}
    tried = grasps["outcome"] != NOT_TRIED
    due = []
    for name in ("bin", "table"):
        own = (around == name)[grasps["scene"]]
        due.append(
            {
                "surroundings": name,
                "scenes": int((around == name).sum()),
                "grasps": int(own.sum()),
                "tried": int((own & tried).sum()),
                "neighbour_hit": int((own & (grasps["outcome"] == 19)).sum()),
                **{label: int((own & grasps[label]).sum()) for label in LABELS},
                "reachable": {},
            }
        )
    assert due[1]["grasps"] > due[1]["free"] >= due[1]["tried"] > due[1]["kept"] > 0

    assert counts_as_dict(small_clutter)["clutter"] == due
    written = write_figures(small_clutter, tmp_path)
    numbers = json.loads((tmp_path / NUMBERS_FILE).read_text())
    assert numbers["clutter"] == due and numbers["scenes"] == {"scenes": [0, 1, 2]}
    assert {"clutter", "scenes"} <= set(written.names) and (tmp_path / "scenes.png").is_file()
    print_stats(small_clutter)
    told = capsys.readouterr().out
    for each in due:
        free, tried, kept = each["free"], each["tried"], each["kept"]
        assert f"({each['surroundings']}): {free} of {each['grasps']} grasps free" in told
        assert f"of {tried} tried {kept} kept, {each['clean']} clean" in told


@pytest.mark.sim
def test_scenes_of_other_trials_are_not_counted(
    small_clutter: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The files were assembled again since: the rest is counted and drawn."""
    out = Path(shutil.copytree(small_clutter, tmp_path / "out"))
    write_figures(out, out / "figures")
    assemble(out, rejected=Trials(out).where(kept=True).trial_ids.tolist()[:1])
    print_stats(out)
    why = "must be of the trials in its folder, got other scenes; run `drakegrasp clutter` again"
    assert f"not counted: {out / 'clutter.hdf5'}: {why}" in capsys.readouterr().out
    left_out = write_figures(out, out / "figures").left_out
    assert set(left_out) == {"clutter", "scenes"} and why in left_out["clutter"]
    assert not (out / "figures/scenes.png").exists()


# The table of the funnel


def cells(funnel: Funnel) -> dict[str, str]:
    """Return the row of the first object by the heads of the columns."""
    columns = funnel_table(funnel).columns
    return {
        str(column.header).replace("\n", " "): str(next(iter(column.cells))) for column in columns
    }


def test_columns_of_the_funnel_add_up_to_the_attempts() -> None:
    """Each outcome of a build is in one column: here each has another power of two attempts."""
    built = [outcome for outcome in Outcome if not outcome.verification_only]
    outcomes = np.zeros((1, 1 + max(Outcome)), dtype=np.int64)
    outcomes[0, built] = 2 ** np.arange(len(built))
    removals = np.zeros((1, 1 + max(Removal)), dtype=np.int64)
    removals[0, [Removal.OTHER_LINKS, Removal.KEPT]] = 8, outcomes[0, Outcome.SUCCESS]
    none = np.zeros(1, dtype=np.int64)
    funnel = Funnel(
        names=("2_[box]",),
        classes=("box",),
        candidates=none + 1200,
        outcomes=outcomes,
        precision=none + 12,
        stable=none + 9,
        removals=removals,
        elevations=np.zeros((1, 3), dtype=np.int64),
        approach_cells=none,
        in_splits=np.zeros((1, 3), dtype=np.int64),
        distinct_in_splits=np.zeros((1, 3), dtype=np.int64),
    )
    row = cells(funnel)
    assert row["object"] == r"2_\[box]"  # rich prints it without the backslash
    other = {"poses": "1,200", "precision": "12", "stable": "9", "- other links": "8"}
    assert {name: row[name] for name in other} == other
    counts = list(row)[3 : 3 + len(built)]
    assert sorted(int(row[name].replace(",", "")) for name in counts) == [
        2**k for k in range(len(built))
    ]
    assert row["attempts"] == f"{outcomes.sum():,}" and "moved" in counts

    # Without one there is no column of lifts that were ended.
    outcomes[0, Outcome.MOVED] = 0
    assert "moved" not in cells(funnel)
