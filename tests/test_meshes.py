"""Truths about meshes: closed forms, seeded faults, refusals; and thirty real files."""

import re
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

import drakegrasp.union
from drakegrasp.audit import audit
from drakegrasp.config import ObjectConfig
from drakegrasp.decimation import decimate
from drakegrasp.errors import MeshError
from drakegrasp.meshes import MeshSource, find_mesh, find_meshes, load_mesh
from drakegrasp.object_model import ObjectModel, load_object, prepare_object, save_object
from drakegrasp.surfaces import Solid, is_solid_surface, signed_volume, winding_numbers
from drakegrasp.wavefront import obj_text

G3DB = Path(__file__).resolve().parents[2] / "shared/meshes/g3db"
needs_g3db = pytest.mark.skipif(not G3DB.is_dir(), reason="the G3DB meshes are not here")

BOX = (0.06, 0.10, 0.04)


def write(path: Path, *meshes: trimesh.Trimesh) -> Path:
    """Write meshes as one Wavefront file, exactly and without repair."""
    lines, offset = [], 1
    for mesh in meshes:
        lines += ["v {!r} {!r} {!r}".format(*row) for row in mesh.vertices.tolist()]
        lines += ["f {} {} {}".format(*row) for row in (mesh.faces + offset).tolist()]
        offset += len(mesh.vertices)
    path.write_text("\n".join(lines) + "\n")
    return path


def prepare(path: Path, scale: float = 1.0, **options: float) -> ObjectModel:
    source = MeshSource(name=path.stem, class_name="thing", path=path, scale=scale)
    return prepare_object(source, ObjectConfig(**options))


def box(extents=BOX, at=(0.0, 0.0, 0.0)) -> trimesh.Trimesh:
    mesh = trimesh.creation.box(extents)
    return trimesh.Trimesh(mesh.vertices + np.asarray(at), mesh.faces, process=False)


def without_faces(mesh: trimesh.Trimesh, keep: np.ndarray) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces[keep], process=False)


def flipped(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1], process=False)


def open_box() -> trimesh.Trimesh:
    mesh = box()
    return without_faces(mesh, mesh.face_normals[:, 2] < 0.5)


def box_inertia(m: float, x: float, y: float, z: float) -> np.ndarray:
    return np.diag([y * y + z * z, x * x + z * z, x * x + y * y]) * m / 12.0


def assert_sound(model: ObjectModel) -> None:
    for mesh in (model.visual, model.collision):
        assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0.0
    low, high = model.visual_vertices.min(axis=0), model.visual_vertices.max(axis=0)
    np.testing.assert_allclose(low + high, 0.0, atol=1e-12)
    np.testing.assert_allclose(model.half_extents, high, atol=1e-12)


# Mass properties


