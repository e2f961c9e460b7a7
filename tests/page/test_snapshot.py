"""The attempts in memory: of assembled files, and of files that are missing."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.datasets import OTM, OTO, SLIP, TRIALS, change, set_at

from drakegrasp.dataset.rejections import AttemptKey, Decisions
from drakegrasp.dataset.trials import NONE
from drakegrasp.errors import DataError
from drakegrasp.page.attempts import Attempts
from drakegrasp.page.renders import read_render, read_rows
from drakegrasp.page.snapshot import FEATURES, read_snapshot


def test_table_is_what_the_files_say(boxes: Path) -> None:
    snapshot = read_snapshot(boxes)
    table = snapshot.table
    with h5py.File(boxes / TRIALS) as file, h5py.File(boxes / OTO) as data:
        for name in ("outcome", "object", "candidate", "standoff_index", "precision", "stable"):
            np.testing.assert_array_equal(getattr(table, name), file["trials"][name][:])
        hits = file["successes/trial_id"][:]
        np.testing.assert_array_equal(table.removal[hits], file["successes/removal"][:])
        for number, split in enumerate(("train", "valid", "test")):
            ids = np.flatnonzero(table.split == number)
            np.testing.assert_array_equal(ids, data[split]["trial_id"][:])
    assert (table.removal != NONE).sum() == (table.split != NONE).sum() == 9
    assert set(FEATURES) < set(table)
    np.testing.assert_allclose(table.slip[table.precision], SLIP)
    # The second attempt misses a finger, the third is below the table.
    assert np.isnan(table.slip[[1, 2]]).all()


def test_rows_and_images_are_those_of_the_attempt(boxes: Path) -> None:
    with h5py.File(boxes / TRIALS) as trials, h5py.File(boxes / OTM) as data:
        X_OG = trials["trials/X_OG"][15]
        split = next(s for s in data if 15 in data[s]["trial_id"][:])
        place = data[split]["trial_id"][:].tolist().index(15)
        image, mask = data[split]["images"][place], data[split]["masks"][place]
    snapshot = read_snapshot(boxes)
    i = snapshot.find(AttemptKey("2_box_b", 1, 0))
    assert i == 15 and str(snapshot.key(i)) == "2_box_b, palm pose 1, stand-off 0"
    assert snapshot.find(AttemptKey("2_box_b", 99, 0)) is None
    (row,) = read_rows(snapshot, [i], ("X_OG",))
    np.testing.assert_array_equal(row["X_OG"], X_OG)
    found = read_render(snapshot, i, "otm")
    assert found is not None
    np.testing.assert_array_equal(found.image, image)
    np.testing.assert_array_equal(found.mask, mask)
    assert read_render(snapshot, i + 1, "otm") is None


def test_a_contact_without_a_normal_has_the_largest_angle(out: Path) -> None:
    change(out, TRIALS, "trials/normal_angle", 0, set_at(0, to=np.nan))
    snapshot = read_snapshot(out)
    assert snapshot.table.normal_angle[0] == np.inf
    table = Attempts(snapshot, Decisions())
    assert table.select(Attempts.query({"sort": "normal_angle"}))[0] == 0


def test_what_is_no_dataset_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="must be the directory of a dataset"):
        read_snapshot(tmp_path)
    (tmp_path / TRIALS).write_bytes(b"nothing")
    with pytest.raises(DataError, match="must be the trials of a dataset, got none"):
        read_snapshot(tmp_path)


def test_trials_that_are_a_link_to_nowhere_are_damaged_and_not_still_to_come(out: Path) -> None:
    (out / "trials.hdf5").unlink()
    (out / "trials.hdf5").symlink_to("trials.hdf5")
    with pytest.raises(DataError, match=r"trials\.hdf5: must be the trials of a dataset"):
        read_snapshot(out)
