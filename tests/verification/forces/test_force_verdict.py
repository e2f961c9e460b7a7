"""Holding by forces alone: closed forms, refusals with their reason, and predictions that lie."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.objects import CUBE, box_model, standing
from scipy.spatial.transform import Rotation

from drakegrasp.hand.description import load_hand
from drakegrasp.hand.kinematics import fingertip_forces
from drakegrasp.hand.settings import load_config
from drakegrasp.simulation.lift import PEAK_ACCELERATION, lift_duration
from drakegrasp.verification.forces import (
    TORSION_RADIUS,
    force_margin,
    judge_forces,
)

GRAVITY, HALF = 9.81, CUBE / 2.0
#: Two contacts on one face of the cube, one in the middle of the opposite face.
P = np.array([[0.02, HALF, 0.0], [-0.02, HALF, 0.0], [0.0, -HALF, 0.0]])
N = np.array([[0.0, 1.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])


@pytest.fixture(scope="module")
def config():
    return load_config()


@pytest.fixture(scope="module")
def box(tmp_path_factory):
    return box_model(tmp_path_factory.mktemp("box"), [CUBE] * 3)


def judged(box, config, p=P, n=N, X_TO=None):
    return judge_forces(box, standing(box) if X_TO is None else X_TO, p, n, config)


def heaviest(config):
    """Return the force that carries the cube [N] where it is accelerated upwards the most."""
    distance = config.lift.p_TG[2] - HALF
    return GRAVITY + PEAK_ACCELERATION * distance / lift_duration(distance, config) ** 2


def slippery(friction):
    return load_config(overrides=[f"physics.friction_hand={friction}"])


def test_finger_that_opposes_two_carries_half_of_the_load(box, config):
    found = judged(box, config)
    force = heaviest(config) / (2.0 * config.physics.friction_hand)
    assert found.held and found.deciding is found.points
    assert found.planned_force == pytest.approx(force, rel=1e-6)
    limit = fingertip_forces(load_hand(), "worm")[2]
    assert found.planned_share == pytest.approx(force / limit, rel=1e-6)
    assert found.reason.startswith(f"normal forces of at most {force:.1f} N carry it: ")


def test_more_friction_than_the_smallest_holds_and_less_does_not(box, config):
    _, smallest = force_margin(box, standing(box), P, N, config)
    assert judged(box, slippery(1.001 * smallest)).held
    found = judged(box, slippery(0.999 * smallest))
    assert not found.held and found.on_surface
    assert "more than the 34.5 N that the fingertip carries" in found.reason


def test_friction_of_the_object_wins_over_the_configured_one(box, config):
    found = judged(replace(box, friction=0.05), config)
    assert found.planned_force == pytest.approx(heaviest(config) / 0.1, rel=1e-6)


def test_finger_below_the_object_as_it_lies_carries_it_almost_without_friction(box):
    """The face of the single finger is the lower one of the lying cube."""
    X_TO, config = standing(box), slippery(1e-3)
    X_TO[:3, :3] = Rotation.from_rotvec([np.pi / 2.0, 0.0, 0.0]).as_matrix()
    found = judged(box, config, X_TO=X_TO)
    assert found.held and not judged(box, config).held
    assert found.planned_force == pytest.approx(heaviest(config), rel=1e-4)


@pytest.mark.parametrize("p", [np.abs(P), [[0.01, HALF, 0.0]] * 3])
def test_contacts_on_one_face_hold_nothing(box, config, p):
    found = judged(box, config, p, np.abs(N))
    assert found.on_surface and not found.held
    assert found.planned_force == np.inf
    assert found.reason.startswith("no forces within the surface's friction cones carry it")


# Predictions that lie


def test_normals_that_lean_upwards_carry_no_more_than_the_surfaces_own(box):
    """At little friction they would point the forces up: the surface does not let them."""
    leaning = N - [0.0, 0.0, 0.8]
    leaning /= np.linalg.norm(leaning, axis=1, keepdims=True)
    found = judged(box, slippery(0.05), P, leaning)
    assert found.on_surface and not found.held
    assert np.array_equal(found.points.normal, judged(box, slippery(0.05)).points.normal)


@pytest.mark.parametrize(("away", "side"), [(0.009, "outside"), (-0.009, "inside")])
def test_points_off_the_surface_fail_by_their_distance(box, config, away, side):
    found = judged(box, config, P + away * N * [[0.0], [1.0], [0.0]], N)
    assert not found.held and not found.on_surface
    assert found.reason == f"contact 2 is 9.0 mm {side} the object's surface, more than 5 mm"


def test_normals_off_the_surfaces_own_fail_by_their_angle(box, config):
    found = judged(box, config, P, N * [[1.0], [1.0], [-1.0]])
    assert not found.held and not found.on_surface
    assert found.reason == "normal 3 is 180° off the surface's own, more than 45°"


# Two fingertips


def test_two_fingertips_hold_by_patches_what_points_let_swing(box):
    """Beside the centre of mass, by less than the radius of a patch."""
    config = load_config(hand="franka")
    p = np.array([[TORSION_RADIUS / 2.0, HALF, 0.0], [TORSION_RADIUS / 2.0, -HALF, 0.0]])
    found = judged(box, config, p, N[[0, 2]])
    assert found.deciding is found.patches
    assert found.points.share == np.inf and np.isfinite(found.patches.share)


@pytest.mark.parametrize(
    "setting",
    ["lift.drive=torque", "physics.friction_hand=0.2", "lift.max_acceleration=90"],
)
def test_each_setting_alone_decides(box, setting):
    """Finger 1, whose worm holds three times what its motor gives, opposes the other two."""
    heavy, order = replace(box, mass=3.0 * box.mass), [2, 0, 1]
    fast = "lift.max_speed=100"
    usual, other = (load_config(overrides=[fast, *more]) for more in ([], [setting]))
    assert judged(heavy, usual, P[order], N[order]).held
    assert not judged(heavy, other, P[order], N[order]).held
