"""Wavefront text of a mesh."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from helpers.meshes import box

from drakegrasp.mesh.surfaces import obj_text


@pytest.mark.parametrize("normals", [False, True])
def test_obj_text_reads_back_exactly(tmp_path, normals):
    mesh = trimesh.creation.icosphere(2, radius=0.1 / 3)
    path = tmp_path / "a.obj"
    path.write_text(obj_text(mesh.vertices, mesh.faces, normals=normals))
    rows = [line.split() for line in path.read_text().splitlines()]
    v = np.array([row[1:] for row in rows if row[0] == "v"], dtype=float)
    f = np.array([[c.split("/")[0] for c in row[1:]] for row in rows if row[0] == "f"], dtype=int)
    np.testing.assert_array_equal(v, mesh.vertices)
    np.testing.assert_array_equal(f - 1, mesh.faces)
    assert any(row[0] == "vn" for row in rows) == normals


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