def test_box_has_the_closed_form(tmp_path):
    model = prepare(write(tmp_path / "a.obj", box(at=(1.0, 2.0, 3.0))), mass=0.7)
    assert_sound(model)
    assert model.mass == 0.7 and model.notes == () and model.collision_error == 0.0
    assert model.volume == pytest.approx(np.prod(BOX), rel=1e-9)
    np.testing.assert_allclose(model.p_OOcm, 0.0, atol=1e-12)
    np.testing.assert_allclose(model.I_OOcm_O, box_inertia(0.7, *BOX), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(model.half_extents, np.array(BOX) / 2.0, rtol=1e-9)


def test_sphere_and_cylinder_approach_the_closed_form(tmp_path):
    ball = prepare(write(tmp_path / "b.obj", trimesh.creation.icosphere(4, radius=0.04)))
    np.testing.assert_allclose(ball.I_OOcm_O, np.eye(3) * 0.4 * 0.04**2, rtol=5e-3, atol=1e-10)
    tin = trimesh.creation.cylinder(radius=0.03, height=0.12, sections=256)
    tin = prepare(write(tmp_path / "c.obj", tin))
    side = (3 * 0.03**2 + 0.12**2) / 12.0
    expected = np.diag([side, side, 0.03**2 / 2.0])
    np.testing.assert_allclose(tin.I_OOcm_O, expected, rtol=1e-3, atol=1e-9)


def test_centre_of_mass_of_a_cone_is_a_quarter_up(tmp_path):
    cone = trimesh.creation.cone(radius=0.03, height=0.1, sections=128)
    model = prepare(write(tmp_path / "cone.obj", cone))
    np.testing.assert_allclose(model.p_OOcm, [0.0, 0.0, -0.025], atol=1e-6)


@settings(max_examples=15, deadline=None)
@given(
    sides=st.tuples(*[st.floats(0.01, 0.3)] * 3),
    shift=st.tuples(*[st.floats(-5.0, 5.0)] * 3),
    unit=st.sampled_from([1.0, 0.01, 0.001]),
)
def test_place_and_unit_of_the_file_do_not_matter(tmp_path_factory, sides, shift, unit):
    folder = tmp_path_factory.mktemp("any")
    wedge = trimesh.convex.convex_hull(np.vstack((np.zeros(3), np.diag(sides), sides)))
    moved = trimesh.Trimesh((wedge.vertices + shift) / unit, wedge.faces, process=False)
    plain, other = (
        prepare(write(folder / "plain.obj", wedge)),
        prepare(write(folder / "moved.obj", moved), unit),
    )
    assert_sound(other)
    np.testing.assert_allclose(other.p_OOcm, plain.p_OOcm, atol=1e-9)
    np.testing.assert_allclose(other.I_OOcm_O, plain.I_OOcm_O, rtol=1e-6, atol=1e-10)
    np.testing.assert_allclose(other.half_extents, np.array(sides) / 2.0, rtol=1e-6)
    moments = np.linalg.eigvalsh(other.I_OOcm_O)
    assert moments[0] > 0.0 and moments[0] + moments[1] >= moments[2]


# Mending


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


def test_a_body_through_itself_counts_once(tmp_path):
    # A bent bar as one surface whose ends cross, like a pretzel.
    path = np.array([[0, 0, 0], [0.2, 0, 0], [0.2, 0.15, 0], [0.1, 0.15, 0], [0.1, -0.1, 0.0]])
    square = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * 0.01
    rings = []
    for i, point in enumerate(path):
        before = point - path[i - 1] if i else path[1] - path[0]
        after = path[i + 1] - point if i < len(path) - 1 else before
        side = sum(np.cross(d / np.linalg.norm(d), [0, 0, 1.0]) for d in (before, after))
        side = side / (1.0 if np.dot(before, after) == 0 else 2.0)
        rings.append(point + square[:, :1] * side + square[:, 1:] * [0, 0, 1.0])
    faces = [[0, 1, 2], [0, 2, 3]]
    for i in range(len(path) - 1):
        for j in range(4):
            a, b, c, d = 4 * i + j, 4 * i + (j + 1) % 4, 4 * i + 4 + j, 4 * i + 4 + (j + 1) % 4
            faces += [[a, d, b], [a, c, d]]
    end = 4 * (len(path) - 1)
    faces += [[end, end + 2, end + 1], [end, end + 3, end + 2]]
    bar = trimesh.Trimesh(np.vstack(rings), faces, process=False)
    model = prepare(write(tmp_path / "a.obj", bar))
    assert_sound(model)
    assert model.volume == pytest.approx(abs(bar.volume) - 0.02**3, rel=2e-3)
    assert any("which now counts once" in note for note in model.notes)


# Formats


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


# Refusals


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
    "nan": ("a.obj", nan_box(), "must be finite, got NaN or inf at"),
    "large": ("a.obj", box((6.0, 10.0, 4.0)), r"0\.01 m to 2 m, got 12\.33 m .* --units .*objects"),
    "small": ("a.obj", box((0.0006, 0.001, 0.0004)), "0.01 m to 2 m"),
    "sheet": ("a.obj", trimesh.Trimesh(np.diag([0.1] * 3), [[0, 1, 2]]), "got a flat sheet"),
    "thin": ("a.obj", box((0.1, 0.1, 0.0004)), "at least 0.5 mm thick, got 0.4 mm"),
    "speck": ("a.obj", tetrahedron(), r"at least 1e-09 m\^3, got 7.2e-10"),
    "bowl": ("a.obj", hemisphere(), "at most 25% of the surface, got 3[0-9]%"),
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
    assert row.status == "refused" and row.notes == (str(caught.value),) and row.volume is None


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


# Sources


@pytest.mark.parametrize(
    ("stem", "class_name"),
    [
        ("24_mug_final", "mug"),
        ("1_mug_small", "mug"),
        ("1_mug", "mug"),
        ("30_fruit_juicer_final", "fruit_juicer"),
        ("41_jar_and_lid_final", "jar_and_lid"),
        ("1_Coffeecup_final", "Coffeecup"),
        ("mug", "mug"),
        ("mug_final", "mug_final"),
        ("24", "24"),
        ("24_", "24_"),
        ("2 große Tasse", "2 große Tasse"),
        ("7_тарелка_a", "тарелка"),
    ],
)
def test_class_comes_from_the_name(tmp_path, stem, class_name):
    write(tmp_path / f"{stem}.obj", box())
    (source,) = find_meshes(tmp_path)
    assert (source.name, source.class_name, source.scale) == (stem, class_name, 1.0)
    assert prepare_object(source).name == stem


def test_sources_are_sorted_and_shallow(tmp_path):
    for name in ("b.OBJ", "a.stl", "c.Ply", ".hidden.obj", "notes.txt"):
        (tmp_path / name).write_text("x")
    (tmp_path / "deep.obj").mkdir()
    write(tmp_path / "deep.obj" / "d.obj", box())
    assert [source.name for source in find_meshes(tmp_path)] == ["a", "b", "c"]


def test_units_and_manifest_precedence(tmp_path):
    for name in ("1_mug_x", "2_cup_x", "é"):
        write(tmp_path / f"{name}.obj", box())
    assert {s.scale for s in find_meshes(tmp_path, units="mm")} == {0.001}
    (tmp_path / "objects.yaml").write_text(
        "units: cm\nobjects:\n  1_mug_x: {units: m, class: pot}\n"
    )
    found = {s.name: s for s in find_meshes(tmp_path, units="mm")}
    assert found["1_mug_x"].scale == 1.0 and found["1_mug_x"].class_name == "pot"
    assert found["2_cup_x"].scale == 0.01 and found["2_cup_x"].class_name == "cup"
    other = tmp_path / "other.yml"
    # The e with its accent as two characters, as some file systems spell it.
    other.write_text("objects: {é: {name: zebra}, 2_cup_x: {units: cm}}\n", encoding="utf-8")
    found = {s.name: s for s in find_meshes(tmp_path, units="mm", manifest=other)}
    assert set(found) == {"1_mug_x", "2_cup_x", "zebra"}
    assert found["zebra"].scale == 0.001 and found["2_cup_x"].scale == 0.01
    other.write_text("")
    assert len(find_meshes(tmp_path, manifest=other)) == 3


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("units: inch", r"units: .*'m', 'cm' or 'mm'.*got 'inch'"),
        ("unit: cm", r"unit: .*legal keys: units, objects"),
        ("objects: {a: {unit: cm}}", r"objects\.a\.unit: .*legal keys: units, class, name"),
        ("objects: {b: {units: cm}}", r"must be names of meshes in .*: a; got b"),
        ("objects: {a: {name: ''}}", "name must be printable"),
        ("objects: {a: {name: x/y}}", "without slashes"),
        ("- a", "the file: "),
        ("units: [", "readable YAML"),
    ],
)
def test_wrong_manifest_is_refused(tmp_path, text, message):
    write(tmp_path / "a.obj", box())
    (tmp_path / "objects.yaml").write_text(text)
    with pytest.raises(MeshError, match=message) as caught:
        find_meshes(tmp_path)
    assert "\n" not in str(caught.value)


