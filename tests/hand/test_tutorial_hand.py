"""The hand of docs/how-to/add-a-hand.md is complete, and does what the page says."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from helpers.commands import run
from helpers.hands import PAGE as PATH
from helpers.hands import write_tongs
from helpers.machine import needs_egl

from drakegrasp import hand_setup
from drakegrasp.hand.file_format import Coupling, Finger, HandFile, Palm, Spread

PAGE = PATH.read_text()


@pytest.fixture
def tongs(tmp_path: Path) -> Path:
    """The files of the page."""
    return write_tongs(tmp_path)


@pytest.mark.sim
@pytest.mark.slow
@needs_egl
def test_the_tutorial_hand_passes_every_check_of_the_page(tongs: Path) -> None:
    picture = tongs.parent / "tongs.png"
    result = run("hand", "check", str(tongs), "--picture", str(picture))
    assert result.exit_code == 0, result.output
    lines = [line.split(None, 1)[1] for line in result.output.splitlines()[:-1]]
    assert lines[0] == "files                2 fingers, 4 joints, 5 shapes in tongs.urdf"
    table = PAGE[PAGE.index("| check | what") : PAGE.index("The picture shows the hand")]
    names = re.findall(r"^\| ([a-z].*?) \|", table, re.MULTILINE)[1:]
    assert [re.split(r"  +", line)[0] for line in lines] == [*names[:-1], *GRASPS]
    assert picture.read_bytes().startswith(b"\x89PNG")


GRASPS = [f"{shape}, {line}" for shape, line in hand_setup.GRASPS]


def test_a_fault_ends_the_command_with_one(tongs: Path) -> None:
    tongs.write_text(tongs.read_text().replace("left_tip ", "left_nail "))
    result = run("hand", "check", str(tongs))
    assert result.exit_code == 1
    assert result.output.startswith("FAIL  files")


def test_the_page_has_every_key_of_a_hand_file() -> None:
    """And no other."""
    rows = re.findall(r"^\| (`[^|]*) \|", PAGE[: PAGE.index("## 3.")], re.MULTILINE)
    named = {key.split(".")[0] for row in rows for key in re.findall(r"`([\w.\[\]]+)`", row)}
    fingers = {
        key
        for row in rows
        if "fingers[]" in row
        for key in re.findall(r"`(?:fingers\[\]\.)?(\w+)`", row)
    }
    top = {key for key in named if "[" not in key} - fingers
    assert top == set(HandFile.model_fields)
    assert fingers == set(Finger.__dataclass_fields__)
    assert all(key in PAGE for key in (*Coupling.__dataclass_fields__, *Spread.model_fields))
    assert all(f"palm.{key}" in PAGE for key in Palm.model_fields)
