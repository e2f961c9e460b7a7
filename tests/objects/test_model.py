"""Models of objects: closed forms of their mass properties, what is saved, contacts; the audit."""

from __future__ import annotations

import json
import pickle
import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
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
    write,
)
from helpers.objects import box_model
from hypothesis import given, settings
from hypothesis import strategies as st

from drakegrasp.errors import MeshError
from drakegrasp.hand.settings import load_config
from drakegrasp.objects.audit import audit, guess_units
from drakegrasp.objects.model import fit_contacts, load_object, prepare_object, save_object
from drakegrasp.objects.sources import MeshSource, find_meshes


def test_box_has_the_closed_form(tmp_path):
    model = prepare(write(tmp_path / "a.obj", box(at=(1.0, 2.0, 3.0))), mass=0.7)
    assert_sound(model)
    assert model.mass == 0.7 and model.notes == () and model.collision_error == 0.0
    assert model.volume == pytest.approx(np.prod(BOX), rel=1e-9)
    np.testing.assert_allclose(model.p_OOcm, 0.0, atol=1e-12)
    np.testing.assert_allclose(model.I_OOcm_O, box_inertia(0.7, *BOX), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(model.half_extents, np.array(BOX) / 2.0, rtol=1e-9)


def test_a_used_object_is_the_same_in_another_process(tmp_path):
    """The R-tree of trimesh is empty once it was pickled, and contacts had no nearest face."""
    model = prepare(write(tmp_path / "a.obj", box()))
    points, normals = np.array([[BOX[0] / 2.0, 0.0, 0.0]]), np.array([[1.0, 0.0, 0.0]])
    fit = fit_contacts(model, points, normals)
    sent = pickle.loads(pickle.dumps(model))
    assert fit_contacts(sent, points, normals).distance == fit.distance == pytest.approx([0.0])
    np.testing.assert_array_equal(sent.collision_faces, model.collision_faces)


def test_cone_has_the_closed_form_about_its_centre_of_mass(tmp_path):
    cone = trimesh.creation.cone(radius=0.03, height=0.1, sections=128)
    model = prepare(write(tmp_path / "cone.obj", cone))
    np.testing.assert_allclose(model.p_OOcm, [0.0, 0.0, -0.025], atol=1e-6)
    # About that centre, and not about the middle of its height.
    side, axis = 3.0 / 80.0 * (4.0 * 0.03**2 + 0.1**2), 0.3 * 0.03**2
    np.testing.assert_allclose(model.I_OOcm_O, np.diag([side, side, axis]), rtol=2e-3, atol=1e-9)


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


def source(path, **said) -> MeshSource:
    return MeshSource(name="a", class_name="thing", path=path, **said)


def test_mass_density_and_friction_of_the_mesh_win(tmp_path):
    path, volume = write(tmp_path / "a.obj", box()), np.prod(BOX)
    plain = prepare_object(source(path))
    assert (plain.mass, plain.friction, plain.up, plain.scale) == (1.0, None, "+z", 1.0)
    for model, mass in (
        (prepare_object(source(path, mass=0.3)), 0.3),
        (prepare_object(source(path, density=700.0)), 700.0 * volume),
    ):
        assert model.mass == pytest.approx(mass)
        assert model.density == pytest.approx(mass / volume)
        np.testing.assert_allclose(model.I_OOcm_O, mass * plain.I_OOcm_O, rtol=1e-9, atol=1e-12)
    rough, physics = prepare_object(source(path, friction=1.2)), load_config().physics
    own = rough.own_physics(physics)
    assert own == physics.model_copy(update={"friction_hand": 1.2, "friction_table": 1.2})
    assert plain.own_physics(physics) is physics
    save_object(rough, tmp_path / "rough.npz")
    assert load_object(tmp_path / "rough.npz").friction == 1.2


@pytest.mark.parametrize("up", ["+x", "-x", "+y", "-y", "+z", "-z"])
def test_axis_that_points_up_becomes_z(tmp_path, up):
    """A wedge, so that no rotation and no mirror image of it is like it."""
    corners = np.array([[0, 0, 0], [0.02, 0, 0], [0, 0.03, 0], [0, 0, 0.05], [0.02, 0.03, 0]])
    wedge = trimesh.convex.convex_hull(corners)
    model = prepare_object(source(write(tmp_path / "a.obj", wedge), up=up))
    axis = np.eye(3)["xyz".index(up[1])] * (1.0 if up[0] == "+" else -1.0)
    heights = np.sort(wedge.vertices @ axis)
    np.testing.assert_allclose(
        np.sort(model.visual_vertices[:, 2]), heights - heights[[0, -1]].mean(), atol=1e-12
    )
    assert model.volume == pytest.approx(wedge.volume)  # a mirror image is inside out
    assert model.notes == ()


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


def tilted(angle_deg: float) -> list[float]:
    """Return the normal +x turned towards +z."""
    angle = np.deg2rad(angle_deg)
    return [np.cos(angle), 0.0, np.sin(angle)]


def test_distance_and_angle_are_those_from_the_nearest_face(tmp_path: Path) -> None:
    model = box_model(tmp_path, [0.06, 0.05, 0.10])
    points = np.array([[0.031, 0.0, 0.01], [0.0295, 0.01, 0.0], [0.0, 0.025, 0.0]])
    normals = np.array([tilted(20.0), tilted(-40.0), [0.0, -1.0, 0.0]])
    fit = fit_contacts(model, points, normals)
    np.testing.assert_allclose(fit.distance, [1e-3, 5e-4, 0.0], atol=1e-8)
    np.testing.assert_allclose(np.degrees(fit.normal_angle), [20.0, 40.0, 180.0], atol=1e-6)


def test_on_a_thin_wall_the_own_side_counts_though_the_other_is_nearer(tmp_path: Path) -> None:
    """A wall of 1 mm; the contact belongs to its +x side, however deep it lies in it."""
    model = box_model(tmp_path, [0.001, 0.05, 0.10])
    points = np.array([[0.0004, 0.0, 0.0], [-0.0004, 0.0, 0.0]])
    fit = fit_contacts(model, points, np.array([tilted(10.0)] * 2))
    np.testing.assert_allclose(np.degrees(fit.normal_angle), 10.0, atol=1e-6)


def test_what_does_not_touch_or_has_no_direction(tmp_path: Path) -> None:
    """A fingertip that does not touch has neither; a normal that is NaN agrees with no face."""
    model, missing = box_model(tmp_path, [0.06, 0.05, 0.10]), [np.nan] * 3
    points = np.array([missing, [0.031, 0.0, 0.0], [0.03, 0.0, 0.0]])
    normals = np.array([missing, [1.0, 0.0, 0.0], missing])
    fit = fit_contacts(model, points, normals)
    np.testing.assert_allclose(fit.distance, [np.nan, 1e-3, 0.0], atol=1e-8)
    np.testing.assert_allclose(fit.normal_angle, [np.nan, 0.0, np.pi], atol=1e-6)
    nothing = fit_contacts(model, points[:1], normals[:1])
    assert np.isnan([nothing.distance, nothing.normal_angle]).all()


def test_row_tells_what_is_measured(tmp_path):
    """A cup of 3 mm walls whose faces run against each other: closed forms, and what is mended."""
    outer, inner = box((0.06, 0.06, 0.08)), flipped(box((0.054, 0.054, 0.074)))
    write(tmp_path / "1_cup.obj", outer, inner)
    write(tmp_path / "2_lid.obj", open_box())
    write(tmp_path / "3_far.obj", trimesh.Trimesh(100.0 * box().vertices, box().faces))
    (tmp_path / "objects.yaml").write_text("objects: {1_cup: {density: 1000}}")
    cup, lid, far = audit(tmp_path)

    assert (cup.status, cup.faces, cup.bodies, cup.watertight) == ("repaired", 24, 2, True)
    assert cup.volume == pytest.approx(0.06**2 * 0.08 - 0.054**2 * 0.074)
    assert cup.volume_change == pytest.approx(0.0, abs=1e-12)
    assert cup.mass == pytest.approx(1000.0 * cup.volume)
    assert cup.warnings == ()
    assert cup.collision_error == 0.0

    assert (lid.status, lid.watertight, lid.bodies) == ("repaired", False, 1)
    assert lid.volume_change is not None and lid.volume_change > 0.0
    assert far.status == "refused" and far.units_guess == "cm"
    assert far.warnings == ("its lengths may be in cm",) and far.volume is None

    # As JSON, without the model.
    assert cup.model is not None and "model" not in cup.to_json()
    assert json.loads(json.dumps(far.to_json()))["units_guess"] == "cm"


def test_size_is_the_solids_not_the_files(tmp_path):
    """A box, and a triangle 0.8 m away, which repair removes."""
    stray = trimesh.Trimesh([[0.8, 0, 0], [0.81, 0, 0], [0.8, 0.01, 0]], [[0, 1, 2]], process=False)
    write(tmp_path / "1_box.obj", box((0.06, 0.05, 0.10)), stray)
    (row,) = audit(tmp_path)
    assert row.status == "repaired" and row.faces == 13
    assert row.extents == pytest.approx((0.06, 0.05, 0.10))
    assert row.units_guess is None


@pytest.mark.parametrize(
    ("said", "warning"),
    [
        ("{}", ["1 kg make 31,250 kg/m^3: give its mass or density"]),
        ("{mass: 0.0001}", ["0.0001 kg make 3 kg/m^3: give its mass or density"]),
        ("{mass: 0.02}", []),
    ],
)
def test_mass_that_nothing_has_is_told(tmp_path, said, warning):
    write(tmp_path / "a.obj", box((0.04, 0.04, 0.02)))
    (tmp_path / "objects.yaml").write_text(f"objects: {{a: {said}}}")
    (row,) = audit(tmp_path)
    assert list(row.warnings) == warning


@pytest.mark.parametrize(
    ("size", "scale", "guess"),
    [(0.1, 1.0, None), (10.0, 1.0, "cm"), (100.0, 1.0, "mm"), (1e-3, 0.01, "m"), (1e7, 1.0, None)],
)
def test_unit_is_guessed_where_the_given_one_is_unlikely(size, scale, guess):
    assert guess_units(size, scale) == guess


@needs_g3db
def test_toaster_that_passes_through_itself_is_noted():
    # Its slots are dents deeper than its wall is thick: a part of the volume stays mixed up.
    (source,) = (s for s in find_meshes(G3DB, units="cm") if "toaster" in s.name)
    (note,) = (n for n in prepare_object(source).notes if "passes through itself" in n)
    assert re.search(r"in 3\.\d% of its volume", note)
