"""Scenes are kept by what they hold: copies share them, and what differs does not."""

from __future__ import annotations

from dataclasses import replace

import pytest

from drakegrasp.config import CameraConfig, Config
from drakegrasp.objects.model import ObjectModel
from drakegrasp.simulation.scene_cache import (
    cached_renderer,
    cached_scene,
    forget_scenes,
)

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
