"""Comparisons that several test modules make."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from drakegrasp.errors import DrakegraspError, GraspError


def contents(folder: Path) -> dict[str, bytes]:
    """Return the bytes of all files below a folder by their paths in it."""
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def arrays_of(path: Path) -> dict[str, np.ndarray]:
    """Return every dataset of an HDF5 file by its path."""
    found: dict[str, np.ndarray] = {}

    def visit(name: str, item: h5py.Dataset | h5py.Group) -> None:
        if isinstance(item, h5py.Dataset):
            found[name] = item[()]

    with h5py.File(path, "r") as file:
        file.visititems(visit)
    return found


def assert_same_arrays(a: Path, b: Path) -> None:
    """Two HDF5 files hold the same datasets with the same bits."""
    first, second = arrays_of(a), arrays_of(b)
    assert first.keys() == second.keys()
    for name, values in first.items():
        other = second[name]
        assert values.dtype == other.dtype, name
        assert np.array_equal(values, other, equal_nan=values.dtype.kind == "f"), name


def assert_same_dataset(a: Path, b: Path) -> None:
    """Two dataset directories hold the same data files and shards."""
    files = sorted(p.relative_to(a) for p in a.rglob("*") if p.suffix in (".h5", ".hdf5"))
    assert files
    assert files == sorted(p.relative_to(b) for p in b.rglob("*") if p.suffix in (".h5", ".hdf5"))
    for name in files:
        assert_same_arrays(a / name, b / name)
    assert (a / "manifest.json").read_bytes() == (b / "manifest.json").read_bytes()


def refused(call: Any, *args: Any, **options: Any) -> str:
    """Return the one line with which a call is refused."""
    with pytest.raises(GraspError) as caught:
        call(*args, **options)
    assert isinstance(caught.value, DrakegraspError)
    assert "\n" not in str(caught.value)
    return str(caught.value)
