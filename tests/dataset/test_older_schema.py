"""Datasets of schema 3: their files are read, and nothing else is done with them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from helpers.datasets import edit_manifest

from drakegrasp.dataset.assemble import assemble
from drakegrasp.dataset.checks.run import check_dataset
from drakegrasp.dataset.manifest import claim_directory, read_manifest
from drakegrasp.dataset.paths import ASSEMBLED_FILES, DATA_FILES
from drakegrasp.dataset.prepared_objects import load_prepared
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.schema import DATA_FIELDS, SPLITS, TRIAL_FIELDS
from drakegrasp.dataset.statistics import count_funnel, count_splits, count_unfinished
from drakegrasp.errors import DataError
from drakegrasp.generation.merge import merge
from drakegrasp.page.catalog import Catalog
from drakegrasp.page.looks import read_rows


@pytest.fixture
def older(out: Path) -> Path:
    """The dataset as schema 3 had it: without the newer fields, and with other hashes."""
    for name in ASSEMBLED_FILES:
        with h5py.File(out / name, "r+") as file:
            file.attrs["schema_version"], file.attrs["signature"] = 3, "0" * 64
            tables = (
                {"trials": TRIAL_FIELDS} if "trials" in file else dict.fromkeys(SPLITS, DATA_FIELDS)
            )
            for group, fields in tables.items():
                for field in fields:
                    if field.since > 3:
                        del file[group][field.name]
    edit_manifest(out, _to_schema_3)
    return out


def _to_schema_3(tree: dict[str, Any]) -> None:
    tree |= {"schema_version": 3, "config_hash": "0" * 16}
    for entry in tree["objects"]:
        (pose,) = entry.pop("resting")
        entry |= {"X_TO": pose["X_TO"], "rolled": pose["rolled"]}


def test_older_counts_are_those_of_its_files(older: Path, sound: Path) -> None:
    assert count_unfinished(older) is None
    assert count_funnel(older).outcomes.tolist() == count_funnel(sound).outcomes.tolist()
    counts = {split.split: split.samples for split in count_splits(older)}
    assert counts == {split.split: split.samples for split in count_splits(sound)}


def test_older_samples_have_no_weights(older: Path) -> None:
    dataset = GraspDataset(older / DATA_FILES["oto"], split="test")
    assert len(dataset) > 0
    assert np.isnan(dataset.column("grasp_props/weight")).all()
    assert not dataset.column("grasp_props/child").any()


def test_older_attempts_are_inspected(older: Path) -> None:
    row, *_ = read_rows(Catalog(older).current(), [0])
    assert row["resting"] == 0
    assert np.isnan(row["log_density"])


@pytest.mark.parametrize(
    "act",
    [
        assemble,
        check_dataset,
        lambda out: claim_directory(out, read_manifest(out).config),
        lambda out: merge(out.parent / "into", [out]),
    ],
    ids=["assemble", "check", "build", "merge"],
)
def test_older_dataset_is_for_reading_alone(older: Path, act: Callable[[Path], object]) -> None:
    with pytest.raises(DataError, match="schema must be 4 for anything but reading, got 3"):
        act(older)


def test_older_objects_are_not_simulated(older: Path) -> None:
    """Plans have no version of their own: this one lacks what plans have since."""
    manifest = read_manifest(older)
    name = manifest.objects[0].name
    with h5py.File(older / "objects" / f"{name}.plan.h5", "r+") as file:
        del file.attrs["max"]
    with pytest.raises(DataError, match="schema must be 4 for anything but reading, got 3"):
        load_prepared(older, name, manifest.config)
