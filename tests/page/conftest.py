"""The application that shows the dataset of boxes, also with names that are scripts."""

from __future__ import annotations

from pathlib import Path

import h5py
import pytest
from helpers.datasets import TRIALS
from helpers.pages import ATTACK, open_pages
from starlette.testclient import TestClient


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
