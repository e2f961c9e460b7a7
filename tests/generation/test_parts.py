"""A build in parts, by jobs that do not know of each other, is the build in one go."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest
from helpers.builds import build
from helpers.commands import error_line, run
from helpers.datasets import make_dataset
from helpers.meshes import write_fixed

from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.paths import ASSEMBLED_FILES
from drakegrasp.errors import ConfigError, DataError
from drakegrasp.generation.build_config import build_config
from drakegrasp.generation.merge import merge
from drakegrasp.generation.request import Part, read_part
from drakegrasp.generation.work_unit import run_unit
from drakegrasp.hand.settings import load_config
from drakegrasp.objects.sources import find_meshes
from drakegrasp.runtime.executor import run_here

#: One box, four work units of two palm poses, small images.
TINY = [
    *("candidates.max=8", "unit_candidates=2", "camera.size=32", "candidates.standoffs=[0.02]"),
    "filters.min_depth_variance=0",
]


def content(out: Path) -> dict[str, bytes]:
    """Return the files of a dataset."""
    files = (path for path in out.rglob("*") if path.is_file())
    return {path.relative_to(out).as_posix(): path.read_bytes() for path in files}


@pytest.mark.nightly
@pytest.mark.sim
def test_parts_that_are_merged_are_the_build_in_one_go(tmp_path: Path) -> None:
    write_fixed(tmp_path / "meshes", "10_box_tall")
    sources, config = find_meshes(tmp_path / "meshes"), load_config("paper", TINY)
    whole = build(sources, tmp_path / "whole", config, run_here, show=False)
    assert whole.simulated == 4

    # Each in a directory of its own.
    outs = [tmp_path / "a", tmp_path / "b", tmp_path / "c"]
    for number, out in enumerate(outs, start=1):
        report = build(sources, out, config, run_here, part=Part(number, 3), show=False)
        assert (report.simulated, report.assembly) == ((2, 1, 1)[number - 1], None)
        assert not any((out / name).exists() for name in ASSEMBLED_FILES)
    merge(tmp_path / "merged", outs)
    assert content(tmp_path / "merged") == content(tmp_path / "whole")

    # One after the other in one directory: the last one writes the files.
    for number, simulated in ((2, 1), (3, 1)):
        report = build(sources, outs[0], config, run_here, part=Part(number, 3), show=False)
        assert report.simulated == simulated
    assert report.assembly == whole.assembly
    assert content(outs[0]) == content(tmp_path / "whole")


def part_of(whole: Path, out: Path, part: Part) -> Path:
    """Return what a build of a part leaves of a dataset."""
    shutil.copytree(whole, out)
    for unit, header in enumerate(read_manifest(out).headers()):
        if not part.has(unit):
            header.path(out).unlink()
    for name in ASSEMBLED_FILES:
        (out / name).unlink()
    return out


def test_part_does_its_units_and_the_last_one_writes_the_files(tmp_path: Path) -> None:
    """The shards of the units are those of the whole dataset: nothing is simulated."""
    whole = make_dataset(tmp_path / "whole", tmp_path / "meshes")
    manifest = read_manifest(whole)
    headers = list(manifest.headers())
    out = part_of(whole, tmp_path / "out", Part(3, 3))
    done: list[int] = []

    def execute(function: Any, tasks: Iterable[Any]) -> Iterator[Any]:
        for task in tasks:
            if function is run_unit:
                done.append(headers.index(task.header))
                shutil.copy(task.header.path(whole), task.header.path(out))
            yield from run_here(function, [task])

    sources = find_meshes(tmp_path / "meshes")
    for number in (1, 2):
        done.clear()
        report = build(sources, out, manifest.config, execute, part=Part(number, 3), show=False)
        assert done == [unit for unit in range(len(headers)) if unit % 3 == number - 1] != []
        assert (report.assembly is None) == (number == 1)
        left = [notice for notice in report.notices if "of other parts left" in notice]
        assert len(left) == (number == 1)
    build(sources, whole, manifest.config, run_here, show=False)
    assert content(out) == content(whole)


def test_parts_are_refused_where_one_is_missing(tmp_path: Path) -> None:
    whole = make_dataset(tmp_path / "whole", tmp_path / "meshes")
    outs = [part_of(whole, tmp_path / f"{i}", Part(i, 3)) for i in (1, 2, 3)]
    with pytest.raises(DataError, match=r"given with all other parts of its build, got none that"):
        merge(tmp_path / "into", outs[:2])
    assert not (tmp_path / "into").exists()
    merge(tmp_path / "into", outs)
    for name in ASSEMBLED_FILES:
        assert (tmp_path / "into" / name).read_bytes() == (whole / name).read_bytes()


@pytest.mark.parametrize("text", ["", "0/4", "5/4", "1", "1/0", "-1/4", "1/4/2", "a/b"])
def test_what_is_no_part_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match=r"part must be I/N, with I from 1 to N, got"):
        read_part(text)


def test_what_is_no_part_is_one_line_of_the_command(tmp_path: Path) -> None:
    words = ["build", "--objects", "builtin", "--out", str(tmp_path / "out"), "--part", "5/4"]
    assert "part must be I/N" in error_line(run(*words))
    assert not (tmp_path / "out").exists()


def test_each_unit_is_of_one_part() -> None:
    assert [[i for i in range(7) if Part(k, 3).has(i)] for k in (1, 2, 3)] == [
        [0, 3, 6],
        [1, 4],
        [2, 5],
    ]


def test_a_number_of_samples_has_no_parts(tmp_path: Path) -> None:
    build_config(load_config("paper", ["samples=5"]))
    with pytest.raises(ConfigError, match="part must be of a build with a number of palm poses"):
        build_config(load_config("paper", ["samples=5"]), part=Part(1, 2))
