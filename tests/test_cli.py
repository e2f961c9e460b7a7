"""The command line as a user sees it: output, one-line errors, exit codes."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from click.testing import CliRunner, Result

from drakegrasp.cli import main


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(main, [str(a) for a in arguments])


def error_line(result: Result) -> str:
    lines = [line for line in result.stderr.splitlines() if line.startswith("error: ")]
    assert len(lines) == 1, result.stderr
    return lines[0]


def test_help_names_every_command() -> None:
    result = run("--help")
    assert result.exit_code == 0
    for command in ("doctor", "objects", "audit", "build", "assemble", "check", "stats", "replay"):
        assert command in result.stdout


def test_help_answers_without_loading_the_simulator() -> None:
    code = (
        "import sys; from drakegrasp.cli import main; main(['--help'], standalone_mode=False); "
        "assert not {'pydrake', 'dask', 'trimesh', 'h5py'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


def test_wrong_usage_is_exit_code_two() -> None:
    assert run("build").exit_code == 2
    assert run("fly").exit_code == 2


def test_objects_are_listed_and_exported(tmp_path: Path) -> None:
    listed = run("objects", "list").stdout.splitlines()
    assert len(listed) >= 24
    assert len({line.split()[1] for line in listed}) >= 12
    assert run("objects", "export", tmp_path / "meshes").exit_code == 0
    assert len(list((tmp_path / "meshes").glob("*.obj"))) == len(listed)


def _empty_directory(folder: Path) -> None:
    pass


def _text(folder: Path) -> None:
    (folder / "1_text_a.obj").write_text("Dear mesh, where are your faces?\n")


def _no_bytes(folder: Path) -> None:
    (folder / "1_empty_a.obj").write_bytes(b"")


def _flat(folder: Path) -> None:
    (folder / "1_flat_a.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3\nf 1 3 4\n")


def _nan(folder: Path) -> None:
    (folder / "1_nan_a.obj").write_text(
        "v 0 0 0\nv nan 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 2 3\nf 1 2 4\n"
    )


def _huge(folder: Path) -> None:
    trimesh.creation.box([5.0, 5.0, 5.0]).export(folder / "1_huge_a.obj")


@pytest.mark.sim
@pytest.mark.cluster
@pytest.mark.parametrize(
    ("make", "words"),
    [
        (_empty_directory, "mesh"),
        (_text, "1_text_a"),
        (_no_bytes, "1_empty_a"),
        (_flat, "1_flat_a"),
        (_nan, "1_nan_a"),
        (_huge, "--units"),
    ],
)
def test_bad_meshes_are_one_line_and_leave_nothing(tmp_path: Path, make, words: str) -> None:
    meshes, out = tmp_path / "meshes", tmp_path / "out"
    meshes.mkdir()
    make(meshes)
    result = run("build", "--objects", meshes, "--out", out, "--workers", "1", "--quiet")
    assert result.exit_code in (1, 2)
    assert words in error_line(result)
    assert not out.exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--set", "lift.speed=1"], "lift.speed: must be a known key"),
        (["--set", "camera.near=2"], "near must be less than far"),
        (["--set", "objects.mass=-1"], "objects.mass: must be greater than 0, got -1"),
        (
            ["--set", "candidates.standoffs=[]"],
            "candidates.standoffs: must be a list of at least 1",
        ),
        (["--config", "nowhere.yaml"], "nowhere.yaml"),
        (["--units", "inch"], "inch"),
        (["--candidates", "0"], "candidates.max: must be greater than or equal to 1, got 0"),
        (["--set", "hand=octopus"], "octopus"),
    ],
)
def test_bad_options_are_one_line_and_leave_nothing(
    tmp_path: Path, arguments: list[str], words: str
) -> None:
    trimesh.creation.box([0.05, 0.06, 0.07]).export(tmp_path / "1_box_a.obj")
    out = tmp_path / "out"
    result = run(
        "build", "--objects", tmp_path, "--out", out, "--workers", "1", "--quiet", *arguments
    )
    assert result.exit_code == 2
    assert words in error_line(result)
    assert not out.exists()


@pytest.mark.sim
@pytest.mark.slow
@pytest.mark.cluster
def test_build_reports_and_says_when_nothing_is_left_to_do(
    small_meshes: Path, tmp_path: Path
) -> None:
    command = ["build", "--objects", small_meshes, "--out", tmp_path / "out", "--workers", "1"]
    command += ["--candidates", "4", "--quiet"]
    first = run(*command)
    assert first.exit_code == 0, first.output
    assert "3 work units simulated" in first.stdout
    assert "grasping_oto.hdf5" in first.stdout
    second = run(*command)
    assert "all 3 work units had been done before: nothing was simulated" in second.stdout
    refused = run(*command, "--seed", "1")
    assert refused.exit_code == 1
    assert "differs in seed" in error_line(refused)


@pytest.mark.sim
@pytest.mark.slow
def test_check_stats_and_replay_speak_of_a_dataset(small_dataset: Path) -> None:
    assert "no broken invariants" in run("check", small_dataset).stdout
    stats = run("stats", small_dataset).stdout
    assert "8_wineglass_flute" in stats
    assert "Samples by split" in stats
    again = run("replay", small_dataset, "--trial", "0")
    assert again.exit_code == 0
    assert "trial 0 of 10_box_tall: was" in again.stdout
    assert run("replay", small_dataset, "--trial", "100000").exit_code == 1


@pytest.mark.sim
@pytest.mark.slow
def test_check_fails_on_a_broken_file(small_dataset: Path, tmp_path: Path) -> None:
    import h5py

    path = tmp_path / "grasping_oto.hdf5"
    path.write_bytes((small_dataset / path.name).read_bytes())
    with h5py.File(path, "r+") as file:
        file["test/grasps"][0, 9:12] *= np.float32(2.0)
    result = run("check", path)
    assert result.exit_code == 1
    assert "/test row 0" in result.stdout


def test_commands_refuse_what_is_no_dataset(tmp_path: Path) -> None:
    for command in ("stats", "check", "assemble"):
        result = run(command, tmp_path)
        assert result.exit_code == 1
        assert str(tmp_path) in error_line(result)


def test_audit_lists_what_would_be_refused(tmp_path: Path) -> None:
    trimesh.creation.box([0.05, 0.06, 0.07]).export(tmp_path / "1_box_a.obj")
    _text(tmp_path)
    result = run("audit", tmp_path)
    assert result.exit_code == 0
    assert "fit" in result.stdout
    assert "refused" in result.stdout


def test_module_runs_as_a_program() -> None:
    """The console script of the package is there and starts."""
    script = Path(sys.executable).with_name("drakegrasp")
    result = subprocess.run(
        [script, "--version"], capture_output=True, text=True, check=True, env=os.environ
    )
    assert result.stdout.startswith("drakegrasp, version ")
