"""A sound dataset passes; one wrong value breaks the one invariant that is about it.

Also of samples, splits, trials and objects together.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.datasets import (
    BOTH,
    OTM,
    OTO,
    TRIALS,
    Edit,
    change,
    found,
    mirrored,
    moved,
    must_find,
    must_find_without_shards,
    set_at,
    turned,
)

from drakegrasp.dataset.assemble import assemble
from drakegrasp.dataset.assembly.pack import IMAGES
from drakegrasp.dataset.hdf5 import AnyArray
from drakegrasp.dataset.manifest import read_manifest, write_manifest
from drakegrasp.dataset.schema import DATA_FIELDS
from drakegrasp.errors import DataError
from drakegrasp.outcomes import Outcome

#: Fields of a sample that are no images and no texts.
NUMBERS = [f for f in DATA_FIELDS if f.dtype != "str" and f.name not in IMAGES]
PROPS = "object_props/"
GRASP = "grasp_props/"
FOLLOWS, HELD = "{} must follow from its trial", "{} must be what the shard holds"
SAMPLE_CASES: Mapping[str, tuple[str, str, Edit, str]] = {
    # where it is, how it is broken, what is found
    "nan": (OTO, "images", set_at(1, 3, 3, to=np.nan), "images must be finite"),
    "infinite": (OTO, "grasps", set_at(0, to=np.inf), "grasps must be finite"),
    "nan frame": (
        OTM,
        PROPS + "frame_cam2img_otm",
        set_at(0, to=np.nan),
        PROPS + "frame_cam2img_otm must be finite",
    ),
    "colour": (OTO, "images", set_at(1, 3, 3, to=1.5), "colours must be within 0..1"),
    "low colour": (OTO, "images", set_at(0, 3, 3, to=-0.1), "colours must be within 0..1"),
    "depth": (OTM, "images", set_at(3, 3, 3, to=0.9), "depths must be within 0.01..0.75 m"),
    "low depth": (OTM, "images", set_at(3, 3, 3, to=0.009), "depths must be within 0.01..0.75 m"),
    "mask value": (OTO, "masks", set_at(3, 3, to=2), "masks must be 0..1"),
    "empty mask": (OTM, "masks", lambda m: 0 * m, "mask must have an object pixel"),
    "normal": (
        OTO,
        "grasps",
        lambda g: np.hstack([g[:12], 1.01 * g[12:15], g[15:]]),
        "grasps of finger 2 must have length 1",
    ),
    "scaled": (OTO, PROPS + "frame_world2obj", lambda p: 1.01 * p, f"{PROPS}frame_world2obj must"),
    "mirror": (OTO, PROPS + "frame_cam2img_otm", mirrored, f"{PROPS}frame_cam2img_otm must"),
    "work": (OTO, PROPS + "frame_world2work", moved(0, 0, 0.01), "frame_world2work must be the"),
    "mass": (OTO, PROPS + "work2mass", lambda m: -m, PROPS + "work2mass must be above"),
    "inertia": (OTO, PROPS + "work2inertia", set_at(1, to=0.1), "work2inertia must be symmetric"),
    "triangle": (
        OTO,
        PROPS + "work2inertia",
        lambda _: np.diag([1e-3, 1e-3, 2.1e-3]).ravel(),
        "work2inertia must be symmetric with moments of a real body",
    ),
    "negative inertia": (OTO, PROPS + "work2inertia", lambda i: -i, "work2inertia must be symm"),
    "massless": (
        OTO,
        PROPS + "work2mass",
        lambda m: 0 * m,
        PROPS + "work2mass must be above",
    ),
    "inverse": (
        OTM,
        PROPS + "frame_work2cam_otm",
        moved(0, 0, 0.01),
        "frame_work2cam_otm times frame_cam2work_otm must be the identity",
    ),
    "image frame behind": (
        OTO,
        PROPS + "frame_cam2img_otm",
        moved(0, 0, -2.0),
        "frame_cam2img_otm must start before the camera",
    ),
    "image frame turned": (
        OTO,
        PROPS + "frame_cam2img_otm",
        turned(np.pi, [0, 0, 1]),
        "frame_cam2img_otm must have +Ix along +Cz",
    ),
    "centroid": (
        OTM,
        PROPS + "frame_cam2img_otm",
        moved(0.01, 0, 0),
        "frame_cam2img_otm must start within 0.05 px",
    ),
    "held normal": (
        OTM,
        "grasps_held",
        set_at(slice(9, 12), to=0.0),
        "grasps_held of finger 1",
    ),
    "palm's side": (OTO, GRASP + "X_CG", mirrored, GRASP + "X_CG must have an orthonormal"),
    "precision": (OTO, GRASP + "precision", lambda _: False, "precision must follow from other"),
    "stable": (OTM, GRASP + "stable", lambda _: False, "stable must follow from other_links_held"),
    "beside": (
        OTO,
        "images",
        set_at(3, 0, 0, to=0.2),
        "points beside the mask must be on the table",
    ),
    "slip back": (OTM, GRASP + "slip_released", lambda s: -s, GRASP + "slip_released must be 0.."),
}


#: Where the samples of a file are.
SAMPLES = [("train", 0), ("train", 1), ("valid", 0), *(("test", row) for row in range(6))]


@pytest.mark.parametrize("first", range(0, len(SAMPLE_CASES), len(SAMPLES)))
def test_a_wrong_value_of_a_sample_is_found(out: Path, first: int) -> None:
    """Each in a sample of its own."""
    with_shards, without = set(), []
    cases = list(SAMPLE_CASES.values())[first : first + len(SAMPLES)]
    for (name, place, edit, what), (split, row) in zip(cases, SAMPLES, strict=False):
        change(out, name, f"{split}/{place}", row, edit)
        found_first = HELD if place in IMAGES else FOLLOWS
        with_shards.add((name, f"/{split}", row, found_first.format(place)))
        without.append((name, f"/{split}", row, what))
    assert found(out) == with_shards
    must_find_without_shards(out, *without)


def slightly_wrong(values: AnyArray) -> AnyArray:
    """Change the first number of a field: by some units in the last place of the largest one."""
    wrong = np.array(values)
    first, largest = wrong.reshape(-1)[:1], np.abs(wrong).max()
    if wrong.dtype.kind == "f":
        first += 4 * np.spacing(largest)
    else:
        first[:] = not first[0]
    return wrong


DERIVED = [field.name for field in NUMBERS if field.name != "trial_id"]


def test_a_last_place_of_a_sample_that_its_trial_does_not_give_is_found(out: Path) -> None:
    for place in DERIVED:
        change(out, OTM, f"train/{place}", 1, slightly_wrong)
    assert found(out) == {(OTM, "/train", 1, FOLLOWS.format(place)) for place in DERIVED}


@pytest.mark.parametrize(
    ("name", "value", "reason"), [("slip", 0.0101, "slid"), ("turn", 0.18, "turned")]
)
def test_a_sample_that_moved_too_far_in_the_hand_is_found(
    out: Path, name: str, value: float, reason: str
) -> None:
    change(out, OTO, f"train/{GRASP}{name}", 1, lambda _: value)
    change(out, OTO, f"train/{GRASP}stable", 1, lambda _: False)
    must_find(out / OTO, (OTO, "/train", 1, f"a sample must pass the filter {reason}"))


@pytest.mark.parametrize(("row", "slip", "turn_deg"), [(0, 0.005, 5.0), (1, 0.010, 10.0)])
def test_on_a_limit_rounding_finds_nothing(
    out: Path, row: int, slip: float, turn_deg: float
) -> None:
    """In single precision the limit of a turn is beyond itself."""
    limits = {"slip": slip, "turn": np.deg2rad(turn_deg)}
    for stable in (True, False) if row == 0 else (False,):
        for name, value in {**limits, "stable": stable}.items():
            change(out, OTO, f"train/{GRASP}{name}", row, lambda _, v=value: v)
        must_find(out / OTO)


def test_a_sample_on_the_palm_is_found(out: Path) -> None:
    change(out, OTO, f"train/{GRASP}other_links_held", 1, lambda _: 1)
    for name in ("precision", "stable"):
        change(out, OTO, f"train/{GRASP}{name}", 1, lambda _: False)
    must_find(out / OTO, (OTO, "/train", 1, "a sample must pass the filter other_links"))


@pytest.mark.parametrize("name", ["surface_distance", "normal_angle"])
def test_a_trial_whose_contacts_are_said_to_be_off_the_surface_is_found(
    out: Path, name: str
) -> None:
    with h5py.File(out / OTO) as file:
        number = int(file["train/trial_id"][1])
    change(out, TRIALS, f"trials/{name}", number, set_at(2, to=0.6))
    must_find(out, (TRIALS, "/trials", number, f"{name} must follow from its shard"))


def test_samples_without_shards_are_compared_with_their_trials(out: Path) -> None:
    change(out, OTM, "train/grasp_props/slip", 1, lambda slip: slip + 1e-4)
    change(out, OTO, "train/trial_id", 0, lambda _: 1)
    change(out, OTO, "test/trial_id", 2, lambda _: 36)
    must_find_without_shards(
        out,
        (OTM, "/train", 1, "grasp_props/slip must follow from its trial"),
        (OTO, "/train", 0, "trial_id must be that of a success"),
        (OTO, "/test", 2, "trial_id must be a row of /trials"),
    )


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
    with pytest.raises(DataError, match=r"must be in one split to be of one group"):
        found(out)
    write_manifest(manifest, out)

    # A sample of the objects that train is in the split that validates.
    with h5py.File(out / OTO, "r+") as file:
        file["valid/object_props/object_name"][0] = members["train"]
    what = "an object and its group must be in one split"
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
