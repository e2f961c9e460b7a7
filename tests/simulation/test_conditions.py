"""What is drawn for an attempt: in range, by seed and number alone; the noise of repeats."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.objects import STANDOFF, from_above, standing
from scipy.spatial.transform import Rotation

from drakegrasp.config import Config
from drakegrasp.frames import rotation_angle
from drakegrasp.hand.settings import load_config, override_config
from drakegrasp.objects.model import ObjectModel
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation.attempt import (
    Conditions,
    disturbed,
    draw_conditions,
    is_drawn,
    usual_conditions,
)
from drakegrasp.simulation.scene_cache import repeat_disturbed

COUNT = 400
#: One key of `randomize` each, and the values of `Conditions.values` that it may change.
KEYS: dict[str, tuple[str, ...]] = {
    "object_colour=1": ("object_colour",),
    "table_colour=0.5": ("table_colour",),
    "light_angle_deg=40": ("light_direction",),
    "light_strength=[0.5,2]": ("light_strength",),
    "camera_shift=0.01": ("X_C0C",),
    "camera_turn_deg=5": ("X_C0C",),
    "depth_noise=[0.001,0.002]": ("depth_noise", "depth_seed"),
    "friction_hand=[0.5,1.5]": ("friction_hand",),
    "friction_table=[0.5,1.5]": ("friction_table",),
    "mass=[0.5,2]": ("mass",),
}


def config_with(*keys: str) -> Config:
    return load_config(overrides=[f"randomize.{key}" for key in keys])


def draws(model: ObjectModel, config: Config) -> list[Conditions]:
    return [draw_conditions(model, config, i // 3, i % 3) for i in range(COUNT)]


def column(conditions: list[Conditions], name: str) -> np.ndarray:
    return np.array([one.values()[name] for one in conditions])


def equal(one: dict[str, Any], other: dict[str, Any]) -> list[str]:
    """Return the names of values that are equal."""
    return [name for name, value in one.items() if np.array_equal(value, other[name])]


def test_nothing_is_drawn_by_default(cube: ObjectModel) -> None:
    config = load_config()
    usual = usual_conditions(cube, config.physics).values()
    assert equal(draw_conditions(cube, config, 3, 1).values(), usual) == list(usual)
    assert (usual["mass"], usual["friction_hand"]) == (cube.mass, 0.71)


@pytest.mark.parametrize("key", KEYS)
def test_a_key_changes_its_own_values_and_switches_no_other_draw(
    cube: ObjectModel, key: str
) -> None:
    usual = usual_conditions(cube, load_config().physics).values()
    alone = draw_conditions(cube, config_with(key), 3, 1).values()
    assert set(usual) - set(equal(alone, usual)) == set(KEYS[key])
    # Shift and turn share a value.
    if KEYS[key] != ("X_C0C",):
        together = draw_conditions(cube, config_with(*KEYS), 3, 1).values()
        assert set(KEYS[key]) <= set(equal(alone, together))


@pytest.mark.parametrize(
    ("name", "low", "high"),
    [
        ("friction_hand", 0.71 * 0.5, 0.71 * 1.5),
        ("friction_table", 0.71 * 0.5, 0.71 * 1.5),
        ("mass", 0.5, 2.0),
        ("light_strength", 0.35, 1.4),
        ("depth_noise", 0.001, 0.002),
        ("object_colour", 0.0, 1.0),
    ],
)
def test_ranges_are_kept_and_filled_evenly(
    cube: ObjectModel, name: str, low: float, high: float
) -> None:
    values = column(draws(cube, config_with(*KEYS)), name)
    assert values.min() >= low
    assert values.max() <= high
    share = (values - low) / (high - low)
    assert share.mean() == pytest.approx(0.5, abs=0.05)
    assert share.std() == pytest.approx(1.0 / np.sqrt(12.0), abs=0.03)


def test_camera_is_shifted_and_turned_about_all_axes_at_most_so_far(cube: ObjectModel) -> None:
    poses = np.array([one.X_C0C for one in draws(cube, config_with(*KEYS))])
    assert np.abs(poses[:, :3, 3]).max() <= 0.01
    assert np.abs(poses[:, :3, 3]).max(axis=0).min() > 0.0099
    turns = np.array([rotation_angle(pose[:3, :3]) for pose in poses])
    assert turns.max() <= np.deg2rad(5.0) * np.sqrt(3.0) * 1.01
    # x, y and z each reach 5 degrees, to first order the entries below the diagonal.
    skew = np.abs([poses[:, 2, 1], poses[:, 0, 2], poses[:, 1, 0]])
    assert np.all(skew.max(axis=1) > np.sin(np.deg2rad(4.8)))
    assert np.abs(np.swapaxes(poses, 1, 2)[:, :3, :3] @ poses[:, :3, :3] - np.eye(3)).max() < 1e-15


@pytest.fixture(scope="module")
def config() -> Config:
    quick = ["lift.max_speed=2", "lift.max_acceleration=5", "lift.hold_time=0.1"]
    return load_config(overrides=["robustness.repeats=2", *quick])


def outcomes(cube, config: Config, *, height: float = STANDOFF) -> list[tuple[Outcome, float]]:
    """Return the outcomes of the repeats of the cube's grasp, and their slips."""
    records = repeat_disturbed(cube, standing(cube), from_above(cube, height), config)
    return [(r.outcome, np.inf if r.lift is None else r.lift.slip) for r in records]


@pytest.mark.sim
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
