"""`drakegrasp build` and `assemble` as a user sees them: what is refused changes nothing."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from helpers.datasets import SLIP, make_dataset

from drakegrasp.cli.main import main
from drakegrasp.dataset.lock import build_lock
from drakegrasp.dataset.manifest import read_manifest

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
