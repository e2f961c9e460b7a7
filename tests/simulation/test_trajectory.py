"""The path of a lift by forces, and by what margin contacts hold along it."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.objects import CUBE, standing
from scipy.spatial.transform import Rotation

from drakegrasp.frames import X_WT, make_pose
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.kinematics import fingertip_forces
from drakegrasp.hand.settings import load_config
from drakegrasp.simulation.lift import LiftPath, carrying_force, lift_path
from drakegrasp.verification.forces import force_margin

GRAVITY = 9.81
HALF = CUBE / 2.0
#: Two contacts on one face of the cube, one in the middle of the opposite face.
P = np.array([[0.02, HALF, 0.0], [-0.02, HALF, 0.0], [0.0, -HALF, 0.0]])
N = np.array([[0.0, 1.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])


@pytest.fixture
def path() -> LiftPath:
    R_TO = Rotation.from_rotvec([0.2, -0.5, 1.0]).as_matrix()
    return lift_path(make_pose(R_TO, [0.1, -0.05, 0.04]), load_config())


def test_path_goes_from_rest_to_rest_at_the_target(path):
    p, v, a = path.at(0.0)
    assert np.allclose(p, X_WT[:3, 3] + [0.1, -0.05, 0.04])
    assert not v.any()
    assert not a.any()
    for time in (path.duration, path.duration + 1.0):
        p, v, a = path.at(time)
        assert np.allclose(p, X_WT[:3, 3] + [0.0, 0.0, 0.60])
        assert np.allclose([v, a], 0.0)


@pytest.mark.parametrize("overrides", [[], ["lift.max_speed=5.0"]])
def test_path_keeps_both_limits_and_meets_one(overrides):
    config = load_config(overrides=overrides)
    path = lift_path(make_pose(np.eye(3), [0.1, -0.05, 0.04]), config)
    states = [path.at(time) for time in np.linspace(0.0, path.duration, 2001)]
    speed = max(np.linalg.norm(v) for _, v, _ in states) / config.lift.max_speed
    acceleration = max(np.linalg.norm(a) for _, _, a in states) / config.lift.max_acceleration
    assert max(speed, acceleration) == pytest.approx(1.0, rel=1e-5)


def test_wrenches_are_the_extremes_of_the_motion(path, cube):
    """They carry the weight and the peak of the inertia, and turn back into {W}."""
    up, down = path.wrenches(cube)
    assert not up[:3].any()
    assert not down[:3].any()
    assert np.allclose(path.R_WO @ (up + down)[3:] / 2.0, [0.0, 0.0, cube.mass * GRAVITY])
    way = path.p_WO_end - path.X_WO[:3, 3]
    along = way / np.linalg.norm(way)
    times = np.linspace(0.0, path.duration, 5001)
    forces = np.array([carrying_force(cube, path.at(time)[2]) for time in times]) @ along
    assert forces.max() == pytest.approx(path.R_WO @ up[3:] @ along, rel=1e-6)
    assert forces.min() == pytest.approx(path.R_WO @ down[3:] @ along, rel=1e-6)


def test_margin_of_a_pinched_cube_is_its_closed_form(cube):
    """The finger that opposes two carries half of the load: mu = m (g + a) / (2 limit)."""
    config = load_config()
    epsilon, friction = force_margin(cube, standing(cube), P, N, config)
    load = lift_path(standing(cube), config).wrenches(cube)[0, 5]
    limit = fingertip_forces(load_hand(config.hand), "worm")[2]
    assert load > cube.mass * GRAVITY
    assert friction == pytest.approx(load / (2.0 * limit), abs=2e-4)
    assert epsilon > 0.0


@pytest.mark.parametrize(("p", "n"), [(np.abs(P), np.abs(N)), (P * np.nan, N)])
def test_contacts_that_cannot_hold_have_no_margin(cube, p, n):
    config = load_config()
    epsilon, friction = force_margin(cube, standing(cube), p, n, config)
    assert epsilon == 0.0
    assert friction == np.inf
