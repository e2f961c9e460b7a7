"""Subdivision: short edges, the same surface, no vertex within another face's edge."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from helpers.meshes import solid_of
from hypothesis import given, settings
from hypothesis import strategies as st

from drakegrasp.mesh.resting import subdivide
from drakegrasp.mesh.surfaces import (
    Solid,
    face_areas,
    half_edges,
    is_solid_surface,
    signed_volume,
)

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


def test_short_edges_are_left_alone():
    solid = solid_of(trimesh.creation.box([0.02, 0.02, 0.02]))
    assert subdivide(solid, 0.03, PLENTY).faces is solid.faces


@pytest.mark.parametrize("size", [0.5, 2.0])
def test_number_of_faces_is_bounded_for_large_objects_and_long_faces(size):
    needles = trimesh.creation.cylinder(radius=0.05 * size, height=size, sections=700)
    solid = solid_of(needles)
    finer = subdivide(solid, 0.02, 12_000)
    assert len(solid.faces) < len(finer.faces) <= 12_000
    assert longest_edge(finer) < 0.6 * size


def test_surface_with_more_faces_than_that_stays_as_it_is():
    solid = solid_of(trimesh.creation.box([0.2, 0.2, 0.2]))
    assert subdivide(solid, 0.02, 5).faces is solid.faces
