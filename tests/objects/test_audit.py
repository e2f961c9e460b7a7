"""The audit of a directory of meshes."""

from __future__ import annotations

import re

import pytest
from helpers.meshes import G3DB, needs_g3db

from drakegrasp.objects.audit import audit
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


@needs_g3db
def test_toaster_is_repaired_and_the_rest_is_noted():
    # Its slots are dents deeper than its wall is thick: a part of the volume stays mixed up.
    (source,) = (s for s in find_meshes(G3DB, units="cm") if "toaster" in s.name)
    (note,) = (n for n in prepare_object(source).notes if "still passes through itself" in n)
    assert re.search(r"in 2\.\d% of its volume", note)
