"""The same solid in other triangles: decimated, coarsened before mending, resting, subdivided."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers.meshes import assert_sound, prepare, solid_of, write
from hypothesis import given, settings
from hypothesis import strategies as st

from drakegrasp.errors import MeshError
from drakegrasp.mesh import remeshing
from drakegrasp.mesh.remeshing import coarsen, decimate, resting_hull, subdivide
from drakegrasp.mesh.surfaces import (
    Solid,
    face_areas,
    half_edges,
    is_solid_surface,
    signed_volume,
)


def test_decimation_keeps_the_solid(tmp_path):
    # So small that no edge is subdivided again.
    ring = trimesh.creation.torus(0.02, 0.008, major_sections=100, minor_sections=50)
    model = prepare(write(tmp_path / "ring.obj", ring), max_collision_faces=2000)
    assert_sound(model)
    assert len(model.visual_faces) == 10_000 and len(model.collision_faces) <= 2000
    assert 0.0 < model.collision_error < 2e-4
    assert model.collision.euler_number == 0
    assert model.collision.volume == pytest.approx(model.volume, rel=0.01)
    again = prepare(tmp_path / "ring.obj", max_collision_faces=2000)
    np.testing.assert_array_equal(again.collision_vertices, model.collision_vertices)


def test_decimation_falls_back(tmp_path, monkeypatch):
    solid = solid_of(trimesh.creation.icosphere(4, radius=0.05))
    monkeypatch.setattr("drakegrasp.mesh.remeshing._decimate_quadric", lambda *_: None)
    reduced, error = decimate(solid, 1000)
    assert is_solid_surface(reduced.faces) and len(reduced.faces) <= 1000 and 0.0 < error < 1e-3
    monkeypatch.setattr("drakegrasp.mesh.remeshing._simplify_manifold", lambda *_: None)
    with pytest.raises(MeshError, match="at most 1000 faces"):
        decimate(solid, 1000)


RADIUS = 0.05


@pytest.fixture
def few_faces(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(remeshing, "MOST_FACES", 3_000)
    monkeypatch.setattr(remeshing, "MOST_READ", 10_000)


def ball(subdivisions: int, radius: float = RADIUS) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions, radius=radius)


def arrays(mesh: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray]:
    return np.array(mesh.vertices), np.array(mesh.faces, dtype=np.int64)


@pytest.mark.usefixtures("few_faces")
def test_surface_with_few_faces_stays_as_it_is() -> None:
    vertices, faces = arrays(ball(3))
    same = coarsen(vertices, faces)
    assert same[0] is vertices and same[1] is faces and same[2] == ()


@pytest.mark.usefixtures("few_faces")
def test_ball_stays_a_ball() -> None:
    vertices, faces, (note,) = coarsen(*arrays(ball(4)))
    again = coarsen(*arrays(ball(4)))
    assert again[0].tobytes() == vertices.tobytes() and again[1].tobytes() == faces.tobytes()
    assert len(faces) <= 3_000 and is_solid_surface(faces)
    assert signed_volume(vertices, faces) == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.01)
    assert np.abs(np.linalg.norm(vertices, axis=1) - RADIUS).max() < 2e-4
    assert note.startswith(f"its 5,120 faces were reduced to {len(faces):,}, ")
    # A chord of an edge of 3 mm is 0.03 mm from the ball.
    assert 0.0 < float(note.split()[-2]) < 0.2


@pytest.mark.usefixtures("few_faces")
def test_too_many_faces_are_refused() -> None:
    with pytest.raises(MeshError, match=r"at most 10,000 faces, got 20,480: reduce it with"):
        coarsen(*arrays(ball(5)))


@pytest.mark.usefixtures("few_faces")
def test_open_scan_is_reduced_and_then_mended(tmp_path: Path) -> None:
    full = ball(4)
    keep = full.triangles_center[:, 2] < 0.98 * RADIUS
    open_ball = trimesh.Trimesh(full.vertices, full.faces[keep], process=False)
    model = prepare(write(tmp_path / "1_ball.obj", open_ball))
    assert_sound(model)
    assert len(model.visual_faces) < 3_200
    assert "were reduced to" in model.notes[0] and "1 open rims were closed" in model.notes[1]


@pytest.mark.parametrize(
    ("mesh", "faces"),
    [
        # Each rectangle, however fine it is in the file: four about its middle, two at each edge.
        (trimesh.creation.box([0.06, 0.08, 0.10]), 6 * 12),
        (trimesh.creation.box([0.06, 0.08, 0.10]).subdivide().subdivide(), 6 * 12),
        # Round bases: one for each edge, and two for each of the eight corners of the ring.
        (trimesh.creation.cylinder(radius=0.03, height=0.12, sections=32), 2 * 48 + 32 * 12),
        # Lone triangles of the side.
        (trimesh.creation.cone(radius=0.04, height=0.10, sections=32), 48 + 32 * 9),
        # What is small and round stays as it is.
        (trimesh.creation.icosphere(subdivisions=3, radius=0.03), 1280),
    ],
)
def test_facets_are_rims_and_fans(mesh: trimesh.Trimesh, faces: int) -> None:
    hull = resting_hull(np.asarray(mesh.vertices))
    assert len(hull.faces) == faces
    assert is_solid_surface(hull.faces)
    assert signed_volume(hull.vertices, hull.faces) == pytest.approx(mesh.volume, rel=1e-9)
    assert face_areas(hull.vertices, hull.faces).sum() == pytest.approx(mesh.area, rel=1e-9)


def test_base_that_is_plane_to_micrometres_is_one_facet() -> None:
    """A scan's or a decimated base is not plane to the last bit."""
    mesh = trimesh.creation.cylinder(radius=0.03, height=0.12, sections=32)
    noise = np.random.default_rng(5).uniform(-2e-6, 2e-6, mesh.vertices.shape)
    hull = resting_hull(mesh.vertices + noise)
    low = hull.vertices[:, 2] < -0.0599
    assert low[hull.faces].all(axis=1).sum() == 32 + 2 * 8
    assert is_solid_surface(hull.faces)
    assert signed_volume(hull.vertices, hull.faces) == pytest.approx(mesh.volume, rel=1e-3)


