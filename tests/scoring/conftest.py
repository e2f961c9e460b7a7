"""Rows to score: the test split of a small dataset of boxes, written without a simulator."""

from __future__ import annotations

import pytest
from helpers.datasets import OTO, make_dataset

from drakegrasp.dataset.reader import GraspDataset


@pytest.fixture(scope="package")
def data(tmp_path_factory: pytest.TempPathFactory) -> GraspDataset:
    folder = tmp_path_factory.mktemp("scored")
    out = make_dataset(folder / "out", folder / "meshes", overrides=["split.by=class"])
    return GraspDataset(out / OTO, split="test")
