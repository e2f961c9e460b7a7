"""A sound dataset passes; one wrong value breaks the one invariant that is about it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from helpers.datasets import OTM, OTO, Edit, change, found, mirrored, moved, set_at, turned

PROPS = "object_props/"
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
    "depth": (OTM, "images", set_at(3, 3, 3, to=0.9), "depths must be within 0.01..0.75 m"),
    "mask value": (OTO, "masks", set_at(3, 3, to=2), "mask must hold 0 and 1 only"),
    "empty mask": (OTM, "masks", lambda m: 0 * m, "mask must have an object pixel"),
    "normal": (
        OTO,
        "grasps",
        lambda g: np.hstack([g[:12], 1.01 * g[12:15], g[15:]]),
        "normal of finger 2 must",
    ),
    "scaled": (OTO, PROPS + "frame_world2obj", lambda p: 1.01 * p, f"{PROPS}frame_world2obj must"),
    "mirror": (OTO, PROPS + "frame_cam2img_otm", mirrored, f"{PROPS}frame_cam2img_otm must"),
    "work": (OTO, PROPS + "frame_world2work", moved(0, 0, 0.01), "frame_world2work must be the"),
    "mass": (OTO, PROPS + "work2mass", lambda m: -m, "work2mass must be positive"),
    "inertia": (OTO, PROPS + "work2inertia", set_at(1, to=0.1), "work2inertia must be symmetric"),
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
    "pose": (
        OTO,
        PROPS + "frame_world2obj",
        moved(0.001, 0, 0),
        "frame_world2obj must follow from its trial",
    ),
    "grasp": (OTM, "grasps", lambda g: g + np.eye(18)[2] * 1e-4, "grasp must be its trial's"),
    "beside": (
        OTO,
        "images",
        set_at(3, 0, 0, to=0.2),
        "points beside the mask must be on the table",
    ),
    "com": (OTO, PROPS + "work2com", lambda p: p + 1e-3, "work2com must be the resting object's"),
    "scaled inertia": (OTO, PROPS + "work2inertia", lambda i: 1.1 * i, "work2inertia must be the"),
    "scaled mass": (OTO, PROPS + "work2mass", lambda m: 1.1 * m, "work2mass must be the resting"),
}


@pytest.mark.parametrize("case", SAMPLE_CASES)
def test_a_wrong_value_of_a_sample_is_found(out: Path, case: str) -> None:
    name, place, edit, what = SAMPLE_CASES[case]
    change(out, name, f"train/{place}", 1, edit)
    hits = found(out)
    assert {h[:3] for h in hits} == {(name, "/train", 1)}
    assert len(hits) == 1
    assert all(h[3].startswith(what) for h in hits), hits
