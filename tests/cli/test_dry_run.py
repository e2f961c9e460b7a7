"""`build --dry-run`: what is known of a build beforehand, and nothing else."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.commands import Result, error_line, run


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


@pytest.mark.parametrize(
    ("words", "must"),
    [
        (("--only", "1_jug_1"), "only must be names of objects"),
        (("--set", "candidates.postures=0123456789abcdef"), "candidates.postures must be"),
    ],
)
def test_dry_run_refuses_what_a_build_refuses(
    tmp_path: Path, words: tuple[str, ...], must: str
) -> None:
    result = dry_run(tmp_path / "out", *words)
    assert (result.exit_code, result.stdout) == (2, "")
    assert must in error_line(result)
    assert not any(tmp_path.iterdir())