def test_wrong_directories_are_refused(tmp_path):
    with pytest.raises(MeshError, match=r"at least one mesh \(\.obj"):
        find_meshes(tmp_path)
    with pytest.raises(MeshError, match="must be a directory of meshes"):
        find_meshes(tmp_path / "gone")
    for name in ("mug.obj", "mug.stl", "b.obj"):
        write(tmp_path / name, box())
    with pytest.raises(MeshError, match=r"unique, got 'mug' for mug\.obj, mug\.stl"):
        find_meshes(tmp_path)
    with pytest.raises(MeshError, match="--units must be one of m, cm, mm, got 'inch'"):
        find_meshes(tmp_path, units="inch")
    (tmp_path / "mug.stl").unlink()
    (tmp_path / "objects.yaml").write_text("objects: {mug: {name: b}}")
    with pytest.raises(MeshError, match=r"unique, got 'b' for b\.obj, mug\.obj"):
        find_meshes(tmp_path)
    with pytest.raises(MeshError, match=r"gone\.yaml: must be a readable YAML"):
        find_meshes(tmp_path, manifest=tmp_path / "gone.yaml")


def test_one_mesh_is_found_whatever_lies_beside_it(tmp_path):
    for name in ("1_mug_a.obj", "1_mug_a.stl", "b.obj"):
        write(tmp_path / name, box())
    (tmp_path / "objects.yaml").write_text("objects: {1_mug_a: {units: cm}, gone: {units: m}}")
    source = find_mesh(tmp_path / "1_mug_a.obj", units="mm")
    assert (source.name, source.class_name, source.scale) == ("1_mug_a", "mug", 0.01)
    assert find_mesh(tmp_path / "b.obj", units="mm").scale == 0.001
    (tmp_path / "a.txt").write_text("")
    for name, got in (("a.txt", "'.txt'"), ("gone.obj", "none")):
        with pytest.raises(MeshError, match=rf"{name}: must be a mesh file .*, got {got}"):
            find_mesh(tmp_path / name)
    with pytest.raises(MeshError, match="--units must be one of m, cm, mm, got 'inch'"):
        find_mesh(tmp_path / "b.obj", units="inch")


