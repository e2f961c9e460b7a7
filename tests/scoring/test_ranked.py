"""Predictions from arrays and files: ranked by confidence, and refused where they do not fit."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
from helpers.scores import ranked_array

from drakegrasp.errors import GraspError
from drakegrasp.exchange.columns import read_contacts

GRASPS = np.arange(2 * 3 * 18, dtype=float).reshape(2, 3, 18)


def test_predictions_of_a_row_are_ranked_by_confidence_and_equal_ones_keep_their_order():
    ranked = ranked_array("a", GRASPS, length=2, confidence=[[0.1, 0.9, 0.9], [0.5, 0.4, 0.6]])
    assert ranked.of_row.tolist() == [0, 0, 0, 1, 1, 1]
    assert ranked.rank.tolist() == [0, 1, 2, 0, 1, 2]
    np.testing.assert_array_equal(
        ranked.grasps, [GRASPS[0, 1], GRASPS[0, 2], GRASPS[0, 0], *GRASPS[1, [2, 0, 1]]]
    )


def test_without_confidence_the_order_is_the_rank():
    ranked = ranked_array("a", GRASPS, length=2)
    np.testing.assert_array_equal(ranked.grasps, GRASPS.reshape(6, 18))
    assert ranked.confidence is None


@pytest.mark.parametrize("none", [np.nan, np.inf, -np.inf, True, 1j])
def test_a_confidence_that_is_no_finite_number_is_refused(none):
    """It would have a rank, and nobody could say which."""
    with pytest.raises(GraspError, match=r"confidence must be \(1, 3\) finite numbers, .*, got"):
        ranked_array("a", GRASPS[:1], length=1, confidence=[[none, 0.2, 0.3]])


def test_bad_numbers_stay_as_they_are_failures_of_the_network():
    assert np.isnan(ranked_array("a", np.full((2, 18), np.nan), length=2).grasps).all()


def test_a_file_states_rows_and_confidence(tmp_path):
    path, flat, rows = tmp_path / "p.h5", GRASPS.reshape(6, 18), np.array([4, 4, 4, 7, 7, 7])
    with h5py.File(path, "w") as file:
        file["test/grasps"], file["test/rows"] = flat, rows
        file["test/confidence"] = np.arange(6.0)
    ranked = ranked_array("a", **read_contacts(path, split="test"), length=9)
    assert ranked.of_row.tolist() == rows.tolist()
    np.testing.assert_array_equal(ranked.grasps, flat[[2, 1, 0, 5, 4, 3]])
    assert len(ranked.sha256) == 64 and ranked.file == "a"
    np.save(tmp_path / "p.npy", GRASPS)
    np.testing.assert_array_equal(read_contacts(tmp_path / "p.npy", axes=3)["grasps"], GRASPS)


@pytest.mark.parametrize(
    ("rows", "confidence", "message"),
    [
        (None, None, "for each of the 5 rows of test in data.hdf5, got 2"),
        ([0, 5], None, "rows must be 0 to 4 of test in data.hdf5, got 5"),
        ([0.0, 1.0], None, "rows must be whole numbers"),
        ([0, 1], [0.5, 0.5], r"confidence must be \(2, 3\)"),
    ],
)
def test_what_does_not_fit_is_refused(rows, confidence, message):
    with pytest.raises(GraspError, match=message):
        ranked_array("a", GRASPS, length=5, rows=rows, confidence=confidence)
