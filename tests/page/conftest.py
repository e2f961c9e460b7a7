"""A small dataset of boxes, and the application that shows it."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import h5py
import pytest
from helpers.datasets import TRIALS, make_dataset
from helpers.pages import ATTACK
from starlette.testclient import TestClient

from drakegrasp.page.app import Inspection, make_app


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
def inspection(out: Path) -> Inspection:
    return Inspection(out)


@pytest.fixture
def client(inspection: Inspection) -> Iterator[TestClient]:
    with TestClient(make_app(inspection), base_url="http://127.0.0.1:8321") as client:
        yield client
