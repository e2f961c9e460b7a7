"""What contact forces can do: moments by hand, epsilon against closed forms and programmes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import linprog
from scipy.spatial.transform import Rotation

from drakegrasp.verification.forces import (
    FRICTION_EDGES,
    GraspContacts,
    characteristic_length,
    contact_axes,
    ferrari_canny,
    grasp_map,
)

#: A contact in the middle of each face of a cube with edges of 2 m.
CUBE = np.vstack([np.eye(3), -np.eye(3)])


def some_grasp(seed, k=4):
    """Return contacts all around an ellipsoid, with their normals, and a centre of mass."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(k, 3))
    directions -= directions.mean(axis=0)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    radii = np.array([0.05, 0.03, 0.04])
    normals = directions / radii
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return directions * radii, normals, rng.uniform(-0.01, 0.01, 3)


def edge_wrenches(p, n, p_OOcm, *, friction, length):
    """Return the wrenches (n, 6) of the cones' edges, summed contact by contact."""
    angles = 2.0 * np.pi * np.arange(FRICTION_EDGES) / FRICTION_EDGES
    found = []
    for point, (inward, t1, t2) in zip(p, contact_axes(n).transpose(0, 2, 1), strict=True):
        for angle in angles:
            force = inward + friction * (np.cos(angle) * t1 + np.sin(angle) * t2)
            found.append(np.append(np.cross(point - p_OOcm, force) / length, force))
    return np.array(found)


def test_contact_axes_are_right_handed_and_start_with_the_inward_normal():
    _, normals, _ = some_grasp(0, k=20)
    axes = contact_axes(3.0 * normals)
    assert np.allclose(axes[:, :, 0], -normals)
    assert np.allclose(np.swapaxes(axes, 1, 2) @ axes, np.eye(3))
    assert np.allclose(np.linalg.det(axes), 1.0)


def test_grasp_map_sums_forces_and_their_moments_about_the_centre_of_mass():
    p, _, p_OOcm = some_grasp(1)
    forces = np.random.default_rng(1).normal(size=p.shape)
    wrench = grasp_map(p - p_OOcm) @ forces.ravel()
    assert np.allclose(wrench[:3], np.cross(p - p_OOcm, forces).sum(axis=0))
    assert np.allclose(wrench[3:], forces.sum(axis=0))


def test_characteristic_length_is_the_farthest_vertex():
    vertices = np.array([[0.0, 0.0, 0.0], [0.03, 0.0, 0.05]])
    assert characteristic_length(vertices, [0.0, 0.0, 0.01]) == pytest.approx(0.05)


def test_epsilon_of_six_contacts_on_a_cube_is_its_closed_form():
    """A torque along a diagonal is the weakest wrench, by symmetry.

    The pair of contacts on an axis gives it from friction alone, at arm 1: the support in
    the direction t is friction times the part of t across the axis, and the largest of the
    three such parts of a unit vector is smallest, sqrt(2/3), on the diagonal. The inscribed
    pyramids lose at most 1 - cos(pi / edges).
    """
    epsilon = ferrari_canny(GraspContacts(CUBE, CUBE, np.zeros(3)), friction=0.1, length=1.0)
    exact = 0.1 * np.sqrt(2.0 / 3.0)
    assert exact * np.cos(np.pi / FRICTION_EDGES) <= epsilon <= exact


@pytest.mark.parametrize("seed", range(4))
def test_epsilon_is_the_radius_that_linear_programmes_find(seed):
    """No direction is weaker than epsilon, and the hull's own weakest one is as weak."""
    p, n, p_OOcm = some_grasp(seed)
    epsilon = ferrari_canny(GraspContacts(p, n, p_OOcm), friction=0.6, length=0.06)
    edges = edge_wrenches(p, n, p_OOcm, friction=0.6, length=0.06)
    assert epsilon > 0.0
    rng = np.random.default_rng(seed)
    reaches = []
    for direction in rng.normal(size=(30, 6)):
        unit = direction / np.linalg.norm(direction)
        # The farthest r with r * unit = sum of edges with weights that sum to one.
        found = linprog(
            np.append(np.zeros(len(edges)), -1.0),
            A_eq=np.vstack(
                [
                    np.column_stack([edges.T, -unit]),
                    np.append(np.ones(len(edges)), 0.0),
                ]
            ),
            b_eq=np.append(np.zeros(6), 1.0),
        )
        reaches.append(found.x[-1])
    assert min(reaches) >= epsilon * (1.0 - 1e-7)
    # The support of the hull in any direction bounds epsilon from above; descent over
    # directions comes close to it.
    supports = [smallest_support(edges, start) for start in rng.normal(size=(12, 6))]
    assert min(supports) == pytest.approx(epsilon, rel=1e-3)


