"""The outcomes as files hold them: a number that changes here breaks every old dataset."""

from __future__ import annotations

from helpers.tables import table

from drakegrasp.outcomes import Outcome, Stage


def test_outcomes_in_files_are_frozen() -> None:
    found = [[o.label, o.value, o.stage.name, o.inconclusive] for o in Outcome]
    assert found == table("outcomes")


def test_stages_are_ordered_and_frozen() -> None:
    """Code compares stages with <: a trial with a lift has everything that a closed one has."""
    assert {s.name: s.value for s in Stage} == {"PLACED": 0, "CLOSED": 1, "TRIED": 2}


def test_no_file_of_a_dataset_holds_what_only_verification_tells() -> None:
    assert {o.label for o in Outcome if o.verification_only} == {"invalid"}


def test_no_verification_ends_a_lift_early() -> None:
    assert {o.label for o in Outcome if o.dataset_only} == {"moved"}
