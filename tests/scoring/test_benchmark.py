"""The frozen benchmark: the same objects for everybody, and a card that says what is not."""

from __future__ import annotations

import json
import shutil
from collections import Counter
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import h5py
import pytest
from helpers.datasets import make_dataset

from drakegrasp.api import building
from drakegrasp.api.building import make_benchmark, make_clutter_benchmark
from drakegrasp.dataset.manifest import Manifest, RefusedMesh, installed_versions, write_manifest
from drakegrasp.dataset.paths import BENCHMARK_FILE, BUILTIN_FOLDER, DATA_FILES
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.errors import DataError
from drakegrasp.hand.settings import load_config, override_config
from drakegrasp.objects.sources import find_meshes
from drakegrasp.runtime.files import seal
from drakegrasp.scoring import benchmark, clutter_benchmark
from drakegrasp.scoring.benchmark import (
    FRICTIONS,
    MASSES,
    NEW_CLASSES,
    PRESET,
    material_of,
    new_classes,
    published,
    read_benchmark,
    rows_digest,
    write_objects,
)
from drakegrasp.scoring.clutter_benchmark import facts_of
from drakegrasp.shapes.catalog import CLASSES, draw_builtin

CONFIG = load_config(PRESET)
SCORED = override_config(CONFIG, ["verify.max_tries=1"])
#: Mass [kg] and friction of the first object, and the classes that no training set may have.
FIRST_MATERIAL = (0.1, 0.71)
NEW = [
    *("alarm_clock", "banana", "book", "bowl", "bowling_pin", "bucket", "can", "candlestick"),
    *("chess_pawn", "comb", "lamp", "mushroom", "pumpkin", "teapot", "towel_roll", "toy_car"),
]
BOTTLE = next(item.name for item in draw_builtin(CONFIG.builtin) if item.name.startswith("10_"))


@pytest.fixture(scope="module")
def part(tmp_path_factory):
    """One object of the benchmark, with the manifest that a build would write."""
    return made(tmp_path_factory.mktemp("benchmark"))


def made(out, config=CONFIG, **stated):
    """Write one object and the manifest of a build."""
    write_objects(out, CONFIG, only=[BOTTLE])
    write_manifest(Manifest(config=config, versions=installed_versions(config), **stated), out)
    return out


def test_each_class_has_all_frictions_and_masses_are_used_alike():
    items = draw_builtin(CONFIG.builtin)
    assert published()["objects"].keys() == {item.name for item in items} and len(items) >= 200
    frictions: dict[str, set[float]] = {}
    for item in items:
        frictions.setdefault(item.object_class.name, set()).add(material_of(item)[1])
    assert all(found == set(FRICTIONS) for found in frictions.values())
    masses = Counter(material_of(item)[0] for item in items)
    assert masses.keys() == set(MASSES)
    assert min(masses.values()) > len(items) / len(MASSES) / 2


def test_draws_are_frozen():
    """Whoever makes the benchmark gets these; a change of them is another benchmark."""
    first = draw_builtin(CONFIG.builtin)[0]
    assert material_of(first) == FIRST_MATERIAL
    assert new_classes() == NEW
    assert set(NEW) < {item.name for item in CLASSES}
    assert len(NEW) == NEW_CLASSES and CONFIG.split.train_classes == ()


def test_a_part_has_the_published_meshes_and_materials_and_is_not_frozen(part):
    about = read_benchmark(part, SCORED, published()["versions"])
    assert about["different_meshes"] == []
    assert about["other_settings"] == ""
    assert about["other_versions"] == {}
    assert (about["objects"], about["of"], about["frozen"]) == (1, 256, False)
    (source,) = find_meshes(part / BUILTIN_FOLDER)
    item = next(item for item in draw_builtin(CONFIG.builtin) if item.name == BOTTLE)
    assert source.name == BOTTLE
    assert (source.mass, source.friction) == material_of(item)


def test_a_score_by_other_rules_is_not_frozen(tmp_path, monkeypatch):
    whole = {"objects": {BOTTLE: published()["objects"][BOTTLE]}, "versions": {}}
    monkeypatch.setattr(benchmark, "published", lambda: whole)
    made(tmp_path)
    looser = override_config(SCORED, ["verify.max_contact_error=0.06"])
    for config, other in ((SCORED, ""), (looser, "max_contact_error"), (CONFIG, "max_tries")):
        about = read_benchmark(tmp_path, config, {})
        assert about is not None
        assert about["frozen"] == (other == "")
        assert other in about["other_settings"]


@pytest.mark.parametrize("manifest", [True, False])
def test_a_folder_of_something_else_stays_as_it_is(tmp_path, manifest):
    if manifest:
        write_manifest(Manifest(config=CONFIG, versions=installed_versions(CONFIG)), tmp_path)
    else:
        (tmp_path / "thesis.tex").write_text("mine")
    before = list(tmp_path.iterdir())
    with pytest.raises(DataError, match="must be empty or hold"):
        make_benchmark(tmp_path, only=[BOTTLE], show=False)
    assert list(tmp_path.iterdir()) == before


