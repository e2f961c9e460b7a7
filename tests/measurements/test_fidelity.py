"""Labels of the same attempts, simulated in other ways."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import fidelity
import pytest
from helpers.objects import CUBE, box_model

from drakegrasp.generation.attempts import TrialSetup
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.settings import load_config
from drakegrasp.mesh.surfaces import signed_volume
from drakegrasp.outcomes import Outcome


def test_finer_surface_is_the_same_surface(tmp_path):
    model = box_model(tmp_path, [CUBE, CUBE, CUBE])
    finer = fidelity.finer(model)
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
    counts = fidelity.count(pairs, [True, False, False, True], [False, False, True, False])
    expected = {"flips": 2, "successes_lost_by_screen": 1, "decided": 2, "simulated": 1}
    assert expected | {"lifted": 1, "lifted_flips": 1} == {
        name: counts[name] for name in (*expected, "lifted", "lifted_flips")
    }


def test_other_drives_that_the_hand_can_have_are_variants(monkeypatch):
    others = {"drive_worm", "drive_torque"}
    found = fidelity.variants(load_config(overrides=["lift.drive=locked"]))
    assert set(found) == {*fidelity.VARIANTS, *others}
    assert found["drive_worm"].overrides == ("lift.drive=worm",)
    hand = load_hand()
    fingers = tuple(replace(finger, holding_torque=None) for finger in hand.fingers)
    monkeypatch.setattr(
        fidelity, "load_hand", lambda name: replace(hand, fingers=fingers, drive="torque")
    )
    assert set(fidelity.variants(load_config())) == {*fidelity.VARIANTS, "drive_locked"}


def test_label_depends_on_the_drive_if_any_other_drive_changes_it(monkeypatch):
    """Three lifts: one that all drives hold, one that two drives lose, one that one loses."""
    held = [Outcome.SUCCESS] * 3
    outcomes = {
        "lift.drive=torque": [Outcome.SUCCESS, Outcome.SLIPPED, Outcome.SUCCESS],
        "lift.drive=locked": [Outcome.SUCCESS, Outcome.SLIPPED, Outcome.DROPPED],
    }
    configs = []

    def lift(setup, attempt, prediction):
        configs.append(setup.config)
        return SimpleNamespace(outcome=Outcome.SUCCESS, lift=object())

    monkeypatch.setattr(fidelity, "predict_attempts", lambda setup, attempts: [None] * 3)
    monkeypatch.setattr(fidelity, "try_attempt", lift)
    monkeypatch.setattr(
        fidelity, "simulate", lambda setup, _, way: outcomes.get("".join(way.overrides), held)
    )
    config = load_config(overrides=["lift.stop_when=lost_sample"])
    found = fidelity.compare_labels(
        TrialSetup(prepared=None, config=config, scene=None), [None] * 3
    )
    # What would be ended without a verdict is lifted to its end.
    assert {config.lift.stop_when for config in configs} == {"never"}
    assert dict(found["drive"]) == {"attempts": 3, "lifted": 3, "flips": 2}
    assert found["drive_torque"]["flips"] == 1
    summed = fidelity.summary([found] * 2)
    assert summed["drive"]["flip_share_of_lifted"] == 4 / 6
    assert summed["screen_off"]["recall"] == 1.0
