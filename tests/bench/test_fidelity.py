"""Labels of the same attempts, simulated in other ways."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest
from helpers.objects import CUBE, box_model

from drakegrasp.bench import fidelity
from drakegrasp.generation.attempts import TrialSetup
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.settings import load_config
from drakegrasp.mesh.surfaces import signed_volume
from drakegrasp.outcomes import Outcome


def bench_of(*overrides):
    return TrialSetup(prepared=None, config=load_config(overrides=overrides), scene=None)


def test_finer_surface_is_the_same_surface(tmp_path):
    model = box_model(tmp_path, [CUBE, CUBE, CUBE])
    finer = fidelity._finer(model)
    assert len(finer.collision_faces) == 4 * len(model.collision_faces)
    volumes = [signed_volume(m.collision_vertices, m.collision_faces) for m in (model, finer)]
    assert volumes[1] == pytest.approx(volumes[0])


def test_screened_attempt_that_would_miss_a_fingertip_is_no_flip():
    pairs = [
        (Outcome.SCREENED, Outcome.MISSING_FINGERTIP),
        (Outcome.START_COLLISION, Outcome.START_COLLISION),
        (Outcome.SUCCESS, Outcome.SLIPPED),
        (Outcome.SCREENED, Outcome.SUCCESS),
    ]
    counts = fidelity._count(pairs, [True, False, False, True], [False, False, True, False])
    assert counts["flips"] == 2
    assert counts["successes_lost_by_screen"] == 1
    assert (counts["decided"], counts["simulated"]) == (2, 1)
    assert (counts["lifted"], counts["lifted_flips"]) == (1, 1)


@pytest.mark.parametrize("own", ["worm", "torque", "locked"])
def test_other_drives_are_variants(own):
    others = set(fidelity.DRIVES) - {f"drive_{own}"}
    found = fidelity.variants(load_config(overrides=[f"lift.drive={own}"]))
    assert set(found) == {*fidelity.VARIANTS, *others}
    assert found["sap"] == fidelity.VARIANTS["sap"]
    for name in others:
        assert found[name].overrides == (f"lift.drive={fidelity.DRIVES[name]}",)


def test_hand_without_holding_torque_has_no_worm(monkeypatch):
    hand = load_hand()
    fingers = tuple(replace(finger, holding_torque=None) for finger in hand.fingers)
    other = replace(hand, fingers=fingers, drive="torque")
    monkeypatch.setattr(fidelity, "load_hand", lambda name: other)
    found = fidelity.variants(load_config())
    assert set(found) == {*fidelity.VARIANTS, "drive_locked"}


def test_label_depends_on_the_drive_if_any_other_drive_changes_it(monkeypatch):
    """Three lifts: one that all drives hold, one that two drives lose, one that one loses."""

    class Record:
        outcome, lift = Outcome.SUCCESS, object()

    outcomes = {
        "lift.drive=torque": [Outcome.SUCCESS, Outcome.SLIPPED, Outcome.SUCCESS],
        "lift.drive=locked": [Outcome.SUCCESS, Outcome.SLIPPED, Outcome.DROPPED],
    }
    same = [Outcome.SUCCESS] * 3

    def simulate(bench, attempts, variant, count):
        return outcomes.get("".join(variant.overrides), same)

    monkeypatch.setattr(fidelity, "_simulate", simulate)
    lifts = [fidelity.Simulated(None, Record(), None)] * 3
    report = fidelity.compare_labels(bench_of(), lifts, lambda outcome: None)
    assert report["drive"] == {"attempts": 3, "lifted": 3, "flips": 2}
    assert report["fidelity"]["drive_torque"]["flips"] == 1
    assert fidelity.sum_drive([report["drive"]] * 2)["flip_share_of_lifted"] == 4 / 6


def test_lift_that_was_ended_is_compared_by_its_whole(monkeypatch):
    """Three closed hands, of which only the first has a verdict yet; all variants hold."""
    tried, configs = [], []

    def lift_again(bench, attempt, prediction):
        tried.append(attempt)
        configs.append(bench.config)
        return SimpleNamespace(outcome=Outcome.SUCCESS, lift=object())

    def simulate(bench, attempts, variant, count):
        configs.append(bench.config)
        return [Outcome.SUCCESS] * 3

    monkeypatch.setattr(fidelity, "try_attempt", lift_again)
    monkeypatch.setattr(fidelity, "_simulate", simulate)
    records = [
        SimpleNamespace(outcome=outcome, lift=object())
        for outcome in (Outcome.SUCCESS, Outcome.MOVED, Outcome.NOT_LIFTED)
    ]
    lifts = [fidelity.Simulated(i, record, None) for i, record in enumerate(records)]
    report = fidelity.compare_labels(
        bench_of("lift.stop_when=lost_sample"), lifts, lambda outcome: None
    )
    assert tried == [1, 2]
    assert {config.lift.stop_when for config in configs} == {"never"}
    assert report["fidelity"]["sap"]["lifted"] == 3
    assert report["fidelity"]["sap"]["flips"] == 0