def test_a_finished_benchmark_is_not_made_a_part_of_itself(tmp_path):
    made(tmp_path, refused=(RefusedMesh(name=BOTTLE, mesh_sha256="0", reason="too heavy"),))
    before = {path: path.read_bytes() for path in (tmp_path / BUILTIN_FOLDER).iterdir()}
    with pytest.raises(DataError, match=f"every mesh .* got none named {BOTTLE}"):
        make_benchmark(tmp_path, only=["6_can_1"], show=False)
    assert {path: path.read_bytes() for path in (tmp_path / BUILTIN_FOLDER).iterdir()} == before


def test_other_meshes_versions_and_settings_are_named(tmp_path, monkeypatch):
    monkeypatch.setattr(benchmark, "wavefront", lambda mesh: b"v 0 0 0\n")
    made(tmp_path, load_config(PRESET, ["lift.hold_time=1"]))
    about = read_benchmark(tmp_path, SCORED, {**published()["versions"], "drake": "0"})
    assert about["different_meshes"] == [BOTTLE] and not about["frozen"]
    assert list(about["other_versions"]) == ["drake"]
    assert "lift.hold_time" in about["other_settings"]


def test_another_dataset_is_no_benchmark_and_a_damaged_file_is_refused(tmp_path):
    assert read_benchmark(tmp_path, SCORED, {}) is None
    (tmp_path / BUILTIN_FOLDER).mkdir()
    (tmp_path / BUILTIN_FOLDER / BENCHMARK_FILE).write_text(json.dumps({"name": "x"}))
    with pytest.raises(DataError, match="must be the file of a benchmark"):
        read_benchmark(tmp_path, SCORED, {})


@pytest.mark.parametrize("field", ["grasps", "grasp_props/X_CG", "object_props/frame_world2obj"])
def test_rows_are_the_same_whatever_the_numbers_of_their_trials(tmp_path, field):
    path, digests = make_dataset(tmp_path / "out", tmp_path) / DATA_FILES["oto"], []
    for name, change in (("trial_id", 0), ("trial_id", 7), (field, 0.001)):
        changed = shutil.copy(path, tmp_path / f"{len(digests)}.hdf5")
        with h5py.File(changed, "r+") as file:
            file[f"train/{name}"][:] += change
        data = GraspDataset(changed, split="train")
        digests.append(rows_digest(data, range(len(data))))
    assert digests[0] == digests[1] != digests[2]


def test_a_card_says_whether_all_rows_are_the_published_ones(tmp_path, monkeypatch):
    out = make_dataset(
        tmp_path / "out", tmp_path, overrides=["split.by=class", "split.train_classes=[]"]
    )
    (out / BUILTIN_FOLDER).mkdir()
    about = {"objects": 3, "of": 3, "different_meshes": []}
    (out / BUILTIN_FOLDER / BENCHMARK_FILE).write_text(json.dumps(about))
    test, real = GraspDataset(out / DATA_FILES["oto"], split="test"), published()
    own = {"count": len(test), "sha256": rows_digest(test, range(len(test)))}
    assert len(test) > 1
    assert rows_digest(test, [0, 1]) != rows_digest(test, [1, 0])
    for rows, same in ((real["rows"], False), (own, True)):
        monkeypatch.setattr(benchmark, "published", lambda rows=rows: {**real, "rows": rows})
        found = read_benchmark(out, SCORED, {})
        assert found is not None
        assert (found["rows"], found["rows_as_published"]) == (len(test), same)
        assert found["published_rows"] == rows["count"]


# The frozen scenes


@pytest.mark.parametrize(
    ("place", "by"), [("scenes/X_TO", 1e-6), ("grasps/outcome", 1), ("grasps/X_TG", 0.5)]
)
def test_objects_poses_and_labels_identify_scenes(small_clutter, tmp_path, place, by):
    path = Path(shutil.copy(small_clutter / "clutter.hdf5", tmp_path))
    known = facts_of(path)
    assert known == facts_of(small_clutter / "clutter.hdf5")
    with h5py.File(path, "r+") as file:
        file[place][0] += by
    seal(path)
    assert facts_of(path).sha256 != known.sha256


def test_recipe_is_made_and_compared(small_clutter, monkeypatch):
    """By the public functions, with one client."""
    asked = []
    monkeypatch.setattr(building, "joined", lambda client, workers: nullcontext())
    monkeypatch.setattr(building, "build_dataset", lambda *a, **k: asked.append((a, k)))
    monkeypatch.setattr(building, "build_clutter", lambda *a, **k: asked.append((a, k)))
    found, same = make_clutter_benchmark(small_clutter, show=False)
    assert not same and found == facts_of(small_clutter / "clutter.hdf5")
    (objects, first), (out, second) = asked
    assert objects == ("builtin", small_clutter) and out == (small_clutter,)
    assert first["config"] == load_config(clutter_benchmark.PRESET)
    assert {"scenes": 60, "objects": (2, 6), "tries": 10}.items() <= second.items()
    assert second["surroundings"] == ("table", "bin", "shelf")
    monkeypatch.setattr(clutter_benchmark, "published", lambda: found)
    assert make_clutter_benchmark(small_clutter, show=False)[1]


def test_published_scenes_have_sixty():
    scenes = clutter_benchmark.published()
    assert scenes.scenes == 60 and len(scenes.sha256) == 64
    assert replace(scenes, grasps=0) != scenes
