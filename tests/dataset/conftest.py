"""A sound dataset, and a copy of it to spoil."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from helpers.datasets import make_dataset


@pytest.fixture(scope="session")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_dataset(tmp_path_factory.mktemp("sound"), tmp_path_factory.mktemp("meshes"))


@pytest.fixture
def out(sound: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(sound, tmp_path / "out"))
