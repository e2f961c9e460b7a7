"""A small dataset of boxes, and the application that shows it."""

from __future__ import annotations

import shutil
from pathlib import Path

import h5py
import pytest
from helpers.datasets import TRIALS, make_dataset
from helpers.pages import ATTACK, open_pages
from starlette.testclient import TestClient


@pytest.fixture(scope="session")
def boxes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Nine successes of 36 attempts on three boxes, assembled. Read only."""
    folder = tmp_path_factory.mktemp("inspection")
    return make_dataset(folder / "boxes", folder)


@pytest.fixture
def out(boxes: Path, tmp_path: Path) -> Path:
    """A copy of the dataset that a test may change."""
    return Path(shutil.copytree(boxes, tmp_path / "out"))


@pytest.fixture
def hostile(out: Path) -> Path:
    """The dataset with an object and a class whose names are scripts."""
    with h5py.File(out / TRIALS, "r+") as file:
        file["objects/name"][0] = ATTACK
        file["objects/class_name"][0] = f"\"'&{ATTACK}"
    return out


@pytest.fixture
def client(out: Path) -> TestClient:
    return open_pages(out)
