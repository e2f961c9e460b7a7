"""Reading mesh files: formats, scenes, and what is refused."""

from __future__ import annotations

import struct

import numpy as np
import pytest
import trimesh
from helpers.mesh_files import load_mesh
from helpers.meshes import BOX, assert_sound, box, prepare, without_faces, write
from hypothesis import given, settings
from hypothesis import strategies as st

from drakegrasp.errors import MeshError
from drakegrasp.objects.audit import audit


@pytest.mark.parametrize("suffix", ["obj", "STL", "ply", "glb"])
def test_formats_agree(tmp_path, suffix):
    path = tmp_path / f"a.{suffix}"
    path.write_bytes(
        box().export(file_type=suffix.lower(), **({"encoding": "ascii"} if suffix == "ply" else {}))
        if suffix != "obj"
        else box().export(file_type="obj").encode()
    )
    model = prepare(path)
    assert_sound(model)
    assert model.notes == () and len(model.visual_faces) == 12
    np.testing.assert_allclose(model.half_extents, np.array(BOX) / 2.0, rtol=1e-6)


def test_scene_is_put_together_with_its_transforms(tmp_path):
    scene = trimesh.Scene()
    shared = box((0.1, 0.1, 0.1))
    turn = trimesh.transformations.rotation_matrix(np.pi / 2.0, [0.0, 0.0, 1.0])
    mirror = np.diag([-1.0, 1.0, 1.0, 1.0])
    for i, (X, x) in enumerate(((turn, 0.0), (mirror, 0.3))):
        X = X.copy()
        X[0, 3] = x
        scene.add_geometry(shared, node_name=f"n{i}", geom_name="shared", transform=X)
    path = tmp_path / "scene.glb"
    path.write_bytes(scene.export(file_type="glb"))
    model = prepare(path)
    assert_sound(model)
    assert model.volume == pytest.approx(2e-3, rel=1e-6)
    np.testing.assert_allclose(model.half_extents, [0.2, 0.05, 0.05], rtol=1e-6)
    assert "2 parts do not touch and will move as one" in model.notes


def nan_box() -> trimesh.Trimesh:
    mesh = box()
    mesh.vertices[3, 1] = np.nan
    return mesh


def moebius() -> trimesh.Trimesh:
    n, vertices, faces = 24, [], []
    for i in range(n):
        t = 2 * np.pi * i / n
        for s in (-0.02, 0.02):
            r = 0.1 + s * np.cos(t / 2)
            vertices.append([r * np.cos(t), r * np.sin(t), s * np.sin(t / 2)])
    for i in range(n - 1):
        faces += [[2 * i, 2 * i + 1, 2 * i + 2], [2 * i + 1, 2 * i + 3, 2 * i + 2]]
    faces += [[2 * n - 2, 2 * n - 1, 1], [2 * n - 1, 0, 1]]
    return trimesh.Trimesh(vertices, faces, process=False)


def tetrahedron() -> trimesh.Trimesh:
    corners = np.vstack((np.zeros(3), np.diag([0.012, 0.0006, 0.0006])))
    return trimesh.Trimesh(corners, [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], process=False)


def hemisphere() -> trimesh.Trimesh:
    ball = trimesh.creation.icosphere(3, radius=0.05)
    return without_faces(ball, ball.triangles_center[:, 2] < 0.0)


GLB = box().export(file_type="glb")


REFUSED = {
    "text": ("a.obj", b"this is a shopping list\n", "must hold triangles, got no faces"),
    "empty": ("a.stl", b"", "got an empty file"),
    "points": ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\n"
               b"property float y\nproperty float z\nend_header\n0 0 0\n", "no faces"),
    "garbage stl": ("a.stl", struct.pack("<80sI", b"x", 10**6) + b"abc", "a.stl: must"),
    "garbage ply": ("a.ply", b"\x00\xff\xfe" * 30, "valid .ply mesh"),
    "truncated glb": ("a.glb", GLB[: len(GLB) // 2], "valid .glb mesh"),
    "index": ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "a.obj: (must be|faces must)"),
    "degenerate": ("a.obj", b"v 0 0 0\nv 1 0 0\nf 1 2 2\n", "only degenerate faces"),
    "nan": ("a.obj", nan_box(), r"must be finite, got NaN, inf or more than 1e\+09 at"),
    "light years": ("a.obj", box((1e12, 0.1, 0.1)), "must be finite, got NaN, inf or more"),
    "wide": ("a.obj", "v 0 0 0".encode("utf-16"), "must hold triangles, got no faces"),
    "large": ("a.obj", box((6.0, 10.0, 4.0)), r"0\.01 m to 2 m, got 12\.33 m .* --units .*objects"),
    "small": ("a.obj", box((0.0006, 0.001, 0.0004)), "0.01 m to 2 m"),
    "sheet": ("a.obj", trimesh.Trimesh(np.diag([0.1] * 3), [[0, 1, 2]]), "got a flat sheet"),
    "thin": ("a.obj", box((0.1, 0.1, 0.0004)), "at least 0.5 mm thick, got 0.4 mm"),
    "speck": ("a.obj", tetrahedron(), r"at least 1e-09 m\^3, got 7.2e-10"),
    "bowl": ("a.obj", hemisphere(), "at most 25% of the surface, got 3[0-9]%"),
    "latin": ("a.obj", b"# caf\xe9 \xff\xfe\nv 0 0 0\n", "(text that is not UTF-8|no faces)"),
    "moebius": ("a.obj", moebius(), "must have two sides"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_refusal_gives_the_reason_and_the_file(tmp_path, case):
    name, content, message = REFUSED[case]
    path = tmp_path / name
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        write(path, content)
    with pytest.raises(MeshError, match=message) as caught:
        prepare(path)
    assert "a." in str(caught.value) and "\n" not in str(caught.value)
    (row,) = audit(tmp_path)
    said = str(caught.value).removeprefix(f"{name}: ")
    assert row.status == "refused" and row.notes == (said,) and row.volume is None


@settings(max_examples=60, deadline=None)
@given(
    kind=st.sampled_from(["obj", "stl", "ply", "glb"]),
    cut=st.floats(0.0, 1.0),
    where=st.floats(0.0, 0.999),
    byte=st.integers(0, 255),
)
def test_damaged_files_never_raise_anything_else(tmp_path_factory, kind, cut, where, byte):
    data = box().export(file_type=kind)
    data = bytearray(data.encode() if isinstance(data, str) else data)
    data[int(where * len(data))] = byte
    path = tmp_path_factory.mktemp("damaged") / f"a.{kind}"
    path.write_bytes(data[: int(cut * len(data))] if cut < 0.8 else data)
    try:
        assert_sound(prepare(path))
    except MeshError as error:
        assert "a." in str(error)


def test_missing_and_foreign_files_are_refused(tmp_path):
    with pytest.raises(MeshError, match=r"gone\.obj: must be a readable file"):
        load_mesh(tmp_path / "gone.obj")
    with pytest.raises(MeshError, match=r"must be one of \.obj"):
        (tmp_path / "a.step").write_text("x")
        load_mesh(tmp_path / "a.step")
