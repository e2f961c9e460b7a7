"""The examples of the docs are a course: each runs, is short, and has its place in the gallery."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import example_gallery
import pytest

import drakegrasp

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = example_gallery.read_examples()
PAGE = ROOT / "docs" / "examples" / "index.md"
#: Lines of an example.
LINES = 60


def test_gallery_is_what_the_scripts_say(tmp_path: Path) -> None:
    assert example_gallery.main(["--check", str(PAGE)]) == 0
    stale = tmp_path / "index.md"
    stale.write_text(PAGE.read_text(encoding="utf-8").replace("Concepts", "Ideas"))
    assert example_gallery.main(["--check", str(stale)]) == 1


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda example: example.path.stem)
def test_an_example_is_short_and_has_a_picture(example: example_gallery.Example) -> None:
    assert len(example.path.read_text(encoding="utf-8").splitlines()) < LINES
    assert (ROOT / "docs" / "images" / example.picture).read_bytes().startswith(b"\x89PNG")


@pytest.mark.nightly
@pytest.mark.sim
@pytest.mark.slow
@pytest.mark.cluster
def test_the_course_runs_in_order(tmp_path: Path) -> None:
    """As a reader runs it: each script in a process of its own, all in one folder."""
    package = str(Path(drakegrasp.__file__).parents[1])
    paths = (package, *filter(None, [os.environ.get("PYTHONPATH")]))
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "MPLBACKEND": "agg"}
    for example in EXAMPLES:
        done = subprocess.run(
            [sys.executable, example.path],
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, f"{example.path.name}: {done.stderr}"
        assert done.stdout, example.path.name
        picture = tmp_path / "example" / f"{example.path.stem}.png"
        assert picture.read_bytes().startswith(b"\x89PNG")
        # A picture that is all of one colour would compress to less.
        assert picture.stat().st_size > 5_000
