"""Running an attempt again: what comes of it, and what it compares with."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import pytest

from drakegrasp.errors import DataError
from drakegrasp.page import recording as recording_module
from drakegrasp.page.recording import Recordings, Rerun

LABEL = "0123456789ab-0-0"


def test_a_replay_that_differs_is_told(out: Path) -> None:
    """The rows of the boxes were never simulated: the program finds others."""
    recordings = Recordings(out)
    try:
        found = recordings.make(LABEL, 0)
        assert not found.same
        assert found.text.startswith("trial 0 of 1_box_a: was success, is ")
        assert "time_close differs: " in found.text
        assert ".html" not in found.text
        content = recordings.read(LABEL)
        assert content is not None
        assert b"<html" in content[:1000].lower()
        assert recordings.make(LABEL, 0) is found
    finally:
        recordings.close()


@pytest.fixture
def commands(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """The commands that are run; each writes a recording and says that all is equal."""
    commands: list[list[str]] = []

    def run(command: list[str], **_: Any) -> subprocess.CompletedProcess[str]:
        commands.append(command)
        path = command[command.index("--html") + 1]
        Path(path).write_text("<html>")
        text = f"trial 7 of a: was success, is success\n{path}\n"
        return subprocess.CompletedProcess(command, 0, text, "")

    monkeypatch.setattr(recording_module.subprocess, "run", run)
    return commands


def test_a_replay_that_is_equal_is_told(tmp_path: Path, commands: list[list[str]]) -> None:
    recordings = Recordings(tmp_path)
    found = recordings.make(LABEL, 7)
    recordings.close()
    assert found == Rerun(same=True, text="trial 7 of a: was success, is success")


def test_the_current_folder_gives_no_modules(tmp_path: Path, commands: list[list[str]]) -> None:
    recordings = Recordings(Path("-out"))
    recordings.make(LABEL, 7)
    recordings.close()
    (command,) = commands
    assert "-P" in command[: command.index("-c")]
    # Nor is the name of the directory taken for an option.
    assert command[-2:] == ["--", "-out"]


def test_what_cannot_run_is_one_line(tmp_path: Path) -> None:
    recordings = Recordings(tmp_path)
    try:
        with pytest.raises(DataError, match=r"trial 7 cannot be run again: error: .*must be"):
            recordings.make(LABEL, 7)
        assert recordings.read(LABEL) is None
    finally:
        recordings.close()
