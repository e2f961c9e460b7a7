"""The built-in objects: sound meshes, truths in closed form, and the same bytes every time."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull

from drakegrasp.errors import MeshError
from drakegrasp.objects.builtin import hollow_shapes, revolved_shapes, solid_shapes
from drakegrasp.objects.builtin.catalog import (
    BUILTIN_OBJECTS,
    BuiltinObject,
    builtin_object,
    export_builtin,
)

NAMES = [item.name for item in BUILTIN_OBJECTS]

#: What lies lower than this bears on the table [m].
CONTACT_HEIGHT = 0.001

#: An object that stands must survive this tilt before its mass leaves its base [rad].
TILT = np.deg2rad(10.0)


@pytest.fixture(params=BUILTIN_OBJECTS, ids=lambda item: item.name)
def item(request: pytest.FixtureRequest) -> BuiltinObject:
    return request.param


def test_mesh_is_one_outward_solid(item: BuiltinObject) -> None:
    mesh = item.build()
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume > 0.0
    assert mesh.body_count == 1
    assert 200 <= len(mesh.faces) <= 3000


def test_mesh_has_sound_triangles(item: BuiltinObject) -> None:
    mesh = item.build()
    assert mesh.edges_unique_length.min() > 0.0005
    longest = np.linalg.norm(mesh.triangles - np.roll(mesh.triangles, 1, axis=1), axis=2).max(1)
    assert (longest**2 / (2.0 * mesh.area_faces)).max() < 40.0
    assert np.median(mesh.edges_unique_length) < 0.013


def test_size_suits_the_hand(item: BuiltinObject) -> None:
    mesh = item.build()
    assert mesh.extents.min() >= 0.02
    assert mesh.extents.max() <= 0.35
    # Some width across must fit between open fingers.
    assert mesh.extents[:2].min() <= 0.15


def test_object_stands_on_the_table(item: BuiltinObject) -> None:
    mesh = item.build()
    assert mesh.bounds[0, 2] == pytest.approx(0.0, abs=1e-6)
    base = mesh.vertices[mesh.vertices[:, 2] < CONTACT_HEIGHT, :2]
    # Each row is an outward unit normal and an offset: negative values are inside.
    sides = ConvexHull(base).equations
    margin = -(sides[:, :2] @ mesh.center_mass[:2] + sides[:, 2]).max()
    assert np.arctan2(margin, mesh.center_mass[2]) > TILT


def test_surface_does_not_cross_itself(item: BuiltinObject) -> None:
    # A point just below any face is inside, just above it outside.
    mesh = item.build()
    centres, normals = mesh.triangles_center, mesh.face_normals
    large = mesh.area_faces > 1e-6
    assert mesh.contains((centres - 1e-4 * normals)[large]).all()
    assert not mesh.contains((centres + 1e-4 * normals)[large]).any()


def test_names_are_unique_and_numbered_in_order() -> None:
    assert len(set(NAMES)) == len(NAMES)
    assert [item.number for item in BUILTIN_OBJECTS] == list(range(1, len(NAMES) + 1))
    assert NAMES[0] == "1_mug_small"


def test_every_class_has_variants_for_a_split() -> None:
    counts = Counter(item.class_name for item in BUILTIN_OBJECTS)
    assert len(counts) >= 14
    assert min(counts.values()) >= 2


def test_box_volume_is_exact() -> None:
    mesh = solid_shapes.box(width=0.1, depth=0.07, height=0.06)
    assert mesh.volume == pytest.approx(0.1 * 0.07 * 0.06, rel=1e-6)
    np.testing.assert_allclose(mesh.bounds, [[-0.05, -0.035, 0.0], [0.05, 0.035, 0.06]], atol=1e-7)


def test_can_volume_is_that_of_a_cylinder() -> None:
    mesh = revolved_shapes.can(radius=0.033, height=0.12)
    assert mesh.volume == pytest.approx(np.pi * 0.033**2 * 0.12, rel=0.02)


def test_mug_is_a_shell_with_a_handle() -> None:
    radius, height, wall, floor = 0.044, 0.1, 0.005, 0.007
    mesh = hollow_shapes.mug(
        radius=radius, height=height, handle_reach=0.034, handle_radius=0.006, wall=wall
    )
    shell = np.pi * (radius**2 * height - (radius - wall) ** 2 * (height - floor))
    # The handle: an ellipse of 0.006 x 0.0078 along half an ellipse from wall to wall.
    a, b = 0.034 - 0.006, 0.32 * height
    handle = np.pi * 0.006 * 0.0078 * np.pi * np.sqrt((a**2 + b**2) / 2.0)
    assert mesh.volume == pytest.approx(shell + handle, rel=0.05)
    assert mesh.extents == pytest.approx([2 * radius + 0.034, 2 * radius, height], abs=5e-4)
    assert mesh.euler_number == 0


@pytest.mark.parametrize(
    "class_name", ["mug", "cup", "bowl", "vase", "wineglass", "pitcher", "saucepan"]
)
def test_vessel_is_hollow_and_thick_enough(class_name: str) -> None:
    for item in BUILTIN_OBJECTS:
        if item.class_name != class_name:
            continue
        mesh = item.build()
        height = mesh.bounds[1, 2]
        axis = np.array([[0.0, 0.0, 0.75 * height], [0.0, 0.0, 0.97 * height]])
        assert not mesh.contains(axis).any()
        assert mesh.contains([[0.0, 0.0, 0.003]]).all()
        # Along +y, away from handle and lip, a ray goes once in and once out of the wall.
        at = np.array([[0.0, 0.0, 0.75 * height]])
        hits, _, _ = mesh.ray.intersects_location(at, [[0.0013, 1.0, 0.0]])
        inner, outer = np.sort(hits[:, 1])
        assert outer - inner > 0.0038


def test_funnel_is_open_at_both_ends() -> None:
    mesh = builtin_object("27_funnel_small").build()
    axis = np.column_stack([np.zeros((20, 2)), np.linspace(-0.01, 0.2, 20)])
    assert not mesh.contains(axis).any()
    assert mesh.euler_number == 0


def test_build_gives_the_same_mesh_twice(item: BuiltinObject) -> None:
    one, two = item.build(), item.build()
    np.testing.assert_array_equal(one.vertices, two.vertices)
    np.testing.assert_array_equal(one.faces, two.faces)


def test_export_round_trip(tmp_path: Path) -> None:
    paths = export_builtin(tmp_path / "new" / "meshes")
    assert [path.name for path in paths] == [f"{name}.obj" for name in NAMES]
    assert sorted(p.name for p in (tmp_path / "new" / "meshes").iterdir()) == sorted(
        path.name for path in paths
    )
    for path, item in zip(paths, BUILTIN_OBJECTS, strict=True):
        loaded, built = trimesh.load_mesh(path, process=False), item.build()
        np.testing.assert_allclose(loaded.vertices, built.vertices, atol=1e-12)
        np.testing.assert_array_equal(loaded.faces, built.faces)


def test_another_process_writes_the_same_bytes(tmp_path: Path) -> None:
    here = export_builtin(tmp_path / "here")
    script = (
        "import sys; from drakegrasp.objects.builtin.catalog import export_builtin; "
        "export_builtin(sys.argv[1])"
    )
    subprocess.run([sys.executable, "-c", script, str(tmp_path / "there")], check=True, timeout=120)
    for path in here:
        other = tmp_path / "there" / path.name
        assert hashlib.sha256(path.read_bytes()).digest() == (
            hashlib.sha256(other.read_bytes()).digest()
        )


def test_export_writes_only_what_is_asked_for(tmp_path: Path) -> None:
    paths = export_builtin(tmp_path, ["11_can_short", "1_mug_small"])
    assert paths == [tmp_path / "11_can_short.obj", tmp_path / "1_mug_small.obj"]
    assert len(list(tmp_path.iterdir())) == 2


def test_unknown_name_is_refused_with_the_names_there_are(tmp_path: Path) -> None:
    with pytest.raises(MeshError, match=r"must be one of 1_mug_small, .*; got '9_spoon'"):
        builtin_object("9_spoon")
    with pytest.raises(MeshError, match="9_spoon"):
        export_builtin(tmp_path / "out", ["1_mug_small", "9_spoon"])
    assert not (tmp_path / "out").exists()
