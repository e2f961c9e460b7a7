"""The margin of contacts: what a prediction selects, epsilon by closed forms and programmes.

How far points are from an object's surface, and whether normals point out of it.
"""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from helpers.objects import CUBE, box_model, model_of
from scipy.optimize import linprog
from scipy.spatial.transform import Rotation

from drakegrasp.config import PhysicsConfig
from drakegrasp.verification.hints import WALL, fit_surface
from drakegrasp.verification.margin import (
    FRICTION_EDGES,
    MAX_ANGLE,
    MAX_DISTANCE,
    contact_axes,
    contact_epsilon,
    ferrari_canny,
    surface_contacts,
)

HALF = CUBE / 2.0
RIGHT, UP = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
#: A contact in the middle of each face of a cube with edges of 2 m.
FACES = np.vstack([np.eye(3), -np.eye(3)])


@pytest.fixture(scope="module")
def box(tmp_path_factory):
    return box_model(tmp_path_factory.mktemp("box"), [CUBE] * 3)


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
def test_prediction_selects_a_point_of_the_surface_and_its_normal(box, p, n, point, normal):
    p_OQ, nhat_Q_O = surface_contacts(box, np.array([p]), n[None])
    np.testing.assert_allclose(p_OQ, [point], atol=1e-12)
    np.testing.assert_allclose(nhat_Q_O, normal[None], atol=1e-12)


def test_a_normal_cannot_name_the_other_side_of_a_wall(tmp_path):
    """No fingertip fits where a flipped normal would have it, e.g. within a bottle."""
    plate = box_model(tmp_path, [0.003, 0.1, 0.1])
    p = np.array([[-0.0015, 0.01, 0.0], [0.0015, 0.01, 0.0]])
    np.testing.assert_allclose(surface_contacts(plate, p, np.array([RIGHT, RIGHT]))[0], p)


def some_grasp(seed, k=4):
    """Return contacts all around an ellipsoid, with their normals, and a centre of mass."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(k, 3))
    directions -= directions.mean(axis=0)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    radii = np.array([0.05, 0.03, 0.04])
    normals = directions / radii
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return directions * radii - rng.uniform(-0.01, 0.01, 3), normals


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


@pytest.mark.parametrize("seed", range(3))
def test_no_direction_is_weaker_than_epsilon(seed):
    """As linear programmes find it: the farthest r with r u = sum of w e, w >= 0 of sum one."""
    p, n = some_grasp(seed)
    epsilon = ferrari_canny(p, n, friction=0.6, length=0.06)
    edges = []
    for point, (inward, t1, t2) in zip(p, contact_axes(n).transpose(0, 2, 1), strict=True):
        for angle in 2.0 * np.pi * np.arange(FRICTION_EDGES) / FRICTION_EDGES:
            force = inward + 0.6 * (np.cos(angle) * t1 + np.sin(angle) * t2)
            edges.append(np.append(np.cross(point, force) / 0.06, force))
    columns, reaches = np.array(edges).T, []
    for direction in np.random.default_rng(seed).normal(size=(30, 6)):
        unit = direction / np.linalg.norm(direction)
        found = linprog(
            np.append(np.zeros(len(edges)), -1.0),
            A_eq=np.vstack(
                [np.column_stack([columns, -unit]), np.append(np.ones(len(edges)), 0.0)]
            ),
            b_eq=np.append(np.zeros(6), 1.0),
        )
        reaches.append(found.x[-1])
    assert 0.0 < epsilon * (1.0 - 1e-7) <= min(reaches)


@pytest.mark.parametrize("seed", range(3))
def test_epsilon_is_the_same_in_any_frame_and_unit(seed):
    """But for the direction of the pyramids' edges about the normals."""
    p, n = some_grasp(seed)
    R = Rotation.from_rotvec([0.3, -1.0, 0.5]).as_matrix()
    here = ferrari_canny(p, n, friction=0.7, length=0.05)
    there = ferrari_canny(p @ R.T, n @ R.T, friction=0.7, length=0.05)
    assert there == pytest.approx(here, rel=0.05)
    large = ferrari_canny(10.0 * p, n, friction=0.7, length=0.5)
    assert large == pytest.approx(here, rel=1e-9)


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


