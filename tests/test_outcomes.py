"""The outcomes as files hold them: a number that changes here breaks every old dataset."""

from __future__ import annotations

from drakegrasp.outcomes import Outcome, Stage

PLACED, CLOSED, TRIED = Stage.PLACED, Stage.CLOSED, Stage.TRIED

#: Label, frozen number, last stage with results, whether it says nothing about the grasp.
TABLE = [
    ("success", 0, TRIED, False),
    ("below_table", 1, PLACED, False),
    ("ray_miss", 2, PLACED, False),
    ("start_collision", 3, PLACED, False),
    ("screened", 4, PLACED, False),
    ("missing_fingertip", 5, CLOSED, False),
    ("hand_contact", 6, CLOSED, False),
    ("table_contact", 7, CLOSED, False),
    ("slipped", 8, TRIED, False),
    ("dropped", 9, TRIED, False),
    ("solver_error", 10, PLACED, True),
    ("timeout", 11, PLACED, True),
    ("crashed", 12, PLACED, True),
    ("moved", 15, TRIED, False),
    ("invalid", 17, PLACED, False),
    ("partly_held", 18, TRIED, False),
]


def test_outcomes_in_files_are_frozen() -> None:
    assert [(o.label, o.value, o.stage, o.inconclusive) for o in Outcome] == TABLE


def test_stages_are_ordered_and_frozen() -> None:
    """Code compares stages with <: a trial with a lift has everything that a closed one has."""
    assert {s.name: s.value for s in Stage} == {"PLACED": 0, "CLOSED": 1, "TRIED": 2}


def test_no_file_of_a_dataset_holds_what_only_verification_tells() -> None:
    assert {o.label for o in Outcome if o.verification_only} == {"invalid"}


def test_no_verification_ends_a_lift_early() -> None:
    assert {o.label for o in Outcome if o.dataset_only} == {"moved"}
