"""Rules of layout and attributes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from helpers.datasets import OTM, OTO, TRIALS, edit_file, must_find


def retype(file: h5py.File) -> None:
    values, attrs = file["valid/masks"][:], dict(file["valid/masks"].attrs)
    del file["valid/masks"]
    file["valid/masks"] = values.astype(np.int32)
    file["valid/masks"].attrs.update(attrs)


LAYOUT_CASES: Mapping[str, tuple[str, Callable[[h5py.File], Any], str, str]] = {
    "extra group": (OTO, lambda f: f.create_group("more"), "", "groups must be those of"),
    "no group": (OTO, lambda f: f.pop("valid"), "/valid", "the group must be there"),
    "extra dataset": (
        OTO,
        lambda f: f.create_dataset("valid/object_props/x", data=[0]),
        "/valid",
        "datasets must be those of the schema",
    ),
    "no dataset": (OTM, lambda f: f.pop("valid/masks"), "/valid/masks", "the dataset must be"),
    "rows": (OTO, lambda f: f["valid/masks"].resize(2, 0), "/valid/masks", "shape must be (1, 32"),
    "type": (OTO, retype, "/valid/masks", "type must be uint8"),
    "unit": (
        OTO,
        lambda f: f["valid/grasps"].attrs.update(unit="mm"),
        "/valid/grasps",
        "attribute unit must be 'm, -'",
    ),
    "frame": (
        TRIALS,
        lambda f: f["trials/slip"].attrs.update(frame="W"),
        "/trials/slip",
        "attribute frame must be 'G'",
    ),
    "meaning": (
        TRIALS,
        lambda f: f["trials/slip"].attrs.pop("meaning"),
        "/trials/slip",
        "attribute meaning must be there",
    ),
    "schema": (OTO, lambda f: f.attrs.update(schema_version=0), "", "attribute schema_version"),
    "K": (OTO, lambda f: f.attrs.update(K=np.eye(3)), "", "attribute K must be"),
    "far": (OTO, lambda f: f.attrs.update(far=1.0), "", "attribute far must be 0.75"),
    "near": (OTO, lambda f: f.attrs.pop("near"), "", "attribute near must be a positive"),
    "seed": (TRIALS, lambda f: f.attrs.update(seed=5), "", "attribute seed must be 0"),
    "hash": (TRIALS, lambda f: f.attrs.update(config_hash="0"), "", "attribute config_hash must"),
    "config": (OTO, lambda f: f.attrs.update(config="{"), "", "attribute config must be a conf"),
    "versions": (OTO, lambda f: f.attrs.update(versions="1"), "", "attribute versions must be a"),
    "convention": (
        OTO,
        lambda f: f.attrs.pop("convention_depth"),
        "",
        "attribute convention_depth must be there",
    ),
    "camera": (OTO, lambda f: f.attrs.update(camera="otm"), "", "attribute camera must be oto"),
}


#: What a file by itself does not show: a file of another version is refused.
OF_DATASET = ("schema", "camera")


@pytest.mark.parametrize("case", LAYOUT_CASES)
def test_a_wrong_layout_or_attribute_is_found(out: Path, case: str) -> None:
    name, edit, group, what = LAYOUT_CASES[case]
    edit_file(out / name, edit)
    must_find(out if case in OF_DATASET else out / name, (name, group, None, what))
