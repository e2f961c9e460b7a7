"""Clouds, whatever the order of their points, and distance fields against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from helpers.meshes import box_distance

from drakegrasp.frames import rotation_about
from drakegrasp.mesh.cloud import MOST, column_solid, read_cloud, smallest_rectangle
from drakegrasp.mesh.distance_field import CELLS, DistanceField, make_distance_field


def top(x: float, y: float, shape: tuple[int, int], turn: float = 0.0) -> np.ndarray:
    """Return a grid of points on the top of a box, of half sides x and y [m], turned [rad]."""
    grid = np.meshgrid(np.linspace(-x, x, shape[0]), np.linspace(-y, y, shape[1]), [0.1])
    return np.stack(grid, axis=-1).reshape(-1, 3) @ rotation_about([0.0, 0.0, 1.0], turn).T


@pytest.mark.parametrize("shape", [(400, 400), (350, 450)])
def test_a_large_cloud_keeps_its_shape_whatever_the_order_of_its_points(shape) -> None:
    cloud = top(0.06, 0.04, shape)
    points = read_cloud(cloud)
    assert MOST / 2 < len(points) <= MOST
    np.testing.assert_allclose(points.max(axis=0), [0.06, 0.04, 0.1], atol=1e-9)
    np.testing.assert_allclose(points.min(axis=0), [-0.06, -0.04, 0.1], atol=1e-9)
    field = column_solid(points).field
    inside = top(0.055, 0.035, (20, 20)) * [1.0, 1.0, 0.5]
    assert (field.interpolate(*inside.astype(np.float32).T) < -0.004).all()
    np.testing.assert_array_equal(points, read_cloud(np.random.default_rng(1).permutation(cloud)))


@pytest.mark.parametrize("turn", [0.0, 0.1, 0.7, np.pi / 4, 1.2, 2.0, 3.0])
def test_a_square_has_one_long_side(turn: float) -> None:
    """Its four sides are equally good, so rounding must not choose among them."""
    cloud = top(0.03, 0.03, (15, 15), turn)
    axes, middle, half = smallest_rectangle(cloud)
    quarters = np.arange(4) * np.pi / 2 + turn
    assert axes[0, 0] == pytest.approx(np.cos(quarters).max())
    np.testing.assert_allclose([*middle, *half], [0.0, 0.0, 0.03, 0.03], atol=1e-9)
    rng = np.random.default_rng(1)
    for _ in range(10):
        np.testing.assert_allclose(smallest_rectangle(rng.permutation(cloud))[0], axes, atol=1e-9)


@pytest.mark.parametrize(("shape", "filled"), [((3, 9), True), ((30, 90), False)])
def test_a_gap_is_filled_where_other_points_are_nearly_as_far_apart(
    shape: tuple[int, int], filled: bool
) -> None:
    """Between two towers, 10 mm from each other, whose points are 7.5 or 0.7 mm apart."""
    tower, aside = top(0.01, 0.03, shape), np.array([0.015, 0.0, 0.0])
    field = column_solid(np.concatenate([tower - aside, tower + aside])).field
    assert (field.interpolate(0.0, 0.0, 0.05) < 0.0) == filled


def field_of(mesh: trimesh.Trimesh) -> DistanceField:
    return make_distance_field(mesh.vertices, mesh.faces)


def columns(points: np.ndarray) -> tuple[np.ndarray, ...]:
    return tuple(np.ascontiguousarray(column, dtype=np.float32) for column in points.T)


def test_box_has_its_distances():
    half = np.array([0.03, 0.05, 0.02])
    field = field_of(trimesh.creation.box(2 * half))
    p = np.random.default_rng(0).uniform(-half - 0.004, half + 0.004, (2000, 3))
    found, true = field.interpolate(*columns(p)), box_distance(p, half)
    assert np.abs(found - true).max() < field.error
    # Away from edges, inner ones included, distances are linear, and so exact.
    near_one_face = np.sort(np.abs(np.abs(p) - half), axis=1)[:, 1] > 0.006
    flat = near_one_face & (np.abs(true) < 0.003)
    assert flat.sum() > 100
    assert np.abs(found - true)[flat].max() < 3e-4


def test_nearest_is_within_its_stated_error_on_the_grid():
    radius = 0.04
    field = field_of(trimesh.creation.icosphere(subdivisions=4, radius=radius))
    p = np.random.default_rng(1).uniform(-0.042, 0.042, (5000, 3))
    true = np.linalg.norm(p, axis=1) - radius
    for asked, limit in ((field.nearest, field.error), (field.interpolate, 1e-3)):
        error = asked(*columns(p)) - true
        # The centre of the sphere is a corner of the distance.
        off_centre = true > -0.03
        assert np.abs(error[off_centre]).max() < limit


def test_far_points_are_at_least_as_far_as_the_field_says():
    field = field_of(trimesh.creation.box([0.1, 0.1, 0.1]))
    p = np.random.default_rng(2).uniform(-0.5, 0.5, (1000, 3))
    true = box_distance(p, np.full(3, 0.05))
    outside = true > 0.0
    found = field.nearest(*columns(p))
    assert np.all(found[outside] <= true[outside] + field.error)
    assert np.all(found[outside] > true[outside] / np.sqrt(3.0) - field.error)


def test_hole_of_a_ring_is_outside():
    ring = trimesh.creation.annulus(r_min=0.02, r_max=0.04, height=0.03)
    field = field_of(ring)
    found = field.interpolate(*columns(np.array([[0.0, 0, 0], [0.03, 0, 0], [0.0, 0, 0.02]])))
    assert found == pytest.approx([0.02, -0.01, 0.0206], abs=1e-3)


def test_parts_that_overlap_are_inside_once():
    """The inner faces of overlapping bodies are no surface of the union."""
    parts = [trimesh.creation.box([0.04] * 3) for _ in range(2)]
    parts[1].apply_translation([0.02, 0.0, 0.0])
    field = field_of(trimesh.util.concatenate(parts))
    assert field.interpolate(*columns(np.array([[0.01, 0.0, 0.0]])))[0] < 0.0


def test_large_and_small_objects_cost_the_same_and_points_do_not_depend_on_others():
    for size in (0.02, 0.3, 1.2):
        field = field_of(trimesh.creation.box([size] * 3))
        assert field.values.size < 1.3 * CELLS
        x, y, z = columns(np.random.default_rng(3).uniform(-0.05, 0.05, (999, 3)))
        for asked in (field.nearest, field.interpolate):
            alone = [asked(x[i : i + 1], y[i : i + 1], z[i : i + 1])[0] for i in range(0, 999, 37)]
            assert np.array_equal(asked(x, y, z)[::37], alone)
