"""The application that shows the dataset of boxes."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.pages import open_pages
from starlette.testclient import TestClient


@pytest.fixture
def client(out: Path) -> TestClient:
    return open_pages(out)
