"""What a certificate says: robust grasps hold when disturbed, and friction is found by halving."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.objects import STANDOFF, from_above, standing

from drakegrasp.config import Config, load_config, override_config
from drakegrasp.hand.description import load_hand
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation.construction import build_scene
from drakegrasp.simulation.robustness import certify, least_friction
from drakegrasp.simulation.trial import run_attempt

pytestmark = pytest.mark.sim


@pytest.fixture(scope="module")
def config() -> Config:
    return load_config(overrides=["certify.repeats=3", "certify.friction_steps=3"])


def test_same_grasp_has_the_same_certificate_and_others_another(cube, config):
    attempt = from_above(cube, STANDOFF)
    first = certify(cube, standing(cube), attempt, config)
    assert first == certify(cube, standing(cube), attempt, config)
    assert first.share == 1.0
    assert 0.0 < first.friction <= config.physics.friction_hand


def test_least_friction_holds_and_less_does_not(cube, config):
    attempt, X_TO = from_above(cube, STANDOFF), standing(cube)
    found = certify(cube, X_TO, attempt, config).friction
    gap = config.physics.friction_hand / 2**config.certify.friction_steps
    half = config.physics.time_step / 2.0
    for friction, holds in ((found, True), (found - gap, False)):
        assert friction > 0.0
        changed = [
            f"physics.friction_hand={friction}",
            f"physics.time_step={half}",
            "physics.coarse_steps=1",
        ]
        other = override_config(config, changed)
        scene = build_scene(cube, other.physics, load_hand(other.hand))
        record = run_attempt(scene, X_TO, attempt, other)
        assert (record.outcome is Outcome.SUCCESS) == holds


def test_own_friction_of_the_object_is_searched_and_shaken(cube, config, monkeypatch):
    """The certificate is that of a configuration with this friction."""
    attempt, X_TO = from_above(cube, STANDOFF), standing(cube)
    other = override_config(config, ["physics.friction_hand=0.5", "physics.friction_table=0.5"])
    tried = []

    def hold(_scene, _X_TO, attempt, *_):
        tried.append(attempt.conditions.materials)
        return SimpleNamespace(outcome=Outcome.SUCCESS)

    monkeypatch.setattr("drakegrasp.simulation.robustness.run_attempt", hold)
    assert certify(replace(cube, friction=0.5), X_TO, attempt, config).friction <= 0.5
    certify(cube, X_TO, attempt, other)
    half = len(tried) // 2
    assert tried[:half] == tried[half:]
    assert len({materials.friction_hand for materials in tried}) > 4


def test_bisection_ends_at_the_least_that_holds_or_knows_nothing():
    assert least_friction(lambda mu: mu >= 0.3, 0.8, 10) == pytest.approx(0.3, abs=0.8 / 2**10)
    assert least_friction(lambda _: False, 0.8, 4) == np.inf
    assert np.isnan(least_friction(lambda _: None, 0.8, 4))
    assert np.isnan(least_friction(lambda mu: None if mu < 0.3 else True, 0.8, 4))


def test_noise_of_centimetres_spoils_grasps(cube, config):
    wild = override_config(config, ["certify.palm_noise=0.04", "certify.palm_noise_deg=20"])
    assert certify(cube, standing(cube), from_above(cube, STANDOFF), wild).share < 1.0


def test_grasp_that_does_not_hold_at_half_the_step_has_no_friction(cube, config):
    slick = override_config(config, ["physics.friction_hand=0.02"])
    found = certify(cube, standing(cube), from_above(cube, STANDOFF), slick)
    assert (found.share, found.friction) == (0.0, np.inf)