def test_epsilon_of_predicted_contacts_is_that_of_the_surface_under_the_objects_friction(box):
    """Torques are divided by the distance of a corner from the centre of mass."""
    physics, corner = PhysicsConfig(), np.sqrt(3.0) * HALF
    expected = ferrari_canny(
        HALF * FACES, FACES, friction=physics.friction_hand, length=float(corner)
    )
    found = contact_epsilon(box, 1.1 * HALF * FACES, FACES, physics)
    assert found == pytest.approx(expected, rel=1e-6) and found > 0.0


EXTENTS = np.array([0.06, 0.08, 0.1])
#: Outer and inner half edge of the open box below [m]: walls of 2 mm.
OUTER, INNER = 0.04, 0.038


@pytest.fixture(scope="module")
def slab(tmp_path_factory):
    return box_model(tmp_path_factory.mktemp("box"), EXTENTS)


@pytest.fixture(scope="module")
def pot(tmp_path_factory):
    """A box, open at the top, with thin walls."""
    outer = trimesh.creation.box(2.0 * OUTER * np.ones(3))
    inner = trimesh.creation.box([2.0 * INNER, 2.0 * INNER, 2.0 * OUTER])
    inner.apply_translation([0.0, 0.0, OUTER - INNER])
    mesh = trimesh.boolean.difference([outer, inner], engine="manifold")
    return model_of(mesh, tmp_path_factory.mktemp("pot"), "1_pot_a")


def outward(model, p, n):
    """Return whether each normal points out of a face next to its point."""
    return [bool(cosine > 0.1) for cosine in fit_surface(model, p, n).agreement]


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize("off", [-0.002, 0.0, 0.002])
def test_a_boxs_normals_point_out(slab, axis, side, off):
    """Also where the point is a little inside or outside, and the normal leans."""
    out = side * np.eye(3)[axis]
    p = np.tile(out * (EXTENTS / 2.0 + off), (4, 1))
    lean = np.roll(out, 1)
    n = np.array([out, -out, (out + lean) / np.sqrt(2.0), (lean - out) / np.sqrt(2.0)])
    assert outward(slab, p, n) == [True, False, True, False]


def test_beside_an_edge_either_face_will_do(slab):
    p = np.array([[EXTENTS[0] / 2.0, EXTENTS[1] / 2.0 - 0.001, 0.0]])
    x, y = np.eye(3)[:2]
    for normal, expected in ((x, True), (y, True), (-x, False), (-y, False)):
        assert outward(slab, p, normal[None]) == [expected]
    # Farther from the edge than a wall is thick only the first is near.
    assert outward(slab, p - [[0.0, 2.0 * WALL, 0.0]], y[None]) == [False]


def test_both_sides_of_a_thin_wall_are_asked(pot):
    """A point may be a few millimetres off, on the wrong side of the wall."""
    x = np.eye(3)[:1]
    for at in (OUTER, INNER, OUTER + 0.004, INNER - 0.004):
        assert outward(pot, at * x, x) == outward(pot, at * x, -x) == [True]
        # Along the wall it still does not point out of it.
        assert outward(pot, at * x, np.eye(3)[1:2]) == [False]


def test_sides_of_a_thick_plate_are_told_apart(tmp_path):
    """Also when the point is off the surface: the other side is no nearer for it."""
    plate = box_model(tmp_path, [0.1, 0.1, 0.008])
    z = np.eye(3)[2:]
    for off in (-0.001, 0.0, 0.003, 0.009):
        assert outward(plate, (0.004 + off) * z, z) == [True]
        assert outward(plate, (0.004 + off) * z, -z) == [False]
