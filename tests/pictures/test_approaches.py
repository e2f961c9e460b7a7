"""Approaches: from where palms come, what they cover, and their map."""

from __future__ import annotations

import numpy as np
import pytest

from drakegrasp.frames import make_pose, rotation_about
from drakegrasp.pictures.approaches import (
    NEAR_DEG,
    approach_directions,
    coverage,
    map_directions,
    view_rotation,
)

CAP = 1.0 - np.cos(np.deg2rad(NEAR_DEG))


def directions(count: int) -> np.ndarray:
    values = np.random.default_rng(0).standard_normal((count, 3))
    return values / np.linalg.norm(values, axis=1, keepdims=True)


def test_palms_come_from_against_their_axis() -> None:
    """Of an object that lies on its side, too."""
    lying = make_pose(rotation_about([1.0, 0.0, 0.0], np.pi / 2), [0.0, 0.0, 0.03])
    # A palm on +Oz that looks at the object; +Oz is -Ty then.
    palm = make_pose(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, 0.2])
    np.testing.assert_allclose(approach_directions(np.eye(4), palm[None]), [[0.0, 0.0, 1.0]])
    np.testing.assert_allclose(approach_directions(lying, palm[None]), [[0, -1, 0]], atol=1e-12)


def test_one_approach_covers_its_cap() -> None:
    up, slanted = np.array([[0.0, 0.0, 1.0]]), np.array([[0.6, 0.0, 0.8]])
    assert coverage(up) == pytest.approx(CAP, abs=1e-3)
    assert coverage(np.concatenate([up, slanted])) == pytest.approx(2 * CAP, abs=1e-3)
    assert coverage(np.concatenate([up, up])) == coverage(up)
    # Half of a cap on the horizon is below it.
    assert coverage(np.array([[1.0, 0.0, 0.0]])) == pytest.approx(CAP / 2, abs=1e-3)


def test_coverage_is_of_the_half_sphere_above() -> None:
    assert coverage(np.zeros((0, 3))) == 0.0
    assert coverage(-np.array([[0.0, 0.0, 1.0]])) == 0.0
    assert coverage(directions(5000)) == 1.0


def test_the_map_keeps_areas_and_azimuths() -> None:
    found = directions(200)
    places = map_directions(found)
    # The area within a place's circle is that of the cap above its direction: 2 pi (1 - z).
    np.testing.assert_allclose((places**2).sum(axis=1), 1.0 - found[:, 2], atol=1e-12)
    turned = places[:, 0] * found[:, 1] - places[:, 1] * found[:, 0]
    np.testing.assert_allclose(turned, 0.0, atol=1e-12)
    assert np.all((places * found[:, :2]).sum(axis=1) > 0.0)
    np.testing.assert_array_equal(map_directions(np.array([[0.0, 0.0, 1.0]])), [[0.0, 0.0]])


def test_a_view_keeps_lengths_and_shows_up_as_up() -> None:
    R = view_rotation()
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) > 0.0
    up = R @ [0.0, 0.0, 1.0]
    assert abs(up[0]) < 1e-12
    assert up[1] > 0.9
