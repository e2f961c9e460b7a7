"""Decisions of several pages and servers in one file, and attempts that are run again."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from drakegrasp.dataset.rejections import AttemptKey, read_decisions
from drakegrasp.errors import DataError
from drakegrasp.page import actions
from drakegrasp.page.actions import LOCK_NAME, DecisionFile, Recordings, Rerun, Step

A, B = AttemptKey("1_box_a", 0, 0), AttemptKey("3_brick", 1, 0)
#: Many decisions of one process.
DECIDE = """
import sys
from pathlib import Path
from drakegrasp.dataset.rejections import AttemptKey
from drakegrasp.page.actions import DecisionFile
out, name = Path(sys.argv[1]), sys.argv[2]
file = DecisionFile(out)
for i in range(60):
    file.decide(AttemptKey(name, i, 0), "rejected")
"""


def test_two_servers_lose_no_decision(tmp_path: Path) -> None:
    commands = [[sys.executable, "-c", DECIDE, str(tmp_path), name] for name in "ab"]
    processes = [subprocess.Popen(command) for command in commands]
    assert [process.wait(timeout=120.0) for process in processes] == [0, 0]
    assert len(read_decisions(tmp_path / "reject.json").rejected) == 120
    assert [path.name for path in tmp_path.iterdir()] == ["reject.json"]


def test_the_last_decision_is_undone_once(tmp_path: Path) -> None:
    file = DecisionFile(tmp_path)
    assert file.undo() is None
    for key in (B, A, A):  # an equal decision is none
        file.decide(key, "rejected")
    assert file.undo() == Step(A, "", "rejected")
    assert file.undo() is None
    assert file.read().rejected == {B}


def test_undo_leaves_what_another_server_decided_since(tmp_path: Path) -> None:
    ours, theirs = DecisionFile(tmp_path), DecisionFile(tmp_path)
    ours.decide(A, "rejected")
    theirs.decide(A, "kept")
    assert ours.undo() is None
    assert ours.read().of(A) == "kept"


def test_a_lock_that_stays_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(actions, "PATIENCE", 0.1)
    file = DecisionFile(tmp_path)
    held = actions._held(tmp_path / LOCK_NAME)
    with held, pytest.raises(DataError, match="must be held for a moment only"):
        file.decide(A, "rejected")
    file.decide(A, "rejected")


def test_a_lock_file_that_a_dead_server_left_is_taken(tmp_path: Path) -> None:
    (tmp_path / LOCK_NAME).touch()
    DecisionFile(tmp_path).decide(A, "rejected")
    assert not (tmp_path / LOCK_NAME).exists()


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

    monkeypatch.setattr(actions.subprocess, "run", run)
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
