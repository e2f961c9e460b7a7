"""Faces that pass through others."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from helpers.meshes import box

from drakegrasp.mesh.crossings import crossing_faces


def joined(*meshes: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.util.concatenate(meshes)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


@pytest.mark.parametrize(
    ("shift", "crosses"),
    [
        ((0.03, 0.02, 0.01), True),  # corners inside each other
        ((0.08, 0.0, 0.0), False),  # apart
        ((0.06, 0.0, 0.0), False),  # they share a wall
        ((0.06, 0.10, 0.04), False),  # they share a corner
        ((0.06 - 1e-7, 0.03, 0.0), False),  # by rounding only
        ((0.06 - 1e-5, 0.03, 0.01), True),  # by a hundredth of a millimetre
    ],
)
def test_two_boxes(shift: tuple[float, ...], crosses: bool) -> None:
    assert bool(len(crossing_faces(*joined(box(), box(at=shift))))) == crosses


def test_sphere_does_not_cross_itself_until_a_vertex_is_pushed_through() -> None:
    ball = trimesh.creation.icosphere(3, radius=0.05)
    vertices, faces = np.array(ball.vertices), np.asarray(ball.faces)
    assert len(crossing_faces(vertices, faces)) == 0
    vertices[17] = -1.3 * vertices[17] + [0.003, 0.002, -0.001]  # not through an edge
    found = crossing_faces(vertices, faces)
    around = np.flatnonzero((faces == 17).any(axis=1))
    assert set(around) & set(found)
    assert 3 < len(found) < 100


def test_needle_through_the_middle_of_a_face_is_found() -> None:
    """No vertex lies inside: only an edge passes through a face."""
    needle = box((1e-3, 1e-3, 0.2))
    found = crossing_faces(*joined(box(), needle))
    assert len(found) >= 4
    assert len(crossing_faces(*joined(box(), box((1e-3, 1e-3, 0.02))))) == 0  # wholly inside
