"""Truths about meshes: closed forms, seeded faults, refusals; and thirty real files."""

import numpy as np
import pytest
import trimesh
from helpers.mesh_files import load_mesh
from helpers.meshes import (
    BOX,
    G3DB,
    assert_sound,
    box,
    box_inertia,
    flipped,
    needs_g3db,
    open_box,
    prepare,
    without_faces,
    write,
)
from hypothesis import given, settings
from hypothesis import strategies as st

import drakegrasp.mesh.components
import drakegrasp.mesh.repair
from drakegrasp.errors import MeshError
from drakegrasp.mesh.components import part_touching_edges
from drakegrasp.mesh.repair import weld
from drakegrasp.mesh.surfaces import (
    is_solid_surface,
    signed_volume,
    whole_windings,
    winding_numbers,
)
from drakegrasp.objects.model import prepare_object
from drakegrasp.objects.sources import find_meshes


def test_inside_out_box_is_turned(tmp_path):
    model = prepare(write(tmp_path / "a.obj", flipped(box())))
    assert_sound(model)
    assert model.notes == ("the surface was inside out and was turned",)
    np.testing.assert_allclose(model.I_OOcm_O, box_inertia(1.0, *BOX), rtol=1e-9, atol=1e-12)


def test_faces_against_their_neighbours_are_turned(tmp_path):
    mesh = box()
    faces = mesh.faces.copy()
    faces[3] = faces[3, ::-1]
    model = prepare(write(tmp_path / "a.obj", trimesh.Trimesh(mesh.vertices, faces, process=False)))
    assert_sound(model)
    assert model.volume == pytest.approx(np.prod(BOX))
    assert model.notes[0].startswith("1 of 12 faces")


def test_missing_face_is_closed_and_noted(tmp_path):
    mesh = open_box()
    model = prepare(write(tmp_path / "a.obj", mesh))
    assert_sound(model)
    assert model.volume == pytest.approx(np.prod(BOX), rel=1e-9)
    share = 0.06 * 0.10 / (2 * (0.06 * 0.10 + 0.06 * 0.04 + 0.10 * 0.04))
    assert model.notes == (f"1 open rims were closed, {share:.1%} of the surface: solid there now",)


def test_gap_between_two_walls_is_closed_as_a_ring(tmp_path):
    tube = trimesh.creation.annulus(0.035, 0.04, height=0.1, sections=64)
    tube = without_faces(tube, tube.face_normals[:, 2] < 0.9)
    model = prepare(write(tmp_path / "tube.obj", tube))
    assert_sound(model)
    area = 64 / 2 * np.sin(2 * np.pi / 64) * (0.04**2 - 0.035**2)
    assert model.volume == pytest.approx(area * 0.1, rel=1e-9)
    assert model.visual.area == pytest.approx(tube.area + area, rel=1e-9)
    assert model.notes[0].startswith("2 open rims were closed")


def test_overlapping_bodies_count_once(tmp_path):
    path = write(
        tmp_path / "a.obj", box((0.1, 0.1, 0.1)), box((0.1, 0.04, 0.04), (0.07, 0.01, 0.0))
    )
    model = prepare(path)
    assert_sound(model)
    assert model.volume == pytest.approx(1e-3 + 0.07 * 0.04 * 0.04, rel=1e-9)
    assert model.notes == ("2 bodies were united into one solid",)


@pytest.mark.parametrize("inside_out", [False, True])
def test_cavity_stays_hollow(tmp_path, inside_out):
    parts = [box((0.1, 0.1, 0.1)), flipped(box((0.08, 0.08, 0.08))), box((0.02, 0.02, 0.02))]
    if inside_out:
        parts = [flipped(part) for part in parts]
    model = prepare(write(tmp_path / "a.obj", *parts))
    assert_sound(model)
    assert model.volume == pytest.approx(1e-3 - 0.08**3 + 0.02**3, rel=1e-9)
    assert "1 sealed cavities were kept hollow" in model.notes
    hollow = np.diag([1.0] * 3) / 6.0 * (0.1**5 - 0.08**5 + 0.02**5) / model.volume
    np.testing.assert_allclose(model.I_OOcm_O, hollow, rtol=1e-9, atol=1e-12)


def test_inside_out_body_beside_a_good_one_is_turned(tmp_path):
    path = write(tmp_path / "a.obj", box((0.1,) * 3), flipped(box((0.04,) * 3, (0.06, 0.0, 0.0))))
    model = prepare(path)
    assert model.volume == pytest.approx(1e-3 + 0.03 * 0.04**2, rel=1e-9)
    assert "1 of 2 bodies were inside out and were turned" in model.notes


