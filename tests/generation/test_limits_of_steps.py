"""A step that hangs ends at its limit, whatever it does, and what it was at is refused."""

from __future__ import annotations

import pickle
import subprocess
import sys
from pathlib import Path

import pytest
import trimesh
from helpers import faults
from helpers.builds import build

from drakegrasp.config import Config
from drakegrasp.dataset.manifest import ObjectEntry, RefusedMesh, read_manifest
from drakegrasp.errors import MachineError
from drakegrasp.generation.prepare import PrepareTask, prepare_one
from drakegrasp.generation.work_unit import WorkUnit, run_unit
from drakegrasp.hand.settings import load_config
from drakegrasp.objects.sources import MeshSource, find_meshes
from drakegrasp.runtime.journal import HUNG_DEATHS

pytestmark = [pytest.mark.sim, pytest.mark.slow, pytest.mark.nightly]

#: Runs a task some times as workers do, each in a process of its own; prints how each ended. The
#: limits are some seconds of computing, and ten times as many on the wall.
CHILD = """
import os, pickle, sys
from drakegrasp.generation import prepare, work_unit

prepare.PREPARE_SECONDS = work_unit.STAGE_SECONDS = float(sys.argv[2])
function, task = pickle.load(sys.stdin.buffer)
for _ in range(int(sys.argv[1])):
    child = os.fork()
    if not child:
        function(task)
        os._exit(0)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""


def die_of_hanging(function: object, task: object, fault: str, seconds: float) -> None:
    """Let processes hang in a task, as often as it takes."""
    run = subprocess.run(
        [sys.executable, "-c", CHILD, str(HUNG_DEATHS), str(seconds)],
        input=pickle.dumps((function, task)),
        env=faults.environment(fault),
        capture_output=True,
        check=True,
        timeout=120,
    )
    codes = list(map(int, run.stdout.split()))
    assert len(codes) == HUNG_DEATHS and 0 not in codes, (codes, run.stderr)


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> list[MeshSource]:
    folder = tmp_path_factory.mktemp("meshes")
    for name in ("1_box_a", "2_box_b"):
        trimesh.creation.box([0.06, 0.05, 0.12]).export(folder / f"{name}.obj")
    return find_meshes(folder)


@pytest.fixture(scope="module")
def config() -> Config:
    return load_config(overrides=["candidates.max=1", "settle.drop_height=0.01"])


@pytest.mark.parametrize("fault", ["freeze", "spin"])
def test_mesh_whose_preparing_hangs_is_refused_and_the_other_is_not(
    fault: str, sources: list[MeshSource], config: Config, tmp_path: Path
) -> None:
    guilty, innocent = (
        PrepareTask(source=source, out=tmp_path / "out", config=config, restartable=True)
        for source in sources
    )
    die_of_hanging(prepare_one, guilty, f"{fault}:1_box_a", seconds=0.3)
    _, entry = prepare_one(guilty)
    assert isinstance(entry, RefusedMesh)
    assert (entry.reason, entry.again) == ("preparing it passed its time limit", False)
    assert isinstance(prepare_one(innocent)[1], ObjectEntry)
    assert not list(tmp_path.rglob("*.journal"))


def test_screen_that_hangs_ends_and_is_named(
    sources: list[MeshSource], config: Config, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    build(sources[:1], out, config)
    manifest = read_manifest(out)
    (header,) = manifest.headers()
    header.path(out).unlink()
    unit = WorkUnit(out=out, header=header, config=manifest.config, restartable=True)
    # Building the scene has the same limit, and takes a second of computing.
    die_of_hanging(run_unit, unit, "spin:1_box_a:screen", seconds=2.0)
    with pytest.raises(MachineError, match=r"screening its attempts passed its time limit"):
        run_unit(unit)
