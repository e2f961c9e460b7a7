"""How far points are from an object's surface, and whether normals point out of it."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from helpers.objects import box_model, model_of

from drakegrasp.verification.hints import WALL, fit_surface

EXTENTS = np.array([0.06, 0.08, 0.1])
#: Outer and inner half edge of the open box below [m]: walls of 2 mm.
OUTER, INNER = 0.04, 0.038


@pytest.fixture(scope="module")
def box(tmp_path_factory):
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
def test_a_boxs_normals_point_out(box, axis, side, off):
    """Also where the point is a little inside or outside, and the normal leans."""
    out = side * np.eye(3)[axis]
    p = np.tile(out * (EXTENTS / 2.0 + off), (4, 1))
    lean = np.roll(out, 1)
    n = np.array([out, -out, (out + lean) / np.sqrt(2.0), (lean - out) / np.sqrt(2.0)])
    assert outward(box, p, n) == [True, False, True, False]


def test_beside_an_edge_either_face_will_do(box):
    p = np.array([[EXTENTS[0] / 2.0, EXTENTS[1] / 2.0 - 0.001, 0.0]])
    x, y = np.eye(3)[:2]
    for normal, expected in ((x, True), (y, True), (-x, False), (-y, False)):
        assert outward(box, p, normal[None]) == [expected]
    # Farther from the edge than a wall is thick only the first is near.
    assert outward(box, p - [[0.0, 2.0 * WALL, 0.0]], y[None]) == [False]


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
