"""A small dataset of boxes to draw."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.datasets import make_dataset


@pytest.fixture(scope="session")
def boxes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Nine successes of 36 attempts on three boxes. Read only."""
    folder = tmp_path_factory.mktemp("figures")
    return make_dataset(folder / "boxes", folder)
