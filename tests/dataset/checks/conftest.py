"""The dataset of the checks, split by class, so that the rule of the paper's split is checked."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.datasets import CERTIFIED, make_dataset


@pytest.fixture(scope="session")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folders = tmp_path_factory.mktemp("sound"), tmp_path_factory.mktemp("meshes")
    return make_dataset(*folders, overrides=[*CERTIFIED, "split.by=class"])
