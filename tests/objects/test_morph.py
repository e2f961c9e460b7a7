"""Morphs: the formula, what stays as it was, and the directory of files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers.meshes import box, write

from drakegrasp.errors import MeshError
from drakegrasp.mesh.crossings import crossing_faces
from drakegrasp.objects import morph as morph_module
from drakegrasp.objects.model import prepare_object
from drakegrasp.objects.morph import (
    draw_morph,
    load_original,
    morph_meshes,
    morph_object,
    morph_points,
)
from drakegrasp.objects.sources import find_meshes
from drakegrasp.seeding import Stream


def stool(folder: Path, name: str = "3_stool_a") -> Path:
    """Write a block that stands on z = 0 and is wider below than above."""
    block = trimesh.util.concatenate([box((0.06, 0.06, 0.04), (0.0, 0.0, 0.02))])
    block.vertices[block.vertices[:, 2] > 0.03, :2] *= 0.6
    return write(folder / f"{name}.obj", block)


def test_formula_is_the_databases() -> None:
    points = np.array([[0.0, 0.0, 0.0], [0.03, 0.0, 0.0], [-0.03, 0.0, 0.0], [0.015, 0.0, 0.1]])
    found = morph_points(points, 2, (1.1, 0.2, -0.1, 0.9, 0.25))
    assert found is not None
    # p is 0 at the base and 1 at the top; r / r_max there is one half.
    np.testing.assert_allclose(found[1], [0.033, 0.0, 0.0], atol=1e-15)
    np.testing.assert_allclose(found[3], [0.015 * 1.2, 0.0, 0.1 * (0.9 + 0.25 / 4.0)], atol=1e-15)


def test_radius_shrinks_to_a_quarter_at_most_and_space_keeps_its_sides() -> None:
    points = np.array([[0.03, 0.0, 0.0], [-0.03, 0.0, 0.0], [0.03, 0.0, 0.1]])
    found = morph_points(points, 2, (0.3, -0.2, -0.2, 1.0, 0.0))
    assert found is not None
    np.testing.assert_allclose(found[:, 0], [0.009, -0.009, 0.0075])
    # One that turns space inside out is not used.
    assert morph_points(points, 2, (0.75, -0.25, -0.25, 0.75, -0.25)) is not None
    assert morph_points(points, 2, (0.3, 1.0, 1.0, 0.2, 0.25)) is None


def test_draws_are_within_the_databases_bounds() -> None:
    stream = Stream(0)
    drawn = [draw_morph(stream) for _ in range(500)]
    c = np.array([c for _, c in drawn])
    assert {axis for axis, _ in drawn} == {0, 1, 2}
    for column, (low, high) in zip(
        c.T, [(0.75, 1.5), (-0.25, 0.25), (-0.25, 0.25), (0.75, 1.5), (-0.25, 0.25)], strict=True
    ):
        assert low <= column.min() < low + 0.02 and high - 0.02 < column.max() < high


def test_morphs_stand_where_the_original_stands_and_are_sound(tmp_path: Path) -> None:
    original = load_original(*find_meshes(stool(tmp_path).parent))
    for number in range(1, 13):
        vertices, _ = morph_object(original, "stool", number, seed=3)
        surface = trimesh.Trimesh(vertices, original.faces, process=False)
        assert surface.is_watertight and surface.volume > 0.0
        assert len(crossing_faces(vertices, original.faces)) == 0
        # The base is flat, at z = 0.
        base = original.vertices[:, 2] == 0.0
        assert (vertices[base, 2] == 0.0).all() and (vertices[:, 2] >= 0.0).all()


def test_draw_that_crosses_itself_is_drawn_again_and_not_for_ever(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    original = load_original(*find_meshes(stool(tmp_path).parent))
    answers = [[4], [], [4]]
    monkeypatch.setattr(morph_module, "crossing_faces", lambda *_: np.array(answers[0]))
    with pytest.raises(MeshError, match="stool: one of 20 draws must give a morph that does not"):
        morph_object(original, "stool", 1, seed=0)
    monkeypatch.setattr(morph_module, "crossing_faces", lambda *_: np.array(answers.pop(0)))
    assert morph_object(original, "stool", 1, seed=0)[1] == 2


def test_draw_that_turns_space_inside_out_is_drawn_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    original = load_original(*find_meshes(stool(tmp_path).parent))
    answers = [None, original.vertices]
    monkeypatch.setattr(morph_module, "morph_points", lambda *_: answers.pop(0))
    vertices, draws = morph_object(original, "stool", 1, seed=0)
    assert draws == 2
    np.testing.assert_allclose(vertices, original.vertices, atol=1e-6)


def test_directory_has_every_morph_with_its_class_and_the_same_bytes(tmp_path: Path) -> None:
    meshes = tmp_path / "meshes"
    meshes.mkdir()
    for name in ("3_stool_a", "4_cup"):
        stool(meshes, name)
    (meshes / "objects.yaml").write_text("objects: {4_cup: {density: 600, class: pot, name: c}}")
    report = morph_meshes(meshes, tmp_path / "out", per_mesh=3, seed=5)
    assert (report.morphs, report.refused, report.crossing) == (6, (), {})
    assert 0 < report.first_draws <= 6
    found = find_meshes(tmp_path / "out", units="mm")
    assert [s.name for s in found] == [
        *(f"pot_c_m{k}" for k in (1, 2, 3)),
        *(f"stool_3_stool_a_m{k}" for k in (1, 2, 3)),
    ]
    assert [(s.class_name, s.density, s.scale) for s in found[2:4]] == [
        ("pot", 600.0, 1.0),
        ("stool", None, 1.0),
    ]
    assert [s.group for s in found] == ["c"] * 3 + ["3_stool_a"] * 3
    assert prepare_object(found[0]).density == pytest.approx(600.0)
    assert len({s.path.read_bytes() for s in found}) == 6

    # The same seed gives the same files, another seed others.
    for folder, seed, same in (("again", 5, True), ("other", 6, False)):
        morph_meshes(meshes, tmp_path / folder, per_mesh=3, seed=seed)
        pairs = [(p, tmp_path / folder / p.name) for p in (tmp_path / "out").glob("*.obj")]
        assert all((a.read_bytes() == b.read_bytes()) is same for a, b in pairs)


def test_axis_and_unit_of_the_file_are_resolved(tmp_path: Path) -> None:
    plain, turned = tmp_path / "plain", tmp_path / "turned"
    for folder in (plain, turned):
        folder.mkdir()
        stool(folder)
    path = turned / "3_stool_a.obj"
    mesh = trimesh.load(path, process=False)
    x, y, z = 1e3 * mesh.vertices.T
    write(path, trimesh.Trimesh(np.column_stack((x, z, -y)), mesh.faces, process=False))
    (turned / "objects.yaml").write_text("units: mm\nobjects: {3_stool_a: {up: +y}}")
    for folder in (plain, turned):
        morph_meshes(folder, tmp_path / f"{folder.name}_out", per_mesh=1)
    a, b = (
        trimesh.load(tmp_path / f"{name}_out" / "stool_3_stool_a_m1.obj", process=False)
        for name in ("plain", "turned")
    )
    np.testing.assert_allclose(a.bounds, b.bounds, atol=2e-7)


def test_morphs_of_two_meshes_that_would_have_one_name_are_told(tmp_path: Path) -> None:
    """`b_c` of class `a`, and `c` of class `a_b`; the first keeps its morphs. A sheet has none."""
    meshes = tmp_path / "meshes"
    meshes.mkdir()
    for name in ("b_c", "c"):
        stool(meshes, name)
    write(meshes / "9_sheet.obj", trimesh.Trimesh(np.eye(3) * 0.05, [[0, 1, 2]], process=False))
    (meshes / "objects.yaml").write_text("objects: {b_c: {class: a}, c: {class: a_b}}")
    report = morph_meshes(meshes, tmp_path / "out", per_mesh=2)
    assert report.morphs == len(list((tmp_path / "out").glob("*.obj"))) == 2
    sheet, twin = report.refused
    assert sheet.startswith("9_sheet.obj: ")
    assert twin == (
        "c of class a_b: its morphs must have names of their own, got a_b_c_m1, which another mesh "
        "has; rename it"
    )


def test_nothing_appears_unless_all_of_it_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "meshes").mkdir()
    stool(tmp_path / "meshes")
    full = tmp_path / "full"
    full.mkdir()
    (full / "notes.txt").write_text("mine")
    with pytest.raises(MeshError, match="full: must be new or an empty directory, got one that"):
        morph_meshes(tmp_path / "meshes", full, per_mesh=1)
    assert [p.name for p in full.iterdir()] == ["notes.txt"]

    def fail(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("drakegrasp.objects.morph.yaml.safe_dump", fail)
    with pytest.raises(KeyboardInterrupt):
        morph_meshes(tmp_path / "meshes", tmp_path / "out", per_mesh=1)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["full", "meshes"]