# Collision meshes


def test_decimation_keeps_the_solid(tmp_path):
    ring = trimesh.creation.torus(0.05, 0.02, major_sections=100, minor_sections=50)
    model = prepare(write(tmp_path / "ring.obj", ring), max_collision_faces=2000)
    assert_sound(model)
    assert len(model.visual_faces) == 10_000 and len(model.collision_faces) <= 2000
    assert 0.0 < model.collision_error < 5e-4
    assert model.collision.euler_number == 0
    assert model.collision.volume == pytest.approx(model.volume, rel=0.01)
    again = prepare(tmp_path / "ring.obj", max_collision_faces=2000)
    np.testing.assert_array_equal(again.collision_vertices, model.collision_vertices)


def test_decimation_falls_back(tmp_path, monkeypatch):
    ball = trimesh.creation.icosphere(4, radius=0.05)
    solid = Solid(vertices=np.array(ball.vertices), faces=np.array(ball.faces, dtype=np.int64))
    monkeypatch.setattr("drakegrasp.decimation._decimate_quadric", lambda *_: None)
    reduced, error = decimate(solid, 1000)
    assert is_solid_surface(reduced.faces) and len(reduced.faces) <= 1000 and 0.0 < error < 1e-3
    monkeypatch.setattr("drakegrasp.decimation._simplify_manifold", lambda *_: None)
    with pytest.raises(MeshError, match="at most 1000 faces"):
        decimate(solid, 1000)


# Keeping and handing on


def test_save_and_load_keep_every_bit(tmp_path):
    model = prepare(write(tmp_path / "é b.obj", open_box()))
    first, second = tmp_path / "x.object", tmp_path / "y.npz"
    save_object(model, first)
    save_object(model, second)
    assert first.read_bytes() == second.read_bytes()
    loaded = load_object(first)
    for key, value in vars(model).items():
        assert type(getattr(loaded, key)) is type(value)
        np.testing.assert_array_equal(getattr(loaded, key), value)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["x.object", "y.npz", "é b.obj"]
    first.write_bytes(first.read_bytes()[:200])
    with pytest.raises(MeshError, match=r"x\.object: must be an object file"):
        load_object(first)
    with pytest.raises(MeshError, match=r"gone: must be an object file"):
        load_object(tmp_path / "gone")


