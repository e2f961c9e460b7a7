"""Tables as a reader sees them."""

from __future__ import annotations

from io import StringIO

import numpy as np
import pytest
from rich.console import Console
from rich.table import Table

from drakegrasp.cli.tables import (
    audit_table,
    funnel_table,
    hold_table,
    preshape_table,
    print_table,
)
from drakegrasp.dataset.statistics import NO_NAME, Funnel, PreshapeCount
from drakegrasp.filters import Removal
from drakegrasp.objects.audit import AuditRow
from drakegrasp.outcomes import Outcome


def make_funnel(outcomes: np.ndarray, *names: str, **counts: np.ndarray) -> Funnel:
    """Return a funnel of objects by their outcomes (m, ...); what is not said is zero."""
    none, tried = np.zeros(len(names), dtype=np.int64), outcomes.sum(axis=1)
    usual = {
        "precision": none,
        "stable": none,
        "removals": np.zeros((len(names), 1 + max(Removal)), dtype=np.int64),
        "elevations": np.zeros((len(names), 3), dtype=np.int64),
        "approach_cells": none,
        "preshapes": np.zeros((256, 4), dtype=np.int64),
    }
    return Funnel(
        names=names,
        classes=("thing",) * len(names),
        candidates=tried,
        outcomes=outcomes,
        **{**usual, **counts},
    )


def printed(table: Table, width: int = 400) -> str:
    text = StringIO()
    Console(width=width, file=text).print(table)
    return text.getvalue()


def cells(text: str) -> list[list[str]]:
    return [line.split() for line in text.splitlines()]


def test_hold_table_tells_what_share_of_the_held_ones_is_stable() -> None:
    outcomes = np.zeros((2, 1 + max(Outcome)), dtype=np.int64)
    outcomes[:, Outcome.DROPPED] = 1180, 7
    outcomes[0, Outcome.SUCCESS] = 20
    removals = np.zeros((2, 1 + max(Removal)), dtype=np.int64)
    removals[0, [Removal.OTHER_LINKS, Removal.KEPT]] = 8, 12
    held = {"precision": np.array([12, 0]), "stable": np.array([9, 0])}
    funnel = make_funnel(outcomes, "1_mug", "2_[box]", removals=removals, **held)
    text = printed(hold_table(funnel), width=80)
    assert ["1_mug", "1,200", "20", "12", "9", "45%", "12"] in cells(text)
    assert ["2_[box]", "7", "0", "0", "0", "-", "0"] in cells(text)
    assert ["all", "1,207", "20", "12", "9", "45%", "12"] in cells(text)
    assert "lower bound" not in text

    # What was ended might have been held.
    outcomes[1, Outcome.MOVED] = 1234
    text = printed(hold_table(funnel))
    assert "lower bound" in text
    assert "1,234 lifts ended early" in " ".join(text.split())


@pytest.mark.parametrize("compact", [False, True])
def test_columns_of_the_funnel_add_up_to_the_attempts(compact: bool) -> None:
    """Each outcome of a build is in one column: here each has another power of two attempts."""
    outcomes = np.zeros((1, 1 + max(Outcome)), dtype=np.int64)
    built = [outcome for outcome in Outcome if not outcome.verification_only]
    outcomes[0, built] = 2 ** np.arange(len(built))
    removals = np.zeros((1, 1 + max(Removal)), dtype=np.int64)
    removals[0, Removal.KEPT] = outcomes[0, Outcome.SUCCESS]
    funnel = make_funnel(outcomes, "1_mug", removals=removals)
    text, count = printed(funnel_table(funnel, compact=compact)), outcomes.sum()
    (row,) = (line for line in cells(text) if "1_mug" in line)
    numbers = [int(cell.replace(",", "")) for cell in row if cell.replace(",", "").isdigit()]
    # The number of grasps is also that of the samples.
    assert sum(set(numbers) - {count}) == count
    assert "moved" in text
    if compact:
        kinds = (Outcome.DROPPED, Outcome.SLIPPED, Outcome.PARTLY_HELD)
        lost = sum(2 ** built.index(outcome) for outcome in kinds)
        assert lost in numbers
    else:
        assert {2**k for k in range(len(built))} <= set(numbers)

    # Without one there is no column of lifts that were ended.
    outcomes[0, Outcome.MOVED] = 0
    assert "moved" not in printed(funnel_table(funnel, compact=compact))


def test_preshape_table_has_a_row_of_each_and_says_which_is_of_none() -> None:
    counts = [PreshapeCount("[red]", 1200, 7, 5, 4), PreshapeCount(NO_NAME, 3, 1, 0, 0)]
    text = printed(preshape_table(counts))
    assert ["[red]", "1,200", "7", "5", "4"] in cells(text)
    assert [NO_NAME, "3", "1", "0", "0"] in cells(text)
    assert "all fingers close" in text
    assert "all fingers close" not in printed(preshape_table(counts[:1]))


def test_audit_is_in_millimetres() -> None:
    fit = AuditRow(
        name="1_mug",
        class_name="mug",
        status="fit",
        notes=("one", "[two]"),
        faces=1200,
        bodies=1,
        watertight=True,
        extents=(0.05, 0.06, 0.07),
        collision_error=0.0004,
    )
    refused = AuditRow(name="2_box", class_name="box", status="refused", notes=("open",))
    text = cells(printed(audit_table([fit, refused])))
    numbers = ["1,200", "50x60x70", "1", "yes", "0.4"]
    assert ["1_mug", "fit", *numbers, "one"] in text
    assert ["2_box", "refused", *"-" * 5, "open"] in text


def test_long_notes_of_an_audit_are_folded_in_a_file(capsys: pytest.CaptureFixture[str]) -> None:
    words = " ".join(f"word{k}" for k in range(80))
    row = AuditRow(
        name="1_mug", class_name="mug", status="fit", notes=(words,), warnings=("w" * 300,)
    )
    print_table(audit_table([row]))
    printed = capsys.readouterr().out
    assert max(map(len, printed.splitlines())) < 180
    assert [word for word in printed.split() if word.startswith("word")] == words.split()
    assert "".join(word for word in printed.split() if not word.strip("w")) == 300 * "w"
