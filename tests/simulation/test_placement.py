"""An object on the table: from a file, a mesh or itself, and its pose without yaw."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from drakegrasp.errors import GraspError, MeshError
from drakegrasp.frames import Array, make_pose
from drakegrasp.hand.settings import load_config
from drakegrasp.simulation.placement import canonical_pose, place_object
from drakegrasp.simulation.settle import settle

EXTENTS = np.array([0.06, 0.08, 0.1])
#: Stands the box of these extents on the table.
X_TO = make_pose(np.eye(3), [0.1, -0.2, 0.05])


def box(scale: float = 1.0, at: float = 0.0) -> trimesh.Trimesh:
    mesh = trimesh.creation.box(scale * EXTENTS)
    mesh.apply_translation([at, at, at])
    return mesh


def write(path: Path, mesh: trimesh.Trimesh) -> Path:
    mesh.export(path)
    return path


# From a file


@pytest.mark.parametrize(("units", "scale"), [("m", 1.0), ("cm", 100.0), ("mm", 1000.0)])
def test_file_or_mesh_is_taken_in_its_units_about_the_boxs_centre(
    tmp_path: Path, units: str, scale: float
) -> None:
    mesh = box(scale, at=0.3 * scale)
    before, path = np.array(mesh.vertices), write(tmp_path / "3_mug_red.obj", mesh)
    for given_as in (mesh, path, str(path)):
        placed = place_object(given_as, units=units, X_TO=X_TO)
        np.testing.assert_allclose(placed.model.half_extents, EXTENTS / 2.0, atol=1e-9)
        np.testing.assert_allclose(placed.model.visual_vertices.mean(axis=0), 0.0, atol=1e-9)
        np.testing.assert_array_equal(placed.X_TO, X_TO)
        assert placed.model.collision.is_watertight
    assert (placed.model.name, placed.model.class_name) == ("3_mug_red", "mug")
    np.testing.assert_array_equal(mesh.vertices, before)


MISTAKES: dict[str, tuple[Any, str, str]] = {
    "gone": (lambda f: f / "gone.obj", "m", "gone.obj"),
    "units of a file": (lambda f: write(f / "a.obj", box()), "inch", "units must be one of m, cm"),
    "units of a mesh": (lambda _: box(), "inch", "units must be one of m, cm, mm, got 'inch'"),
    "nothing": (lambda _: None, "m", "a trimesh.Trimesh or a placed object, got NoneType"),
    "scene": (lambda _: box().scene(), "m", "a trimesh.Trimesh or a placed object, got Scene"),
    "empty": (lambda _: trimesh.Trimesh(), "m", "mesh: must hold triangles, got no faces"),
}


@pytest.mark.parametrize("case", MISTAKES)
def test_what_is_no_object_is_refused_in_one_line(tmp_path: Path, case: str) -> None:
    make, units, message = MISTAKES[case]
    with pytest.raises(MeshError) as caught:
        place_object(make(tmp_path), units=units, X_TO=X_TO)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


# From an object


def test_placed_object_stays_as_it_is() -> None:
    first = place_object(box(), X_TO=X_TO)
    again = place_object(first)
    assert again.model is first.model
    np.testing.assert_array_equal(again.X_TO, first.X_TO)
    moved = make_pose(np.eye(3), [0.0, 0.3, 0.05])
    np.testing.assert_array_equal(place_object(first, X_TO=moved).X_TO, moved)
    np.testing.assert_array_equal(first.X_TO, X_TO)


# Poses


def lifted(height: float) -> Array:
    return make_pose(np.eye(3), [0.0, 0.0, 0.05 + height])


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        (lifted(0.02), "its lowest point within 5 mm, got one at 20 mm"),
        (lifted(-0.02), "its lowest point within 5 mm, got one at -20 mm"),
        (
            make_pose(Rotation.from_euler("x", 90, True).as_matrix(), [0.0, 0.0, 0.05]),
            "got one at 10 mm",
        ),
        (np.tile(X_TO, (2, 1, 1)), "X_TO must be one pose, got an array of shape (2, 4, 4)"),
        (X_TO.T, "X_TO must have 0 0 0 1 as its last row"),
    ],
)
def test_pose_that_does_not_stand_on_the_table_is_refused(pose: Any, message: str) -> None:
    with pytest.raises(GraspError) as caught:
        place_object(box(), X_TO=pose)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.sim
def test_without_a_pose_the_object_is_dropped_as_in_a_build(tmp_path: Path) -> None:
    config = load_config(overrides=["settle.drop_height=0.01"])
    path = write(tmp_path / "a.obj", box())
    placed = place_object(path, config=config)
    resting = settle(placed.model, config)
    np.testing.assert_array_equal(placed.X_TO, resting.X_TO)
    # It stays as it was dropped, about as high as it is.
    np.testing.assert_allclose(placed.X_TO, lifted(0.0), atol=1e-3)
    # The same from memory.
    np.testing.assert_allclose(place_object(box(), config=config).X_TO, placed.X_TO, atol=1e-6)


# The pose without yaw

angles = st.floats(-np.pi, np.pi)


def pose_of(yaw: float, tilt: float, about: float, x: float = 0.0, y: float = 0.0) -> Array:
    """Return a pose that is tilted about an axis of the object, then turned about the vertical."""
    axis = np.array([np.cos(about), np.sin(about), 0.0])
    R = Rotation.from_euler("z", yaw) * Rotation.from_rotvec(tilt * axis)
    return make_pose(R.as_matrix(), [x, y, 0.04])


def assert_keeps_up_and_height(X: Array) -> None:
    rest = canonical_pose(X)
    np.testing.assert_allclose(rest[2], X[2], atol=1e-9)
    np.testing.assert_array_equal(rest[:2, 3], 0.0)
    np.testing.assert_array_equal(rest[3], [0.0, 0.0, 0.0, 1.0])
    R = rest[:3, :3]
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)


# Nearly upside down every small tilt has its own direction, so rounding decides.
@given(angles, st.floats(0.0, np.pi - 1e-3), angles, angles, st.floats(-1.0, 1.0))
def test_canonical_pose_keeps_up_and_height_and_depends_on_nothing_else(
    yaw: float, tilt: float, about: float, other: float, x: float
) -> None:
    assert_keeps_up_and_height(pose_of(other, tilt, about, x, -x))
    rest = canonical_pose(pose_of(yaw, tilt, about))
    np.testing.assert_allclose(canonical_pose(pose_of(other, tilt, about, x, -x)), rest, atol=1e-9)
    # Of all yaws it has the one that turns the least: by the tilt alone.
    np.testing.assert_allclose(rest, pose_of(0.0, tilt, about), atol=1e-9)


@pytest.mark.parametrize("yaw", [0.0, 0.5, 3.0])
@pytest.mark.parametrize("slant", [0.0, 1e-12, 1e-9, 1e-7, 1e-5, 1e-4])
def test_canonical_pose_works_upside_down(yaw: float, slant: float) -> None:
    assert_keeps_up_and_height(pose_of(yaw, np.pi - slant, 0.7))
