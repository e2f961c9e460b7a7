"""Fixtures that several test modules share."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import trimesh
from helpers.meshes import G3DB, SMALL, write_fixed
from hypothesis import settings

from drakegrasp.build.pipeline import build
from drakegrasp.config import Config
from drakegrasp.hand.settings import load_config
from drakegrasp.objects.sources import find_meshes
from drakegrasp.runtime.executor import run_here

# Software OpenGL must not start threads beside the test workers, and nothing needs the network.
os.environ.setdefault("LP_NUM_THREADS", "0")
os.environ.setdefault("DRAKE_ALLOW_NETWORK", "none")

# Shared machines stall now and then; an example is never too slow by itself.
settings.register_profile("drakegrasp", deadline=None)
settings.load_profile("drakegrasp")


@pytest.fixture(scope="session")
def g3db() -> Path:
    """The thirty real meshes beside the project; tests that need them skip without."""
    if not G3DB.is_dir():
        pytest.skip("the real meshes are not beside the project")
    return G3DB


@pytest.fixture(scope="session")
def small_meshes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two built-in objects and a box, of two classes, as files."""
    folder = tmp_path_factory.mktemp("meshes")
    write_fixed(folder, "8_wineglass_flute", "10_box_tall")
    slim = trimesh.creation.box([0.065, 0.05, 0.14]).subdivide().subdivide()
    slim.export(folder / "11_box_slim.obj")
    return folder


@pytest.fixture(scope="session")
def small_config() -> Config:
    return load_config(overrides=SMALL)


@pytest.fixture(scope="session")
def small_dataset(
    small_meshes: Path, small_config: Config, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """A dataset built in this process, without Dask. Read only: copy it to change it."""
    out = tmp_path_factory.mktemp("dataset") / "out"
    build(find_meshes(small_meshes), out, small_config, run_here, show=False)
    return out
