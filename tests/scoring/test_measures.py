"""Measures of predictions: means over objects, k best, intervals, curve, calibration."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.scores import grouping, judged, ranked_array, verdict

from drakegrasp.scoring.measures import (
    FIRST,
    Judged,
    by_name,
    calibration,
    curve,
    difference,
    diversity,
    estimates,
    resample,
)

DRAWS = resample([f"object {i}" for i in range(3)])


def estimated(one, *objects):
    """Return the measures of a set whose rows are of these objects."""
    return estimates(one, grouping(*objects), DRAWS, FIRST[:-1])


def of_verdicts(*verdicts, **stated):
    """Return a set with a prediction for each row that has this verdict."""
    count = len(verdicts)
    ranked = ranked_array("net", np.zeros((count, 18)), length=count, **stated)
    return Judged(name="net", ranked=(ranked,), verdicts=(verdicts,))


def test_an_object_with_many_rows_counts_no_more_than_another():
    rows = [["kept"], ["fails"], ["fails"], ["fails"], ["kept"], ["kept"]]
    found = estimated(judged("net", rows), 0, 0, 0, 0, 1, 2)
    assert found["headline"]["value"] == pytest.approx((0.25 + 1 + 1) / 3, abs=1e-6)
    assert found["objects"]["value"] == 1.0
    assert "lifted_any" not in found


@pytest.mark.parametrize(
    ("measure", "rows"),
    [("headline", [1, 0, 0]), ("kept", [1, 1, 0]), ("matches", [1, 0, 1]), ("lifted", [1, 1, 1])],
)
def test_the_headline_asks_for_a_sample_with_contacts_where_they_were_asked_for(measure, rows):
    one = of_verdicts(verdict("kept"), verdict("kept", error=0.03), verdict("lifted"))
    # A row without prediction fails.
    assert grouping(0, 1, 2, 3).best_of_rows(one, one.table[measure]).tolist() == [[*rows, 0]]


def test_the_k_best_of_a_row_count_in_success_at_k_only():
    rows = [["fails", "kept", "fails"], ["fails", "fails", "kept"], ["kept"] * 3]
    found = estimated(judged("net", rows), 0, 1, 2)
    assert found["headline"]["value"] == pytest.approx(1 / 3, abs=1e-6)
    assert found["success@2"]["value"] == pytest.approx(2 / 3, abs=1e-6)
    assert "success@5" not in found


def test_intervals_are_of_objects_and_come_again():
    one = judged("net", [["kept"], ["fails"], ["fails"]])
    found = estimated(one, 0, 1, 2)["headline"]
    assert (found["low"], found["high"]) == (0.0, 1.0)
    assert estimated(one, 0, 1, 2)["headline"] == found
    # As one object there is nothing to draw.
    alone = estimates(one, grouping(0, 0, 0), resample(["a"]), FIRST[:-1])["headline"]
    assert alone["low"] == alone["value"] == alone["high"]


def test_objects_of_a_class_are_drawn_together():
    draws = resample(["a", "a", "b"])
    np.testing.assert_array_equal(draws[:, 0], draws[:, 1])
    np.testing.assert_allclose(draws.sum(axis=1), 1.0)
    assert set(np.round(draws[:, 2], 6)) == {0.0, 0.333333, 1.0}


def test_a_difference_is_paired_by_object():
    """Two equal sets differ by nothing in every resample, however wide their own intervals are."""
    one = judged("net", [["kept"], ["fails"], ["fails"]])
    same = difference(one, one, grouping(0, 1, 2), DRAWS)
    assert (same["value"], same["low"], same["high"]) == (0.0, 0.0, 0.0)
    less = judged("other", [["fails"], ["fails"], ["fails"]])
    assert difference(one, less, grouping(0, 1, 2), DRAWS)["value"] == pytest.approx(
        1 / 3, abs=1e-6
    )


def test_training_seeds_of_both_sets_widen_a_difference():
    """Drawn apart: the better seeds of one may meet the worse of the other."""
    good, bad = [["kept"]] * 3, [["fails"]] * 3
    spread = judged("spread", good, bad)
    for one, other in ((spread, judged("bad", bad)), (judged("good", good), spread)):
        found = difference(one, other, grouping(0, 1, 2), DRAWS)
        assert (found["value"], found["low"], found["high"]) == (0.5, 0.0, 1.0)
    both = difference(spread, judged("other", good, bad), grouping(0, 1, 2), DRAWS)
    assert (both["value"], both["low"], both["high"]) == (0.0, -1.0, 1.0)


def test_the_curve_rises_with_the_distance():
    one = of_verdicts(verdict("lifted", error=0.012), verdict("lifted", error=0.05))
    assert curve(one, grouping(0, 1)) == [0.0] * 3 + [0.5] * 7 + [1.0] * 3


def test_calibration_groups_by_confidence():
    words = ["fails"] * 5 + ["kept"] * 5
    groups = calibration(of_verdicts(*map(verdict, words), confidence=np.arange(10) / 10))
    assert [group["share"] for group in groups] == [0, 0, 0.5, 1, 1]
    assert calibration(judged("net", [["kept"]])) == []


def test_diversity_is_one_along_a_line_and_falls_with_directions():
    def variance(postures):
        return diversity(of_verdicts(*(replace(verdict("kept"), posture=(*p,)) for p in postures)))

    assert variance(np.outer([0.0, 1.0, 2.0, 3.0], [1.0, 1.0, 0.0]))[0] == 1.0
    assert variance(np.eye(4))[0] == pytest.approx(1 / 3, abs=1e-6)


def test_classes_are_means_of_their_objects():
    one, rows = judged("net", [["kept"], ["fails"], ["fails"]]), grouping(0, 0, 1)
    assert by_name(one, rows, rows.classes) == {"class 0": 0.5, "class 1": 0.0}
