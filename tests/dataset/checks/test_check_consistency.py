"""Rules of samples, splits, trials and objects together."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.datasets import BOTH, OTM, OTO, TRIALS, change, found, moved, must_find

from drakegrasp.dataset.assemble import assemble
from drakegrasp.dataset.manifest import read_manifest, write_manifest
from drakegrasp.outcomes import Outcome


def test_what_a_sample_says_of_its_trial_and_its_object_is_checked(out: Path) -> None:
    """Each in a sample of its own."""
    with h5py.File(out / OTO, "r+") as file, h5py.File(out / TRIALS) as trials:
        # A failure of the same object, whichever object the split has drawn.
        sample_of = trials["trials/object"][file["test/trial_id"][0]]
        failed = trials["trials/outcome"][:] == Outcome.MISSING_FINGERTIP
        same = trials["trials/object"][:] == sample_of
        file["test/trial_id"][0] = np.flatnonzero(failed & same)[0]
        file["train/object_props/object_name"][0] = file["test/object_props/object_name"][0]
    for name in BOTH:
        change(out, name, "test/trial_id", 1, lambda _: 10**9)
        change(out, name, "test/object_props/class_name", 2, lambda _: "other")
    trial = "trial_id must follow from shards and manifest"
    what = "must follow from its trial"
    must_find(
        out,
        (OTO, "/test", 0, trial),
        (OTO, "/train", 0, f"object_props/object_name {what}"),
        *((name, "/test", 1, trial) for name in BOTH),
        *((name, "/test", 2, f"object_props/class_name {what}") for name in BOTH),
    )


def test_a_trial_in_two_splits_is_found(out: Path) -> None:
    with h5py.File(out / OTO, "r+") as file:
        file["valid/trial_id"][0] = file["train/trial_id"][0]
    assert (OTO, "/valid", 0, "trial_id must be unique in all splits") in found(out / OTO)


def test_classes_of_an_object_are_the_same_in_all_splits(out: Path) -> None:
    with h5py.File(out / OTO, "r+") as file:
        file["train/object_props/class_name"][...] = "brick"
        file["valid/object_props/class_name"][...] = "cup"
    must_find(
        out / OTO,
        (OTO, "/valid", None, "1_box_a of class cup must be in /test"),
        (OTO, "/train", None, "1_box_a of class cup must be in /test"),
    )


@pytest.mark.parametrize(
    ("named", "expected"),
    [
        (None, {("/train", "1_box_a of class cup must"), ("/valid", "1_box_a of class cup must")}),
        (["cup"], set()),
        (
            ["box"],
            {
                ("/train", "1_box_a of class cup must"),
                ("/valid", "1_box_a of class cup must"),
                ("/test", "2_box_b of class box must be in no test split"),
            },
        ),
    ],
)
def test_a_class_is_not_tested_if_it_is_named_and_has_one_object(
    out: Path, named: list[str] | None, expected: set[tuple[str, str]]
) -> None:
    with h5py.File(out / OTO, "r+") as file:
        for split in ("train", "valid"):
            file[f"{split}/object_props/class_name"][...] = "cup"
        config = json.loads(file.attrs["config"])
        config["split"]["train_classes"] = named
        file.attrs["config"] = json.dumps(config, sort_keys=True)
    must_find(out / OTO, *((OTO, group, None, what) for group, what in expected))


def test_a_named_class_with_two_objects_is_tested(out: Path) -> None:
    with h5py.File(out / OTO, "r+") as file:
        names = file["train/object_props/object_name"]
        names[0] = b"9_other"
        for split in ("train", "valid"):
            file[f"{split}/object_props/class_name"][...] = "cup"
        config = json.loads(file.attrs["config"])
        config["split"]["train_classes"] = ["cup"]
        file.attrs["config"] = json.dumps(config, sort_keys=True)
    assert any("of class cup must be in /test" in what for *_, what in found(out / OTO))


def test_by_object_no_object_is_in_two_splits_nor_another_of_its_mesh(out: Path) -> None:
    assemble(out, overrides=["split.by=object"])
    assert not found(out)
    with h5py.File(out / OTO) as file:
        home = {
            file[f"{split}/object_props/object_name"].asstr()[0]: split
            for split in ("train", "valid", "test")
        }
    assert len(home) == 3

    # Of two objects that are said to be of one mesh one is in another split.
    manifest = read_manifest(out)
    members = {split: name for name, split in home.items()}
    objects = tuple(
        replace(entry, group=members["train"]) if entry.name == members["valid"] else entry
        for entry in manifest.objects
    )
    write_manifest(replace(manifest, objects=objects), out)
    what = "an object and its group must be in one split"
    assert {(name, "/valid", None, what) for name in BOTH} <= found(out)

    # A sample of the objects that train is in the split that validates.
    with h5py.File(out / OTO, "r+") as file:
        file["valid/object_props/object_name"][0] = members["train"]
    assert (OTO, "/valid", None, what) in found(out / OTO)


def test_the_rule_of_the_split_is_that_of_the_manifest(out: Path) -> None:
    with h5py.File(out / OTO, "r+") as file:
        file.attrs["split_by"] = "object"
    what = "attribute split_by must be that of manifest.json"
    assert (OTO, "", None, what) in found(out)


def test_samples_are_compared_without_the_trials(out: Path) -> None:
    (out / TRIALS).unlink()
    change(out, OTM, "train/trial_id", 1, lambda i: i + 1000)
    change(out, OTM, "test/object_props/class_name", 0, lambda _: "ball")
    change(out, OTM, "test/object_props/frame_cam2img_otm", 1, moved(0, 0, 1e-4))
    must_find(
        out,
        (TRIALS, "", None, "the file must be there and readable"),
        (OTM, "/train", 1, "trial_id must follow from shards and manifest"),
        (OTM, "/test", 0, "object_props/class_name must follow from its trial"),
        (OTM, "/test", 1, "object_props/frame_cam2img_otm must follow from its trial"),
    )


def test_objects_are_those_of_the_manifest(out: Path) -> None:
    change(out, TRIALS, "objects/class_name", 1, lambda _: "ball")
    must_find(out, (TRIALS, "/objects", 1, "class_name must follow from manifest.json"))
