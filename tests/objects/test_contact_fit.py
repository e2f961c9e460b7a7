"""Contacts on boxes, whose faces are known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from drakegrasp.objects.model import ObjectModel, fit_contacts, prepare_object
from drakegrasp.objects.sources import MeshSource


def box(folder: Path, *edges: float) -> ObjectModel:
    path = folder / "box.stl"
    trimesh.creation.box(edges).export(path)
    return prepare_object(MeshSource(name="box", class_name="box", path=path))


def tilted(angle_deg: float) -> list[float]:
    """Return the normal +x turned towards +z."""
    angle = np.deg2rad(angle_deg)
    return [np.cos(angle), 0.0, np.sin(angle)]


def test_distance_and_angle_are_those_from_the_nearest_face(tmp_path: Path) -> None:
    model = box(tmp_path, 0.06, 0.05, 0.10)
    points = np.array([[0.031, 0.0, 0.01], [0.0295, 0.01, 0.0], [0.0, 0.025, 0.0]])
    normals = np.array([tilted(20.0), tilted(-40.0), [0.0, -1.0, 0.0]])
    fit = fit_contacts(model, points, normals)
    np.testing.assert_allclose(fit.distance, [1e-3, 5e-4, 0.0], atol=1e-8)
    np.testing.assert_allclose(np.degrees(fit.normal_angle), [20.0, 40.0, 180.0], atol=1e-6)


@pytest.mark.parametrize("depth", [1e-4, 9e-4])
def test_on_a_thin_wall_the_own_side_counts_though_the_other_is_nearer(
    tmp_path: Path, depth: float
) -> None:
    """A wall of 1 mm; the contact belongs to its +x side, however deep it lies in it."""
    model = box(tmp_path, 0.001, 0.05, 0.10)
    point = np.array([[0.0005 - depth, 0.0, 0.0]])
    fit = fit_contacts(model, point, np.array([tilted(10.0)]))
    np.testing.assert_allclose(np.degrees(fit.normal_angle), 10.0, atol=1e-6)


def test_a_fingertip_that_does_not_touch_has_neither(tmp_path: Path) -> None:
    model = box(tmp_path, 0.06, 0.05, 0.10)
    missing = [np.nan] * 3
    fit = fit_contacts(
        model, np.array([missing, [0.031, 0.0, 0.0]]), np.array([missing, [1.0, 0.0, 0.0]])
    )
    np.testing.assert_allclose(fit.distance, [np.nan, 1e-3], atol=1e-8)
    np.testing.assert_allclose(fit.normal_angle, [np.nan, 0.0], atol=1e-6)
    nothing = fit_contacts(model, np.full((2, 3), np.nan), np.full((2, 3), np.nan))
    assert np.isnan([nothing.distance, nothing.normal_angle]).all()


def test_normal_without_a_direction_agrees_with_no_face(tmp_path: Path) -> None:
    model = box(tmp_path, 0.06, 0.05, 0.10)
    fit = fit_contacts(model, np.array([[0.03, 0.0, 0.0]]), np.full((1, 3), np.nan))
    assert fit.normal_angle.tolist() == [np.pi]
    assert fit.distance == pytest.approx(0.0, abs=1e-8)
