"""The manifest: equal content gives equal bytes, and a broken one is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from drakegrasp.dataset.manifest import (
    DIGEST,
    Manifest,
    ObjectEntry,
    RefusedMesh,
    RestingEntry,
    claim_directory,
    installed_versions,
    read_manifest,
    with_postprocessing,
    write_manifest,
)
from drakegrasp.dataset.paths import MANIFEST_FILE
from drakegrasp.errors import DataError
from drakegrasp.hand.settings import load_config

#: What builds have always written of these entries, in this order.
X_TO = (1.0, 0.0, 0.0, 0.30000000000000004, 0.0, 1.0, 0.0, -0.0, 0.0, 0.0, 1.0, 1e-17)
RESTING: dict[str, Any] = {"X_TO": X_TO, "probability": 0.75, "rolled": True}
SOLID: dict[str, Any] = {
    "mesh_sha256": "ab",
    "scale": 1.0,
    "up": "+z",
    "mass": 0.1,
    "density": 1000.0,
    "friction": None,
    "collision_error": 0.0,
}
REFUSED = {"name": "2_sheet", "mesh_sha256": "cd", "reason": "must be closed"}
ENTRIES = {
    "objects": [
        {"name": "1_mug_é", "class": "mug", **SOLID}
        | {"resting": [RESTING], "candidates": 7, "notes": ["2 holes closed"]}
    ],
    "refused": [REFUSED],
}

MUG = ObjectEntry(
    name="1_mug_é",
    class_name="mug",
    resting=(RestingEntry(**RESTING),),
    candidates=7,
    notes=("2 holes closed",),
    **SOLID,
)
SHEET = RefusedMesh(**REFUSED)


@pytest.fixture
def manifest() -> Manifest:
    config = load_config(overrides=["unit_candidates=3"])
    return Manifest(config=config, objects=(MUG,), refused=(SHEET,), versions={"drake": "1"})


def test_entries_are_written_as_ever_and_come_back(tmp_path: Path, manifest: Manifest) -> None:
    write_manifest(manifest, tmp_path)
    text = (tmp_path / MANIFEST_FILE).read_text(encoding="utf-8")
    entries = json.dumps(ENTRIES, indent=1, ensure_ascii=False)
    assert text.split(f',\n "{DIGEST}"')[0].endswith(entries.strip("{}\n"))
    assert read_manifest(tmp_path) == manifest


def test_a_value_that_may_be_but_was_not_written_is_refused(
    tmp_path: Path, manifest: Manifest
) -> None:
    """A changed bit and a lost hash show; another layout is read."""
    write_manifest(manifest, tmp_path)
    path = tmp_path / MANIFEST_FILE
    text = path.read_text(encoding="utf-8")
    tree = json.loads(text)
    path.write_text(json.dumps(tree), encoding="utf-8")
    assert read_manifest(tmp_path) == manifest
    path.write_text(text.replace('"mass": 0.1', '"mass": 0.3'), encoding="utf-8")
    with pytest.raises(DataError, match="must be as it was written, got one with another sha256"):
        read_manifest(tmp_path)
    del tree[DIGEST]
    path.write_text(json.dumps(tree), encoding="utf-8")
    with pytest.raises(DataError, match="sha256: must be given"):
        read_manifest(tmp_path)
    path.write_text('{"once": 1, "again": 2, "again": 3}', encoding="utf-8")
    with pytest.raises(DataError, match="the key 'again' twice"):
        read_manifest(tmp_path)


def test_rule_of_the_split_splits_and_groups_are_stated(tmp_path: Path, manifest: Manifest) -> None:
    objects = (replace(MUG, split="test"), replace(MUG, name="4_morph", group="3_mug"))
    write_manifest(replace(manifest, objects=objects), tmp_path)
    tree = json.loads((tmp_path / MANIFEST_FILE).read_text(encoding="utf-8"))
    assert tree["split_by"] == "object"
    assert [entry.get("split") for entry in tree["objects"]] == ["test", None]
    assert read_manifest(tmp_path).objects == objects


def test_units_cover_the_candidates_of_each_object(manifest: Manifest) -> None:
    manifest = replace(manifest, objects=(MUG, replace(MUG, name="3_cup", candidates=3)))
    ranges = [(h.object_name, h.start, h.stop) for h in manifest.headers()]
    assert ranges == [("1_mug_é", 0, 3), ("1_mug_é", 3, 6), ("1_mug_é", 6, 7), ("3_cup", 0, 3)]
    assert manifest.units == len(ranges)


def test_units_of_many_candidates_grow(manifest: Manifest) -> None:
    """So large datasets have few files and tasks."""

    def stops(candidates: int, *, most: int) -> list[int]:
        config = load_config(overrides=[f"candidates.max={most}"])
        objects = (replace(MUG, candidates=candidates),)
        grown = replace(manifest, config=config, objects=objects)
        headers = list(grown.headers())
        assert [h.start for h in headers] == [0, *(h.stop for h in headers[:-1])]
        assert grown.units == len(headers)
        return [h.stop for h in headers]

    assert stops(70, most=1000) == [50, 70]
    assert stops(1001, most=10_000) == [50, 100, 200, 400, 800, 1001]
    assert len(stops(10_000, most=10_000)) == 28


def test_filters_may_change_but_not_the_physics(manifest: Manifest) -> None:
    manifest = replace(manifest, objects=(replace(MUG, split="test"),))
    changed = with_postprocessing(manifest, ["filters.max_slip=0.001", "split.seed=0"])
    assert changed.config.filters.max_slip == 0.001
    assert changed.objects == manifest.objects
    # Another split is drawn anew.
    changed = with_postprocessing(manifest, ["split.valid_fraction=0.2"])
    assert changed.config.split.valid_fraction == 0.2
    assert changed.objects == (MUG,)
    # So may all that no shard depends on.
    changed = with_postprocessing(manifest, ["scenes.views=2", "samples=7"])
    assert (changed.config.scenes.views, changed.config.samples) == (2, 7)
    # Only what changes the simulation is told.
    told = (
        r"^only values of attempt_seconds, scenes, .*, verify can change, "
        r".* simulated: physics\.time_step \(0\.008 there, 0\.004 here\)$"
    )
    with pytest.raises(ValueError, match=told):
        with_postprocessing(manifest, ["physics.time_step=0.004", "filters.max_slip=0.001"])


@pytest.mark.parametrize(
    ("name", "version"),
    [
        ("drakegrasp", "0.1.9"),
        ("drakegrasp", "99.0"),
        ("drakegrasp", "other"),
        ("drake", "other"),
        ("hand", "other"),
    ],
)
def test_dataset_of_other_results_is_not_continued(tmp_path: Path, name: str, version: str) -> None:
    """The package, the simulator and the hand's files decide what comes out."""
    config = load_config()
    versions = {**installed_versions(config), name: version}
    write_manifest(Manifest(config=config, versions=versions), tmp_path)
    with pytest.raises(DataError, match=rf"must be continued with {name} {version}, which made it"):
        claim_directory(tmp_path, config)
