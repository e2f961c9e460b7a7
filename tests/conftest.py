"""Fixtures that several test modules share."""

from __future__ import annotations

import fcntl
import gc
import os
import shutil
from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
import trimesh
from helpers.builds import build
from helpers.datasets import REPEATED, make_dataset
from helpers.golden import Golden, compare
from helpers.meshes import G3DB, SMALL, write_fixed
from helpers.objects import CUBE, box_model
from hypothesis import HealthCheck, settings

from drakegrasp.config import Config
from drakegrasp.generation.clutter import ClutterRequest, make_clutter
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.settings import load_config
from drakegrasp.objects.model import ObjectModel
from drakegrasp.runtime.executor import run_here
from drakegrasp.simulation.fixtures import load_surroundings

# Software OpenGL must not start threads beside the test workers, and nothing needs the network.
os.environ.setdefault("LP_NUM_THREADS", "0")
os.environ.setdefault("DRAKE_ALLOW_NETWORK", "none")

# Shared machines stall now and then; an example is never too slow by itself, nor is its making.
settings.register_profile("drakegrasp", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("drakegrasp")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option that stores whole outputs anew, see `helpers/golden.py`."""
    parser.addoption("--write-golden", action="store_true", help="write tests/golden anew")


@pytest.fixture
def golden(request: pytest.FixtureRequest) -> Golden:
    """Returns a function that compares a text with the stored one of a name."""
    return partial(compare, write=bool(request.config.getoption("--write-golden")))


def pytest_collection_finish() -> None:
    """Leave what is there before the tests out of garbage collections: a full one takes 0.2 s."""
    gc.collect()
    gc.freeze()


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


@pytest.fixture
def builds_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let `drakegrasp build` do the work in this process, and start no others."""
    no_cluster = nullcontext(SimpleNamespace(dashboard_link=""))
    building = "drakegrasp.api.building"
    monkeypatch.setattr(f"{building}.joined", lambda *_: no_cluster)
    monkeypatch.setattr(f"{building}.checked_workers", lambda *_: nullcontext(False))
    execute = Mock(side_effect=run_here, pool=None)
    monkeypatch.setattr(f"{building}.DaskExecutor", lambda *_, **__: execute)


@pytest.fixture(scope="session")
def made_once(
    tmp_path_factory: pytest.TempPathFactory,
) -> Callable[[str, Callable[[Path], object]], Path]:
    """Returns the folder of a name, which one process of a run makes; all others only read it."""

    def once(name: str, make: Callable[[Path], object]) -> Path:
        common = tmp_path_factory.getbasetemp()
        common = common.parent if "PYTEST_XDIST_WORKER" in os.environ else common
        folder, made = common / name, common / f"{name}.made"
        with open(common / f"{name}.lock", "wb") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not made.exists():
                make(folder)
                made.touch()
        return folder

    return once


@pytest.fixture(scope="session")
def small_dataset(
    small_meshes: Path,
    small_config: Config,
    made_once: Callable[[str, Callable[[Path], object]], Path],
) -> Path:
    """A dataset built in one process, without Dask. Read only: copy it to change it."""

    def make(out: Path) -> None:
        build(small_meshes, out, small_config)

    return made_once("small_dataset", make)


@pytest.fixture(scope="session")
def small_clutter(
    small_dataset: Path, made_once: Callable[[str, Callable[[Path], object]], Path]
) -> Path:
    """The same dataset with three scenes of up to two objects, on the table and in a bin.

    Both test scenes have kept grasps. Read only.
    """

    def make(out: Path) -> None:
        around = [load_surroundings(name) for name in ("table", "bin")]
        request = ClutterRequest(scenes=3, objects=(1, 2), surroundings=around, tries=4)
        make_clutter(Path(shutil.copytree(small_dataset, out)), request)

    return made_once("small_clutter", make)


@pytest.fixture(scope="session")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset that nobody simulated: nine successes of 36 attempts on three boxes. Read only.

    Its samples are repeated, so that it has all columns that there are.
    """
    folders = tmp_path_factory.mktemp("sound"), tmp_path_factory.mktemp("meshes")
    return make_dataset(*folders, overrides=REPEATED)


@pytest.fixture
def out(sound: Path, tmp_path: Path) -> Path:
    """A copy of it that a test may change."""
    return Path(shutil.copytree(sound, tmp_path / "out"))


@pytest.fixture(scope="session")
def config() -> Config:
    """The defaults."""
    return load_config()


@pytest.fixture(scope="session")
def hand() -> Hand:
    """The one of the defaults."""
    return load_hand()


@pytest.fixture(scope="session")
def cube(tmp_path_factory: pytest.TempPathFactory) -> ObjectModel:
    """One that the hand can grasp."""
    return box_model(tmp_path_factory.mktemp("cube"), [CUBE] * 3)
