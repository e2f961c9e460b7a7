"""What a certificate says: robust grasps hold when disturbed, and friction is found by halving."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.objects import STANDOFF, from_above, standing
from scipy.spatial.transform import Rotation

from drakegrasp.config import Config
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.settings import load_config, override_config
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation.construction import build_scene
from drakegrasp.simulation.robustness import Certificate, certify, least_friction
from drakegrasp.simulation.trial import run_attempt

pytestmark = pytest.mark.sim


@pytest.fixture(scope="module")
def config() -> Config:
    return load_config(overrides=["certify.repeats=2", "certify.friction_steps=3"])


@pytest.fixture(scope="module")
def certificate(cube, config) -> Certificate:
    return certify(cube, standing(cube), from_above(cube, STANDOFF), config)


def test_same_grasp_has_the_same_certificate_and_one_in_the_air_another(cube, config, certificate):
    assert certify(cube, standing(cube), from_above(cube, STANDOFF), config) == certificate
    assert certificate.share == 1.0
    assert 0.0 < certificate.friction <= config.physics.friction_hand
    other = certify(cube, standing(cube), from_above(cube, 0.25), config)
    assert (other.share, other.friction) == (0.0, np.inf)


def test_least_friction_holds_and_less_does_not(cube, config, certificate):
    attempt, X_TO, found = from_above(cube, STANDOFF), standing(cube), certificate.friction
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


class Seen:
    """What certification builds and runs, with nothing simulated; every repeat holds."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, outcome: Outcome = Outcome.SUCCESS) -> None:
        self.physics, self.configs, self.attempts = [], [], []

        def build(model, physics, hand):
            self.physics.append(physics)
            return SimpleNamespace()

        def hold(_scene, _X_TO, attempt, config, _prediction=None):
            self.configs.append(config)
            self.attempts.append(attempt)
            return SimpleNamespace(outcome=outcome)

        module = "drakegrasp.simulation.robustness"
        monkeypatch.setattr(f"{module}.build_scene", build)
        monkeypatch.setattr(f"{module}.run_attempt", hold)

    def materials(self, name: str) -> list[float]:
        return [getattr(attempt.conditions.materials, name) for attempt in self.attempts]


def test_repeats_are_simulated_at_half_the_step_throughout(cube, config, monkeypatch):
    seen = Seen(monkeypatch)
    certify(cube, standing(cube), from_above(cube, STANDOFF), config)
    half = config.physics.time_step / 2.0
    assert len(seen.attempts) == 2 + 1 + 3
    for physics in (*seen.physics, *(c.physics for c in seen.configs)):
        assert (physics.time_step, physics.coarse_steps) == (half, 1)


def test_repeats_are_lifted_to_their_end(cube, config, monkeypatch):
    """Whether a grasp holds is not known of a lift that ends when its sample is lost."""
    seen = Seen(monkeypatch)
    ended = override_config(config, ["lift.stop_when=lost_sample"])
    certify(cube, standing(cube), from_above(cube, STANDOFF), ended)
    assert {each.lift.stop_when for each in seen.configs} == {"never"}


NOISE = {"palm_noise": 0.0, "palm_noise_deg": 0.0, "friction_noise": 0.0, "mass_noise": 0.0}


@pytest.mark.parametrize("noise", [None, *NOISE])
def test_each_noise_moves_its_own_quantity(cube, config, monkeypatch, noise):
    """And without any the repeats are the attempt itself."""
    amounts = NOISE if noise is None else {**NOISE, noise: 0.1}
    rules = ["certify.repeats=30", *(f"certify.{key}={value}" for key, value in amounts.items())]
    seen, attempt = Seen(monkeypatch), from_above(cube, STANDOFF)
    certify(cube, standing(cube), attempt, override_config(config, rules))
    noisy = [np.linalg.inv(attempt.X_OG) @ a.X_OG for a in seen.attempts[:30]]
    shifts = np.array([X[:3, 3] for X in noisy])
    turns = np.array([Rotation.from_matrix(X[:3, :3]).as_rotvec(degrees=True) for X in noisy])
    friction = np.log(np.array(seen.materials("friction_hand")[:30]) / config.physics.friction_hand)
    mass = np.log(np.array(seen.materials("mass")[:30]) / cube.mass)
    found = {
        "palm_noise": shifts,
        "palm_noise_deg": turns,
        "friction_noise": friction,
        "mass_noise": mass,
    }
    for name, values in found.items():
        spread = values.std(axis=0)
        if name == noise:
            assert np.all((spread > 0.06) & (spread < 0.15)), name
            assert np.all(np.abs(values.mean(axis=0)) < 0.06), name
        else:
            assert np.abs(values).max() < 1e-6, name


def test_noise_is_of_the_attempts_seed_and_standoff(cube, config, monkeypatch):
    seen, attempt = Seen(monkeypatch), from_above(cube, STANDOFF)
    for changes in ({}, {}, {"seed": 1}, {"standoff_index": 1}):
        certify(cube, standing(cube), replace(attempt, **changes), config)
    first, again, *others = np.array(seen.materials("mass")).reshape(4, -1)[:, :2]
    assert np.array_equal(first, again)
    assert all(np.all(first != other) for other in others)
    assert np.all(others[0] != others[1])


def test_repeats_without_a_verdict_do_not_count(cube, config, monkeypatch):
    """A new scene after each; and if there is none with a verdict, nothing is known."""
    seen = Seen(monkeypatch, Outcome.SOLVER_ERROR)
    found = certify(cube, standing(cube), from_above(cube, STANDOFF), config)
    assert np.isnan([found.share, found.friction]).all()
    assert len(seen.physics) == 1 + len(seen.attempts)


def test_share_is_that_of_the_repeats_that_hold(cube, config, monkeypatch):
    Seen(monkeypatch)
    said = iter([Outcome.SUCCESS, Outcome.SOLVER_ERROR, Outcome.SLIPPED, *[Outcome.SUCCESS] * 9])
    monkeypatch.setattr(
        "drakegrasp.simulation.robustness.run_attempt",
        lambda *_: SimpleNamespace(outcome=next(said)),
    )
    three = override_config(config, ["certify.repeats=3"])
    found = certify(cube, standing(cube), from_above(cube, STANDOFF), three)
    assert found.share == 0.5
    assert found.friction == pytest.approx(config.physics.friction_hand / 2**3)


def test_less_friction_is_tried_on_the_attempt_without_noise(cube, config, monkeypatch):
    seen, attempt = Seen(monkeypatch), from_above(cube, STANDOFF)
    certify(cube, standing(cube), attempt, config)
    mu = config.physics.friction_hand
    assert seen.materials("friction_hand")[2:] == pytest.approx([mu, mu / 2, mu / 4, mu / 8])
    assert set(seen.materials("mass")[2:]) == {cube.mass}
    assert all(np.array_equal(a.X_OG, attempt.X_OG) for a in seen.attempts[2:])
