"""Rays against closed forms, and the Wavefront text of a mesh."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from helpers.meshes import box

from drakegrasp.mesh.surfaces import RAY_PAIRS, first_hits, obj_text

HALF = np.array([0.03, 0.04, 0.05])


@pytest.fixture(scope="module")
def grids() -> np.ndarray:
    """The triangles of a box whose faces are grids, so that many rays meet edges and corners."""
    mesh = trimesh.creation.box(2.0 * HALF).subdivide().subdivide().subdivide()
    return np.asarray(mesh.triangles)


def down(xy: np.ndarray, height: float = 0.2) -> tuple[np.ndarray, np.ndarray]:
    """Return rays from a height, straight down, at points (n, 2)."""
    p = np.column_stack([xy, np.full(len(xy), height)])
    return p, np.tile([0.0, 0.0, -1.0], (len(xy), 1))


def test_no_ray_slips_through_an_edge_or_a_corner(grids: np.ndarray) -> None:
    top = grids[np.all(grids[:, :, 2] == HALF[2], axis=1)]
    middles = (top + np.roll(top, 1, axis=1)) / 2.0
    xy = np.concatenate([top.reshape(-1, 3), middles.reshape(-1, 3)])[:, :2]
    assert np.allclose(first_hits(grids, *down(xy)), 0.2 - HALF[2], rtol=0.0, atol=1e-15)


def test_a_ray_past_the_silhouette_misses(grids: np.ndarray) -> None:
    beside = np.array([[HALF[0] + 1e-7, 0.0], [0.0, -HALF[1] - 1e-7], [0.1, 0.1]])
    assert np.isinf(first_hits(grids, *down(beside))).all()


def test_the_first_of_several_walls_counts_and_what_is_behind_does_not(grids: np.ndarray) -> None:
    inside, away = np.zeros((1, 3)), np.array([[0.0, 0.0, 0.2]])
    z = np.array([[0.0, 0.0, 1.0]])
    assert first_hits(grids, inside, z)[0] == pytest.approx(HALF[2])
    assert np.isinf(first_hits(grids, away, z)[0])


def test_slanted_rays_agree_with_the_box_in_closed_form(grids: np.ndarray) -> None:
    """Slab by slab; more rays than fit into one block."""
    rng = np.random.default_rng(1)
    count = 3 * RAY_PAIRS // len(grids) + 5
    p = rng.normal(size=(count, 3))
    p *= 0.3 / np.linalg.norm(p, axis=1, keepdims=True)
    z = rng.uniform(-1.2, 1.2, (count, 3)) * HALF - p
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    t = np.sort(np.stack([(-HALF - p) / z, (HALF - p) / z]), axis=0)
    entry, leave = t[0].max(axis=1), t[1].min(axis=1)
    expected = np.where(entry <= leave, entry, np.inf)
    assert np.isfinite(expected).any() and np.isinf(expected).any()
    assert np.allclose(first_hits(grids, p, z), expected, rtol=0.0, atol=1e-12)


def test_no_rays_and_no_triangles(grids: np.ndarray) -> None:
    none = np.zeros((0, 3))
    assert first_hits(grids, none, none).shape == (0,)
    assert np.isinf(first_hits(grids[:0], *down(np.zeros((2, 2))))).all()


def test_normals_are_crisp_on_boxes_and_smooth_on_balls():
    def normals(mesh):
        rows = [r.split() for r in obj_text(mesh.vertices, mesh.faces, normals=True).splitlines()]
        vn = np.array([r[1:] for r in rows if r[0] == "vn"], dtype=float)
        index = [[int(c.split("//")[1]) - 1 for c in r[1:]] for r in rows if r[0] == "f"]
        return vn, vn[np.array(index)]

    cube = box()
    vn, corners = normals(cube)
    assert len(vn) == 6
    np.testing.assert_allclose(corners, np.repeat(cube.face_normals[:, None], 3, axis=1))
    ball = trimesh.creation.icosphere(3)
    vn, corners = normals(ball)
    assert len(vn) <= len(ball.vertices)
    assert np.einsum("ijk,ijk->ij", corners, ball.vertices[ball.faces]).min() > 0.999
