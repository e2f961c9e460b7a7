"""Scenes with other friction and mass give the bits of scenes built with them; they are kept."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
from helpers.objects import STANDOFF, from_above, standing

from drakegrasp.config import CameraConfig, Config
from drakegrasp.frames import make_pose
from drakegrasp.hand.description import Hand
from drakegrasp.objects.model import ObjectModel
from drakegrasp.objects.surroundings import Box, Neighbourhood
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation.attempt import Attempt, Materials, usual_conditions
from drakegrasp.simulation.construction import FRICTION, build_scene
from drakegrasp.simulation.scene import Scene
from drakegrasp.simulation.scene_cache import cached_renderer, cached_scene, forget_scenes, run_in
from drakegrasp.simulation.trial import TrialRecord, run_attempt

pytestmark = pytest.mark.sim


def attempt_with(cube: ObjectModel, config: Config, **materials: float) -> Attempt:
    usual = usual_conditions(cube, config.physics)
    return replace(
        from_above(cube, STANDOFF),
        conditions=replace(usual, materials=replace(usual.materials, **materials)),
    )


def frictions(scene: Scene) -> list[float]:
    """Return the own coefficient of friction of each shape of a scene."""
    inspector = scene.plant.EvalSceneGraphInspector(scene.context)
    return [
        inspector.GetProximityProperties(geometry).GetProperty(*FRICTION).dynamic_friction()
        for body in filter(None, (scene.object, scene.table, scene.walls, *scene.links))
        for geometry in scene.plant.GetCollisionGeometriesForBody(body)
    ]


def assert_same_bits(one: TrialRecord, other: TrialRecord) -> None:
    assert pickle.dumps(one) == pickle.dumps(other)


@pytest.mark.parametrize(
    "materials",
    [
        Materials(friction_hand=0.3, friction_table=0.9, mass=1.4),
        Materials(friction_hand=1.5, friction_table=0.2, mass=1.0),
    ],
)
def test_materials_of_an_attempt_are_those_of_a_scene_built_with_them(
    cube: ObjectModel, config: Config, hand: Hand, materials: Materials
) -> None:
    X_TB = make_pose(np.eye(3), [0.0, 0.4, 0.15])
    wall = Neighbourhood(
        X_TN=np.zeros((0, 4, 4)), walls=(Box(size=np.array([0.5, 0.02, 0.3]), X_TB=X_TB),)
    )
    scene = build_scene(cube, config.physics, hand, around=wall)
    changes = {k: v for k, v in vars(materials).items() if k != "mass"}
    physics = config.physics.model_copy(update=changes)
    factor = materials.mass / cube.mass
    heavy = replace(cube, mass=materials.mass, I_OOcm_O=factor * cube.I_OOcm_O)
    plain = from_above(cube, STANDOFF)
    other = build_scene(heavy, physics, hand, around=wall)
    coefficients = frictions(other)
    built = run_attempt(other, standing(cube), plain, config)
    assert built.outcome is Outcome.SUCCESS

    found = run_attempt(
        scene, standing(cube), attempt_with(cube, config, **vars(materials)), config
    )
    assert_same_bits(found, built)
    assert frictions(scene) == coefficients
    # Nothing of them remains.
    fresh = build_scene(cube, config.physics, hand, around=wall)
    first, again = (run_attempt(s, standing(cube), plain, config) for s in (fresh, scene))
    assert_same_bits(again, first)


def test_scene_is_that_of_equal_objects_and_physics(cube: ObjectModel, config: Config) -> None:
    copy = replace(cube, collision_vertices=cube.collision_vertices.copy())
    scene = cached_scene(cube, config.physics, config.hand)
    assert cached_scene(copy, config.physics, config.hand) is scene
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
