"""The attempts in memory: of assembled files, of a build that runs, of files that are missing."""

from __future__ import annotations

import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.datasets import OTM, OTO, SLIP, TRIALS

from drakegrasp.dataset.assemble import assemble
from drakegrasp.dataset.filters import Removal
from drakegrasp.errors import DataError
from drakegrasp.inspection import catalog as catalog_module
from drakegrasp.inspection.catalog import Catalog
from drakegrasp.inspection.rows import read_look, read_rows
from drakegrasp.inspection.table import FEATURES, NONE, empty_table
from drakegrasp.outcomes import Outcome


def build_again(out: Path) -> None:
    """Take away what is assembled: a build that has done all units but not ended."""
    for name in (TRIALS, OTO, OTM):
        (out / name).unlink()


def test_table_is_what_the_files_say(boxes: Path) -> None:
    snapshot = Catalog(boxes).current()
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
    assert set(table.features) == set(FEATURES)
    np.testing.assert_allclose(table.feature("slip")[table.precision], SLIP)
    assert table.value("force", 0) == 10.0
    # The second attempt misses a finger, the third is below the table.
    assert np.isnan(table.feature("slip")[[1, 2]]).all()
    assert np.isnan(table.value("force", 2))
    assert table.value("force", 1) == 10.0
    assert np.isfinite(table.feature("force")[table.closed]).all()


def test_attempts_are_found_by_their_label(boxes: Path) -> None:
    snapshot = Catalog(boxes).current()
    assert snapshot.label(3) == "0-1-0"
    assert snapshot.find("0-1-0") == 3
    assert str(snapshot.key(3)) == "1_box_a, palm pose 1, stand-off 0"
    for label in ("9-0-0", "0-1", "0-1-x", "0-1--1", "", "٣-1-0"):
        assert snapshot.find(label) is None


@pytest.mark.parametrize("assembled", [True, False], ids=["assembled", "building"])
def test_rows_and_images_are_those_of_the_attempt(out: Path, assembled: bool) -> None:
    with h5py.File(out / TRIALS) as trials, h5py.File(out / OTM) as data:
        X_OG = trials["trials/X_OG"][15]
        split = next(s for s in data if 15 in data[s]["trial_id"][:])
        place = data[split]["trial_id"][:].tolist().index(15)
        image, mask = data[split]["images"][place], data[split]["masks"][place]
    if not assembled:
        build_again(out)
    snapshot = Catalog(out).current()
    assert snapshot.assembled is assembled
    i = snapshot.find("1-1-0")
    assert i is not None
    (row,) = read_rows(snapshot, [i], ("X_OG",))
    np.testing.assert_array_equal(row["X_OG"], X_OG)
    look = read_look(snapshot, i, "otm")
    assert look is not None
    np.testing.assert_array_equal(look.image, image)
    np.testing.assert_array_equal(look.mask, mask)
    assert read_look(snapshot, i + 1, "otm") is None


def test_success_that_is_no_sample_has_the_images_of_its_shard(out: Path) -> None:
    expected = read_look(Catalog(out).current(), 0, "oto")
    assert assemble(out, rejected=[0]).removed[Removal.REJECTED] == 1
    snapshot = Catalog(out).current()
    assert snapshot.table.split[0] == NONE
    look = read_look(snapshot, 0, "oto")
    assert look is not None
    assert expected is not None
    np.testing.assert_array_equal(look.image, expected.image)


def test_data_files_alone_are_enough_for_images(out: Path) -> None:
    for folder in ("shards", "objects"):
        shutil.rmtree(out / folder)
    (out / "manifest.json").unlink()
    (out / OTM).unlink()
    snapshot = Catalog(out).current()
    assert read_look(snapshot, 0, "oto") is not None
    assert read_look(snapshot, 0, "otm") is None
    assert [line.split()[0] for line in snapshot.missing] == [OTM, "3"]


def test_a_build_that_runs_shows_what_is_done(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    build_again(out)
    hidden = out / "shards" / "3_brick"
    hidden.rename(out / "later")
    catalog = Catalog(out)
    first = catalog.current()
    assert len(first.table) == 24
    assert "4 of 6 work units are done" in first.missing[0]
    assert first.trial_id(0) is None

    # A new shard shows after a while, and the assembled files at once.
    (out / "later").rename(hidden)
    assert catalog.current() is first
    monkeypatch.setattr(catalog_module, "LISTING_PERIOD", 0.0)
    assert len(catalog.current().table) == 36
    assert (catalog.current().table.outcome == Outcome.SUCCESS).sum() == 9
    assemble(out)
    assert catalog.current().assembled
    assert catalog.current() is catalog.current()


def test_a_build_that_has_done_nothing_yet_has_no_attempts(out: Path) -> None:
    build_again(out)
    shutil.rmtree(out / "shards")
    table = Catalog(out).current().table
    assert len(table) == len(empty_table()) == 0
    assert table.candidate.dtype == np.int32


def test_what_is_no_dataset_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="must be the directory of a dataset"):
        Catalog(tmp_path)
    (tmp_path / TRIALS).write_bytes(b"nothing")
    with pytest.raises(DataError, match="must be the trials of a dataset, got none"):
        Catalog(tmp_path)
