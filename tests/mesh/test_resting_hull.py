"""The resting hull: a closed convex surface whose facets are fans."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from drakegrasp.mesh.resting import resting_hull
from drakegrasp.mesh.surfaces import face_areas, is_solid_surface, signed_volume


@pytest.mark.parametrize(
    ("mesh", "faces"),
    [
        # Each rectangle, however fine it is in the file: four about its middle, two at each edge.
        (trimesh.creation.box([0.06, 0.08, 0.10]), 6 * 12),
        (trimesh.creation.box([0.06, 0.08, 0.10]).subdivide().subdivide(), 6 * 12),
        # Round bases have short edges and no rim; their sides do.
        (trimesh.creation.cylinder(radius=0.03, height=0.12, sections=32), 2 * 32 + 32 * 12),
        # Lone triangles of the side.
        (trimesh.creation.cone(radius=0.04, height=0.10, sections=32), 32 + 32 * 9),
        # What is small and round stays as it is.
        (trimesh.creation.icosphere(subdivisions=3, radius=0.03), 1280),
    ],
)
def test_facets_are_fans(mesh: trimesh.Trimesh, faces: int) -> None:
    hull = resting_hull(np.asarray(mesh.vertices))
    assert len(hull.faces) == faces
    assert is_solid_surface(hull.faces)
    assert signed_volume(hull.vertices, hull.faces) == pytest.approx(mesh.volume, rel=1e-9)
    assert face_areas(hull.vertices, hull.faces).sum() == pytest.approx(mesh.area, rel=1e-9)


def test_base_that_is_plane_to_micrometres_is_one_fan() -> None:
    """A scan's or a decimated base is not plane to the last bit."""
    mesh = trimesh.creation.cylinder(radius=0.03, height=0.12, sections=32)
    noise = np.random.default_rng(5).uniform(-2e-6, 2e-6, mesh.vertices.shape)
    hull = resting_hull(mesh.vertices + noise)
    low = hull.vertices[:, 2] < -0.0599
    assert low[hull.faces].all(axis=1).sum() == 32
    assert is_solid_surface(hull.faces)
    assert signed_volume(hull.vertices, hull.faces) == pytest.approx(mesh.volume, rel=1e-3)


def test_ring_gets_a_disc_as_its_base() -> None:
    ring = trimesh.creation.annulus(r_min=0.03, r_max=0.04, height=0.02, sections=32)
    hull = resting_hull(np.asarray(ring.vertices))
    expected = trimesh.creation.cylinder(radius=0.04, height=0.02, sections=32).volume
    assert signed_volume(hull.vertices, hull.faces) == pytest.approx(expected, rel=1e-6)
