"""The smallest forces: closed forms, cones and balance, refusals as values."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import linprog
from scipy.spatial.transform import Rotation

from drakegrasp.verification.forces import (
    FRICTION_TOLERANCE,
    MAX_FRICTION,
    ForceProgram,
    GraspContacts,
    contact_axes,
    grasp_map,
    hardest_forces,
    smallest_friction,
)

WEIGHT = 9.81  # of 1 kg [N]
#: The wrench that carries 1 kg at rest, +Oz up.
CARRY = np.array([0.0, 0.0, 0.0, 0.0, 0.0, WEIGHT])
MU = 0.71
ORIGIN = np.zeros(3)


def ring(k, radius=0.04):
    """Return k contacts around an upright cylinder at the height of its centre."""
    angles = 2.0 * np.pi * np.arange(k) / k
    normals = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(k)])
    return radius * normals, normals


def smallest_forces(p, n, p_OOcm, wrench, friction, **limits):
    """Return the smallest forces of one wrench."""
    return ForceProgram(GraspContacts(p, n, p_OOcm, **limits), friction).smallest(wrench)


#: Two contacts on one face of a box, one in the middle of the opposite face.
PINCH = (
    np.array([[0.02, 0.03, 0.0], [-0.02, 0.03, 0.0], [0.0, -0.03, 0.0]]),
    np.array([[0.0, 1.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0]]),
)


def some_grasp(seed, k=3):
    """Return a ring of contacts that are moved and tilted at random, and a centre of mass."""
    rng = np.random.default_rng(seed)
    p, n = ring(k)
    n = n + rng.uniform(-0.2, 0.2, n.shape)
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    return p + rng.uniform(-0.005, 0.005, p.shape), n, rng.uniform(-0.005, 0.005, 3)


def assert_in_cones(forces, n, friction):
    push = -np.einsum("ij,ij->i", forces.f_Q_O, n)
    tangential = np.linalg.norm(forces.f_Q_O + push[:, None] * n, axis=1)
    assert np.all(push >= -1e-6)
    assert np.all(tangential <= friction * push + 1e-6)
    assert forces.largest_normal == pytest.approx(push.max(), abs=1e-6)


@pytest.mark.parametrize("k", [2, 3, 4, 7])
def test_contacts_around_a_cylinder_share_its_weight_by_friction(k):
    p, n = ring(k)
    forces = smallest_forces(p, n, ORIGIN, CARRY, MU)
    assert forces.feasible
    assert forces.largest_normal == pytest.approx(WEIGHT / (k * MU), rel=1e-6)
    assert np.allclose(forces.f_Q_O[:, 2], WEIGHT / k, atol=1e-5)


def test_finger_that_opposes_two_presses_as_hard_as_both():
    """Its friction carries half of the weight: N = m g / (2 mu)."""
    forces = smallest_forces(*PINCH, ORIGIN, CARRY, MU)
    assert forces.largest_normal == pytest.approx(WEIGHT / (2.0 * MU), rel=1e-6)
    assert forces.f_Q_O[2, 1] == pytest.approx(WEIGHT / (2.0 * MU), rel=1e-5)


def test_finger_below_the_centre_of_mass_carries_it_without_friction():
    forces = smallest_forces([[0.0, 0.0, -0.03]], [[0.0, 0.0, -1.0]], ORIGIN, CARRY, 0.0)
    assert forces.feasible
    assert np.allclose(forces.f_Q_O, [[0.0, 0.0, WEIGHT]])


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("k", [3, 5])
def test_forces_stay_in_their_cones_and_sum_to_the_wrench(seed, k):
    p, n, p_OOcm = some_grasp(seed, k)
    wrench = CARRY + np.random.default_rng(seed).uniform(-0.05, 0.05, 6) * [1, 1, 1, 20, 20, 20]
    forces = smallest_forces(p, n, p_OOcm, wrench, MU)
    assert forces.feasible
    assert_in_cones(forces, n, MU)
    assert np.allclose(grasp_map(p - p_OOcm) @ forces.f_Q_O.ravel(), wrench, atol=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_linear_programme_with_pyramids_needs_hardly_more(seed):
    """Pyramids of 64 edges lie within the cones and fill all but 0.12 % of their radius."""
    p, n, p_OOcm = some_grasp(seed)
    angles = 2.0 * np.pi * np.arange(64) / 64
    pyramid = np.stack([np.ones(64), MU * np.cos(angles), MU * np.sin(angles)])
    blocks = grasp_map(p - p_OOcm).reshape(6, 3, 3)
    edges = np.einsum("wki,kie->wke", blocks, contact_axes(n) @ pyramid).reshape(6, -1)
    found = linprog(
        np.append(np.zeros(edges.shape[1]), 1.0),
        A_ub=np.column_stack([np.kron(np.eye(3), np.ones(64)), -np.ones(3)]),
        b_ub=np.zeros(3),
        A_eq=np.column_stack([edges, np.zeros(6)]),
        b_eq=CARRY,
    )
    smallest = smallest_forces(p, n, p_OOcm, CARRY, MU).largest_normal
    assert smallest <= found.fun * (1.0 + 1e-6)
    assert smallest == pytest.approx(found.fun, rel=0.01)


@pytest.mark.parametrize("seed", range(3))
def test_forces_move_and_turn_with_the_frame(seed):
    p, n, p_OOcm = some_grasp(seed)
    R = Rotation.from_rotvec([1.0, -0.4, 0.7]).as_matrix()
    shift = np.array([0.3, -0.2, 0.9])
    turned = np.concatenate([R @ CARRY[:3], R @ CARRY[3:]])
    here = smallest_forces(p, n, p_OOcm, CARRY, MU)
    there = smallest_forces(p @ R.T + shift, n @ R.T, R @ p_OOcm + shift, turned, MU)
    assert there.largest_normal == pytest.approx(here.largest_normal, rel=1e-6)
    assert np.allclose(there.f_Q_O, here.f_Q_O @ R.T, atol=1e-3)  # they are not unique


def test_one_programme_serves_all_wrenches_in_any_order():
    p, n, p_OOcm = some_grasp(3)
    program = ForceProgram(GraspContacts(p, n, p_OOcm, force_limit=20.0), MU)
    heavy = program.smallest(2.0 * CARRY)
    program.smallest([1.0, 0.0, 0.0, 0.0, 0.0, 100.0])
    light = program.smallest(CARRY)
    assert heavy.largest_normal == pytest.approx(2.0 * light.largest_normal, rel=1e-6)
    alone = ForceProgram(GraspContacts(p, n, p_OOcm), MU).smallest(CARRY)
    assert np.array_equal(light.f_Q_O, alone.f_Q_O)


@pytest.mark.parametrize(
    ("p", "n"),
    [
        (
            PINCH[0] * [1.0, 0.0, 1.0] + [0.0, 0.03, 0.0],
            np.tile([0.0, 1.0, 0.0], (3, 1)),
        ),  # one side
        (PINCH[0], PINCH[1] * [[-1.0], [-1.0], [1.0]]),  # two of three reversed
        (PINCH[0] + [0.0, 0.0, 0.0], PINCH[1] * 0.0),  # no direction
        (PINCH[0] * np.nan, PINCH[1]),
        (PINCH[0] + [np.inf, 0.0, 0.0], PINCH[1]),
    ],
)
def test_grasp_that_cannot_carry_the_object_says_so(p, n):
    forces = smallest_forces(p, n, ORIGIN, CARRY, MU)
    assert not forces.feasible
    assert forces.largest_normal == np.inf
    assert np.isnan(forces.f_Q_O).all()
    assert smallest_friction(GraspContacts(p, n, ORIGIN, 20.0), [CARRY]) == np.inf


def test_no_load_needs_no_force_and_a_wrench_that_is_not_finite_cannot_be_given():
    forces = smallest_forces(*PINCH, ORIGIN, np.zeros(6), MU)
    assert forces.feasible and forces.largest_normal == 0.0 and not forces.f_Q_O.any()
    assert not smallest_forces(*PINCH, ORIGIN, CARRY * np.nan, MU).feasible


@pytest.mark.parametrize("limit", [5.0, 20.0])
def test_smallest_friction_of_a_ring_is_its_share_of_the_weight(limit):
    p, n = ring(3)
    friction = smallest_friction(GraspContacts(p, n, ORIGIN, limit), [CARRY, 0.5 * CARRY])
    exact = WEIGHT / (3.0 * limit)
    assert exact <= friction <= exact + FRICTION_TOLERANCE * (1.0 + 1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_smallest_friction_is_where_the_force_limit_is_met(seed):
    p, n, p_OOcm = some_grasp(seed)
    loads = np.array([1.1 * CARRY, 0.9 * CARRY])
    friction = smallest_friction(GraspContacts(p, n, p_OOcm, 20.0), loads)
    at = hardest_forces(ForceProgram(GraspContacts(p, n, p_OOcm), friction), loads).largest_normal
    below = hardest_forces(
        ForceProgram(GraspContacts(p, n, p_OOcm), friction - 2e-4), loads
    ).largest_normal
    assert at <= 20.0 < below


def test_smallest_friction_is_infinite_where_the_limit_is_too_low():
    p, n = ring(3)
    limit = 0.99 * WEIGHT / (3.0 * MAX_FRICTION)
    assert smallest_friction(GraspContacts(p, n, ORIGIN, limit), [CARRY]) == np.inf


def test_no_forces_take_a_smaller_share_of_unequal_limits():
    """Doubling the limit of the finger that presses hardest halves the share, and no more."""
    forces = smallest_forces(*PINCH, ORIGIN, CARRY, MU, force_limit=[20.0, 20.0, 40.0])
    # Finger 3 presses as hard as both others: N = m g / (2 mu), half of that on each of them.
    normal = WEIGHT / (2.0 * MU)
    assert forces.share == pytest.approx(normal / 40.0, rel=1e-6)
    assert np.allclose(forces.normal, [normal / 2.0, normal / 2.0, normal], rtol=1e-5)
    weak = smallest_forces(*PINCH, ORIGIN, CARRY, MU, force_limit=[40.0, 40.0, 20.0])
    assert weak.share == pytest.approx(normal / 20.0, rel=1e-6)


def two_rings(offset, radius):
    """Return rings of eight points on opposite faces, `offset` [m] beside the centre."""
    angles = 2.0 * np.pi * np.arange(8) / 8
    ring = radius * np.column_stack([np.cos(angles), np.zeros(8), np.sin(angles)])
    p = np.stack([ring + np.array([offset, side * 0.03, 0.0]) for side in (1.0, -1.0)])
    n = np.broadcast_to(np.array([[[0.0, 1.0, 0.0]], [[0.0, -1.0, 0.0]]]), p.shape)
    return p, n


def test_two_points_resist_no_torque_about_their_line_and_two_rings_do():
    """All points at one radius and one direction of friction: mu N r = M / 2 on each ring."""
    radius, torque = 0.003, 0.02
    twist = np.array([0.0, torque, 0.0, 0.0, 0.0, 0.0])
    p, n = two_rings(0.0, radius)
    assert not smallest_forces(p.mean(axis=1), n[:, 0], ORIGIN, twist, MU).feasible
    forces = smallest_forces(p, n, ORIGIN, twist, MU)
    assert forces.feasible
    assert np.allclose(forces.normal, torque / 2.0 / (MU * radius), rtol=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_points_of_a_finger_share_its_limit_and_stay_in_their_cones(seed):
    """The sum of their normal parts is what the finger presses with."""
    rng = np.random.default_rng(seed)
    p, n = two_rings(0.002, 0.003)
    n = n + rng.uniform(-0.2, 0.2, n.shape)
    n /= np.linalg.norm(n, axis=2, keepdims=True)
    limits = np.array([20.0, 30.0])
    forces = smallest_forces(p, n, ORIGIN, CARRY, MU, force_limit=limits)
    push = -np.einsum("ij,ij->i", forces.f_Q_O, n.reshape(-1, 3))
    tangential = np.linalg.norm(forces.f_Q_O + push[:, None] * n.reshape(-1, 3), axis=1)
    assert forces.feasible
    assert np.all(tangential <= MU * push + 1e-6)
    assert np.allclose(push.reshape(2, 8).sum(axis=1), forces.normal, atol=1e-6)
    assert np.allclose(forces.shares, forces.normal / limits)
    moments = np.cross(p.reshape(-1, 3), forces.f_Q_O).sum(axis=0)
    assert np.allclose(np.append(moments, forces.f_Q_O.sum(axis=0)), CARRY, atol=1e-6)


def test_ring_beside_the_centre_of_mass_holds_where_its_middle_does_not():
    p, n = two_rings(0.002, 0.003)
    middle = GraspContacts(p.mean(axis=1), n[:, 0], ORIGIN, [20.0, 30.0])
    assert smallest_friction(middle, [CARRY]) == np.inf
    assert smallest_friction(GraspContacts(p, n, ORIGIN, [20.0, 30.0]), [CARRY]) < 0.5