def test_bodies_that_share_an_edge_or_a_wall(tmp_path):
    edge = prepare(write(tmp_path / "a.obj", box((0.1,) * 3), box((0.1,) * 3, (0.1, 0.1, 0.0))))
    assert edge.volume == pytest.approx(2e-3, rel=1e-9)
    assert is_solid_surface(edge.visual_faces.astype(np.int64))
    wall = prepare(write(tmp_path / "b.obj", box((0.1,) * 3), box((0.1,) * 3, (0.1, 0.0, 0.0))))
    assert_sound(wall)
    np.testing.assert_allclose(
        wall.I_OOcm_O, box_inertia(1.0, 0.2, 0.1, 0.1), rtol=1e-9, atol=1e-12
    )


def test_inner_wall_is_dropped(tmp_path):
    left, right = box((0.1,) * 3), box((0.1,) * 3, (0.1, 0.0, 0.0))
    right = without_faces(right, right.face_normals[:, 0] > -0.5)
    model = prepare(write(tmp_path / "a.obj", left, right))
    assert_sound(model)
    assert model.volume == pytest.approx(2e-3, rel=1e-9)
    assert "enclose nothing" in model.notes[-1]


def test_duplicate_and_degenerate_faces_are_dropped(tmp_path):
    mesh = box()
    faces = np.vstack((mesh.faces, mesh.faces[:2], mesh.faces[5, ::-1], [[0, 0, 1]]))
    path = write(tmp_path / "a.obj", trimesh.Trimesh(mesh.vertices, faces, process=False))
    loaded = load_mesh(path)
    assert len(loaded.faces) == 12 and len(loaded.vertices) == 8
    assert prepare(path).volume == pytest.approx(np.prod(BOX))


def test_every_face_in_both_directions(tmp_path):
    path = write(tmp_path / "a.obj", box(), flipped(box()))
    assert prepare(path).volume == pytest.approx(np.prod(BOX))


def test_loose_triangle_is_dropped(tmp_path):
    speck = trimesh.Trimesh(np.eye(3) * 1e-3 + 0.06, [[0, 1, 2]], process=False)
    model = prepare(write(tmp_path / "a.obj", box(), speck))
    assert model.volume == pytest.approx(np.prod(BOX))
    np.testing.assert_allclose(model.half_extents, np.array(BOX) / 2.0)
    assert "1 pieces that enclose nothing" in model.notes[0]


def test_seam_that_does_not_quite_meet_is_stitched(tmp_path):
    mesh = trimesh.Trimesh(
        box().vertices[box().faces].reshape(-1, 3), np.arange(36).reshape(-1, 3), process=False
    )
    mesh.vertices += np.random.default_rng(0).uniform(-1e-6, 1e-6, mesh.vertices.shape)
    model = prepare(write(tmp_path / "a.obj", mesh))
    assert_sound(model)
    assert model.volume == pytest.approx(np.prod(BOX), rel=1e-3)
    assert "stitched" in model.notes[0]


def test_winding_numbers_of_a_box():
    cube = box()
    points = np.array([[0.0, 0.0, 0.0], [0.029, 0.049, 0.019], [0.031, 0.0, 0.0], [5.0, 5.0, 5.0]])
    w = winding_numbers(points, np.array(cube.vertices), np.array(cube.faces))
    np.testing.assert_allclose(w, [1.0, 1.0, 0.0, 0.0], atol=1e-9)


