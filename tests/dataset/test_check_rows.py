"""The check of rows: one wrong value breaks the one rule that is about it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.datasets import (
    AFTER_LIFT,
    BELOW,
    BOXES,
    HAND,
    MISSING,
    OTM,
    OTO,
    OUTCOMES,
    SLIPPED,
    SUCCESS,
    TRIALS,
    Edit,
    change,
    edit_file,
    mirrored,
    moved,
    must_find,
    set_at,
)

from drakegrasp.dataset.assemble import IMAGES
from drakegrasp.dataset.hdf5 import AnyArray
from drakegrasp.dataset.schema import DATA_FIELDS
from drakegrasp.frames import invert_pose, pack_pose, unpack_pose

TRIAL_CASES: Sequence[tuple[str, int, Edit, str]] = [
    ("trial_id", MISSING, lambda i: i + 1, "trial_id must be the number of the row"),
    ("outcome", BELOW, lambda _: 99, "outcome must be one of 0, 1, 2"),
    ("object", BELOW, lambda _: 3, "object must be one of the rows of /obj"),
    ("closed_q", SUCCESS, set_at(1, to=np.nan), "closed_q must be finite from"),
    ("spread", BELOW, lambda _: np.inf, "spread must be finite"),
    ("turn", MISSING, lambda _: 0.0, "turn must be finite from the stage tried"),
    ("closed_other_links", BELOW, lambda _: 1, "closed_other_links must be 0"),
    ("slip", AFTER_LIFT, lambda _: np.nan, "slip must be finite from"),
    ("closed_p_OQ", MISSING, set_at(2, to=0.0), "closed_p_OQ must be finite where"),
    ("lifted_p_OQ", SUCCESS, set_at(2, 0, to=np.nan), "lifted_p_OQ must be finite where"),
    (
        "closed_nhat_Q_O",
        SUCCESS,
        set_at(2, to=[0, 0.9, 0]),
        "normals in closed_nhat_Q_O must have length 1",
    ),
    ("closed_penetration", SUCCESS, set_at(1, to=-1e-3), "closed_penetration must be 0..inf"),
    ("X_OG", BELOW, lambda p: 1.1 * p, "X_OG must have an orthonormal rotation"),
    ("X_OG_lifted", SUCCESS, mirrored, "X_OG_lifted must have an orthon"),
    ("slip_released", SUCCESS, lambda s: -s, "slip_released must be 0..inf"),
    ("object", BELOW, lambda _: -1, "object must be one of the rows of /obj"),
    ("turn_released", SUCCESS, lambda _: 4.0, "turn_released must be 0..3.142"),
    ("stable", MISSING, lambda _: True, "stable must be 0 before the stage tried"),
    ("X_TO_lifted", SUCCESS, mirrored, "X_TO_lifted must have an orthonormal"),
    ("clearance_lift", HAND, lambda _: 0.1, "clearance_lift must be NaN before"),
    ("slip_use", SLIPPED, lambda u: u + 1e-6, "slip_use must follow from"),
]


@pytest.mark.parametrize("first", range(0, len(TRIAL_CASES), len(BOXES)))
def test_a_wrong_value_of_a_trial_is_found(out: Path, first: int) -> None:
    """One of each object at once: all have the same attempts."""
    expected, cases = [], TRIAL_CASES[first : first + len(BOXES)]
    for k, (name, row, edit, what) in enumerate(cases):
        own = row + k * len(OUTCOMES)
        change(out, TRIALS, f"trials/{name}", own, edit)
        expected.append((TRIALS, "/trials", own, what))
    must_find(out, *expected, of=TRIALS)


def test_a_removal_without_a_meaning_is_found(out: Path) -> None:
    change(out, TRIALS, "successes/removal", 2, lambda _: 14)  # was one, and is none
    must_find(out, (TRIALS, "/successes", 2, "removal must be one of 0, 1, 2"))


PROPS, GRASP = "object_props/", "grasp_props/"
SAMPLE_CASES: Sequence[tuple[str, str, Edit, str]] = [
    # where it is, how it is broken, what is found
    (OTO, "grasps", set_at(0, to=np.inf), "grasps must be finite"),
    (
        OTM,
        PROPS + "frame_cam2img_otm",
        set_at(0, to=np.nan),
        PROPS + "frame_cam2img_otm must be finite",
    ),
    (OTO, "masks", set_at(3, 3, to=2), "masks must be 0..1"),
    (OTM, "masks", lambda m: 0 * m, "contacts must project within 2 px of the mask"),
    (
        OTO,
        "grasps",
        lambda g: np.hstack([g[:12], 1.01 * g[12:15], g[15:]]),
        "normals in grasps must have length 1",
    ),
    (OTM, "grasps_lifted", set_at(slice(9, 12), to=0.0), "normals in grasps_lifted"),
    (OTO, PROPS + "frame_world2obj", lambda p: 1.01 * p, f"{PROPS}frame_world2obj must"),
    (OTO, PROPS + "frame_cam2img_otm", mirrored, f"{PROPS}frame_cam2img_otm must"),
    (OTO, GRASP + "X_CG", mirrored, GRASP + "X_CG must have an orthonormal"),
    (OTO, PROPS + "frame_world2work", moved(0, 0, 0.01), "frame_world2work must be the"),
    (
        OTM,
        PROPS + "frame_cam2work_otm",
        moved(0, 0, 0.01),
        "frame_work2cam_otm times frame_cam2work_otm must be the identity",
    ),
    (OTO, PROPS + "work2mass", lambda m: 0 * m, PROPS + "work2mass must be above"),
    (OTM, GRASP + "slip_released", lambda s: -s, GRASP + "slip_released must be 0.."),
    (OTO, GRASP + "X_CG", moved(0, 1e-4, 0), GRASP + "X_CG must follow from its trial"),
    (
        OTO,
        PROPS + "frame_world2obj",
        moved(0, 1e-4, 0),
        PROPS + "frame_world2obj must follow from its trial",
    ),
    (OTO, "grasps", set_at(0, to=0.1), "contacts must project within 2 px of the mask"),
    (OTM, "grasps", set_at(2, to=-0.1), "contacts must project within 2 px of the mask"),
    (
        OTM,
        "grasps",
        lambda g: np.hstack([0.97 * g[:3], g[3:]]),
        "contacts must be on the object's mesh within 0.002 m",
    ),
    (
        OTM,
        "grasps",
        lambda g: np.hstack([g[:9], -g[9:12], g[12:]]),
        "normals must point out of the object",
    ),
    (OTM, "trial_id", lambda _: 36, "trial_id must be one of the rows of /trials"),
]
#: Where the samples of a file are.
SAMPLES = [(split, row) for split in ("train", "valid", "test") for row in range(3)]


@pytest.mark.parametrize("first", range(0, len(SAMPLE_CASES), len(SAMPLES)))
def test_a_wrong_value_of_a_sample_is_found(out: Path, first: int) -> None:
    """Each in a sample of its own."""
    expected, names = [], set()
    cases = SAMPLE_CASES[first : first + len(SAMPLES)]
    for (name, place, edit, what), (split, row) in zip(cases, SAMPLES, strict=False):
        change(out, name, f"{split}/{place}", row, edit)
        expected.append((name, f"/{split}", row, what))
        names |= {name} if place == "trial_id" else set()
    kept = "the samples must be the successes that no filter removes"
    must_find(out, *expected, *((name, "", None, kept) for name in names))


def slightly_wrong(values: AnyArray) -> AnyArray:
    """Change the first number of a field: by some units in the last place of the largest one."""
    wrong = np.array(values)
    first, largest = wrong.reshape(-1)[:1], np.abs(wrong).max()
    if wrong.dtype.kind == "f":
        first += 4 * np.spacing(largest)
    else:
        first[:] = not first[0]
    return wrong


def test_a_last_place_of_a_sample_that_its_trial_does_not_have_is_found(out: Path) -> None:
    copied = [f.name for f in DATA_FIELDS if f.of and f.name not in IMAGES]
    assert len(copied) > 20
    # This column decides what is due.
    places = [name for name in copied if name != GRASP + "unused"]
    for place in places:
        change(out, OTM, f"train/{place}", 1, slightly_wrong)
    must_find(out, *((OTM, "/train", 1, f"{name} must follow from its trial") for name in places))


def test_samples_are_the_kept_successes_each_once(out: Path) -> None:
    def repeat(file: h5py.File) -> None:
        file["train"].visititems(
            lambda _, item: (
                item.write_direct(item[:][[0, 0, 2]])
                if isinstance(item, h5py.Dataset) and item.dtype != object
                else None
            )
        )

    edit_file(out / OTO, repeat)
    must_find(out, (OTO, "", None, "the samples must be the successes that no filter removes"))


def test_cameras_of_a_sample_have_one_place_and_view(out: Path) -> None:
    def shift(file: h5py.File) -> None:
        props = file["test/object_props"]
        packed = moved(0.0, 0.0, 0.01)(props["frame_work2cam_otm"][2])
        props["frame_work2cam_otm"][2] = packed
        props["frame_cam2work_otm"][2] = pack_pose(invert_pose(unpack_pose(packed)))

    edit_file(out / OTO, shift)
    must_find(out, (OTO, "/test", 2, "both cameras must have the same place and view"))
