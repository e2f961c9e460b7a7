"""The scene that most tests of the simulation use: the hand and a cube that it can grasp."""

from __future__ import annotations

import pytest

from drakegrasp.config import Config
from drakegrasp.hand.description import Hand
from drakegrasp.objects.model import ObjectModel
from drakegrasp.simulation.construction import build_scene
from drakegrasp.simulation.scene import Scene


@pytest.fixture(scope="module")
def scene(cube: ObjectModel, config: Config, hand: Hand) -> Scene:
    return build_scene(cube, config.physics, hand)
