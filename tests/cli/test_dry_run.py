"""`build --dry-run`: what is known of a build beforehand, and nothing else."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.commands import Result, error_line, run
from helpers.datasets import OTM, OTO, make_dataset

from drakegrasp.dataset.manifest import read_manifest


def dry_run(out: Path, *words: str | Path) -> Result:
    return run("build", "--objects", "builtin", "--out", out, "--dry-run", *words)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            (),
            [
                "128 objects: until 20 samples of each, at most 10,000 palm poses of each",
                "images of 2,560 samples: 1,426.1 MB before compression",
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


@pytest.mark.parametrize(
    ("wanted", "samples"),
    [
        (("--samples", "3000"), 3000),
        (("--samples-per-object", "500"), 1000),
        (("--samples", "3000", "--samples-per-object", "500"), 1000),
    ],
)
def test_size_of_images_is_that_of_a_dataset(
    tmp_path: Path, wanted: tuple[str, ...], samples: int
) -> None:
    out = make_dataset(tmp_path / "out", tmp_path / "meshes")
    size, rows = 0, 0
    for name in (OTO, OTM):
        with h5py.File(out / name) as file:
            for split in file.values():
                size += sum(split[images].nbytes for images in ("images", "masks"))
                rows += len(split["images"])
    per_sample = size / (rows / 2)
    side = read_manifest(out).config.camera.size

    words = ("--only", "1_mug_1", "--only", "1_mug_2", "--set", f"camera.size={side}", *wanted)
    line = dry_run(tmp_path / "new", *words).stdout.splitlines()[-1]
    expected = f"{samples * per_sample / 1e6:,.1f} MB before compression"
    assert line == f"images of {samples:,} samples: {expected}"


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
