"""Diagrams are kept by what they hold: copies share them, and what differs does not."""

from __future__ import annotations

import pickle
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.objects import CUBE, STANDOFF, box_model, from_above, standing

from drakegrasp.config import CameraConfig, Config
from drakegrasp.hand.description import load_hand
from drakegrasp.objects.model import ObjectModel
from drakegrasp.simulation import scene_cache
from drakegrasp.simulation.construction import build_scene
from drakegrasp.simulation.scene_cache import (
    cached_renderer,
    cached_scene,
    forget_scenes,
)
from drakegrasp.simulation.trial import run_attempt

pytestmark = pytest.mark.sim


@pytest.fixture(autouse=True)
def empty(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(scene_cache, "_kept", {})
    monkeypatch.setattr(scene_cache, "_diagrams", {})
    yield


def test_copy_of_an_object_shares_its_scene(cube: ObjectModel, config: Config) -> None:
    scene = cached_scene(cube, config.physics, config.hand)
    copy = replace(cube, collision_vertices=cube.collision_vertices.copy())
    assert cached_scene(copy, config.physics, config.hand) is scene


def test_scene_of_another_mass_shape_or_physics_is_another(
    cube: ObjectModel, config: Config
) -> None:
    scene = cached_scene(cube, config.physics, config.hand)
    heavy = replace(cube, mass=2.0 * cube.mass)
    large = replace(cube, collision_vertices=1.1 * cube.collision_vertices)
    slick = config.physics.model_copy(update={"friction_hand": 0.1})
    for other in (
        cached_scene(heavy, config.physics, config.hand),
        cached_scene(large, config.physics, config.hand),
        cached_scene(cube, slick, config.hand),
        cached_scene(replace(cube, friction=0.1), config.physics, config.hand),
    ):
        assert other is not scene
    assert np.isclose(cached_scene(heavy, config.physics, config.hand).model.mass, 2.0 * cube.mass)


def test_scenes_are_forgotten_and_renderers_stay(cube: ObjectModel, config: Config) -> None:
    scene = cached_scene(cube, config.physics, config.hand)
    renderer = cached_renderer(cube, CameraConfig())
    forget_scenes()
    assert cached_scene(cube, config.physics, config.hand) is not scene
    assert cached_renderer(cube, CameraConfig()) is renderer
    assert cached_renderer(cube, CameraConfig(size=64)) is not renderer


@pytest.mark.parametrize("friction", [None, 0.4])
def test_object_on_the_diagram_of_another_gives_the_bits_of_a_scene_of_its_own(
    cube: ObjectModel, config: Config, tmp_path: Path, friction: float | None
) -> None:
    small = replace(box_model(tmp_path, [CUBE, 0.9 * CUBE, CUBE]), mass=0.6, friction=friction)
    first = cached_scene(cube, config.physics, config.hand)
    run_attempt(first, standing(cube), from_above(cube, STANDOFF), config)
    shared = cached_scene(small, config.physics, config.hand)
    assert shared.plant is first.plant

    alone = build_scene(small, config.physics, load_hand(config.hand))
    found, expected = (
        run_attempt(scene, standing(small), from_above(small, STANDOFF), config)
        for scene in (shared, alone)
    )
    assert expected.lift is not None
    assert pickle.dumps(found) == pickle.dumps(expected)
