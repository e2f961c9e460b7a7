"""Whatever dies on the way, the data are those of an undisturbed build."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import time
from pathlib import Path
from unittest.mock import Mock

import h5py
import numpy as np
import pytest
import trimesh
from helpers.assertions import assert_same_dataset
from helpers.builds import FAST, build, finish, start_build, wait_for_shards, workers_of

from drakegrasp.config import Config
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.statistics import count_funnel
from drakegrasp.errors import BlankImageError, DiskFullError, MachineError
from drakegrasp.generation import attempts
from drakegrasp.generation.work_unit import STAGE_SECONDS, WorkUnit, run_unit
from drakegrasp.hand.settings import load_config
from drakegrasp.outcomes import Outcome
from drakegrasp.runtime.environment import host_label
from drakegrasp.runtime.journal import Journal, Verdict
from drakegrasp.vision import rendering

pytestmark = [pytest.mark.sim, pytest.mark.slow]

UNITS = 12


@pytest.fixture(scope="module")
def meshes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("boxes")
    trimesh.creation.box([0.06, 0.05, 0.12]).export(folder / "1_box_a.obj")
    trimesh.creation.box([0.07, 0.05, 0.14]).export(folder / "2_box_b.obj")
    return folder


@pytest.fixture(scope="module")
def config() -> Config:
    return load_config(overrides=FAST)


@pytest.fixture(scope="module")
def undisturbed(meshes: Path, config: Config, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The dataset, built in this process. Read only: copy it to harm it."""
    out = tmp_path_factory.mktemp("undisturbed") / "out"
    build(meshes, out, config)
    assert count_funnel(out).outcomes[:, Outcome.SUCCESS].sum() > 0
    return out