def smallest_support(edges, start):
    """Return a local minimum over unit directions u of the largest edge . u.

    With the other side of the sphere fixed by u . start = 1, each step is a linear programme.
    """
    u = start / np.linalg.norm(start)
    for _ in range(30):
        # Minimise s with edges @ v <= s and v . u = 1; then s / |v| never grows.
        found = linprog(
            np.append(np.zeros(6), 1.0),
            A_ub=np.column_stack([edges, -np.ones(len(edges))]),
            b_ub=np.zeros(len(edges)),
            A_eq=np.append(u, 0.0)[None],
            b_eq=[1.0],
            bounds=[(None, None)] * 7,
        )
        v = found.x[:6] / np.linalg.norm(found.x[:6])
        if np.allclose(v, u):
            break
        u = v
    return float((edges @ u).max())


@pytest.mark.parametrize("seed", range(3))
def test_epsilon_is_the_same_in_any_frame(seed):
    """But for the direction of the pyramids' edges about the normals."""
    p, n, p_OOcm = some_grasp(seed)
    R = Rotation.from_rotvec([0.3, -1.0, 0.5]).as_matrix()
    shift = np.array([0.2, 0.1, -0.4])
    here = ferrari_canny(GraspContacts(p, n, p_OOcm), friction=0.7, length=0.05)
    there = ferrari_canny(
        GraspContacts(p @ R.T + shift, n @ R.T, R @ p_OOcm + shift), friction=0.7, length=0.05
    )
    assert there == pytest.approx(here, rel=0.05)
    assert ferrari_canny(
        GraspContacts(10.0 * p, n, 10.0 * p_OOcm), friction=0.7, length=0.5
    ) == pytest.approx(here, rel=1e-9)


@pytest.mark.parametrize(
    ("p", "n"),
    [
        (CUBE[:1], CUBE[:1]),  # one contact
        (CUBE[[0, 3]], CUBE[[0, 3]]),  # two: no torque about their line
        (CUBE[[0, 0, 0]] + 0.1 * CUBE[:3], CUBE[[0, 0, 0]]),  # all on one face
        (CUBE, CUBE * [1.0, 1.0, 0.0] + [0.0, 0.0, 1.0]),  # all push down
        (CUBE * np.nan, CUBE),
        (CUBE, CUBE * 0.0),
    ],
)
def test_grasp_that_some_wrench_breaks_at_once_has_epsilon_zero(p, n):
    assert ferrari_canny(GraspContacts(p, n, np.zeros(3)), friction=0.5, length=1.0) == 0.0


def test_epsilon_of_two_rings_is_what_they_resist_by_twisting():
    """The weakest wrench is the torque mu r about the line between them; points have none."""
    p, n = CUBE[[0, 3]], CUBE[[0, 3]]
    assert ferrari_canny(GraspContacts(p, n, np.zeros(3)), friction=0.5, length=1.0) == 0.0
    angles = 2.0 * np.pi * np.arange(8) / 8
    ring = 0.02 * np.column_stack([np.zeros(8), np.cos(angles), np.sin(angles)])
    rings = GraspContacts(p[:, None] + ring, np.broadcast_to(n[:, None], (2, 8, 3)), np.zeros(3))
    epsilon = ferrari_canny(rings, friction=0.5, length=1.0)
    assert epsilon == pytest.approx(0.5 * 0.02, rel=0.02)
