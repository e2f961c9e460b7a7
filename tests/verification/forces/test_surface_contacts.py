"""What a prediction selects: the surface's own points and normals, and patches about them."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from helpers.objects import CUBE, box_model, model_of

from drakegrasp.verification.forces import (
    MAX_ANGLE,
    MAX_DISTANCE,
    RING_POINTS,
    TORSION_RADIUS,
    patch_points,
    surface_contacts,
)

HALF = CUBE / 2.0
RIGHT, UP = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def box(tmp_path_factory):
    return box_model(tmp_path_factory.mktemp("box"), [CUBE] * 3)


def leaning(angle):
    """Return a normal that leans from +x towards +z by an angle [rad]."""
    return np.array([np.cos(angle), 0.0, np.sin(angle)])


def test_points_beside_a_face_select_it_and_its_normal(box):
    """In the air, inside and on it, with the angle of the prediction's own normal."""
    p = np.array([[HALF + 0.004, 0.01, 0.0], [HALF - 0.003, 0.01, 0.0], [HALF, 0.01, 0.0]])
    found = surface_contacts(box, p, [RIGHT, leaning(0.5), leaning(-0.2)])
    assert np.allclose(found.p_OQ, [HALF, 0.01, 0.0])
    assert np.allclose(found.nhat_Q_O, RIGHT)
    assert np.allclose(found.distance, [0.004, 0.003, 0.0])
    assert found.inside.tolist()[:2] == [False, True]
    assert np.allclose(found.angle, [0.0, 0.5, 0.2])
    assert not found.off_surface.any()


@pytest.mark.parametrize("inside", [False, True])
def test_points_too_far_from_the_surface_are_off_it(box, inside):
    sign = -1.0 if inside else 1.0
    p = [[HALF + sign * (MAX_DISTANCE + shift), 0.0, 0.0] for shift in (-1e-6, 1e-4, 0.01)]
    found = surface_contacts(box, p, [RIGHT] * 3)
    assert found.off_surface.tolist() == [False, True, True]
    assert found.inside.tolist() == [inside] * 3


def test_normals_too_far_from_the_surfaces_own_are_off_it(box):
    angles = [MAX_ANGLE - 1e-6, MAX_ANGLE, MAX_ANGLE + 1e-6, np.pi]
    found = surface_contacts(box, [[HALF, 0.0, 0.0]] * 4, [leaning(angle) for angle in angles])
    assert np.allclose(found.angle, angles)
    assert found.off_surface.tolist() == [False, False, True, True]


def test_at_an_edge_the_normal_chooses_between_the_faces(box):
    edge = [HALF, 0.0, HALF]
    found = surface_contacts(box, [edge] * 2, [leaning(0.4), leaning(1.2)])
    assert np.allclose(found.nhat_Q_O, [RIGHT, UP])
    assert np.allclose(found.p_OQ, edge)


def test_a_normal_cannot_name_the_other_side_of_a_wall(tmp_path):
    """No fingertip fits where a flipped normal would have it, e.g. within a bottle."""
    plate = box_model(tmp_path, [0.003, 0.1, 0.1])
    p = [[-0.0015, 0.01, 0.0], [0.0015, 0.01, 0.0]]
    found = surface_contacts(plate, p, [RIGHT, RIGHT])
    assert np.allclose(found.p_OQ, p)
    assert found.off_surface.tolist() == [True, False]


def test_patch_on_a_plane_is_a_ring_with_the_planes_normal(box):
    contacts = surface_contacts(box, [[HALF, 0.01, -0.005]], [RIGHT])
    points, normals = patch_points(box, contacts)
    assert points.shape == normals.shape == (1, 1 + RING_POINTS, 3)
    away = np.linalg.norm(points[0] - contacts.p_OQ[0], axis=1)
    assert np.allclose(away, [0.0, *[TORSION_RADIUS] * RING_POINTS])
    assert np.allclose(points[0, :, 0], HALF)
    assert np.allclose(normals, RIGHT)


def test_patch_ends_at_a_sharp_edge(box):
    """No finger that presses on one side holds by the other."""
    contacts = surface_contacts(box, [[HALF, 0.0, HALF - 0.001]], [RIGHT])
    points, normals = patch_points(box, contacts)
    assert points[..., 2].max() == pytest.approx(HALF)
    assert np.allclose(points[..., 0], HALF)
    assert np.allclose(normals, RIGHT)


def test_patch_on_a_ball_has_the_normals_of_its_own_faces(tmp_path):
    radius = 0.02
    ball = model_of(trimesh.creation.icosphere(4, radius), tmp_path)
    contacts = surface_contacts(ball, [[radius, 0.0, 0.0]], [RIGHT])
    points, normals = patch_points(ball, contacts)
    assert np.allclose(np.linalg.norm(points, axis=2), radius, atol=1e-4)
    assert np.allclose(normals, points / radius, atol=0.06)
    tilt = np.arccos(normals[0, 1:] @ contacts.nhat_Q_O[0])
    assert np.allclose(tilt, np.arctan(TORSION_RADIUS / radius), atol=0.1)
