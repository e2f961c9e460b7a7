"""Lifting by forces alone: closed forms, refusals, and a simulation that can say no."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from helpers.objects import CUBE, standing
from scipy.spatial.transform import Rotation

from drakegrasp.config import Config
from drakegrasp.frames import X_WT, make_pose, rotation_about
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.settings import load_config, override_config
from drakegrasp.hand.strength import fingertip_forces
from drakegrasp.simulation.construction import build_object_scene
from drakegrasp.simulation.scene import ObjectScene, advance, reset_object
from drakegrasp.simulation.trajectory import PEAK_ACCELERATION, lift_duration, lift_path
from drakegrasp.verification.forces import lift as force_lift_module
from drakegrasp.verification.forces.contact_forces import (
    GraspContacts,
    hand_contacts,
    patch_torsion_radius,
)
from drakegrasp.verification.forces.lift import ForceLift, LiftEnd, lift_by_forces
from drakegrasp.verification.forces.quality import force_margin

pytestmark = pytest.mark.sim

GRAVITY, LIMIT = 9.81, 20.0
HALF = CUBE / 2.0
#: Two contacts on one face of the cube, one in the middle of the opposite face.
P = np.array([[0.02, HALF, 0.0], [-0.02, HALF, 0.0], [0.0, -HALF, 0.0]])
N = np.array([[0.0, 1.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])


@pytest.fixture(scope="module")
def scene(cube, config) -> ObjectScene:
    return build_object_scene(cube, config.physics)


def lifted(
    scene: ObjectScene,
    config: Config,
    p: npt.ArrayLike = P,
    n: npt.ArrayLike = N,
    limit: npt.ArrayLike = LIMIT,
    X_TO: np.ndarray | None = None,
) -> ForceLift:
    """Lift the cube of a scene by forces at contacts."""
    contacts = GraspContacts(p, n, scene.model.p_OOcm, limit, patch_torsion_radius(len(p)))
    return lift_by_forces(scene, standing(scene.model) if X_TO is None else X_TO, contacts, config)


@pytest.fixture(scope="module")
def held(scene, cube, config) -> ForceLift:
    return lifted(scene, config)


def heaviest(config: Config) -> float:
    """Return the force that carries the cube [N] where it is accelerated upwards the most."""
    distance = config.lift.p_TG[2] - HALF
    return GRAVITY + PEAK_ACCELERATION * distance / lift_duration(distance, config) ** 2


def test_cube_held_on_its_faces_arrives(held, config):
    assert held.held
    assert held.end is LiftEnd.HELD
    assert held.position_error < 1e-4
    assert held.angle_error < 1e-3
    assert np.allclose(held.X_TO_lifted, make_pose(np.eye(3), config.lift.p_TG), atol=1e-3)
    assert held.steps > 0
    assert held.message == ""


def test_forces_of_the_lift_are_the_closed_form(held, config):
    """The finger that opposes two carries half of the load by friction."""
    load = heaviest(config)
    mu = config.physics.friction_hand
    assert held.planned_force == pytest.approx(load / (2.0 * mu), rel=1e-6)
    assert held.applied_force == pytest.approx(held.planned_force, rel=0.02)


def test_more_friction_than_the_smallest_holds_and_less_does_not(scene, cube, config):
    smallest = force_margin(
        cube, standing(cube), hand_contacts(cube, P, N, config), config
    ).smallest_friction
    for factor, outcome in ((1.001, LiftEnd.HELD), (0.999, LiftEnd.OVER_LIMIT)):
        friction = factor * smallest
        changed = load_config(overrides=[f"physics.friction_hand={friction}"])
        limits = fingertip_forces(load_hand(), "worm")
        found = lifted(scene, changed, limit=limits)
        assert found.end is outcome


def test_slippery_cube_takes_more_than_a_fingertip_can_give(scene):
    slippery = load_config(overrides=["physics.friction_hand=0.05"])
    found = lifted(scene, slippery)
    assert found.end is LiftEnd.OVER_LIMIT
    assert not found.held
    assert found.planned_force == pytest.approx(heaviest(slippery) / 0.1, rel=1e-6)
    assert found.X_TO_lifted is None
    assert np.isnan(found.position_error)
    assert found.steps == 0


def test_friction_of_the_object_wins_over_the_configured_one(cube, config):
    slippery = replace(cube, friction=0.05)
    bare = build_object_scene(slippery, config.physics)
    assert bare.physics.friction_hand == bare.physics.friction_table == 0.05
    found = lifted(bare, config)
    assert found.planned_force == pytest.approx(heaviest(config) / 0.1, rel=1e-6)
    margins = [
        force_margin(model, standing(cube), hand_contacts(model, P, N, config), config)
        for model in (cube, slippery)
    ]
    assert margins[1].epsilon < margins[0].epsilon


def test_contacts_that_cannot_carry_the_cube_are_infeasible(scene, config):
    found = lifted(scene, config, P, N * [[-1.0], [-1.0], [1.0]])
    assert found.end is LiftEnd.INFEASIBLE
    assert found.planned_force == np.inf


def test_turned_cube_is_held_as_well(scene, cube, config, held):
    """Turned about the vertical, with the contacts of {O}; no figure may change."""
    X_TO = standing(cube)
    X_TO[:3, :3] = Rotation.from_rotvec([0.0, 0.0, 0.7]).as_matrix()
    found = lifted(scene, config, X_TO=X_TO)
    assert found.held
    assert found.planned_force == pytest.approx(held.planned_force, rel=1e-6)
    assert np.allclose(found.X_TO_lifted[:3, :3], X_TO[:3, :3], atol=1e-3)


def test_lift_keeps_its_speed_and_its_straight_path(scene, config, monkeypatch):
    heights: list[float] = []
    sideways: list[float] = []

    def watch(scene: ObjectScene, duration: float) -> None:
        advance(scene, duration)
        p = scene.pose(scene.object)[:3, 3]
        heights.append(p[2])
        sideways.append(float(np.abs(p[:2]).max()))

    monkeypatch.setattr(force_lift_module, "advance", watch)
    found = lifted(scene, config)
    assert found.held
    assert len(heights) == found.steps
    step = config.physics.time_step * force_lift_module.STEPS_PER_CONTROL
    assert np.abs(np.diff(heights)).max() / step <= 1.02 * config.lift.max_speed
    assert max(sideways) < 1e-3


@pytest.mark.parametrize("limit", [LIMIT, 3.0])
def test_object_that_is_heavier_than_believed_is_lost(scene, cube, config, limit):
    """The forces are computed for a tenth of the mass, the simulation has all of it."""
    deceived = replace(scene, model=replace(cube, mass=0.1, I_OOcm_O=0.1 * cube.I_OOcm_O))
    found = lifted(deceived, config, limit=limit)
    assert found.planned_force < limit
    assert found.end is LiftEnd.STRAYED
    assert found.position_error > config.verify.max_position_error
    assert found.applied_force <= limit * (1.0 + 1e-6)


@pytest.mark.parametrize(
    ("p", "n", "end"),
    [
        ([[0.0, 0.0, -HALF]], [[0.0, 0.0, -1.0]], LiftEnd.STRAYED),  # balanced on one finger
        (P, N, LiftEnd.HELD),
    ],
)
def test_nudged_cube_is_held_by_a_grasp_and_lost_by_a_balance(
    scene, cube, config, monkeypatch, p, n, end
):
    """One finger below carries the cube, but nothing turns it back once it leans."""

    def nudge(scene: ObjectScene, duration: float) -> None:
        advance(scene, duration)
        if 1.0 < scene.time < 1.0 + 1.5 * duration:
            velocity = np.zeros(6)
            velocity[0] = 0.05  # about Wx [rad/s]
            scene.plant.SetVelocities(scene.context, velocity)

    monkeypatch.setattr(force_lift_module, "advance", nudge)
    found = lifted(scene, config, p, n)
    assert found.planned_force < LIMIT
    assert found.end is end


def test_same_lift_gives_the_same_bits_whatever_ran_before(scene, cube, config, held):
    deceived = replace(scene, model=replace(cube, mass=0.1))
    lifted(deceived, config)
    again = lifted(scene, config)
    fresh = build_object_scene(cube, config.physics)
    for other in (
        again,
        lifted(fresh, config),
    ):
        assert np.array_equal(other.X_TO_lifted, held.X_TO_lifted)
        assert other.applied_force == held.applied_force
        assert other.planned_force == held.planned_force


def test_no_force_is_left_behind(scene, cube, config, held):
    """The cube falls from the air as in a scene that never knew a force."""
    lifted(scene, config)
    heights = []
    for used in (scene, build_object_scene(cube, config.physics)):
        reset_object(used, X_WT @ make_pose(np.eye(3), [0.0, 0.0, 0.5]))
        used.simulator.Initialize()
        advance(used, 0.1)
        heights.append(used.pose(used.object)[2, 3])
    assert heights[0] == heights[1]
    assert heights[0] < X_WT[2, 3] + 0.5 - 0.04


@pytest.mark.parametrize("error", [RuntimeError("broken\nlong story"), SystemExit("abort")])
def test_error_within_drake_is_an_outcome(scene, config, monkeypatch, error):
    def fail(*_):
        raise error

    monkeypatch.setattr(force_lift_module, "advance", fail)
    found = lifted(scene, config)
    assert found.end is LiftEnd.ERROR
    assert found.message == str(error).splitlines()[0]
    assert not found.held


def test_lift_that_takes_too_long_is_a_timeout(scene, config):
    """Computing time, as of an attempt; what was planned is there all the same."""
    hasty = config.model_copy(update={"attempt_seconds": 1e-9})
    found = lifted(scene, hasty)
    assert found.end is LiftEnd.TIMEOUT
    assert found.planned_force > 0.0
    assert not found.held


def test_limit_is_that_of_the_finger(scene, config):
    """Finger 3 opposes two: it needs twice their force, and only its own limit counts for it."""
    mu = config.physics.friction_hand
    needed = heaviest(config) / (2.0 * mu)
    weak = 0.9 * needed
    for limits, outcome in (
        ([weak, weak, 1.1 * needed], LiftEnd.HELD),
        ([1.1 * needed, 1.1 * needed, weak], LiftEnd.OVER_LIMIT),
    ):
        found = lifted(scene, config, limit=limits)
        assert found.end is outcome
        assert found.planned_force == pytest.approx(needed, rel=1e-4)
        assert found.planned_share == pytest.approx(needed / limits[2], rel=1e-4)


def test_two_fingertips_hold_a_cube_beside_its_centre_by_torsion(scene, config):
    """As points they would let it swing about the line between them."""
    p = np.array([[0.004, HALF, 0.0], [0.004, -HALF, 0.0]])
    n = np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])
    found = lifted(scene, config, p, n, [LIMIT, LIMIT])
    share = np.hypot(1.0, 0.004 / patch_torsion_radius(2)) / 2.0
    mu = config.physics.friction_hand
    assert found.planned_force == pytest.approx(heaviest(config) * share / mu, rel=1e-4)
    assert found.end is LiftEnd.HELD
    assert found.angle_error < 1e-3


@pytest.mark.parametrize(
    ("limit", "found"),
    [("max_position_error", "position_error"), ("max_angle_error_deg", "angle_error")],
)
def test_lift_that_ends_beyond_a_limit_has_strayed(scene, config, monkeypatch, limit, found):
    """At each look it is off by 1 mm and 1 degree; the other limit is far above."""
    off = (1e-3, np.deg2rad(1.0))
    monkeypatch.setattr(force_lift_module, "_deviation", lambda *_: off)
    amount = {"max_position_error": 1e-3, "max_angle_error_deg": 1.0}[limit]
    for factor, end in ((1.01, LiftEnd.HELD), (0.99, LiftEnd.STRAYED), (0.2, LiftEnd.STRAYED)):
        rules = ["verify.max_position_error=1", "verify.max_angle_error_deg=90"]
        limited = override_config(config, [*rules, f"verify.{limit}={factor * amount}"])
        ended = lifted(scene, limited)
        assert ended.end is end
        assert getattr(ended, found) == off[found == "angle_error"]


def test_deviation_is_distance_and_angle_from_the_path(scene, cube, config):
    path = lift_path(standing(cube), config)
    X_WO = path.X_WO @ make_pose(rotation_about([0.0, 1.0, 0.0], 0.2), [0.003, 0.0, 0.004])
    reset_object(scene, X_WO)
    assert force_lift_module._deviation(scene, path) == pytest.approx((0.005, 0.2))
