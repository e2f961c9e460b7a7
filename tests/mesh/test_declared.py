"""A mesh file is read as it declares itself, or refused with what it has."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.mesh_files import (
    ASIDE,
    CUBE,
    OUTLINES,
    QUADS,
    READ,
    REFUSED,
    dae,
    edited_glb,
    load_mesh,
    obj,
    ply,
    prism,
    write_file,
)
from scipy.spatial.transform import Rotation

from drakegrasp.errors import MeshError
from drakegrasp.mesh.loading import load_points, load_surface


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
    mesh = load_mesh(write_file(tmp_path, "a.glb", edited_glb(lambda _: [{"mesh": 0, **pose}])))
    wanted = turn.apply(CUBE * scale) + place
    found = [np.linalg.norm(mesh.vertices - corner, axis=1).min() for corner in wanted]
    np.testing.assert_allclose(found, 0.0, atol=1e-6)


def test_child_is_moved_in_the_axes_of_its_parent(tmp_path):
    turn = Rotation.from_euler("xyz", [0.4, 0.7, 1.1])
    parent = {"rotation": turn.as_quat().tolist(), "translation": [4.0, 5.0, 6.0]}
    child = {"mesh": 0, "translation": [1.0, 2.0, 3.0]}

    def edit(g):
        g.extra.update(scene=0, scenes=[{"nodes": [0]}])
        return [{"children": [1], **parent}, child]

    mesh = load_mesh(write_file(tmp_path, "a.glb", edited_glb(edit)))
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
