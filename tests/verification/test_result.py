"""What a verdict is called, and what is said of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from helpers.objects import standing
from helpers.verdicts import asked_otherwise, some_contacts, some_trial, some_try, some_verdict

from drakegrasp.filters import Removal
from drakegrasp.hand.settings import load_config
from drakegrasp.objects.model import make_object
from drakegrasp.outcomes import Outcome

CONFIG = load_config()


def lifted(*, slip_mm, turn_deg, links, outcome=Outcome.SUCCESS):
    """Return the verdict on a grasp whose object moved so much in the hand."""
    box = trimesh.creation.box([0.06, 0.05, 0.12])
    model = make_object(
        box.vertices, box.faces, CONFIG.objects, name="vase", class_name="vase", mesh_sha256=""
    )
    contacts = some_contacts(other_links=links)
    removal = Removal.OTHER_LINKS if links else Removal.KEPT
    removal = removal if outcome is Outcome.SUCCESS else None
    trial = some_trial(
        standing(model),
        contacts,
        contacts,
        outcome=outcome,
        slip=1e-3 * slip_mm,
        turn=np.deg2rad(turn_deg),
    )
    return some_verdict(model, outcome=outcome, tries=(some_try(trial, removal=removal),))


TIPS_ALONE, ANOTHER = "no other link of the hand touches it", "another link touches it"


@pytest.mark.parametrize(
    ("slip_mm", "turn_deg", "links", "stable", "said"),
    [
        (0.2, 0.3, 0, True, f"{TIPS_ALONE}: a precision grasp, stable."),
        (4.9, 4.9, 0, True, f"{TIPS_ALONE}: a precision grasp, stable."),
        (5.1, 0.3, 0, False, f"{TIPS_ALONE}: a precision grasp, not stable."),
        (0.2, 5.1, 0, False, f"{TIPS_ALONE}: a precision grasp, not stable."),
        (0.2, 0.3, 1, False, f"{ANOTHER}: no precision grasp, not stable."),
        (73.0, 98.0, 2, False, "2 other links touch it: no precision grasp, not stable."),
    ],
)
def test_words_and_sentences_follow_from_slip_turn_and_other_links(
    slip_mm, turn_deg, links, stable, said
):
    verdict = lifted(slip_mm=slip_mm, turn_deg=turn_deg, links=links)
    assert verdict.lifted is verdict.matches is True
    assert (verdict.precision, verdict.stable, verdict.kept) == (not links, stable, not links)
    assert repr(verdict) == "Verification(success: so it is)"
    text, load = verdict.explain(), "1.0 N, 0.1 times the hand's rated load of 19.6 N."
    moved = f"slips by {slip_mm:.1f} mm and turns by {turn_deg:.1f}° in the hand"
    assert text.startswith("The grasp of vase holds: so it is. Before closing, the fingertips are ")
    assert f" During the lift the object {moved}, and at the end {said} In a dataset" in text
    assert f"The largest force of a fingertip is {load}" in text


def test_grasp_that_fails_is_none_of_the_words_and_gets_no_mark():
    verdict = lifted(slip_mm=80.0, turn_deg=9.0, links=0, outcome=Outcome.DROPPED)
    assert (verdict.lifted, verdict.precision, verdict.stable) == (False, False, False)
    text = verdict.explain()
    assert text.startswith("The grasp of vase fails (dropped): so it is. ")
    assert text.endswith("touches it; 3 of 3 fingertips still touch it.")
    # What was not lifted is nothing, either.
    verdict = replace(verdict, tries=(), outcome=Outcome.INVALID)
    assert (verdict.lifted, verdict.precision, verdict.stable) == (False, False, False)
    assert "slips" not in verdict.explain()


@pytest.mark.parametrize(
    ("removal", "said"),
    [(Removal.KEPT, "it would be a sample;"), (Removal.SLID, "it would be no sample (slid);")],
)
def test_explanation_says_whether_it_is_a_sample_and_what_is_not_judged(removal, said):
    verdict = lifted(slip_mm=0.1, turn_deg=0.1, links=0)
    verdict = replace(verdict, tries=(replace(verdict.tries[0], removal=removal),))
    text = verdict.explain()
    assert verdict.kept is (removal is Removal.KEPT)
    assert f"In a dataset {said} not judged: not_seen, flat_depth, outlier." in text


def test_hints_and_normalised_normals_are_told():
    verdict = lifted(slip_mm=80.0, turn_deg=9.0, links=0, outcome=Outcome.DROPPED)
    verdict = replace(verdict, told=("points in millimetres instead of metres",))
    text = asked_otherwise(verdict, normalised=True).explain()
    assert "A predicted normal was not of unit length; it was normalised." in text
    assert text.endswith("This would fit much better: points in millimetres instead of metres.")


def test_lifted_within_a_distance_follows_from_the_farthest_contact():
    verdict = lifted(slip_mm=0.1, turn_deg=0.1, links=0)
    error = np.array([0.003, np.nan, 0.019])
    near = replace(verdict, tries=(replace(verdict.tries[0], contact_error=error),))
    assert near.farthest_contact == 0.019 and near.matches
    far = replace(verdict, tries=(replace(verdict.tries[0], contact_error=error + 0.002),))
    assert far.lifted and not far.matches
    assert "fingertip 3 is more than 20.0 mm from its point" in far.explain()
