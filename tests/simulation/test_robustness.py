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
from drakegrasp.simulation.robustness import (
    certify,
    is_drawn,
    least_friction,
)
from drakegrasp.simulation.trial import run_attempt

pytestmark = pytest.mark.sim


@pytest.fixture(scope="module")
def config() -> Config:
    quick = ["lift.max_speed=2", "lift.max_acceleration=5", "lift.hold_time=0.1"]
    return load_config(overrides=["certify.repeats=2", "certify.friction_steps=3", *quick])


def certified(cube, config: Config, *, height: float = STANDOFF, **options) -> dict[str, float]:
    """Return the certificate of the cube's grasp; what holds would be a sample."""
    return certify(
        cube,
        standing(cube),
        from_above(cube, height),
        config,
        lambda record: record.outcome is Outcome.SUCCESS,
        **options,
    )


@pytest.fixture(scope="module")
def certificate(cube, config) -> dict[str, float]:
    return certified(cube, config)


def test_same_grasp_has_the_same_certificate_and_one_in_the_air_another(cube, config, certificate):
    assert certified(cube, config) == certificate
    assert (
        certificate["p_hold_samples"],
        certificate["p_hold_held"],
        certificate["p_hold_repeats"],
    ) == (2, 2, 2)
    assert certificate["p_hold_half_step"] == 1.0
    assert 0.0 < certificate["certified_friction"] <= config.physics.friction_hand
    other = certified(cube, config, height=0.25)
    assert (other["p_hold_samples"], other["p_hold_held"], other["p_hold_repeats"]) == (0, 0, 2)
    assert (other["p_hold_half_step"], other["certified_friction"]) == (0.0, np.inf)


def test_least_friction_holds_and_less_does_not(cube, config, certificate):
    attempt, X_TO, found = (
        from_above(cube, STANDOFF),
        standing(cube),
        certificate["certified_friction"],
    )
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
    assert (
        certify(replace(cube, friction=0.5), X_TO, attempt, config, bool)["certified_friction"]
        <= 0.5
    )
    certify(cube, X_TO, attempt, other, bool)
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
    assert certified(cube, wild)["p_hold_held"] < 2


