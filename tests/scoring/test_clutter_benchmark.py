"""The frozen scenes: their recipe, and what identifies them."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from helpers.datasets import edit_file

from drakegrasp.api import building
from drakegrasp.api.building import make_clutter_benchmark
from drakegrasp.hand.settings import load_config
from drakegrasp.scoring import clutter_benchmark
from drakegrasp.scoring.clutter_benchmark import PRESET, facts_of, published


def test_objects_poses_and_labels_identify_scenes(small_clutter: Path, tmp_path: Path) -> None:
    known = facts_of(small_clutter / "clutter.hdf5")
    for place, by in (("scenes/X_TO", 1e-6), ("grasps/outcome", 1), ("grasps/X_TG", 0.5)):
        path = Path(shutil.copy(small_clutter / "clutter.hdf5", tmp_path / "other.hdf5"))

        def edit(file: Any, place: str = place, by: float = by) -> None:
            file[place][0] += by

        edit_file(path, edit)
        assert facts_of(path).sha256 != known.sha256, place
    assert facts_of(small_clutter / "clutter.hdf5") == known


def test_recipe_is_made_and_compared(small_clutter: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By the public functions, with one client."""
    asked = list[tuple[Any, ...]]()
    monkeypatch.setattr(building, "joined", lambda client, workers: _Open())
    monkeypatch.setattr(building, "build_dataset", lambda *a, **k: asked.append((a, k)))
    monkeypatch.setattr(building, "build_clutter", lambda *a, **k: asked.append((a, k)))
    found, same = make_clutter_benchmark(small_clutter, show=False)
    assert not same and found == facts_of(small_clutter / "clutter.hdf5")
    (objects, first), (out, second) = asked
    assert objects == ("builtin", small_clutter) and out == (small_clutter,)
    assert first["config"] == load_config(PRESET)
    assert {"scenes": 60, "objects": (2, 6), "tries": 10}.items() <= second.items()
    assert second["surroundings"] == ("table", "bin", "shelf")
    monkeypatch.setattr(clutter_benchmark, "published", lambda: found)
    assert make_clutter_benchmark(small_clutter, show=False)[1]


class _Open:
    def __enter__(self) -> None:
        return None

    def __exit__(self, *_: object) -> None:
        return None


def test_published_scenes_have_sixty(small_clutter: Path) -> None:
    assert published().scenes == 60 and len(published().sha256) == 64
    assert replace(published(), grasps=0) != published()
