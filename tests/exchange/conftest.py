"""A small dataset with samples in all three splits, and its samples."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.datasets import make_dataset

from drakegrasp.exchange.closed_grasps import ClosedGrasp, read_closed_grasps


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("exchange")
    (folder / "meshes").mkdir()
    return make_dataset(folder / "out", folder / "meshes")


@pytest.fixture(scope="session")
def grasps(dataset: Path) -> list[ClosedGrasp]:
    return list(read_closed_grasps(dataset))
