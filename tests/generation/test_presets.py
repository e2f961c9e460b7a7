"""A small set of every preset: its files are sound, and its physics agrees with itself."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.builds import build
from helpers.physics import broken_physics
from helpers.tiers import few

from drakegrasp.dataset.check import check_dataset
from drakegrasp.dataset.trials import Trials
from drakegrasp.hand.settings import load_config
from drakegrasp.objects.sources import find_meshes

pytestmark = pytest.mark.sim

#: Few palm poses of one box, in small images.
SMALL = ("candidates.max=6", "unit_candidates=3", "camera.size=32", "objects.resting_poses=1")


@pytest.mark.parametrize("preset", few(["fast", "randomized", "paper", "released"], 2))
def test_small_set_of_a_preset_is_sound(preset: str, small_meshes: Path, tmp_path: Path) -> None:
    sources = [source for source in find_meshes(small_meshes) if "box" in source.name][:1]
    out = tmp_path / "out"
    build(sources, out, load_config(preset, overrides=SMALL))
    assert len(Trials(out)) > 0
    assert check_dataset(out) == []
    assert broken_physics(out) == {}
