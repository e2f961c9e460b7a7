"""Clouds: few points of a large one, and the rectangle around them, whatever their order."""

from __future__ import annotations

import numpy as np
import pytest

from drakegrasp.frames import rotation_about
from drakegrasp.mesh.cloud import MOST, column_solid, read_cloud, smallest_rectangle


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
