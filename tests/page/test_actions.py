"""Decisions of a person, in one file, and how the last is undone."""

from __future__ import annotations

from pathlib import Path

from drakegrasp.dataset.rejections import AttemptKey, Decisions, write_decisions
from drakegrasp.page.app import DecisionFile, Step

A, B = AttemptKey("1_box_a", 0, 0), AttemptKey("3_brick", 1, 0)


def test_the_last_decision_is_undone_once(tmp_path: Path) -> None:
    file = DecisionFile(tmp_path)
    assert file.undo() is None
    for key in (B, A, A):  # an equal decision is none
        file.decide(key, "rejected")
    assert file.undo() == Step(A, "", "rejected")
    assert file.undo() is None
    assert file.read().rejected == {B}


def test_what_stands_in_the_file_otherwise_stays(tmp_path: Path) -> None:
    """Decisions of another server since are neither lost nor undone."""
    ours, theirs = DecisionFile(tmp_path), DecisionFile(tmp_path)
    ours.decide(A, "rejected")
    theirs.decide(B, "rejected")
    theirs.decide(A, "")
    assert ours.undo() is None
    assert ours.read().rejected == {B}


def test_attempts_that_a_file_keeps_are_written_again(tmp_path: Path) -> None:
    write_decisions(tmp_path / "reject.json", Decisions(kept=frozenset([B])))
    assert DecisionFile(tmp_path).decide(A, "rejected").kept == {B}
