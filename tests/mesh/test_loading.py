"""Mesh files are read as they declare themselves, or refused with what they have."""

from __future__ import annotations

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
from helpers.meshes import assert_sound, box, prepare, without_faces, write
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from drakegrasp.errors import MeshError
from drakegrasp.mesh.loading import load_points, load_surface
from drakegrasp.objects.audit import audit


def nan_box() -> trimesh.Trimesh:
    mesh = box()
    mesh.vertices[3, 1] = np.nan
    return mesh


def moebius() -> trimesh.Trimesh:
    angle = 0.4 * np.pi * np.arange(5)
    corners = 0.1 * np.column_stack([np.cos(angle), np.sin(angle), np.sin(3.0 * angle)])
    return trimesh.Trimesh(corners, [np.arange(i, i + 3) % 5 for i in range(5)], process=False)


def tetrahedron() -> trimesh.Trimesh:
    corners = np.vstack((np.zeros(3), np.diag([0.012, 0.0006, 0.0006])))
    return trimesh.Trimesh(corners, [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], process=False)


def hemisphere() -> trimesh.Trimesh:
    ball = trimesh.creation.icosphere(3, radius=0.05)
    return without_faces(ball, ball.triangles_center[:, 2] < 0.0)


UNUSABLE = {
    "text": ("a.obj", b"this is a shopping list\n", "must hold triangles, got no faces"),
    "empty": ("a.stl", b"", "got an empty file"),
    "points": ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\n"
               b"property float y\nproperty float z\nend_header\n0 0 0\n", "no faces"),
    "degenerate": ("a.obj", b"v 0 0 0\nv 1 0 0\nf 1 2 2\n", "only degenerate faces"),
    "nan": ("a.obj", nan_box(), r"must be finite, got NaN, inf or more than 1e\+09 at"),
    "light years": ("a.obj", box((1e12, 0.1, 0.1)), "must be finite, got NaN, inf or more"),
    "large": ("a.obj", box((6.0, 10.0, 4.0)), r"0\.01 m to 2 m, got 12\.33 m .* --units .*objects"),
    "small": ("a.obj", box((0.0006, 0.001, 0.0004)), "0.01 m to 2 m"),
    "sheet": ("a.obj", trimesh.Trimesh(np.diag([0.1] * 3), [[0, 1, 2]]), "got a flat sheet"),
    "thin": ("a.obj", box((0.1, 0.1, 0.0004)), "at least 0.5 mm thick, got 0.4 mm"),
    "speck": ("a.obj", tetrahedron(), r"at least 1e-09 m\^3, got 7.2e-10"),
    "bowl": ("a.obj", hemisphere(), "at most 25% of the surface, got 3[0-9]%"),
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
    """In the axes of its parent, which was."""
    turn, place = Rotation.from_euler("xyz", [0.4, 0.7, 1.1]), np.array([4.0, 5.0, 6.0])
    scale, aside = np.array([1.0, 2.0, 3.0]), np.array([1.0, 2.0, -3.0])
    pose = {"rotation": turn.as_quat().tolist(), "scale": scale.tolist()}
    parent = {"children": [1], **pose, "translation": place.tolist()}
    child = {"mesh": 0, **pose, "translation": aside.tolist()}
    content = nodes_glb(parent, child, scene=0, scenes=[{"nodes": [0]}])
    mesh = load_mesh(write_file(tmp_path, "a.glb", content))
    inner = turn.apply(CUBE * scale) + aside
    wanted = turn.apply(inner * scale) + place
    found = [np.linalg.norm(mesh.vertices - corner, axis=1).min() for corner in wanted]
    np.testing.assert_allclose(found, 0.0, atol=1e-6)


def test_order_of_existing_datasets_stays(tmp_path):
    """The last material of a Wavefront file comes first, as trimesh has it."""
    far = [[k + 8 for k in q] for q in QUADS]
    text = f"usemtl a\n{obj()}usemtl b\n{obj(ASIDE, far)}"
    mesh = load_mesh(write_file(tmp_path, "a.obj", text))
    np.testing.assert_array_equal(mesh.vertices, np.vstack((ASIDE, CUBE)))
    assert (mesh.faces[:12] < 8).all() and (mesh.faces[12:] >= 8).all()
