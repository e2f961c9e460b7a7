"""`drakegrasp build` and `assemble` as a user sees them: what is refused changes nothing."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import h5py
import pytest
from click.testing import CliRunner, Result
from helpers.datasets import OTM, OTO, SLIP, TRIALS, make_dataset

from drakegrasp.cli.main import main
from drakegrasp.dataset.lock import build_lock
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.errors import DataError
from drakegrasp.runtime import file_set

FILES = (OTO, OTM, TRIALS)
#: A filter that would remove every sample.
SLIPPED = ("--set", f"filters.max_slip={SLIP / 2}")


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(main, [str(a) for a in arguments])


def state(out: Path) -> dict[str, bytes]:
    """Return the files of a dataset's directory by their names, and of no folder."""
    return {path.name: path.read_bytes() for path in out.iterdir() if path.is_file()}


@pytest.fixture
def out(tmp_path: Path) -> Path:
    (tmp_path / "meshes").mkdir()
    return make_dataset(tmp_path / "out", tmp_path / "meshes")


def _cut_shard(out: Path) -> None:
    path = sorted(out.glob("shards/*/*.h5"))[-1]
    path.write_bytes(path.read_bytes()[:-100])


def _nothing(out: Path) -> None:
    pass


@pytest.mark.parametrize(
    ("spoil", "arguments", "words"),
    [
        (_nothing, ["--reject", "ids.txt"], "rejected trials must be successes, got trial 1"),
        (_cut_shard, [], "damaged or cut off"),
        (_nothing, ["--set", "filters.max_slip=-1"], "must be greater than 0"),
        (_nothing, ["--set", "lift.hold_time=9"], "values of filters and split only"),
    ],
    ids=["reject", "shard", "value", "key"],
)
def test_refused_assemble_changes_nothing(
    out: Path,
    monkeypatch: pytest.MonkeyPatch,
    spoil: Callable[[Path], None],
    arguments: list[str],
    words: str,
) -> None:
    """Neither the files nor the filters that the next build would use."""
    monkeypatch.chdir(out.parent)
    Path("ids.txt").write_text("1\n")
    spoil(out)
    before = state(out)
    result = run("assemble", out, *SLIPPED, *arguments)
    assert result.exit_code in (1, 2)
    assert words in result.stderr
    assert state(out) == before


def test_assemble_beside_a_build_does_not_change_its_filters(out: Path) -> None:
    with build_lock(out):
        before = state(out)
        result = run("assemble", out, *SLIPPED)
        assert result.exit_code == 1
        assert "must be built by one process at a time" in result.stderr
        assert state(out) == before


def test_assemble_that_works_keeps_its_filters(out: Path) -> None:
    assert run("assemble", out, *SLIPPED).exit_code == 0
    assert read_manifest(out).config.filters.max_slip == SLIP / 2


#: Assembles without samples, and dies at one of the renames.
DIE = """
import os, signal, sys
from drakegrasp.cli.main import main
rename, left = os.replace, int(sys.argv[1])
def replace(*names, **options):
    global left
    if not left:
        os.kill(os.getpid(), signal.SIGKILL)
    left -= 1
    rename(*names, **options)
os.replace = replace
main(sys.argv[2:])
"""


def die_at(rename: int, *arguments: str | Path) -> None:
    """Run a command that is killed at one of its renames."""
    command = [sys.executable, "-c", DIE, str(rename), *map(str, arguments)]
    assert subprocess.run(command, capture_output=True).returncode == -signal.SIGKILL


def samples(out: Path) -> list[int]:
    """Return the numbers of samples that the files and the filters of a dataset stand for."""
    counts = []
    for name in (OTO, OTM):
        with h5py.File(out / name) as file:
            counts.append(sum(len(file[split]["trial_id"]) for split in file))
    with h5py.File(out / TRIALS) as file:
        counts.append(int((file["successes/removal"][:] == 0).sum()))
    return [*counts, 0 if read_manifest(out).config.filters.max_slip == SLIP / 2 else 9]


@pytest.mark.parametrize("command", ["stats", "check", "assemble"])
@pytest.mark.parametrize("rename", range(5))
def test_files_appear_together_whenever_assembling_is_killed(
    out: Path, rename: int, command: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A reader refuses what is half done, and the next command completes it."""
    monkeypatch.setattr(file_set, "PATIENCE", 0.1)
    before = samples(out)
    die_at(rename, "assemble", out, *SLIPPED)

    # Before the list of new files has its name (the first rename), the old files count.
    if rename:
        with pytest.raises(DataError, match=r"drakegrasp stats .* completes this"):
            GraspDataset(out / OTO)
    else:
        assert samples(out) == before == [9] * 4

    # The next command leaves files of one state, and nothing else.
    assert run(command, out).exit_code == 0
    assert samples(out) == ([0] * 4 if rename else before)
    assert sorted(os.listdir(out)) == sorted(["manifest.json", "objects", "shards", *FILES])


def test_files_of_two_states_are_a_finding(out: Path) -> None:
    old = (out / OTM).read_bytes()
    assert run("assemble", out, *SLIPPED).exit_code == 0
    assert run("check", out).exit_code == 0
    (out / OTM).write_bytes(old)
    result = run("check", out)
    assert result.exit_code == 1
    assert "the three files must be of one assembly" in result.stdout
