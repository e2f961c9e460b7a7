"""Fixtures that several test modules share."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import settings

# Software OpenGL must not start threads beside the test workers, and nothing needs the network.
os.environ.setdefault("LP_NUM_THREADS", "0")
os.environ.setdefault("DRAKE_ALLOW_NETWORK", "none")

# Shared machines stall now and then; an example is never too slow by itself.
settings.register_profile("drakegrasp", deadline=None)
settings.load_profile("drakegrasp")


@pytest.fixture(scope="session")
def g3db() -> Path:
    """The thirty real meshes beside the project; tests that need them skip without."""
    folder = Path(__file__).resolve().parents[2] / "shared" / "meshes" / "g3db"
    if not folder.is_dir():
        pytest.skip("the real meshes are not beside the project")
    return folder
