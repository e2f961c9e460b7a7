"""Scenes are kept by what they hold: copies share them, and what differs does not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drakegrasp.config import CameraConfig, Config
from drakegrasp.objects.model import ObjectModel
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation.attempt import Attempt
from drakegrasp.simulation.scene_cache import cached_renderer, cached_scene, forget_scenes, run_in
from drakegrasp.simulation.trial import TrialRecord

pytestmark = pytest.mark.sim


def test_copy_of_an_object_shares_its_scene(cube: ObjectModel, config: Config) -> None:
    scene = cached_scene(cube, config.physics, config.hand)
    copy = replace(cube, collision_vertices=cube.collision_vertices.copy())
    assert cached_scene(copy, config.physics, config.hand) is scene


def test_scene_of_another_mass_shape_or_physics_is_another(
    cube: ObjectModel, config: Config
) -> None:
    large = replace(cube, collision_vertices=1.1 * cube.collision_vertices)
    slick = config.physics.model_copy(update={"friction_hand": 0.1})
    for model, physics in (
        (replace(cube, mass=2.0 * cube.mass), config.physics),
        (large, config.physics),
        (replace(cube, friction=0.1), config.physics),
        (cube, slick),
    ):
        scene = cached_scene(cube, config.physics, config.hand)
        other = cached_scene(model, physics, config.hand)
        assert other is not scene
        assert other.model.mass == model.mass


def test_scenes_are_forgotten_and_renderers_stay(cube: ObjectModel, config: Config) -> None:
    scene = cached_scene(cube, config.physics, config.hand)
    renderer = cached_renderer(cube, CameraConfig())
    forget_scenes()
    assert cached_scene(cube, config.physics, config.hand) is not scene
    assert cached_renderer(cube, CameraConfig()) is renderer
    assert cached_renderer(cube, CameraConfig(size=64)) is not renderer


@pytest.mark.parametrize("outcome", [Outcome.SUCCESS, Outcome.SOLVER_ERROR, Outcome.TIMEOUT])
def test_no_scene_is_used_again_after_an_inconclusive_trial(
    cube: ObjectModel, config: Config, monkeypatch: pytest.MonkeyPatch, outcome: Outcome
) -> None:
    pose = np.eye(4)
    record = TrialRecord(outcome=outcome, X_TO=pose, X_OG=pose)
    monkeypatch.setattr("drakegrasp.simulation.scene_cache.run_attempt", lambda *_: record)
    scene = cached_scene(cube, config.physics, config.hand)
    assert run_in(scene, pose, Attempt(X_OG=pose, spread=0.0), config) is record
    kept = cached_scene(cube, config.physics, config.hand) is scene
    assert kept is (outcome is Outcome.SUCCESS)
