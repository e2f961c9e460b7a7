"""Repeats with noise: robust grasps stay samples, and the noise is the attempt's own."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.objects import STANDOFF, from_above, standing
from scipy.spatial.transform import Rotation

from drakegrasp.config import Config
from drakegrasp.hand.settings import load_config, override_config
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation.attempt import disturbed, is_drawn, usual_conditions
from drakegrasp.simulation.scene_cache import repeat_disturbed

pytestmark = pytest.mark.sim


@pytest.fixture(scope="module")
def config() -> Config:
    quick = ["lift.max_speed=2", "lift.max_acceleration=5", "lift.hold_time=0.1"]
    return load_config(overrides=["robustness.repeats=2", *quick])


def outcomes(cube, config: Config, *, height: float = STANDOFF) -> list[tuple[Outcome, float]]:
    """Return the outcomes of the repeats of the cube's grasp, and their slips."""
    records = repeat_disturbed(cube, standing(cube), from_above(cube, height), config)
    return [(r.outcome, np.inf if r.lift is None else r.lift.slip) for r in records]


def test_same_grasp_has_the_same_repeats_and_one_in_the_air_others(cube, config):
    first = outcomes(cube, config)
    assert [outcome for outcome, _ in first] == [Outcome.SUCCESS] * 2
    assert first[0] != first[1]
    assert outcomes(cube, config) == first
    assert Outcome.SUCCESS not in dict(outcomes(cube, config, height=0.25))


def test_repeats_are_lifted_to_their_end_with_the_trials_step(cube, config, monkeypatch):
    """Whether a grasp holds is not known of a lift that ends when its sample is lost."""
    seen = list[Config]()

    def end(_model, _X_TO, _attempt, config):
        seen.append(config)
        return SimpleNamespace(outcome=Outcome.SUCCESS)

    monkeypatch.setattr("drakegrasp.simulation.scene_cache.run_cached", end)
    rules = override_config(config, ["lift.stop_when=lost_sample"])
    repeat_disturbed(cube, standing(cube), from_above(cube, STANDOFF), rules)
    assert [each.lift.stop_when for each in seen] == ["never"] * 2
    assert [each.physics for each in seen] == [config.physics] * 2


def test_draw_is_the_attempts_own_and_of_its_probability(cube):
    attempts = [replace(from_above(cube, STANDOFF), seed=seed) for seed in range(1000)]
    for probability in (0.0, 0.25, 1.0):
        drawn = [is_drawn(attempt, probability) for attempt in attempts]
        assert np.mean(drawn) == pytest.approx(probability, abs=0.04)
    others = [replace(attempt, standoff_index=1) for attempt in attempts]
    both = [is_drawn(a, 0.25) == is_drawn(b, 0.25) for a, b in zip(attempts, others, strict=True)]
    assert 0.5 < np.mean(both) < 0.75


@pytest.mark.parametrize(
    ("quantity", "deviation"), [("shift", 0.002), ("turn", 1.0), ("friction", 0.1), ("mass", 0.1)]
)
def test_each_quantity_has_its_noise(cube, config, quantity, deviation):
    attempt, known = from_above(cube, STANDOFF), usual_conditions(cube, config.physics)
    noisy = list(disturbed(attempt, known, 100))
    moved = np.array([np.linalg.inv(attempt.X_OG) @ a.X_OG for a in noisy])
    materials = [a.conditions.materials for a in noisy]
    values = {
        "shift": lambda: moved[:, :3, 3],
        "turn": lambda: Rotation.from_matrix(moved[:, :3, :3]).as_rotvec(degrees=True),
        "friction": lambda: np.log(
            [m.friction_hand / known.materials.friction_hand for m in materials]
        ),
        "mass": lambda: np.log([m.mass / known.materials.mass for m in materials]),
    }[quantity]()
    assert values.std(axis=0) == pytest.approx(deviation, rel=0.3)
    assert np.all(np.abs(values.mean(axis=0)) < 0.3 * deviation)


def test_noise_is_of_the_attempts_seed_and_standoff(cube, config):
    attempt, known = from_above(cube, STANDOFF), usual_conditions(cube, config.physics)
    first, again, *others = (
        np.array([a.conditions.materials.mass for a in disturbed(replace(attempt, **of), known, 2)])
        for of in ({}, {}, {"seed": 1}, {"standoff_index": 1})
    )
    assert np.array_equal(first, again)
    assert all(np.all(first != other) for other in others)
    assert np.all(others[0] != others[1])
