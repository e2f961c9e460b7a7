"""Decisions of several pages and servers in one file."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from drakegrasp.dataset.rejections import AttemptKey, read_decisions
from drakegrasp.errors import DataError
from drakegrasp.page import decisions as decisions_module
from drakegrasp.page.decisions import LOCK_NAME, DecisionFile, Undo

A, B = AttemptKey("1_box_a", 0, 0), AttemptKey("3_brick", 1, 0)
#: Many decisions of one process.
DECIDE = """
import sys
from pathlib import Path
from drakegrasp.dataset.rejections import AttemptKey
from drakegrasp.page.decisions import DecisionFile
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


def test_undo_leaves_what_another_server_decided_since(tmp_path: Path) -> None:
    ours, theirs = DecisionFile(tmp_path), DecisionFile(tmp_path)
    ours.decide(B, "kept")
    ours.decide(A, "rejected")
    theirs.decide(A, "kept")
    assert ours.undo() == Undo(A, "kept", done=False)
    assert ours.read().of(A) == "kept"
    # The decision before is still undone.
    assert ours.undo() == Undo(B, "", done=True)
    assert ours.undo() is None


def test_an_equal_decision_is_nothing_to_undo(tmp_path: Path) -> None:
    file = DecisionFile(tmp_path)
    file.decide(A, "rejected")
    file.decide(A, "rejected")
    assert file.undo() == Undo(A, "", done=True)
    assert file.read().of(A) == ""
    assert file.undo() is None


def test_each_page_undoes_its_own(tmp_path: Path) -> None:
    file = DecisionFile(tmp_path)
    file.decide(A, "rejected", "first")
    file.decide(B, "rejected", "second")
    assert file.undo("third") is None
    assert file.undo("first") == Undo(A, "", done=True)
    assert file.read().rejected == {B}


def test_few_pages_are_remembered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(decisions_module, "KEPT_PAGES", 2)
    file = DecisionFile(tmp_path)
    for page in ("first", "second", "third"):
        file.decide(A, "rejected" if page == "second" else "kept", page)
    assert file.undo("first") is None


def test_a_lock_that_stays_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(decisions_module, "PATIENCE", 0.1)
    file = DecisionFile(tmp_path)
    held = decisions_module._held(tmp_path / LOCK_NAME)
    with held, pytest.raises(DataError, match="must be held for a moment only"):
        file.decide(A, "rejected")
    file.decide(A, "rejected")


def test_a_lock_file_that_a_dead_server_left_is_taken(tmp_path: Path) -> None:
    (tmp_path / LOCK_NAME).touch()
    DecisionFile(tmp_path).decide(A, "rejected")
    assert not (tmp_path / LOCK_NAME).exists()
