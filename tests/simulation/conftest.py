"""The scene that most tests of the simulation use: the hand and a cube that it can grasp."""

from __future__ import annotations

import pytest
from helpers.objects import CUBE, box_model

from drakegrasp.config import Config
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.settings import load_config
from drakegrasp.objects.model import ObjectModel
from drakegrasp.simulation.construction import build_scene
from drakegrasp.simulation.scene import Scene


@pytest.fixture(scope="module")
def config() -> Config:
    return load_config()


@pytest.fixture(scope="module")
def hand() -> Hand:
    return load_hand()


@pytest.fixture(scope="module")
def cube(tmp_path_factory: pytest.TempPathFactory) -> ObjectModel:
    return box_model(tmp_path_factory.mktemp("cube"), [CUBE] * 3)


@pytest.fixture(scope="module")
def scene(cube: ObjectModel, config: Config, hand: Hand) -> Scene:
    return build_scene(cube, config.physics, hand)
