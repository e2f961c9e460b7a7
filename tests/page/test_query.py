"""Filters and order: each filter chooses by its own column, in the units that are shown."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from urllib.parse import parse_qsl

import numpy as np
import pytest
from helpers.pages import numbered

from drakegrasp.dataset.rejections import AttemptKey, Decisions
from drakegrasp.dataset.trials import NONE
from drakegrasp.errors import DataError
from drakegrasp.page.attempts import Attempts
from drakegrasp.page.snapshot import Snapshot, read_snapshot

NOTHING = Decisions()


@pytest.fixture
def snapshot(boxes: Path) -> Snapshot:
    return read_snapshot(boxes)


def chosen(snapshot: Snapshot, text: str, decisions: Decisions = NOTHING) -> list[str]:
    places = Attempts(snapshot, decisions).select(Attempts.query(dict(parse_qsl(text))))
    return [numbered(snapshot, str(i)) for i in places]


@pytest.mark.parametrize(
    ("text", "labels"),
    [
        ("outcome=slipped", ["0-1-1", "1-1-1", "2-1-1"]),
        ("object=2_box_b", ["1-0-0", "1-1-0", "1-3-2"]),
        ("class=brick", ["2-0-0", "2-1-0", "2-3-2"]),
        ("class=brick&object=2_box_b", []),
        ("object=nothing", []),
        ("split=none", []),
        ("removal=other_links", []),
    ],
)
def test_each_filter_chooses_its_own(snapshot: Snapshot, text: str, labels: list[str]) -> None:
    assert chosen(snapshot, f"{text}&sort=row&order=up") == labels


def test_any_sample_is_one_choice(snapshot: Snapshot) -> None:
    split = snapshot.table.split.copy()
    split[[0, 3]] = NONE
    changed = replace(snapshot, table=snapshot.table.with_columns(split=split))
    assert len(chosen(changed, "split=samples&outcome=any")) == 7
    assert set(chosen(changed, "split=none")) == {"0-0-0", "0-1-0"}


def test_order_is_by_the_quantity_and_those_without_come_last(snapshot: Snapshot) -> None:
    score = snapshot.table.anomaly.copy()
    score[[0, 3, 11]] = [5.0, np.nan, 7.0]
    changed = replace(snapshot, table=snapshot.table.with_columns(anomaly=score))
    down, up = chosen(changed, ""), chosen(changed, "order=up")
    assert down[:2] == ["0-3-2", "0-0-0"]
    assert up[-3:] == ["0-0-0", "0-3-2", "0-1-0"]
    assert down[-1] == up[-1] == "0-1-0"
    rows = chosen(snapshot, "sort=row&order=up")
    assert rows[:3] == ["0-0-0", "0-1-0", "0-3-2"]  # "smallest first"
    assert chosen(snapshot, "sort=row") == rows[::-1]


def test_decisions_choose_what_is_left(snapshot: Snapshot) -> None:
    a, b = AttemptKey("1_box_a", 0, 0), AttemptKey("3_brick", 1, 0)
    gone = AttemptKey("no object", 0, 0)
    decisions = Decisions(rejected=frozenset([a, gone]), kept=frozenset([b]))
    assert chosen(snapshot, "decision=rejected", decisions) == ["0-0-0"]
    # Failures are never decided, so they are not open either.
    for text in ("decision=open", "decision=open&outcome=any"):
        assert len(chosen(snapshot, text, decisions)) == 8


def test_address_of_a_query_gives_the_query_again() -> None:
    text = "outcome=any&object=a%26b%3Dc&sort=slip&order=up&page=3&hold=stable"
    query = Attempts.query(dict(parse_qsl(text)))
    assert Attempts.query(dict(parse_qsl(query.params()))) == query
    assert query["object"] == "a&b=c" and not query["outcome"]
    assert Attempts.query().params() == ""


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("outcome=good", "outcome must be one of any, success, .* got 'good'"),
        ("sort=x", "sort must be one of"),
        ("page=-1", "page must be a number"),
    ],
)
def test_what_cannot_be_asked_for_is_refused(text: str, words: str) -> None:
    with pytest.raises(DataError, match=words):
        Attempts.query(dict(parse_qsl(text)))
