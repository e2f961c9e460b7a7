"""`drakegrasp build` and `assemble` as a user sees them: what is refused changes nothing."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import trimesh
from distributed.security import Security
from helpers import datasets
from helpers.assertions import contents
from helpers.builds import start_build, workers_of
from helpers.commands import Result, run
from helpers.datasets import OTM, OTO, SLIP, TRIALS, make_dataset
from helpers.tiers import in_second_tier

from drakegrasp.dataset.lock import build_lock
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.rejections import AttemptKey, Decisions, write_decisions
from drakegrasp.dataset.successes import read_summary
from drakegrasp.errors import MachineError
from drakegrasp.generation.pipeline import Counts
from drakegrasp.outcomes import Outcome
from drakegrasp.runtime.progress import silent
from drakegrasp.simulation.trial import TrialRecord

FILES = (OTO, OTM, TRIALS)
#: Assembling gives the files their names, and last the manifest.
LAST = len(FILES)
#: A filter that would remove every sample.
SLIPPED = ("--set", f"filters.max_slip={SLIP / 2}")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("--reject reject.json", "must be a list of rejections of drakegrasp inspect"),
        ("--set filters.max_slip=-1", "must be greater than 0"),
        ("--set lift.hold_time=9", "verify can change, got one that changes what was simulated"),
        ("", "must be built by one process at a time"),
    ],
    ids=["reject", "value", "key", "beside a build"],
)
def test_refused_assemble_changes_nothing(
    out: Path, monkeypatch: pytest.MonkeyPatch, arguments: str, words: str
) -> None:
    """Neither the files nor the filters that the next build would use."""
    monkeypatch.chdir(out.parent)
    Path("reject.json").write_text("[]")
    with nullcontext() if arguments else build_lock(out):
        before = contents(out)
        result = run("assemble", out, *SLIPPED, *arguments.split())
        assert result.exit_code in (1, 2)
        assert words in result.stderr
        assert contents(out) == before


def test_assemble_says_which_rejections_had_no_effect(out: Path) -> None:
    """Of a success, of a failure, and of an object that is gone; the first counts."""
    path = out / "reject.json"
    success, failure = (AttemptKey("1_box_a", 0, standoff) for standoff in (0, 1))
    gone = AttemptKey("0_gone", 0, 0)
    write_decisions(path, Decisions(rejected=frozenset([success, failure, gone])))
    result = run("assemble", out, "--reject", path)
    assert result.exit_code == 0
    assert "skipped 2 of 3 rejections, which name no success" in result.stdout
    assert "0_gone, palm pose 0, stand-off 0; 1_box_a, palm pose 0, stand-off 1" in result.stdout
    assert read_manifest(out).rejected == (success,)
    assert f"{path}: rejections that were not used: 3" in run("assemble", out).stdout
    # A file that cannot be read is no matter of an assembly that does not use it.
    path.write_text("broken")
    assert run("assemble", out).exit_code == 0


#: Assembles copies of a dataset without samples, and dies when the file of the number that is the
#: copy's name should get its name.
DIE = """
import os, signal, sys
from pathlib import Path
import rich.progress
from drakegrasp.cli.main import main
from drakegrasp.dataset.assemble import assemble
rename, (setting, *copies) = os.replace, sys.argv[1:]
for copy in copies:
    left = int(Path(copy).name)
    def replace(old, new, **options):
        global left
        if Path(new).parent == Path(copy) and not Path(new).name.startswith("."):
            if not left:
                os.kill(os.getpid(), signal.SIGKILL)
            left -= 1
        rename(old, new, **options)
    child = os.fork()
    if not child:
        os.replace = replace
        main(["assemble", copy, "--set", setting])
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL
"""


#: The renames at which assembling is killed in the first tier, and the others.
FIRST = (0, 2, LAST)
OTHERS = tuple(k for k in range(LAST) if k not in FIRST)


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> Callable[[int], Path]:
    """Returns a dataset of one box whose assembling was killed at a rename. Read only."""

    @cache
    def kill(renames: tuple[int, ...]) -> Path:
        folder = tmp_path_factory.mktemp("killed")
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(datasets, "BOXES", dict([*datasets.BOXES.items()][:1]))
            whole = make_dataset(folder / "whole", folder / "meshes")
        copies = [shutil.copytree(whole, folder / str(k)) for k in renames]
        command = [sys.executable, "-c", DIE, SLIPPED[1], *map(str, copies)]
        subprocess.run(command, check=True, capture_output=True)
        return folder

    return lambda rename: kill(FIRST if rename in FIRST else OTHERS) / str(rename)


def samples(out: Path) -> list[int]:
    """Return the numbers of samples that the files and the filters of a dataset stand for."""
    counts = []
    for name in (OTO, OTM):
        with h5py.File(out / name) as file:
            counts.append(sum(len(file[split]["trial_id"]) for split in file))
    with h5py.File(out / TRIALS) as file:
        counts.append(int((file["successes/removal"][:] == 0).sum()))
    return [*counts, 0 if read_manifest(out).config.filters.max_slip == SLIP / 2 else 3]


@pytest.mark.parametrize("rename", [*FIRST, *map(in_second_tier, OTHERS)])
def test_files_are_of_one_state_or_told_whenever_assembling_is_killed(
    killed: Callable[[int], Path], tmp_path: Path, rename: int
) -> None:
    """The manifest is the last: while it is the old one, new files are told."""
    out = Path(shutil.copytree(killed(rename), tmp_path / "out"))
    stats = run("stats", out)
    assert stats.exit_code == (rename > 0)
    assert ("files must be those of manifest.json, got others" in stats.stderr) == (rename > 0)
    if rename == 0:
        assert samples(out) == [3] * 4
    else:
        result = run("check", out)
        assert result.exit_code == 1
        assert f"{TRIALS}: attribute signature must be that of manifest.json" in result.stdout

    # Assembling leaves files of one state, and nothing else.
    assert run("assemble", out).exit_code == 0
    assert samples(out) == [3] * 4
    assert run("check", out).exit_code == 0
    whole = ["manifest.json", "objects", "shards", *FILES]
    assert sorted(os.listdir(out)) == sorted(whole)


def _crash(*arguments: object) -> TrialRecord:
    setup, attempt = arguments[:2]
    return TrialRecord(
        outcome=Outcome.CRASHED, X_TO=setup.prepared.resting_poses[0], X_OG=attempt.X_OG
    )


@pytest.mark.sim
@pytest.mark.usefixtures("builds_here")
def test_crashes_that_no_physics_explains_end_the_build_with_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All attempts crash; the same command says so again, though it has nothing left to do."""
    monkeypatch.setattr("drakegrasp.generation.work_unit.try_attempt", _crash)
    (tmp_path / "meshes").mkdir()
    trimesh.creation.box([0.06, 0.05, 0.12]).export(tmp_path / "meshes" / "1_box.obj")
    few = ("--candidates", "3")
    for _ in range(2):
        result = run("build", "--objects", tmp_path / "meshes", "--out", tmp_path / "out", *few)
        assert result.exit_code == 1
        line = "1_box: 3 of 3 attempts crashed or timed out, which is no property of grasps."
        assert line in result.stderr


