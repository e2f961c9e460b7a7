"""Directories of meshes: names, classes, units, `objects.yaml`."""

from __future__ import annotations

import pytest
from helpers.meshes import box, write
from helpers.tables import table

from drakegrasp.errors import MeshError
from drakegrasp.objects.model import prepare_object
from drakegrasp.objects.sources import find_mesh, find_meshes, source_sha256


@pytest.mark.parametrize(
    ("stem", "class_name"),
    [
        ("24_mug_final", "mug"),
        ("1_mug_small", "mug"),
        ("30_fruit_juicer_final", "fruit_juicer"),
        ("41_jar_and_lid_final", "jar_and_lid"),
        ("mug_final", "mug_final"),
        ("24_", "24_"),
        ("7_тарелка_a", "тарелка"),
    ],
)
def test_class_comes_from_the_name(tmp_path, stem, class_name):
    write(tmp_path / f"{stem}.OBJ", box())
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


def test_what_triangles_do_not_say_is_in_the_manifest_and_in_the_digest(tmp_path):
    write(tmp_path / "a.obj", box())
    said, digests = "units: cm", {source_sha256(find_meshes(tmp_path, units="cm")[0])}
    named, *others = "name: b, class: c, group: d", "scale: 2", "up: +y", "mass: 2"
    for text in (named, *others, "density: 2", "friction: 2"):
        (tmp_path / "objects.yaml").write_text(f"{said}\nobjects: {{a: {{{text}}}}}\n")
        (source,) = find_meshes(tmp_path)
        digests.add(source_sha256(source))
    assert len(digests) == 6  # name, class and group change nothing
    (tmp_path / "objects.yaml").write_text(
        "units: cm\nobjects: {a: {scale: 2, up: -x, density: 700, friction: 0.4}}\n"
    )
    (source,) = find_meshes(tmp_path)
    assert (source.scale, source.up) == (0.02, "-x")
    assert (source.mass, source.density, source.friction) == (None, 700.0, 0.4)


@pytest.mark.parametrize(("text", "message"), table("objects"))
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
    with pytest.raises(MeshError, match="units must be one of m, cm, mm, got 'inch'"):
        find_meshes(tmp_path, units="inch")
    (tmp_path / "mug.stl").unlink()
    (tmp_path / "objects.yaml").write_text("objects: {mug: {name: b}}")
    with pytest.raises(MeshError, match=r"unique, got 'b' for b\.obj, mug\.obj"):
        find_meshes(tmp_path)
    with pytest.raises(MeshError, match=r"gone\.yaml: must be a readable YAML"):
        find_meshes(tmp_path, manifest=tmp_path / "gone.yaml")


def test_licences_are_stated_for_the_set_and_for_a_mesh(tmp_path):
    for name in "ab":
        write(tmp_path / f"{name}.obj", box())
    unsaid = find_meshes(tmp_path)
    (tmp_path / "objects.yaml").write_text(
        "licence: CC-BY-4.0\nobjects: {b: {licence: LicenseRef-of-the-lab}}\n"
    )
    said = find_meshes(tmp_path)
    assert [source.licence for source in unsaid] == [None, None]
    assert [source.licence for source in said] == ["CC-BY-4.0", "LicenseRef-of-the-lab"]
    # No licence changes what is simulated.
    assert [*map(source_sha256, said)] == [*map(source_sha256, unsaid)]


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
    with pytest.raises(MeshError, match="units must be one of m, cm, mm, got 'inch'"):
        find_mesh(tmp_path / "b.obj", units="inch")