def test_model_is_read_only_and_knows_its_source(tmp_path):
    path = write(tmp_path / "a.obj", box())
    model = prepare(path)
    for array in (model.visual_vertices, model.collision_faces, model.p_OOcm, model.I_OOcm_O):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0
    assert model.visual_faces.dtype == np.int32 and model.visual_vertices.dtype == np.float64
    assert model.visual is model.visual
    digests = {model.mesh_sha256, prepare(path, 0.5).mesh_sha256, prepare(path).mesh_sha256}
    assert len(digests) == 2


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


def test_winding_numbers_of_a_box():
    cube = box()
    points = np.array([[0.0, 0.0, 0.0], [0.029, 0.049, 0.019], [0.031, 0.0, 0.0], [5.0, 5.0, 5.0]])
    w = winding_numbers(points, np.array(cube.vertices), np.array(cube.faces))
    np.testing.assert_allclose(w, [1.0, 1.0, 0.0, 0.0], atol=1e-9)


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


# Real files


@needs_g3db
def test_audit_tells_what_is_wrong(tmp_path):
    for name in ("3_book", "53_watertap", "110_bunny", "24_mug", "60_comb"):
        (tmp_path / f"{name}_final.obj").symlink_to(G3DB / f"{name}_final.obj")
    rows = {row.class_name: row for row in audit(tmp_path, units="cm")}
    assert {name: row.status for name, row in rows.items()} == {
        "book": "mended", "watertap": "mended", "bunny": "mended", "mug": "fit", "comb": "mended",
    }  # fmt: skip
    assert rows["bunny"].notes[0] == "the surface was inside out and was turned"
    assert rows["bunny"].volume == pytest.approx(427e-6, rel=0.01)
    assert "50 bodies" in rows["comb"].notes[0]
    # The book is a closed block: nearly as large as its hull.
    assert rows["book"].volume == pytest.approx(430e-6, rel=0.01)
    x, y, z = rows["mug"].extents
    assert (round(x, 3), round(y, 3), round(z, 3)) == (0.093, 0.093, 0.143)


@needs_g3db
def test_boots_are_in_metres(tmp_path):
    (source,) = (s for s in find_meshes(G3DB, units="cm") if "boots" in s.name)
    with pytest.raises(MeshError, match=r"95_boots_final\.obj: .*--units .*objects\.yaml"):
        prepare_object(source)
    manifest = tmp_path / "objects.yaml"
    manifest.write_text("units: cm\nobjects: {95_boots_final: {units: m}}\n")
    (source,) = (s for s in find_meshes(G3DB, manifest=manifest) if "boots" in s.name)
    assert_sound(prepare_object(source))


@needs_g3db
def test_toaster_is_mended_and_the_rest_is_told():
    # Its slots are dents deeper than its wall is thick: a part of the volume stays mixed up.
    (source,) = (s for s in find_meshes(G3DB, units="cm") if "toaster" in s.name)
    (note,) = (n for n in prepare_object(source).notes if "still passes through itself" in n)
    assert re.search(r"in 2\.\d% of its volume", note)


@needs_g3db
def test_surface_that_passes_through_itself_too_much_is_refused(monkeypatch):
    monkeypatch.setattr(drakegrasp.union, "MAX_OVERLAP", 0.02)
    (source,) = (s for s in find_meshes(G3DB, units="cm") if "toaster" in s.name)
    with pytest.raises(MeshError, match="must not pass through itself"):
        prepare_object(source)


def test_signed_volume_does_not_depend_on_the_place():
    cube = box(at=(100.0, -50.0, 7.0))
    volume = signed_volume(np.array(cube.vertices), np.array(cube.faces))
    assert volume == pytest.approx(np.prod(BOX), rel=1e-9)
