"""The attempts in memory: of assembled files, and of files that are missing or replaced."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.datasets import OTM, OTO, SLIP, TRIALS, change, set_at
from helpers.pages import coded, numbered

from drakegrasp.dataset.assemble import assemble
from drakegrasp.dataset.manifest import Manifest, read_manifest, write_manifest
from drakegrasp.dataset.rejections import Decisions
from drakegrasp.dataset.trials import NONE
from drakegrasp.errors import DataError
from drakegrasp.filters import Removal
from drakegrasp.page.attempts import Attempts
from drakegrasp.page.catalog import FEATURES, Catalog
from drakegrasp.page.looks import read_look, read_rows


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
    assert set(snapshot.closed) == {*FEATURES, "place"}
    np.testing.assert_allclose(snapshot.feature("slip")[table.precision], SLIP)
    assert snapshot.value("force", 0) == 12.5
    # The second attempt misses a finger, the third is below the table.
    assert np.isnan(snapshot.feature("slip")[[1, 2]]).all()
    assert np.isnan(snapshot.value("force", 2))
    assert snapshot.value("force", 1) == 10.0
    assert np.isfinite(snapshot.feature("force")[snapshot.closed.place]).all()


def test_attempts_are_found_by_their_label(boxes: Path) -> None:
    snapshot = Catalog(boxes).current()
    assert numbered(snapshot, snapshot.label(3)) == "0-1-0"
    assert snapshot.find(coded(snapshot, "0-1-0")) == 3
    assert str(snapshot.key(3)) == "1_box_a, palm pose 1, stand-off 0"
    code = snapshot.codes[0]
    for label in ("0-1-0", f"{code}-1", f"{code}-1-x", f"{code}-1--1", "", f"{code}-٣-0"):
        assert snapshot.find(label) is None


def test_rows_and_images_are_those_of_the_attempt(boxes: Path) -> None:
    with h5py.File(boxes / TRIALS) as trials, h5py.File(boxes / OTM) as data:
        X_OG = trials["trials/X_OG"][15]
        split = next(s for s in data if 15 in data[s]["trial_id"][:])
        place = data[split]["trial_id"][:].tolist().index(15)
        image, mask = data[split]["images"][place], data[split]["masks"][place]
    snapshot = Catalog(boxes).current()
    i = snapshot.find(coded(snapshot, "1-1-0"))
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


def test_a_build_that_grew_has_the_images_of_its_longer_shard(out: Path) -> None:
    assemble(out, rejected=[0])
    (path,) = sorted(out.glob("shards/*/0000000-*.h5"))[:1]
    shutil.copy(path, path.with_name("0000000-0000001.h5"))
    assert read_look(Catalog(out).current(), 0, "oto") is not None


def test_data_files_alone_are_enough_for_images(out: Path) -> None:
    for folder in ("shards", "objects"):
        shutil.rmtree(out / folder)
    (out / "manifest.json").unlink()
    (out / OTM).unlink()
    snapshot = Catalog(out).current()
    assert read_look(snapshot, 0, "oto") is not None
    assert read_look(snapshot, 0, "otm") is None
    assert [line.split()[0] for line in snapshot.missing] == [OTM, "3"]


def without_first(out: Path) -> Manifest:
    """Make the dataset one of the last two objects; return the manifest of all three."""
    whole = read_manifest(out)
    write_manifest(replace(whole, objects=whole.objects[1:]), out)
    return whole


def test_a_label_stays_that_of_its_attempt_when_objects_are_added(out: Path) -> None:
    """Another object comes first by its name, so the numbers of all others change."""
    whole = without_first(out)
    assemble(out)
    catalog = Catalog(out)
    before = catalog.current()
    labels = {before.label(i): before.key(i) for i in range(before.table.count)}
    write_manifest(whole, out)
    assert catalog.current() is before  # the files are still those of before
    assemble(out)
    after = catalog.current()
    assert after.table.count == len(labels) + 12
    for label, key in labels.items():
        place = after.find(label)
        assert place is not None
        assert after.key(place) == key


def test_a_label_of_another_mesh_or_configuration_is_another(boxes: Path) -> None:
    snapshot = Catalog(boxes).current()
    label = snapshot.label(0)
    for other in (
        replace(snapshot, meshes=("0" * 64, *snapshot.meshes[1:])),
        replace(snapshot, config_hash="0" * 16),
    ):
        assert other.find(label) is None


def test_a_file_that_was_replaced_is_not_read_as_the_one_before(out: Path) -> None:
    """By row the files would give the numbers and images of other attempts."""
    whole = without_first(out)
    assemble(out)
    catalog = Catalog(out)
    before = catalog.current()
    assert read_look(before, 0, "oto") is not None
    write_manifest(whole, out)
    assemble(out)
    with pytest.raises(DataError, match="must stay while it is read"):
        read_rows(before, [0], ("slip",))
    with pytest.raises(DataError, match="must stay while it is read"):
        read_look(before, 0, "oto")
    assert len(read_rows(catalog.current(), [0], ("slip",))) == 1


def test_a_shard_of_another_mesh_has_no_images_of_an_attempt(out: Path) -> None:
    assemble(out, rejected=[0])
    (path,) = sorted(out.glob("shards/*/0000000-*.h5"))[:1]
    with h5py.File(path, "r+") as file:
        file.attrs["mesh_sha256"] = "0" * 64
    assert read_look(Catalog(out).current(), 0, "oto") is None


def test_a_contact_without_a_normal_has_the_largest_angle(out: Path) -> None:
    change(out, TRIALS, "trials/normal_angle", 0, set_at(0, to=np.nan))
    snapshot = Catalog(out).current()
    assert snapshot.value("normal_angle", 0) == np.inf
    table = Attempts(snapshot, Decisions())
    assert table.select(Attempts.query({"min_normal_angle": "10"})).tolist() == [0]
    assert table.select(Attempts.query({"sort": "normal_angle"}))[0] == 0


def test_another_schema_is_one_message(out: Path) -> None:
    with h5py.File(out / TRIALS, "r+") as file:
        file.attrs["schema_version"] = 2
    with pytest.raises(DataError) as caught:
        Catalog(out)
    assert str(caught.value).count(TRIALS) == 1


def test_what_is_no_dataset_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="must be the directory of a dataset"):
        Catalog(tmp_path)
    (tmp_path / TRIALS).write_bytes(b"nothing")
    with pytest.raises(DataError, match="must be the trials of a dataset, got none"):
        Catalog(tmp_path)


def test_trials_that_are_a_link_to_nowhere_are_damaged_and_not_still_to_come(out: Path) -> None:
    (out / "trials.hdf5").unlink()
    (out / "trials.hdf5").symlink_to("trials.hdf5")
    with pytest.raises(DataError, match=r"trials\.hdf5: must be the trials of a dataset"):
        Catalog(out).current()