def test_few_crashes_are_no_error(sound: Path) -> None:
    manifest = read_manifest(sound)
    counts = Counts(manifest, None, None, silent)
    summary = read_summary(sound, next(manifest.headers()), manifest.config)
    for crashed, said in ((9, 0), (1, 1)):
        outcomes = {Outcome.SUCCESS: 100, Outcome.CRASHED: crashed}
        counts.add(replace(summary, outcomes=outcomes))
        assert len(counts.unexplained()) == said


def test_build_connects_with_the_certificates_that_it_is_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def connect(*_: Any, security: Security, **__: Any) -> None:
        assert security.require_encryption
        for key in ("tls_client_cert", "tls_client_key", "tls_ca_file"):
            assert getattr(security, key) == str(tmp_path / key.split("_")[-1])
        raise MachineError("connected")

    monkeypatch.setattr("drakegrasp.cluster.connect._RemoteClient", connect)
    (tmp_path / "meshes").mkdir()
    trimesh.creation.box([0.06, 0.05, 0.12]).export(tmp_path / "meshes" / "1_box.obj")
    build = ["build", "--objects", tmp_path / "meshes", "--out", tmp_path / "out"]
    build += ["--scheduler", "tls://10.0.0.1:8786"]
    for name, file in (("ca-file", "file"), ("cert", "cert"), ("key", "key")):
        (tmp_path / file).touch()
        build += [f"--tls-{name}", tmp_path / file]
        if name != "key":
            assert "must be given together" in run(*build).stderr
    result = run(*build)
    assert result.exit_code == 1 and "(connected)" in result.stderr


