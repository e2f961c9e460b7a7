"""The built-in objects: sound meshes whatever is drawn, truths in closed form, the same bytes."""

from __future__ import annotations

import json
from collections import Counter
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers import tiers
from scipy.spatial import ConvexHull

from drakegrasp.config import BuiltinConfig
from drakegrasp.errors import MeshError
from drakegrasp.mesh.surfaces import overlap_share
from drakegrasp.seeding import Stream
from drakegrasp.shapes.catalog import (
    CLASSES,
    BuiltinObject,
    ObjectClass,
    Range,
    builtin_object,
    builtin_sources,
    deg,
    draw_builtin,
    export_builtin,
    mm,
    pieces,
)

#: Volume [cm^3] and area [cm^2] of the smallest and the largest object of each class.
SIZES = json.loads((Path(tiers.__file__).parent / "shapes.json").read_text(encoding="utf-8"))

#: What lies lower than this bears on the table [m].
CONTACT_HEIGHT = 0.001

#: An object that stands must survive this tilt before its mass leaves its base [rad].
TILT = np.deg2rad(10.0)

#: Classes with round, flat and cut surfaces, few enough to build them again and again.
SOME = ["1_mug_1", "23_toaster_2", "31_comb_1", "36_snake_1", "52_house_1", "58_dice_1"]


def value(span: Range, end: str) -> float | int:
    """Return an end of a range in metres or radians."""
    number = getattr(span, end)
    return {"mm": number * 1e-3, "deg": np.deg2rad(number), "-": int(number)}[span.unit]


@cache
def build(object_class: ObjectClass, which: str) -> trimesh.Trimesh:
    """Return the mesh of all lower ends, or of all upper ends."""
    spans = object_class.parameters.items()
    return object_class.shape(**{name: value(span, which) for name, span in spans})


@pytest.fixture(params=tiers.few(["low", "high"], 1))
def which(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.mark.parametrize("object_class", CLASSES, ids=lambda item: item.name)
def test_mesh_is_a_sound_object_for_the_hand(object_class: ObjectClass, which: str) -> None:
    """The objects that are drawn are between these; `test_equal_draws` has their hash."""
    mesh = build(object_class, which)
    sizes = [1e6 * mesh.volume, 1e4 * mesh.area]
    assert sizes == pytest.approx(SIZES[f"{object_class.name} {which}"], rel=1e-4)

    # One outward solid, whose surface does not cross itself.
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume > 0.0
    assert mesh.body_count == 1
    # More than 3000 faces would be decimated before they are simulated.
    assert 200 <= len(mesh.faces) <= 3000
    assert overlap_share(np.asarray(mesh.vertices), np.asarray(mesh.faces), points=200) == 0.0

    # Few thin triangles, and none that is large.
    longest = np.linalg.norm(mesh.triangles - np.roll(mesh.triangles, 1, axis=1), axis=2).max(1)
    thin = longest**2 / (2.0 * mesh.area_faces) > 40.0
    assert mesh.area_faces[thin].sum() < 0.01 * mesh.area
    assert np.median(mesh.edges_unique_length) < 0.016

    # Some width across must fit between open fingers.
    assert mesh.extents.min() >= 0.02
    assert mesh.extents.max() <= 0.35
    assert mesh.extents[:2].min() <= 0.15

    # It stands on the table.
    assert mesh.bounds[0, 2] == pytest.approx(0.0, abs=1e-6)
    base = mesh.vertices[mesh.vertices[:, 2] < CONTACT_HEIGHT, :2]
    # Each row is an outward unit normal and an offset: negative values are inside.
    sides = ConvexHull(base).equations
    margin = -(sides[:, :2] @ mesh.center_mass[:2] + sides[:, 2]).max()
    assert np.arctan2(margin, mesh.center_mass[2]) > TILT


def test_draws_fill_their_range_in_whole_steps() -> None:
    stream = Stream(0)
    lengths = np.array([mm(4.5, 6).draw(stream) for _ in range(500)])
    assert np.array_equal(np.unique(lengths), np.arange(45, 61) / 1e4)
    angles = {deg(90, 90.2).draw(stream) for _ in range(100)}
    assert sorted(angles) == pytest.approx(np.deg2rad([90.0, 90.1, 90.2]), rel=1e-15)
    assert {pieces(8, 11).draw(stream) for _ in range(100)} == {8, 9, 10, 11}
    spans = [mm(4.5, 6), deg(90, 100), pieces(8, 11)]
    assert [str(span) for span in spans] == ["4.5 to 6 mm", "90 to 100 deg", "8 to 11"]


def test_as_many_of_each_class_as_asked_for() -> None:
    assert [item.number for item in CLASSES] == list(range(1, 65))
    drawn = draw_builtin(BuiltinConfig(per_class=3, seed=5))
    counts = Counter(item.object_class.name for item in drawn)
    assert set(counts.values()) == {3} and len(counts) == 64
    assert [item.name for item in drawn[:4]] == ["1_mug_1", "1_mug_2", "1_mug_3", "2_bottle_1"]
    assert {item.seed for item in drawn} == {5}
    assert drawn[0].sizes != drawn[1].sizes


def test_seam_that_rounding_opens_is_closed() -> None:
    mesh = builtin_object("25_watertap_1", seed=2).build()
    assert mesh.is_watertight and mesh.body_count == 1


def test_export_round_trip(tmp_path: Path) -> None:
    paths = export_builtin(tmp_path / "new" / "meshes", SOME)
    assert paths == [tmp_path / "new" / "meshes" / f"{name}.obj" for name in SOME]
    assert sorted((tmp_path / "new" / "meshes").iterdir()) == sorted(paths)
    for path, name in zip(paths, SOME, strict=True):
        loaded, built = trimesh.load_mesh(path, process=False), builtin_object(name).build()
        np.testing.assert_allclose(loaded.vertices, built.vertices, atol=1e-12)
        np.testing.assert_array_equal(loaded.faces, built.faces)


def test_sources_are_the_objects_of_a_configuration_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A build that died may have left other meshes in the folder."""
    cup = trimesh.creation.box([0.1, 0.1, 0.1])
    monkeypatch.setattr(BuiltinObject, "build", lambda self: cup)
    (carton,) = builtin_sources(tmp_path, BuiltinConfig(), only=["24_carton_1"])
    assert (
        [path.name for path in tmp_path.iterdir()] == [f"{carton.name}.obj"] == ["24_carton_1.obj"]
    )
    builtin_sources(tmp_path, BuiltinConfig(per_class=2))
    seen: list[int] = []
    sources = builtin_sources(
        tmp_path, BuiltinConfig(per_class=1), lambda done, total, **_: seen.append(done)
    )
    assert len(list(tmp_path.iterdir())) == 128
    assert len(sources) == 64 and seen == list(range(1, 65))
    assert [s.name for s in sources] == sorted(f"{c.number}_{c.name}_1" for c in CLASSES)
    assert {s.class_name for s in sources} == {c.name for c in CLASSES}


@pytest.mark.parametrize("name", ["9_spoon_1", "1_mug", "1_mug_0", "1_mug_01", "2_mug_1", "mug_1"])
def test_unknown_name_is_refused_with_the_classes_there_are(tmp_path: Path, name: str) -> None:
    with pytest.raises(MeshError, match=rf"got '{name}'; the classes: 1_mug, 2_bottle, "):
        export_builtin(tmp_path / "out", ["1_mug_1", name])
    assert not (tmp_path / "out").exists()
