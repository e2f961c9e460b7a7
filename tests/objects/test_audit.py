"""The audit of a directory of meshes."""

from __future__ import annotations

import json
import re

import pytest
import trimesh
from helpers.meshes import G3DB, box, flipped, needs_g3db, open_box, write

from drakegrasp.objects.audit import audit, guess_units
from drakegrasp.objects.model import prepare_object
from drakegrasp.objects.sources import find_meshes


@needs_g3db
def test_audit_tells_what_is_wrong(tmp_path):
    for name in ("3_book", "53_watertap", "110_bunny", "24_mug", "60_comb"):
        (tmp_path / f"{name}_final.obj").symlink_to(G3DB / f"{name}_final.obj")
    rows = {row.class_name: row for row in audit(tmp_path, units="cm")}
    assert {name: row.status for name, row in rows.items()} == {
        "book": "repaired",
        "watertap": "repaired",
        "bunny": "repaired",
        "mug": "fit",
        "comb": "repaired",
    }
    assert rows["bunny"].notes[0] == "the surface was inside out and was turned"
    assert rows["bunny"].volume == pytest.approx(427e-6, rel=0.01)
    assert "50 bodies" in rows["comb"].notes[0]
    # The book is a closed block: nearly as large as its hull.
    assert rows["book"].volume == pytest.approx(430e-6, rel=0.01)
    x, y, z = rows["mug"].extents
    assert (round(x, 3), round(y, 3), round(z, 3)) == (0.093, 0.093, 0.143)


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
