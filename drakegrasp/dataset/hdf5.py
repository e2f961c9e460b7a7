"""HDF5 files of a dataset: opening one to read, and writing a field of the schema into one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from drakegrasp.dataset.schema import Field
from drakegrasp.runtime.file_set import refuse_half_replaced

AnyArray = npt.NDArray[Any]
#: Rows in a chunk of a column of small values.
COLUMN_CHUNK = 2048


def open_hdf5(path: Path) -> h5py.File:
    """Open a file of a dataset to read it; close it after use.

    Raises:
        OSError: If it cannot be read.
        DataError: If a process died while it replaced the files beside it.
    """
    refuse_half_replaced(path.parent)
    return h5py.File(path, "r")


def create_field(group: h5py.Group, field: Field, shape: tuple[int, ...]) -> h5py.Dataset:
    """Create the dataset of a field, without rows; it can be resized.

    Unit, frame and meaning become attributes. An image is one chunk, because loaders read single
    samples in random order.

    Args:
        group: Where to create it.
        field: The field.
        shape: Shape of one row.
    """
    text = field.dtype == "str"
    dataset = group.create_dataset(
        field.name,
        shape=(0, *shape),
        maxshape=(None, *shape),
        dtype=h5py.string_dtype() if text else np.dtype(field.dtype),
        chunks=(1 if field.sample else COLUMN_CHUNK, *shape),
        compression="gzip",
        compression_opts=1,
        shuffle=not text,
    )
    dataset.attrs.update({"unit": field.unit, "frame": field.frame, "meaning": field.meaning})
    return dataset


def write_field(group: h5py.Group, field: Field, values: AnyArray) -> h5py.Dataset:
    """Create the dataset of a field from all of its rows (n, ...), see `create_field`."""
    dataset = create_field(group, field, values.shape[1:])
    dataset.resize(len(values), axis=0)
    if len(values):
        dataset[...] = values
    return dataset
