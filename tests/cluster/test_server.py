"""A real SLURM, of this machine alone. Run by `make test-cluster`, as root."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from helpers.assertions import assert_same_dataset
from helpers.builds import build
from helpers.meshes import write_fixed
from helpers.scripts import PIPELINES
from server.processes import wait_until
from server.slurm import PARTITION, queued_jobs, running_slurm

from drakegrasp.cluster import kinds
from drakegrasp.cluster.kinds import cluster_of
from drakegrasp.config import BUILD_PRESET
from drakegrasp.hand.settings import load_config

pytestmark = [pytest.mark.server, pytest.mark.cluster, pytest.mark.sim, pytest.mark.slow]

CANDIDATES, UNIT = 12, 4
#: A build may take this long on a machine that has other work [s].
PATIENCE = 600.0


@pytest.fixture(scope="module")
def meshes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("meshes") / "m s$d"
    write_fixed(folder, "10_box_tall")
    return folder


@pytest.fixture
def out(tmp_path: Path) -> Path:
    """A directory whose path a shell splits, and whose `$` it replaces, where it has no quotes."""
    folder = tmp_path / "a b$c"
    folder.mkdir()
    return folder / "out $(touch ran)"


@pytest.fixture(scope="module")
def built_here(meshes: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The dataset, by a plain loop in this process."""
    out = tmp_path_factory.mktemp("here") / "out"
    config = load_config(BUILD_PRESET, [f"candidates.max={CANDIDATES}", f"unit_candidates={UNIT}"])
    build(meshes, out, config)
    return out


@pytest.fixture(scope="module")
def slurm() -> Iterator[dict[str, str]]:
    """The environment of a SLURM whose user has a jobqueue.yaml; jobs inherit none of it."""
    # Not pytest's folder: its name is too long for a socket.
    with tempfile.TemporaryDirectory(prefix="slurm-") as name, running_slurm(Path(name)) as env:
        folder = Path(name) / "dask"
        folder.mkdir()
        (folder / "jobqueue.yaml").write_text(
            f"jobqueue:\n  slurm:\n    queue: {PARTITION}\n    interface: lo\n"
            f"    log-directory: {name}/logs\n    memory: 1GB\n"
            "    job-script-prologue: ['export FROM_YAML=1']\n"
        )
        yield {**env, "DASK_CONFIG": str(folder), "SBATCH_EXPORT": "NONE"}


def submit(env: dict[str, str], meshes: Path, out: Path, *arguments: str) -> None:
    command = [sys.executable, PIPELINES / "submit_build.py", "--objects", meshes, "--out", out]
    options = ["--candidates", str(CANDIDATES), "--set", f"unit_candidates={UNIT}", *arguments]
    result = subprocess.run(
        [*command, *options], env=env, cwd=out.parent, capture_output=True, text=True
    )
    assert result.returncode == 0, result.stderr
    assert f"{CANDIDATES // UNIT} work units simulated" in result.stdout
    assert not list(out.glob(".tls-*"))
    assert not list(out.parent.parent.rglob("ran"))


def test_slurm_builds_what_a_plain_loop_builds(
    slurm: dict[str, str], meshes: Path, built_here: Path, out: Path
) -> None:
    options = ["--workers", "2", "--walltime", "00:30:00"]
    submit(slurm, meshes, out, "--cluster", "slurm", *options)
    assert_same_dataset(built_here, out)
    wait_until(lambda: not queued_jobs(slurm), "the end of the jobs", out / "none")


def test_slurm_workers_have_their_settings_and_are_replaced(
    slurm: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import dask

    for name in ("SLURM_CONF", "SBATCH_EXPORT"):
        monkeypatch.setenv(name, slurm[name])
    monkeypatch.setattr(kinds, "REFILL_SECONDS", 2.0)
    # Over the defaults of dask-jobqueue, which another test's import may have read already.
    yaml = dask.config.collect(paths=[slurm["DASK_CONFIG"]], env={})
    settings_of_site = dask.config.merge(dask.config.config, yaml)
    with ExitStack() as stack:
        stack.enter_context(dask.config.set(settings_of_site))
        cluster = cluster_of("slurm", workers=3, cores=1, walltime="00:20:00", tls=False)
        client = stack.enter_context(cluster.connected(tmp_path))
        client.wait_for_workers(3, timeout=PATIENCE)
        assert all(address.startswith("tcp://127.0.0.1:") for address in client.nthreads())
        assert [*client.run(os.environ.get, "FROM_YAML").values()] == ["1"] * 3
        before = queued_jobs(slurm)
        subprocess.run(["scancel", before[0]], env=slurm, check=True)
        end = time.monotonic() + PATIENCE
        while not (len(set(queued_jobs(slurm)) - set(before)) == 1 and len(client.nthreads()) == 3):
            assert time.monotonic() < end, queued_jobs(slurm)
            time.sleep(0.5)
    wait_until(lambda: not queued_jobs(slurm), "the end of the jobs", tmp_path / "none")


def test_sbatch_file_builds_what_a_plain_loop_builds(
    slurm: dict[str, str], meshes: Path, built_here: Path, out: Path, tmp_path: Path
) -> None:
    """The recipe, with scheduler, workers and client in one allocation."""
    log = tmp_path / "log"
    recipe = (PIPELINES / "recipes" / "build.sbatch").read_text()
    asked = f"--quiet --candidates {CANDIDATES} --set unit_candidates={UNIT}"
    script = tmp_path / "build.sbatch"
    script.write_text(recipe.replace("--quiet", asked))
    env = {k: v for k, v in slurm.items() if k != "SBATCH_EXPORT"} | {
        "PATH": f"{Path(sys.executable).parent}:{slurm['PATH']}",
        "MESHES": str(meshes),
        "OUT": str(out),
        "SCHEDULER_HOST": "127.0.0.1",
    }
    flags = ["--wait", "--ntasks=2", "--mem-per-cpu=1G", "--time=20", f"--output={log}"]
    result = subprocess.run(["sbatch", *flags, script], env=env, cwd=PIPELINES.parent)
    assert result.returncode == 0, log.read_text()
    assert_same_dataset(built_here, out)
    assert not list(out.glob(".job-*"))
