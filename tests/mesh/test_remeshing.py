"""The same solid in other triangles: decimated, coarsened before mending, resting, subdivided."""

from __future__ import annotations

import math
from pathlib import Path

import fast_simplification
import manifold3d
import numpy as np
import pytest
import trimesh
from helpers.meshes import assert_sound, prepare, solid_of, write
from helpers.tiers import few
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from drakegrasp.errors import MeshError
from drakegrasp.mesh import remeshing
from drakegrasp.mesh.components import face_components, pair_half_edges
from drakegrasp.mesh.remeshing import _decimate_parted, coarsen, decimate, resting_hull, subdivide
from drakegrasp.mesh.surfaces import Solid, face_areas, half_edges, is_solid_surface, signed_volume


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
    reduced, error = decimate(solid, 1000)
    assert is_solid_surface(reduced.faces) and len(reduced.faces) <= 1000 and 0.0 < error < 1e-3
    for way in ("parted", "twice"):
        monkeypatch.setattr(f"drakegrasp.mesh.remeshing._decimate_{way}", lambda *_: None)
    with pytest.raises(MeshError, match="at most 1000 faces"):
        decimate(solid, 1000)


def test_mesh_with_few_faces_too_many_is_not_decimated_twice(monkeypatch):
    """The first of two decimations aims at more faces than are allowed, or than there are."""
    solid = solid_of(trimesh.creation.icosphere(4, radius=0.05))
    for way in ("decimate_quadric", "simplify_manifold", "decimate_parted"):
        monkeypatch.setattr(f"drakegrasp.mesh.remeshing._{way}", lambda *_: None)
    with pytest.raises(MeshError, match="at most 4000 faces, got a broken one from 5120"):
        decimate(solid, 4000)


def test_first_decimation_that_went_far_enough_is_parted_as_it_is():
    """Of thousands of specks, few faces are left: there is nothing to aim at any more."""
    few = solid_of(trimesh.creation.icosphere(1))
    assert _decimate_parted(few, 1000) is few


def scanned_bowl() -> trimesh.Trimesh:
    """Return a thin bowl as scanners make it: noisy, with sheets that touch, and open below."""

    def depth(x: float, y: float, z: float) -> float:
        ripple = sum(math.sin(2 * math.pi * at / 4e-3) for at in (x, y, z))
        r = math.sqrt(x * x + y * y + (z - 0.075) ** 2)
        shell = min(0.078 - r, r - 0.0762, 0.054 - z, z)
        foot = min(0.030 - math.hypot(x, y), z, 0.006 - z)
        return max(shell, foot) + 7e-5 * ripple

    bounds = [-0.08, -0.08, -0.003, 0.08, 0.08, 0.058]
    mesh = manifold3d.Manifold.level_set(depth, bounds, 1.8e-3).to_mesh64()
    surface = trimesh.Trimesh(mesh.vert_properties[:, :3], mesh.tri_verts, process=False)
    noise = 4e-4 * np.random.default_rng(2).standard_normal((len(surface.vertices), 1))
    vertices, faces = fast_simplification.simplify(
        surface.vertices + noise * surface.vertex_normals, surface.faces, target_count=16_500
    )

    # Weld corners where the sheets touch; what is near the table was not seen.
    normals = trimesh.Trimesh(vertices, faces, process=False).vertex_normals
    welded = np.arange(len(vertices))
    for a, b in np.sort(cKDTree(vertices).query_pairs(5e-4, output_type="ndarray")).tolist():
        if normals[a] @ normals[b] < 0.0:
            welded[b] = welded[a]
    faces = welded[faces]
    whole = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    seen = (vertices[faces][:, :, 2] > 1.5e-3).any(axis=1)
    scan = trimesh.Trimesh(vertices, faces[whole & seen], process=False)
    scan.remove_unreferenced_vertices()
    return scan


def test_thin_noisy_scan_keeps_its_shape(tmp_path):
    """Quadric decimation alone leaves edges with four faces where the wall touches itself."""
    scanned_bowl().export(tmp_path / "bowl.ply")
    model = prepare(tmp_path / "bowl.ply")
    assert_sound(model)
    assert 14_000 < len(model.visual_faces) < 18_000
    assert 0.0 < model.collision_error < 2e-3
    assert model.collision.volume == pytest.approx(model.volume, rel=0.05)
    assert "parted" in model.notes[0]


RADIUS = 0.05


@pytest.fixture
def few_faces(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(remeshing, "MOST_FACES", 3_000)


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
@pytest.mark.parametrize("subdivisions", few([5, 4], 1))
def test_ball_stays_a_ball(subdivisions: int) -> None:
    """5,120 faces are decimated; 20,480 are clustered before."""
    vertices, faces, (note,) = coarsen(*arrays(ball(subdivisions)))
    again = coarsen(*arrays(ball(subdivisions)))
    assert again[0].tobytes() == vertices.tobytes() and again[1].tobytes() == faces.tobytes()
    assert len(faces) <= 3_000 and is_solid_surface(faces)
    assert signed_volume(vertices, faces) == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.01)
    assert np.abs(np.linalg.norm(vertices, axis=1) - RADIUS).max() < 2e-4
    assert note.startswith(f"its {20 * 4**subdivisions:,} faces were reduced to {len(faces):,}, ")
    # A chord of an edge of 3 mm is 0.03 mm from the ball.
    assert 0.0 < float(note.split()[-2]) < 0.2


@pytest.mark.usefixtures("few_faces")
def test_sheets_that_lie_close_to_each_other_stay_two() -> None:
    """A hollow ball with a wall far thinner than a cell of the clusters."""
    outer, inner = ball(5), ball(5, RADIUS - 5e-5)
    inner.invert()
    _, faces, _ = coarsen(*arrays(trimesh.util.concatenate([outer, inner])))
    pieces, _ = face_components(pair_half_edges(faces[:0], faces, radial=False), len(faces))
    assert pieces == 2


@pytest.mark.usefixtures("few_faces")
def test_open_scan_is_reduced_and_then_mended(tmp_path: Path) -> None:
    full = ball(5)
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