def test_ring_gets_a_disc_as_its_base() -> None:
    ring = trimesh.creation.annulus(r_min=0.03, r_max=0.04, height=0.02, sections=32)
    hull = resting_hull(np.asarray(ring.vertices))
    expected = trimesh.creation.cylinder(radius=0.04, height=0.02, sections=32).volume
    assert signed_volume(hull.vertices, hull.faces) == pytest.approx(expected, rel=1e-6)


#: More faces than any solid here can need.
PLENTY = 10**6


def longest_edge(solid: Solid) -> float:
    a, b = solid.vertices[half_edges(solid.faces)].swapaxes(0, 1)
    return float(np.linalg.norm(b - a, axis=1).max())


@settings(max_examples=40, deadline=None)
@given(
    points=st.lists(st.tuples(*[st.floats(-0.1, 0.1)] * 3), min_size=5, max_size=9, unique=True),
    limit=st.floats(0.01, 0.1),
)
def test_closed_surface_stays_the_same_closed_surface(points, limit):
    cloud = np.vstack((points, 0.05 * np.eye(3), -0.05 * np.eye(3)))
    solid = solid_of(trimesh.convex.convex_hull(cloud))
    finer = subdivide(solid, limit, PLENTY)
    assert longest_edge(finer) <= limit * (1.0 + 1e-6)
    assert is_solid_surface(finer.faces)
    assert len(np.unique(finer.faces)) == len(finer.vertices)
    np.testing.assert_array_equal(finer.vertices[: len(solid.vertices)], solid.vertices)

    # The same surface: volume and area, with no face turned over.
    volumes = [signed_volume(s.vertices, s.faces) for s in (solid, finer)]
    areas = [face_areas(s.vertices, s.faces).sum() for s in (solid, finer)]
    assert volumes[1] == pytest.approx(volumes[0], rel=1e-9)
    assert areas[1] == pytest.approx(areas[0], rel=1e-9)


@pytest.mark.parametrize("size", [0.5, 2.0])
def test_number_of_faces_is_bounded_for_large_objects_and_long_faces(size):
    needles = trimesh.creation.cylinder(radius=0.05 * size, height=size, sections=700)
    solid = solid_of(needles)
    finer = subdivide(solid, 0.02, 12_000)
    assert len(solid.faces) < len(finer.faces) <= 12_000
    assert longest_edge(finer) < 0.6 * size


def test_short_edges_and_surfaces_with_more_faces_are_left_alone():
    solid = solid_of(trimesh.creation.box([0.02, 0.02, 0.02]))
    assert subdivide(solid, 0.03, PLENTY).faces is solid.faces
    assert subdivide(solid, 0.002, 5).faces is solid.faces
