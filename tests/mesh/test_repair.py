"""Truths about meshes: closed forms, seeded faults, refusals; and thirty real files."""

import re

import numpy as np
import pytest
import trimesh
from helpers.mesh_files import load_mesh
from helpers.meshes import BOX, assert_sound, box, flipped, open_box, prepare, without_faces, write
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

VOLUME = float(np.prod(BOX))


def one_face_turned() -> trimesh.Trimesh:
    mesh = box()
    faces = mesh.faces.copy()
    faces[0] = faces[0, ::-1]
    return trimesh.Trimesh(mesh.vertices, faces, process=False)


def tube() -> trimesh.Trimesh:
    """Return a pipe that is open at one end, between its two walls."""
    mesh = trimesh.creation.annulus(0.035, 0.04, height=0.1, sections=64)
    return without_faces(mesh, mesh.face_normals[:, 2] < 0.9)


def apart() -> trimesh.Trimesh:
    """Return a box whose triangles share no vertex, each of which is off by a micrometre."""
    corners = box().vertices[box().faces].reshape(-1, 3)
    corners += np.random.default_rng(0).uniform(-1e-6, 1e-6, corners.shape)
    return trimesh.Trimesh(corners, np.arange(36).reshape(-1, 3), process=False)


def cracked() -> trimesh.Trimesh:
    """Return a box with an edge that only one of its two faces divides: a hole without an area."""
    mesh = box()
    a, b, c = mesh.faces[0]
    middle = np.append(mesh.vertices, [mesh.vertices[[a, b]].mean(axis=0)], axis=0)
    m = len(mesh.vertices)
    return trimesh.Trimesh(middle, [[a, m, c], [m, b, c], *mesh.faces[1:]], process=False)


def beside(at: float, flip: bool = False) -> list[trimesh.Trimesh]:
    """Return two cubes that touch or overlap, the second of which may be inside out."""
    other = box((0.04,) * 3, (at, 0.0, 0.0))
    return [box((0.1,) * 3), flipped(other) if flip else other]


LEFT, RIGHT = box((0.1,) * 3), box((0.1,) * 3, (0.1, 0.0, 0.0))
HOLLOW = [box((0.1,) * 3), flipped(box((0.08,) * 3)), box((0.02,) * 3)]
SPECK = trimesh.Trimesh(np.eye(3) * 1e-3 + 0.06, [[0, 1, 2]], process=False)
#: Area of the end of the pipe [m^2], and the share of a box's surface that its lid is.
RING = 64 / 2 * np.sin(2 * np.pi / 64) * (0.04**2 - 0.035**2)
LID = 0.06 * 0.10 / (2 * (0.06 * 0.10 + 0.06 * 0.04 + 0.10 * 0.04))
#: Parts of a file, the volume of its solid [m^3], and what is told.
REPAIRED: dict[str, tuple[list[trimesh.Trimesh], float, str]] = {
    "inside out": ([flipped(box())], VOLUME, "the surface was inside out and was turned"),
    "a face turned": ([one_face_turned()], VOLUME, "1 of 12 faces ran against their neighbours"),
    "no lid": ([open_box()], VOLUME, f"1 open rims were closed, {LID:.1%} of the surface: solid"),
    "open between two walls": ([tube()], 0.1 * RING, "2 open rims were closed"),
    "an edge that one side divides": ([cracked()], VOLUME, "1 open rims were closed, 0.0% of"),
    "bodies that overlap": (beside(0.06), 1e-3 + 0.03 * 0.04**2, "2 bodies were united into one"),
    "one of them inside out": (
        beside(0.06, flip=True),
        1e-3 + 0.03 * 0.04**2,
        "1 of 2 bodies were inside out and were turned",
    ),
    "hollow": (HOLLOW, 1e-3 - 0.08**3 + 0.02**3, "1 sealed cavities were kept hollow"),
    "hollow, inside out": (
        [flipped(part) for part in HOLLOW],
        1e-3 - 0.08**3 + 0.02**3,
        "1 sealed cavities were kept hollow",
    ),
    "a hollow body in a hollow one": (
        [box((0.1,) * 3), flipped(box((0.08,) * 3)), box((0.06,) * 3), flipped(box((0.04,) * 3))],
        1e-3 - 0.08**3 + 0.06**3 - 0.04**3,
        "2 sealed cavities were kept hollow",
    ),
    "a wall in common": ([LEFT, RIGHT], 2e-3, ""),
    "a wall inside": (
        [LEFT, without_faces(RIGHT, RIGHT.face_normals[:, 0] > -0.5)],
        2e-3,
        r"\d+ pieces that enclose nothing were dropped",
    ),
    "an edge in common": ([LEFT, box((0.1,) * 3, (0.1, 0.1, 0.0))], 2e-3, ""),
    "apart": (
        [LEFT, box((0.1,) * 3, (0.3, 0.0, 0.0))],
        2e-3,
        "2 parts do not touch",
    ),
    "each face in both directions": ([box(), flipped(box())], VOLUME, ""),
    "a loose triangle": ([box(), SPECK], VOLUME, "1 pieces that enclose nothing were dropped"),
    "a seam that does not quite meet": (
        [apart()],
        VOLUME,
        r"\d+ open edges were stitched together",
    ),
}


@pytest.mark.parametrize("case", REPAIRED)
def test_a_surface_becomes_one_solid_and_what_was_done_is_told(tmp_path, case):
    parts, volume, note = REPAIRED[case]
    model = prepare(write(tmp_path / "a.obj", *parts))
    assert_sound(model)
    assert is_solid_surface(model.visual_faces.astype(np.int64))
    assert model.volume == pytest.approx(volume, rel=1e-3 if "seam" in case else 1e-9)
    inertia = model.visual.moment_inertia / model.volume
    np.testing.assert_allclose(model.I_OOcm_O, inertia, rtol=1e-6, atol=1e-10)
    assert not note or any(re.match(note, each) for each in model.notes)


def test_duplicate_and_degenerate_faces_are_dropped(tmp_path):
    mesh = box()
    faces = np.vstack((mesh.faces, mesh.faces[:2], mesh.faces[5, ::-1], [[0, 0, 1]]))
    path = write(tmp_path / "a.obj", trimesh.Trimesh(mesh.vertices, faces, process=False))
    loaded = load_mesh(path)
    assert len(loaded.faces) == 12 and len(loaded.vertices) == 8
    assert prepare(path).volume == pytest.approx(np.prod(BOX))


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
