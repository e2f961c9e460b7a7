"""Mesh files are read as they declare themselves, or refused with what they have."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers.mesh_files import (
    ASIDE,
    CUBE,
    OUTLINES,
    QUADS,
    READ,
    REFUSED,
    dae,
    load_mesh,
    nodes_glb,
    obj,
    ply,
    prism,
    write_file,
)
from helpers.meshes import BOX, assert_sound, box, prepare, without_faces, write
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from drakegrasp.errors import MeshError
from drakegrasp.mesh.loading import load_points, load_surface
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


UNUSABLE = {
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


@pytest.mark.parametrize("case", UNUSABLE)
def test_refusal_gives_the_reason_and_the_file(tmp_path, case):
    name, content, message = UNUSABLE[case]
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


@pytest.mark.parametrize("case", READ)
def test_a_file_is_read_as_it_declares_itself(tmp_path: Path, case: str) -> None:
    name, content, (volume, area) = READ[case]
    mesh = load_mesh(write_file(tmp_path, name, content))
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(volume, rel=1e-4)
    assert mesh.area == pytest.approx(area, rel=1e-4)


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_read_as_something_else_is_refused_in_one_line(tmp_path: Path, case: str) -> None:
    name, content, message = REFUSED[case]
    with pytest.raises(MeshError, match=message) as caught:
        load_mesh(write_file(tmp_path, name, content))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("outline", OUTLINES)
def test_concave_polygons_are_refused_whatever_their_first_corner(
    tmp_path: Path, outline: str
) -> None:
    for start in range(len(OUTLINES[outline])):
        vertices, faces = prism(OUTLINES[outline], start)
        for scale, mirrored in ((1.0, faces), (1e-3, [f[::-1] for f in faces])):
            path = write_file(tmp_path, "a.obj", obj(scale * vertices, mirrored))
            with pytest.raises(MeshError, match="polygons that are concave or fold back"):
                load_mesh(path)


@pytest.mark.parametrize(
    ("unit", "size"),
    [
        ('<unit meter="1"/>', 1.0),
        ('<unit meter="0.001" name="millimeter"/>', 1e-3),
        ('<unit meter="0.0254" name="inch"/>', 0.0254),
        ("", 1.0),
    ],
)
def test_the_unit_that_a_file_states_applies(tmp_path: Path, unit: str, size: float) -> None:
    pytest.importorskip("collada")
    vertices, faces = load_surface(write_file(tmp_path, "a.dae", dae(unit)))
    assert len(faces) == 12
    np.testing.assert_allclose(np.ptp(vertices, axis=0), size)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (dae(count=14), "14 faces declared, but 12 that can be read"),
        (dae().replace("instance_geometry", "instance_controller"), "a controller, which may bend"),
        (dae('<unit meter="0,001"/>'), "a unit of '0,001' metres"),
        (dae()[:900], "must be a valid .dae mesh"),
        (dae().replace("0.0", "0,0", 1), "must be a valid .dae mesh"),
    ],
)
def test_collada_that_is_not_as_declared_is_refused(
    tmp_path: Path, content: str, message: str
) -> None:
    pytest.importorskip("collada")
    with pytest.raises(MeshError, match=message):
        load_surface(write_file(tmp_path, "a.dae", content))


def test_points_are_read_from_a_file_without_faces(tmp_path: Path) -> None:
    for order in ("<", ">", ""):
        path = write_file(tmp_path, "a.ply", ply(CUBE, [], order))
        np.testing.assert_array_equal(load_points(path), CUBE)
    for content, message in (
        (ply(CUBE, QUADS, "<"), "must hold points, got a mesh"),
        (ply(CUBE, [], "")[:-5], "7 lines, but a header that declares 8|text in place|must be a"),
        (ply(CUBE, [], "<")[:-1], "unexpected length"),
    ):
        with pytest.raises(MeshError, match=message):
            load_points(write_file(tmp_path, "a.ply", content))


def test_node_is_scaled_then_turned_then_moved(tmp_path):
    turn, scale, place = (
        Rotation.from_euler("xyz", [0.4, 0.7, 1.1]),
        [1.0, 2.0, 3.0],
        [4.0, 5.0, 6.0],
    )
    pose = {"rotation": turn.as_quat().tolist(), "scale": scale, "translation": place}
    mesh = load_mesh(write_file(tmp_path, "a.glb", nodes_glb({"mesh": 0, **pose})))
    wanted = turn.apply(CUBE * scale) + place
    found = [np.linalg.norm(mesh.vertices - corner, axis=1).min() for corner in wanted]
    np.testing.assert_allclose(found, 0.0, atol=1e-6)


def test_child_is_moved_in_the_axes_of_its_parent(tmp_path):
    turn = Rotation.from_euler("xyz", [0.4, 0.7, 1.1])
    parent = {"rotation": turn.as_quat().tolist(), "translation": [4.0, 5.0, 6.0]}
    child = {"mesh": 0, "translation": [1.0, 2.0, 3.0]}

    nodes = ({"children": [1], **parent}, child)
    content = nodes_glb(*nodes, scene=0, scenes=[{"nodes": [0]}])
    mesh = load_mesh(write_file(tmp_path, "a.glb", content))
    wanted = turn.apply(CUBE + np.array([1.0, 2.0, 3.0])) + np.array([4.0, 5.0, 6.0])
    found = [np.linalg.norm(mesh.vertices - corner, axis=1).min() for corner in wanted]
    np.testing.assert_allclose(found, 0.0, atol=1e-6)


def test_order_of_existing_datasets_stays(tmp_path):
    """The last material of a Wavefront file comes first, as trimesh has it."""
    far = [[k + 8 for k in q] for q in QUADS]
    text = f"usemtl a\n{obj()}usemtl b\n{obj(ASIDE, far)}"
    mesh = load_mesh(write_file(tmp_path, "a.obj", text))
    np.testing.assert_array_equal(mesh.vertices, np.vstack((ASIDE, CUBE)))
    assert (mesh.faces[:12] < 8).all() and (mesh.faces[12:] >= 8).all()
