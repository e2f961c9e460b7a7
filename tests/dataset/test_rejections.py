"""Decisions of an inspection: their file, and what assembly makes of it."""

from __future__ import annotations

from pathlib import Path

import pytest

from drakegrasp.dataset.assemble import assemble
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.rejections import (
    AttemptKey,
    Decisions,
    read_decisions,
    unused_rejections,
    write_decisions,
)
from drakegrasp.filters import Removal

A, B = AttemptKey("1_box_a", 0, 0), AttemptKey("3_brick", 1, 0)


def test_decisions_are_read_as_they_were_written(tmp_path: Path) -> None:
    path = tmp_path / "reject.json"
    assert read_decisions(path) == Decisions()
    decisions = Decisions().with_decision(B, "rejected").with_decision(A, "kept")
    write_decisions(path, decisions)
    assert read_decisions(path) == decisions
    assert read_decisions(path).rejected == {B}
    assert [p.name for p in tmp_path.iterdir()] == ["reject.json"]


def test_a_decision_replaces_the_one_before() -> None:
    rejected = Decisions().with_decision(A, "rejected")
    assert rejected.of(A) == "rejected"
    assert rejected.with_decision(A, "kept") == Decisions(kept=frozenset([A]))
    assert rejected.with_decision(A, "") == Decisions()
    assert rejected.of(B) == ""
    with pytest.raises(ValueError, match="decision must be rejected, kept or empty, got 'no'"):
        rejected.with_decision(A, "no")


def test_keys_that_are_no_success_are_left_out(out: Path) -> None:
    """Of a failure, and of an object that is gone: the others count."""
    failure, gone = AttemptKey("1_box_a", 0, 1), AttemptKey("0_gone", 0, 0)
    path = out / "reject.json"
    write_decisions(path, Decisions(rejected=frozenset([A, failure, gone])))
    given = sorted(read_decisions(path).rejected)
    assert assemble(out, rejected=given).removed == {Removal.KEPT: 8, Removal.REJECTED: 1}
    used = read_manifest(out).rejected
    assert used == (A,)
    (sentence,) = unused_rejections(out, given, used)
    assert sentence.startswith("skipped 2 of 3 rejections")
    assert "0_gone, palm pose 0, stand-off 0; 1_box_a, palm pose 0, stand-off 1" in sentence


def test_rejections_that_nobody_asked_for_are_named(tmp_path: Path) -> None:
    path = tmp_path / "reject.json"
    write_decisions(path, Decisions(rejected=frozenset([A, B])))
    for given in ([], [0]):
        (sentence,) = unused_rejections(tmp_path, given, [A])
        assert "not used: 1; --reject" in sentence
    assert unused_rejections(tmp_path, [A, B], [A, B]) == []
    assert unused_rejections(tmp_path, [], [A, B]) == []
    # A file that cannot be read is no matter of an assembly that does not use it.
    path.write_text("broken")
    assert unused_rejections(tmp_path, [], []) == []