def begin(out: Path, finished: Path, units: int) -> None:
    """Copy a dataset as a client that died left it: without the last units of each object."""
    for name in ("objects", "shards"):
        shutil.copytree(finished / name, out / name)
    for folder in (out / "shards").iterdir():
        for shard in sorted(folder.glob("*.h5"))[UNITS // 2 - units :]:
            shard.unlink()


def assert_clean(out: Path, *patterns: str) -> None:
    """Nothing is left of what was on the way."""
    for pattern in patterns or (".*.tmp", "*.journal", "build.lock"):
        assert list(out.rglob(pattern)) == []


@pytest.mark.nightly
@pytest.mark.cluster
def test_random_kills_change_nothing(meshes: Path, tmp_path: Path) -> None:
    """All of four workers are killed while objects are prepared, and many times one of them.

    However quick they are: at the latest with the next shard.
    """
    more, units, kills = "candidates.max=14", 28, 20
    undisturbed, out = tmp_path / "undisturbed", tmp_path / "out"
    config = load_config(overrides=[*FAST, more])
    build(meshes, undisturbed, config)
    process, rng, killed = start_build(meshes, out, 4, "--set", more), random.Random(0), 0
    while not list(out.glob("objects/*.journal")):
        assert process.poll() is None
        time.sleep(0.05)
    workers = workers_of(process.pid)
    for worker in workers:
        os.kill(worker, signal.SIGKILL)
    # A journal outlives its process: preparing was interrupted.
    assert workers and list(out.glob("objects/*.journal"))
    wait_for_shards(out, 1)
    while process.poll() is None and killed < kills:
        wait_for_shards(out, 2 + killed, patience=0.8)
        workers = workers_of(process.pid)
        if workers:
            os.kill(rng.choice(workers), signal.SIGKILL)
            killed += 1
    said, _ = finish(process)
    assert killed == kills
    assert f"{units} work units simulated\n" in said
    assert_same_dataset(undisturbed, out)
    assert_clean(out)


def test_objects_are_prepared_once_whatever_died(
    meshes: Path, undisturbed: Path, config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The manifest names them when all are; a client that dies before loses none of them."""
    out = tmp_path / "out"
    begin(out, undisturbed, units=0)
    monkeypatch.setattr("drakegrasp.generation.prepare.prepare", None)
    build(meshes, out, config)
    assert (out / "manifest.json").read_bytes() == (undisturbed / "manifest.json").read_bytes()
    assert_same_dataset(undisturbed, out)


@pytest.mark.nightly
@pytest.mark.cluster
def test_fault_costs_what_is_guilty_and_nothing_else(
    meshes: Path, undisturbed: Path, tmp_path: Path
) -> None:
    """One attempt crashes, one hangs, one hangs with the interpreter's lock, a mesh crashes."""
    more = Path(shutil.copytree(meshes, tmp_path / "meshes"))
    trimesh.creation.box([0.05, 0.05, 0.1]).export(more / "3_box_c.obj")
    faults = "crash:1_box_a:3:1 hang:1_box_a:5:0 freeze:2_box_b:4:2 crash:3_box_c"
    out = tmp_path / "out"
    # A hang that does not compute takes many times as long, and is tried twice.
    limit = ("--set", "attempt_seconds=2")
    said, errors = finish(start_build(more, out, 2, *limit, fault=faults))
    assert "refused: 3_box_c: preparing it crashed its process" in said
    assert errors == ""
    crashed, timeout = Outcome.CRASHED, Outcome.TIMEOUT
    failing = {(0, 3, 1): crashed, (0, 5, 0): timeout, (1, 4, 2): timeout}
    with h5py.File(undisturbed / "trials.hdf5") as a, h5py.File(out / "trials.hdf5") as b:
        names = ("object", "candidate", "standoff_index")
        places = list(zip(*(a["trials"][n][:].tolist() for n in names), strict=True))
        innocent = np.array([place not in failing for place in places])
        assert innocent.sum() == len(places) - 3
        for name in a["trials"]:
            one, two = a["trials"][name][:], b["trials"][name][:]
            assert one[innocent].tobytes() == two[innocent].tobytes(), name
        for place, outcome in failing.items():
            assert b["trials/outcome"][places.index(place)] == outcome
            assert np.isnan(b["trials/closed_q"][places.index(place)]).all()
    assert_clean(out)


@pytest.mark.nightly
@pytest.mark.cluster
def test_mesh_that_takes_too_much_memory_is_refused_and_the_others_go_on(
    meshes: Path, tmp_path: Path
) -> None:
    """The kernel kills its process each time; with more memory the next build has it."""
    out = tmp_path / "out"
    few = ("--set", "candidates.max=1")
    said, errors = finish(start_build(meshes, out, 1, *few, fault="exit:1_box_a"))
    assert "refused: 1_box_a: preparing it was at work whenever its process vanished" in said
    assert errors == ""
    assert [entry.name for entry in read_manifest(out).objects] == ["2_box_b"]
    assert_clean(out)
    build(meshes, out, load_config(overrides=[*FAST, few[1]]))
    assert [entry.name for entry in read_manifest(out).objects] == ["1_box_a", "2_box_b"]
    assert not read_manifest(out).refused


STEPS = ("build", "screen", "measure", "write")


@pytest.fixture
def unit(undisturbed: Path, tmp_path: Path) -> WorkUnit:
    """A unit that is not there, in a process that can be restarted."""
    out = Path(shutil.copytree(undisturbed, tmp_path / "out"))
    header = next(read_manifest(out).headers())
    header.path(out).unlink()
    return WorkUnit(out=out, header=header, config=read_manifest(out).config, restartable=True)


@pytest.mark.parametrize("step", STEPS)
def test_every_step_of_a_unit_is_in_its_journal(
    unit: WorkUnit, step: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """So that a hang in it meets its limit, and the user is told of which step it was."""
    monkeypatch.setattr(Journal, "verdict", lambda _, name: {step: Verdict.HUNG}.get(name))
    with pytest.raises(MachineError, match=r"1_box_a: .*passed its time limit"):
        run_unit(unit)


def test_every_step_of_a_unit_has_a_limit(unit: WorkUnit, monkeypatch: pytest.MonkeyPatch) -> None:
    step = Mock(wraps=Journal.step)
    monkeypatch.setattr(Journal, "step", lambda *given: step(*given))
    run_unit(unit)
    limits = {name: seconds for _, name, seconds in (call.args for call in step.call_args_list)}
    assert limits.keys() > set(STEPS)
    assert 0.0 < min(limits.values()) <= max(limits.values()) == STAGE_SECONDS


# Faults found on start


def test_what_is_harmed_is_named_and_run_again(
    meshes: Path, undisturbed: Path, config: Config, tmp_path: Path
) -> None:
    """Shards that are cut off, changed, of another object, and missing; what the dead left."""
    out = Path(shutil.copytree(undisturbed, tmp_path / "out"))
    shards = sorted(out.glob("shards/*/*.h5"))
    shards[0].write_bytes(shards[0].read_bytes()[:-100])
    content = bytearray(shards[1].read_bytes())
    content[len(content) // 2] ^= 0xFF
    shards[1].write_bytes(bytes(content))
    shutil.copyfile(out / "shards" / "2_box_b" / shards[2].name, shards[2])
    shards[3].unlink()
    dead = subprocess.Popen(["true"])
    dead.wait()
    stale = out / "shards" / "1_box_a" / f".x.h5.{host_label()}~{dead.pid}~0123456789ab.tmp"
    alive = stale.with_name(stale.name.replace(f"~{dead.pid}~", f"~{os.getpid()}~"))
    foreign = stale.with_name(f".y.h5.elsewhere~1~{'0' * 12}.tmp")
    old = stale.with_name(f".z.h5.elsewhere~1~{'0' * 12}.tmp")
    for path in (stale, alive, foreign, old):
        path.write_bytes(b"half")
    os.utime(old, (0, 0))
    (out / "build.lock").write_text("process 5 on h, since s")
    report = build(meshes, out, config)
    assert (report.simulated, report.reused) == (4, UNITS - 4)
    taken, swept, damaged = report.notices
    assert taken == "the lock of a dead build was taken over: process 5 on h, since s"
    assert swept.startswith("2 temporary files (shards/1_box_a/.")
    names = ", ".join(str(s.relative_to(out)) for s in shards[:3])
    assert damaged == f"3 shards ({names}): damaged, and simulated again"
    assert (stale.exists(), alive.exists(), foreign.exists(), old.exists()) == (0, 1, 1, 0)
    assert_same_dataset(undisturbed, out)


@pytest.mark.nightly
def test_full_disk_stops_and_goes_on(meshes: Path, undisturbed: Path, tmp_path: Path) -> None:
    """A limit on the size of files is what a full disk is to a shard with images."""
    out = tmp_path / "out"
    begin(out, undisturbed, units=0)
    largest = max(out.glob("shards/*/*.h5"), key=lambda path: path.stat().st_size)
    size = largest.stat().st_size - 1
    largest.unlink()
    process = start_build(meshes, out, workers=1, largest_file=size)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 1
    assert "the disk or the quota is full" in errors.splitlines()[-1]
    assert "Traceback" not in errors, errors
    # A unit that was begun meanwhile, and dropped, keeps its journal for its next run.
    assert_clean(out, ".*.tmp", "build.lock")
    finish(start_build(meshes, out, workers=1))
    assert_same_dataset(undisturbed, out)


def test_full_disk_of_the_client_is_one_error(
    meshes: Path, config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    full = Mock(side_effect=OSError(28, "No space left on device"))
    monkeypatch.setattr("drakegrasp.dataset.manifest.write_atomic", full)
    with pytest.raises(DiskFullError, match=r"disk or the quota is full .* continues from here"):
        build(meshes, tmp_path / "out", config)
    assert not (tmp_path / "out").exists()


def test_blank_image_never_becomes_data(
    meshes: Path, undisturbed: Path, config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = Path(shutil.copytree(undisturbed, tmp_path / "out"))
    with h5py.File(undisturbed / "trials.hdf5") as file:
        row = int(np.flatnonzero(file["trials/outcome"][:] == Outcome.SUCCESS)[0])
        name = ("1_box_a", "2_box_b")[file["trials/object"][row]]
        start = int(file["trials/candidate"][row])
    shard = out / "shards" / name / f"{start:07d}-{start + 1:07d}.h5"
    shard.unlink()
    with monkeypatch.context() as patch:
        patch.setattr(attempts, "render", Mock(side_effect=BlankImageError(rendering.BLANK)))
        with pytest.raises(BlankImageError, match="must not be blank"):
            build(meshes, out, config)
    assert not shard.exists()
    build(meshes, out, config)
    assert_same_dataset(undisturbed, out)