# What is known of a build beforehand.

EACH = ("--samples-per-object", "5")


def dry_run(out: Path, *words: str | Path) -> Result:
    return run("build", "--objects", "builtin", "--out", out, "--dry-run", *words)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            (),
            [
                "128 objects: until 20 samples of each, at most 1,280,000 palm poses in 160,000 "
                "work units"
            ],
        ),
        (
            ("--only", "1_mug_1", "--only", "1_mug_1", "--candidates", "101"),
            ["1 object: at most 101 palm poses in 13 work units"],
        ),
        (
            (*("--only", "1_mug_1", "--candidates", "100", "--samples", "7"), *EACH),
            [
                "1 object: until 7 samples or 5 samples of each, at most 100 palm poses in "
                "13 work units"
            ],
        ),
        (
            ("--only", "1_mug_1", "--candidates", "100", "--samples", "7"),
            ["1 object: until 7 samples, at most 100 palm poses in 13 work units"],
        ),
    ],
)
def test_dry_run_tells_the_most_work_and_writes_nothing(
    tmp_path: Path, words: tuple[str, ...], said: list[str]
) -> None:
    result = dry_run(tmp_path / "out", *words)
    assert (result.exit_code, result.stdout.splitlines(), result.stderr) == (0, said, "")
    assert not any(tmp_path.iterdir())


def test_dry_run_of_postures_counts_those_that_can_be_tried(tmp_path: Path) -> None:
    file, out = tmp_path / "palms.npz", tmp_path / "out"
    names = ["1_mug_1", "1_mug_2", "1_mug_1", "9_jar"]
    np.savez(file, object=names, position=[[0, 0, 0.2]] * 4, quaternion=[[1, 0, 0, 0]] * 4)
    assert dry_run(out, "--postures", file).stdout == "2 objects: 3 postures\n"
    assert dry_run(out, "--postures", file, "--only", "1_mug_1").stdout == "1 object: 2 postures\n"
    assert not out.exists()


@pytest.mark.nightly
@pytest.mark.cluster
@pytest.mark.slow
@pytest.mark.parametrize("seconds", [1.0, 0.5, 3.0])
def test_ctrl_c_while_workers_start_is_one_line(tmp_path: Path, seconds: float) -> None:
    """It reaches every process of the terminal, also those that have just begun."""
    (tmp_path / "meshes").mkdir()
    trimesh.creation.box([0.06, 0.05, 0.12]).export(tmp_path / "meshes" / "1_box.obj")
    process = start_build(tmp_path / "meshes", tmp_path / "out", 2, new_session=True)
    while not workers_of(process.pid):
        assert process.poll() is None
        time.sleep(0.05)
    time.sleep(seconds)
    os.killpg(process.pid, signal.SIGINT)
    said, errors = process.communicate(timeout=240)
    assert (process.returncode, said) == (130, "")
    assert errors == "stopped; the same command continues from here\n"