class Seen:
    """What certification runs, with nothing simulated; every repeat holds."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, outcome: Outcome = Outcome.SUCCESS) -> None:
        self.physics, self.configs, self.attempts, self.forgotten = [], [], [], []

        def scene(model, physics, source, preshape):
            self.physics.append(physics)
            return SimpleNamespace()

        def hold(_scene, _X_TO, attempt, config, _prediction=None):
            self.configs.append(config)
            self.attempts.append(attempt)
            return SimpleNamespace(outcome=outcome)

        module = "drakegrasp.simulation.robustness"
        monkeypatch.setattr(f"{module}.cached_scene", scene)
        monkeypatch.setattr(f"{module}.run_attempt", hold)
        monkeypatch.setattr(f"{module}.forget_scenes", lambda: self.forgotten.append(1))

    def materials(self, name: str) -> list[float]:
        return [getattr(attempt.conditions.materials, name) for attempt in self.attempts]


def test_disturbed_repeats_have_the_trials_step_and_others_half_of_it(cube, config, monkeypatch):
    """The error of the step is numerics: it is told apart from what the grasp bears."""
    seen, own = Seen(monkeypatch), config.physics
    certified(cube, config)
    assert len(seen.attempts) == 2 + 1 + 3
    for physics in (seen.physics, [each.physics for each in seen.configs]):
        steps = [(each.time_step, each.coarse_steps) for each in physics]
        assert steps[:2] == [(own.time_step, own.coarse_steps)] * 2
        assert set(steps[2:]) == {(own.time_step / 2.0, 1)}


def test_repeats_are_lifted_to_their_end(cube, config, monkeypatch):
    """Whether a grasp holds is not known of a lift that ends when its sample is lost."""
    seen = Seen(monkeypatch)
    certified(cube, override_config(config, ["lift.stop_when=lost_sample"]))
    assert {each.lift.stop_when for each in seen.configs} == {"never"}


def test_least_friction_is_that_of_grasps_that_hold(cube, config, monkeypatch):
    seen = Seen(monkeypatch)
    assert np.isnan(certified(cube, config, held=False)["certified_friction"])
    assert np.isnan(
        certified(cube, override_config(config, ["certify.friction_steps=0"]))["certified_friction"]
    )
    assert len(seen.attempts) == 2 * (2 + 1)


def test_repeats_are_judged_by_the_rules_of_a_sample(cube, config, monkeypatch):
    """Not by success: that counts a grasp that slid onto the palm."""
    Seen(monkeypatch)
    attempt, answers = from_above(cube, STANDOFF), iter([True, False, False])
    found = certify(cube, standing(cube), attempt, config, lambda _: next(answers))
    assert (
        found["p_hold_samples"],
        found["p_hold_held"],
        found["p_hold_repeats"],
        found["p_hold_half_step"],
    ) == (1, 2, 2, 0.0)


def test_draw_is_the_attempts_own_and_of_its_probability(cube):
    attempts = [replace(from_above(cube, STANDOFF), seed=seed) for seed in range(1000)]
    for probability in (0.0, 0.25, 1.0):
        drawn = [is_drawn(attempt, probability) for attempt in attempts]
        assert np.mean(drawn) == pytest.approx(probability, abs=0.04)
    others = [replace(attempt, standoff_index=1) for attempt in attempts]
    both = [is_drawn(a, 0.25) == is_drawn(b, 0.25) for a, b in zip(attempts, others, strict=True)]
    assert 0.5 < np.mean(both) < 0.75


NOISE = {"palm_noise": 0.0, "palm_noise_deg": 0.0, "friction_noise": 0.0, "mass_noise": 0.0}


@pytest.mark.parametrize("noise", [None, *NOISE])
def test_each_noise_moves_its_own_quantity(cube, config, monkeypatch, noise):
    """And without any the repeats are the attempt itself."""
    amounts = NOISE if noise is None else {**NOISE, noise: 0.1}
    rules = ["certify.repeats=30", *(f"certify.{key}={value}" for key, value in amounts.items())]
    seen, attempt = Seen(monkeypatch), from_above(cube, STANDOFF)
    certified(cube, override_config(config, rules))
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
        certify(cube, standing(cube), replace(attempt, **changes), config, bool)
    first, again, *others = np.array(seen.materials("mass")).reshape(4, -1)[:, :2]
    assert np.array_equal(first, again)
    assert all(np.all(first != other) for other in others)
    assert np.all(others[0] != others[1])


def test_repeats_without_a_verdict_do_not_count(cube, config, monkeypatch):
    """A new scene after each; and if there is none with a verdict, nothing is known."""
    seen = Seen(monkeypatch, Outcome.SOLVER_ERROR)
    found = certified(cube, config)
    assert found["p_hold_repeats"] == 0
    assert np.isnan([found["p_hold_half_step"], found["certified_friction"]]).all()
    assert len(seen.forgotten) == len(seen.attempts) == len(seen.physics) == 3


def test_counts_are_those_of_the_repeats_with_a_verdict(cube, config, monkeypatch):
    Seen(monkeypatch)
    said = iter([Outcome.SUCCESS, Outcome.TIMEOUT, Outcome.SLIPPED, *[Outcome.SUCCESS] * 9])
    monkeypatch.setattr(
        "drakegrasp.simulation.robustness.run_attempt",
        lambda *_: SimpleNamespace(outcome=next(said)),
    )
    found = certified(cube, override_config(config, ["certify.repeats=3"]))
    assert (found["p_hold_held"], found["p_hold_repeats"]) == (1, 2)
    assert found["certified_friction"] == pytest.approx(config.physics.friction_hand / 2**3)


def test_less_friction_is_tried_on_the_attempt_without_noise(cube, config, monkeypatch):
    seen, attempt = Seen(monkeypatch), from_above(cube, STANDOFF)
    certified(cube, config)
    mu = config.physics.friction_hand
    assert seen.materials("friction_hand")[2:] == pytest.approx([mu, mu / 2, mu / 4, mu / 8])
    assert set(seen.materials("mass")[2:]) == {cube.mass}
    assert all(np.array_equal(a.X_OG, attempt.X_OG) for a in seen.attempts[2:])
