"""A scene with other friction and mass gives the bits of a scene that is built with them."""

from __future__ import annotations

import pickle
from dataclasses import replace

import pytest
from helpers.objects import STANDOFF, from_above, standing

from drakegrasp.config import Config
from drakegrasp.hand.description import Hand
from drakegrasp.objects.model import ObjectModel
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation.attempt import Attempt, Materials, usual_conditions
from drakegrasp.simulation.construction import FRICTION, build_scene
from drakegrasp.simulation.scene import Scene
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
        for body in (scene.object, scene.table, *scene.links)
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
    scene: Scene, cube: ObjectModel, config: Config, hand: Hand, materials: Materials
) -> None:
    changes = {k: v for k, v in vars(materials).items() if k != "mass"}
    physics = config.physics.model_copy(update=changes)
    factor = materials.mass / cube.mass
    heavy = replace(cube, mass=materials.mass, I_OOcm_O=factor * cube.I_OOcm_O)
    plain = from_above(cube, STANDOFF)
    alone = build_scene(heavy, physics, hand)
    coefficients = frictions(alone)
    built = run_attempt(alone, standing(cube), plain, config)
    assert built.outcome is Outcome.SUCCESS

    found = run_attempt(
        scene, standing(cube), attempt_with(cube, config, **vars(materials)), config
    )
    assert_same_bits(found, built)
    assert frictions(scene) == coefficients


def test_nothing_remains_of_the_materials_of_the_attempt_before(
    scene: Scene, cube: ObjectModel, config: Config
) -> None:
    plain, X_TO = from_above(cube, STANDOFF), standing(cube)
    first = run_attempt(scene, X_TO, plain, config)
    other = attempt_with(cube, config, friction_hand=0.4, friction_table=0.3, mass=1.3)
    changed = run_attempt(scene, X_TO, other, config)
    assert changed.lift.slip != first.lift.slip
    assert_same_bits(run_attempt(scene, X_TO, plain, config), first)
