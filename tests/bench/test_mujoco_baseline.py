"""The trial in MuJoCo: another simulator, the same rules."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.objects import CUBE, box_model, from_above, standing

from drakegrasp.config import Config, load_config, override_config
from drakegrasp.frames import make_pose
from drakegrasp.objects.model import ObjectModel
from drakegrasp.outcomes import Outcome

pytest.importorskip("mujoco")
pytest.importorskip("coacd")

from drakegrasp.bench.mujoco_baseline import MujocoBaseline

pytestmark = pytest.mark.sim

STANDOFF = 0.06


@pytest.fixture(scope="module")
def cube(tmp_path_factory: pytest.TempPathFactory) -> ObjectModel:
    return box_model(tmp_path_factory.mktemp("cube"), [CUBE, CUBE, CUBE])


@pytest.fixture(scope="module")
def config() -> Config:
    return load_config()


@pytest.fixture(scope="module")
def baseline(cube: ObjectModel, config: Config) -> MujocoBaseline:
    return MujocoBaseline(cube, standing(cube), config)


def test_cube_is_one_part_and_is_held_across_its_faces(
    baseline: MujocoBaseline, cube: ObjectModel
) -> None:
    assert baseline.parts == 1
    attempt = from_above(cube, STANDOFF)
    assert baseline.run(attempt) is Outcome.SUCCESS
    assert baseline.run(attempt) is Outcome.SUCCESS  # nothing is left of the first run


@pytest.mark.parametrize(
    ("standoff", "outcome"),
    [(0.3, Outcome.MISSING_FINGERTIP), (0.001, Outcome.START_COLLISION)],
)
def test_attempts_fail_where_they_should(
    baseline: MujocoBaseline, cube: ObjectModel, standoff: float, outcome: Outcome
) -> None:
    assert baseline.run(from_above(cube, standoff)) is outcome


def test_what_geometry_decides_is_not_simulated(
    baseline: MujocoBaseline, cube: ObjectModel
) -> None:
    attempt = from_above(cube, STANDOFF)
    assert baseline.run(replace(attempt, ray_hits=False)) is Outcome.RAY_MISS
    below = attempt.X_OG @ make_pose(np.eye(3), [0.0, 0.0, 0.3])
    assert baseline.run(replace(attempt, X_OG=below)) is Outcome.BELOW_TABLE


def test_slippery_cube_is_not_held(cube: ObjectModel, config: Config) -> None:
    slick = override_config(config, ["physics.friction_hand=0.05"])
    outcome = MujocoBaseline(cube, standing(cube), slick).run(from_above(cube, STANDOFF))
    assert outcome in (Outcome.DROPPED, Outcome.SLIPPED)


def test_spread_turns_the_fingers(baseline: MujocoBaseline, cube: ObjectModel) -> None:
    """At 90 degrees both spread fingers are at the sides, where the third does not oppose them."""
    outcome = baseline.run(from_above(cube, STANDOFF, spread=float(np.deg2rad(90.0))))
    assert outcome is not Outcome.SUCCESS