def test_whole_windings_are_those_of_the_solid_angles():
    """Overlaps, a cavity, a part inside out; and below and above corners and edges."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.03)
    leaning = box((0.05, 0.04, 0.06), (0.03, 0.02, 0.0))
    leaning.apply_transform(trimesh.transformations.euler_matrix(0.4, 0.3, 0.2))
    hole = flipped(box((0.01, 0.02, 0.01)))
    outside = flipped(box((0.02,) * 3, (0.0, 0.09, 0.0)))
    parts = trimesh.util.concatenate([ball, box(), leaning, hole, outside])
    vertices, faces = np.array(parts.vertices), np.array(parts.faces)

    points = np.random.default_rng(3).uniform(-0.08, 0.12, (4000, 3))
    columns = np.vstack([vertices, vertices[faces[:, :2]].mean(axis=1)])
    heights = np.linspace(-0.0717, 0.0713, 12)
    for z in heights:
        points = np.vstack([points, np.column_stack([columns[:, :2], np.full(len(columns), z)])])
    expected = winding_numbers(points, vertices, faces)
    assert set(np.rint(expected)) == {-1.0, 0.0, 1.0, 2.0, 3.0}
    np.testing.assert_allclose(whole_windings(points, vertices, faces), expected, atol=1e-9)


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), shift=st.tuples(*[st.floats(-0.08, 0.08)] * 3))
def test_union_volume_is_inclusion_exclusion(tmp_path_factory, seed, shift):
    order = np.random.default_rng(seed).permutation(2)
    a, b = np.array([0.1, 0.08, 0.06]), np.array([0.05, 0.09, 0.07])
    common = np.clip(np.minimum(a / 2, shift + b / 2) - np.maximum(-a / 2, shift - b / 2), 0, None)
    parts = [box(a), box(b, shift)]
    path = write(tmp_path_factory.mktemp("any") / "a.obj", *(parts[i] for i in order))
    model = prepare(path)
    assert is_solid_surface(model.visual_faces.astype(np.int64))
    assert model.volume == pytest.approx(a.prod() + b.prod() - common.prod(), rel=1e-4)


def test_surface_of_too_many_pieces_is_refused(tmp_path, monkeypatch):
    boxes = [box().apply_translation([0.3 * i, 0.0, 0.0]) for i in range(4)]
    path = write(tmp_path / "1_boxes.obj", *boxes)
    monkeypatch.setattr(drakegrasp.mesh.repair, "MOST_PIECES", 4)
    assert_sound(prepare(path))
    monkeypatch.setattr(drakegrasp.mesh.repair, "MOST_PIECES", 3)
    with pytest.raises(MeshError, match="must be of at most 3 pieces, got 4: keep the large ones"):
        prepare(path)


@needs_g3db
def test_surface_that_passes_through_itself_too_much_is_refused(monkeypatch):
    monkeypatch.setattr(drakegrasp.mesh.components, "MAX_OVERLAP", 0.02)
    (source,) = (s for s in find_meshes(G3DB, units="cm") if "toaster" in s.name)
    with pytest.raises(MeshError, match="must not pass through itself"):
        prepare_object(source)


def test_signed_volume_does_not_depend_on_the_place():
    cube = box(at=(100.0, -50.0, 7.0))
    volume = signed_volume(np.array(cube.vertices), np.array(cube.faces))
    assert volume == pytest.approx(np.prod(BOX), rel=1e-9)


def test_touching_edge_gets_a_vertex_for_each_side():
    """Two bricks share an edge; each keeps its own two faces at both halves of it."""
    corner, other = box((0.02,) * 3), box((0.02,) * 3, (0.02, 0.02, 0.0))
    vertices, faces = weld(
        np.vstack((corner.vertices, other.vertices)), np.vstack((corner.faces, other.faces + 8))
    )
    assert not is_solid_surface(faces)
    parted, new_faces = part_touching_edges(vertices, faces)
    assert len(parted) == len(vertices) + 2 and len(new_faces) == len(faces) + 4
    np.testing.assert_allclose(parted[-2:], [[0.01, 0.01, 0.0]] * 2, atol=1e-12)
    assert is_solid_surface(new_faces)
    assert signed_volume(parted, new_faces) == pytest.approx(2 * 0.02**3)


def test_triangle_that_is_a_needle_is_collapsed_and_told():
    """An edge of a box is parted a nanometre from its end, in both faces beside it."""
    solid = trimesh.creation.box([0.1, 0.2, 0.4])
    (one, two), (a, b) = solid.face_adjacency[0], solid.face_adjacency_edges[0]
    vertices = np.vstack([solid.vertices, solid.vertices[a]])
    vertices[-1] += 1e-9 * (vertices[b] - vertices[a])
    m, faces = len(vertices) - 1, [list(face) for face in solid.faces]
    for face in (faces[one].copy(), faces[two].copy()):
        faces.remove(face)
        faces += [[m if v == end else v for v in face] for end in (a, b)]
    notes: list[str] = []
    united = drakegrasp.mesh.components.unite([(vertices, np.array(faces))], 0.5, notes)
    assert notes == ["degenerate triangles were collapsed"]
    assert signed_volume(*united) == pytest.approx(0.008)

    notes.clear()
    drakegrasp.mesh.components.unite([(solid.vertices, solid.faces)], 0.5, notes)
    assert notes == []


@pytest.mark.parametrize(
    ("share", "said"), [(0.0015, "kept"), (0.03, "noted"), (0.045, "noted"), (0.055, "refused")]
)
def test_what_passes_through_itself_is_kept_noted_or_refused(share, said, monkeypatch):
    """By the share of its volume that is enclosed twice."""
    monkeypatch.setattr(drakegrasp.mesh.components, "overlap_share", lambda *_, **__: share)
    box, notes = trimesh.creation.box([0.1, 0.2, 0.4]), []
    surface = np.asarray(box.vertices), np.asarray(box.faces)
    if said == "refused":
        with pytest.raises(MeshError, match=r"must not pass through itself, got 5\.5%"):
            drakegrasp.mesh.components.check_self_intersection(*surface, notes)
        return
    drakegrasp.mesh.components.check_self_intersection(*surface, notes)
    assert any("passes through" in note for note in notes) is (said == "noted")
