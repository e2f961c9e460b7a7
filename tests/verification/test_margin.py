"""The margin of contacts: what a prediction selects, epsilon by closed forms.

How far points are from an object's surface, and whether normals point out of it.
"""

from __future__ import annotations

import numpy as np
import pytest
from helpers.objects import CUBE, box_model

from drakegrasp.config import PhysicsConfig
from drakegrasp.verification.hints import WALL, fit_surface
from drakegrasp.verification.prediction import (
    FRICTION_EDGES,
    MAX_ANGLE,
    MAX_DISTANCE,
    contact_epsilon,
    ferrari_canny,
    surface_contacts,
)

HALF = CUBE / 2.0
RIGHT, UP = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
#: A contact in the middle of each face of a cube with edges of 2 m.
FACES = np.vstack([np.eye(3), -np.eye(3)])


def leaning(angle):
    """Return a normal that leans from +x towards +z by an angle [rad]."""
    return np.array([np.cos(angle), 0.0, np.sin(angle)])


@pytest.mark.parametrize(
    ("p", "n", "point", "normal"),
    [
        # In the air, inside and on a face, with the angle of the prediction's own normal.
        ([HALF + 0.004, 0.01, 0.0], RIGHT, [HALF, 0.01, 0.0], RIGHT),
        ([HALF - 0.003, 0.01, 0.0], leaning(0.5), [HALF, 0.01, 0.0], RIGHT),
        ([HALF, 0.01, 0.0], leaning(-0.2), [HALF, 0.01, 0.0], RIGHT),
        # At an edge the normal chooses between the faces.
        ([HALF, 0.0, HALF], leaning(0.4), [HALF, 0.0, HALF], RIGHT),
        ([HALF, 0.0, HALF], leaning(1.2), [HALF, 0.0, HALF], UP),
        # Where no face agrees or is near, the closest of all.
        ([HALF, 0.01, 0.0], leaning(MAX_ANGLE + 0.1), [HALF, 0.01, 0.0], RIGHT),
        ([HALF + MAX_DISTANCE + 0.01, 0.01, 0.0], UP, [HALF, 0.01, 0.0], RIGHT),
    ],
)
def test_prediction_selects_a_point_of_the_surface_and_its_normal(cube, p, n, point, normal):
    p_OQ, nhat_Q_O = surface_contacts(cube, np.array([p]), n[None])
    np.testing.assert_allclose(p_OQ, [point], atol=1e-12)
    np.testing.assert_allclose(nhat_Q_O, normal[None], atol=1e-12)


def test_a_normal_cannot_name_the_other_side_of_a_wall(tmp_path):
    """No fingertip fits where a flipped normal would have it, e.g. within a bottle."""
    plate = box_model(tmp_path, [0.003, 0.1, 0.1])
    p = np.array([[-0.0015, 0.01, 0.0], [0.0015, 0.01, 0.0]])
    np.testing.assert_allclose(surface_contacts(plate, p, np.array([RIGHT, RIGHT]))[0], p)


def test_epsilon_of_six_contacts_on_a_cube_is_its_closed_form():
    """A torque along a diagonal is the weakest wrench, by symmetry.

    The pair of contacts on an axis gives it from friction alone, at arm 1: the support in
    the direction t is friction times the part of t across the axis, and the largest of the
    three such parts of a unit vector is smallest, sqrt(2/3), on the diagonal. The inscribed
    pyramids lose at most 1 - cos(pi / edges).
    """
    epsilon = ferrari_canny(FACES, FACES, friction=0.1, length=1.0)
    exact = 0.1 * np.sqrt(2.0 / 3.0)
    assert exact * np.cos(np.pi / FRICTION_EDGES) <= epsilon <= exact


@pytest.mark.parametrize(
    ("p", "n"),
    [
        (FACES[:1], FACES[:1]),  # one contact
        (FACES[[0, 3]], FACES[[0, 3]]),  # two: no torque about their line
        (FACES[[0, 0, 0]] + 0.1 * FACES[:3], FACES[[0, 0, 0]]),  # all on one face
        (FACES, FACES * [1.0, 1.0, 0.0] + [0.0, 0.0, 1.0]),  # all push down
    ],
)
def test_grasp_that_some_wrench_breaks_at_once_has_epsilon_zero(p, n):
    assert ferrari_canny(p, n, friction=0.5, length=1.0) == 0.0


def test_epsilon_of_predicted_contacts_is_that_of_the_surface_under_the_objects_friction(cube):
    """Torques are divided by the distance of a corner from the centre of mass."""
    physics, corner = PhysicsConfig(), np.sqrt(3.0) * HALF
    expected = ferrari_canny(
        HALF * FACES, FACES, friction=physics.friction_hand, length=float(corner)
    )
    found = contact_epsilon(cube, 1.1 * HALF * FACES, FACES, physics)
    assert found == pytest.approx(expected, rel=1e-6) and found > 0.0


#: Extents of boxes [m].
SLAB, THIN, THICK = [0.06, 0.08, 0.1], [0.1, 0.1, 0.002], [0.1, 0.1, 0.008]
Y = np.array([0.0, 1.0, 0.0])


@pytest.mark.parametrize(
    ("extents", "p", "n", "out"),
    [
        # A little inside or outside of a face, and leaning.
        (SLAB, [0.032, 0.0, 0.0], RIGHT, True),
        (SLAB, [0.028, 0.0, 0.0], -RIGHT, False),
        (SLAB, [-0.03, 0.0, 0.0], Y - RIGHT, True),
        (SLAB, [0.03, 0.0, 0.0], Y - RIGHT, False),
        # Beside an edge either face will do, farther from it only the first.
        (SLAB, [0.03, 0.039, 0.0], Y, True),
        (SLAB, [0.03, 0.039, 0.0], -Y, False),
        (SLAB, [0.03, 0.04 - 2.0 * WALL, 0.0], Y, False),
        # Either side of a thin wall, but not along it; of a thick one, the near side.
        (THIN, [0.0, 0.0, 0.005], UP, True),
        (THIN, [0.0, 0.0, 0.005], -UP, True),
        (THIN, [0.0, 0.0, 0.005], Y, False),
        (THICK, [0.0, 0.0, 0.013], UP, True),
        (THICK, [0.0, 0.0, 0.013], -UP, False),
    ],
)
def test_a_normal_points_out_of_a_face_that_is_next_to_its_point(tmp_path, extents, p, n, out):
    normal = n / np.linalg.norm(n)
    found = fit_surface(box_model(tmp_path, extents), np.array([p]), normal[None])
    assert (found.agreement[0] > 0.1) == out
