"""Data files of made-up samples."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from drakegrasp.dataset.hdf5 import create_field
from drakegrasp.dataset.schema import DATA_FIELDS, SCHEMA_VERSION, SPLITS, Field, sizes

#: Attributes of a file of a test.
ATTRIBUTES: dict[str, Any] = {
    "schema_version": SCHEMA_VERSION,
    "seed": 0,
    "K": np.eye(3),
    "near": 0.01,
    "far": 0.75,
    "camera": "oto",
    "split_by": "object",
    "joints": "[]",
    **dict.fromkeys(("config", "versions", "fingers"), "{}"),
    **dict.fromkeys(("signature", "shards", "config_hash"), "of a test"),
}


def write_data_file(
    path: Path,
    count: int,
    value: Callable[[Field, int], object],
    *,
    split: str = "train",
    image: int = 16,
    **attributes: object,
) -> Path:
    """Write samples of one split of a hand with three fingers.

    Args:
        path: Of the file.
        count: Number of samples.
        value: Returns what a field of a sample is, or the one value that fills it.
        split: Of the samples; the others have none.
        image: Edge of the images [pixels].
        **attributes: Of the file, in place of the usual ones.
    """
    letters = sizes(fingers=3, joints=8, image=image)
    with h5py.File(path, "w") as file:
        file.attrs.update(ATTRIBUTES | attributes)
        for name in SPLITS:
            group = file.create_group(name)
            for field in DATA_FIELDS:
                dataset = create_field(group, field, field.row_shape(letters))
                dataset.resize(count if name == split else 0, axis=0)
                for row in range(len(dataset)):
                    dataset[row] = value(field, row)
    return path
