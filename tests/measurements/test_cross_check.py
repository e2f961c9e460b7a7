"""Stored lifts, tried again in MuJoCo: the draw and what is counted."""

from __future__ import annotations

import json
from collections import Counter

import h5py
import pytest
from click.testing import CliRunner
from cross_check import GROUPS, agreement, draw_lifts, main
from helpers.datasets import BOXES, SLIPPED, TRIALS, change, make_dataset
from scipy.stats import binomtest

from drakegrasp.filters import Removal
from drakegrasp.outcomes import Outcome


def names(file):
    return [name.decode() for name in file["objects/name"][:]]


def test_drawn_lifts_are_what_the_dataset_says(sound):
    lifts = draw_lifts(sound, 1000)
    # Per object three successes, and three lifts that were lost: slipped, dropped, on the table.
    assert len(lifts) == 6 * len(BOXES)
    assert len({lift.trial_id for lift in lifts}) == len(lifts)
    with h5py.File(sound / TRIALS) as file:
        removals = dict(zip(file["successes/trial_id"], file["successes/removal"], strict=True))
        for lift in lifts:
            row = lift.trial_id
            assert lift.outcome == file["trials/outcome"][row]
            assert lift.object_name == names(file)[file["trials/object"][row]]
            assert lift.pregrasp.X_OG[:3].ravel().tolist() == file["trials/X_OG"][row].tolist()
            assert lift.pregrasp.spread == file["trials/spread"][row]
            if lift.outcome is Outcome.SUCCESS:
                kept = removals[row] == Removal.KEPT
                assert lift.group == ("sample" if kept else "removed")
            else:
                assert lift.group == "lost"


def test_drawn_lifts_have_their_own_friction_and_mass(tmp_path):
    ranges = ("randomize.mass=[0.5,1.5]", "randomize.friction_hand=[0.7,1.3]")
    out = make_dataset(tmp_path / "data", tmp_path / "meshes", overrides=ranges)
    lifts = draw_lifts(out, 10)
    with h5py.File(out / TRIALS) as file:
        for lift in lifts:
            for name, value in vars(lift.materials).items():
                assert value == file[f"trials/{name}"][lift.trial_id]
    assert len({lift.materials for lift in lifts}) == len(lifts)


def test_lift_without_a_verdict_is_no_lost_one(sound, out):
    change(out, TRIALS, "trials/outcome", SLIPPED, lambda _: Outcome.MOVED)
    drawn = [{lift.trial_id for lift in draw_lifts(each, 1000)} for each in (sound, out)]
    assert drawn[0] - drawn[1] == {SLIPPED}


def test_groups_and_objects_take_turns(out):
    """With every second success removed, each group has lifts of each object."""
    with h5py.File(out / TRIALS, "r+") as file:
        file["successes/removal"][::3] = Removal.OUTLIER
    lifts = draw_lifts(out, 9)
    assert set(Counter((lift.group, lift.object_name) for lift in lifts).values()) == {1}
    assert Counter(lift.group for lift in lifts) == dict.fromkeys(GROUPS, 3)
    # A group that is empty leaves its turn to the others.
    with h5py.File(out / TRIALS, "r+") as file:
        file["successes/removal"][:] = Removal.OUTLIER
    assert Counter(lift.group for lift in draw_lifts(out, 9)) == {"removed": 5, "lost": 4}


def test_agreement_counts_what_is_lifted_there():
    def row(there, tried):
        return {"there": there.label, "tried": tried}

    rows = [
        *[row(Outcome.SUCCESS, True)] * 3,
        row(Outcome.TABLE_CONTACT, True),
        *[row(Outcome.MISSING_FINGERTIP, False)] * 2,
        row(Outcome.TABLE_CONTACT, False),
    ]
    found = agreement(rows)
    assert (found["drawn"], found["tried"], found["lifted"]) == (7, 4, 3)
    assert found["not_tried"] == {"missing_fingertip": 2, "table_contact": 1}
    for of, count in (("of_all", 7), ("of_tried", 4)):
        share = found[of]
        assert share["share"] == 3 / count
        assert (share["low"], share["high"]) == binomtest(3, count).proportion_ci(method="wilson")
    assert agreement(rows[4:])["of_all"]["share"] == 0.0
    assert agreement(rows[4:])["of_tried"] is None
    assert agreement([])["of_all"] is None


@pytest.mark.sim
def test_command_prints_the_agreement(sound, tmp_path):
    pytest.importorskip("mujoco")
    pytest.importorskip("coacd")
    path = tmp_path / "report.json"
    result = CliRunner().invoke(main, [str(sound), "6", "--out", str(path)])
    assert result.exit_code == 0, result.output
    report = json.loads(path.read_text())
    assert [row["trial_id"] for row in report["lifts"]] == sorted(
        lift.trial_id for lift in draw_lifts(sound, 6)
    )
    assert sum(counts["drawn"] for counts in report["groups"].values()) == 6
    assert report["drive"] == "worm"
    assert json.loads(result.stdout)["versions"]["mujoco"] == report["versions"]["mujoco"]
