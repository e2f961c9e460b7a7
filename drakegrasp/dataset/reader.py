"""Reading a dataset. Imports h5py and NumPy, but no Drake, no trimesh and no Dask.

>>> data = GraspDataset("OUT/grasping_oto.hdf5", split="train")   # doctest: +SKIP
>>> data[0].image.shape, data[0].grasp.shape                      # doctest: +SKIP
((4, 128, 128), (18,))
"""

from __future__ import annotations

import operator
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from drakegrasp.dataset.hdf5 import open_hdf5
from drakegrasp.dataset.schema import DATA_FIELDS, SPLITS, refuse_other_schema
from drakegrasp.errors import DataError


@dataclass(frozen=True, kw_only=True, eq=False)
class Sample:
    """One grasp with the image of its camera.

    Attributes:
        image: (4, S, S) float32: R, G, B in 0..1 and depth [m].
        mask: (S, S) uint8, 1 where the object is seen.
        grasp: (6k,) float32, contact points [m], then outward unit normals, in the camera frame,
            after closing.
        grasp_held: (6k,) float32, the same where the fingertips hold the object after the lift, on
            the object in its resting pose.
        trial_id: Row of /trials in trials.hdf5.
        grasp_props: Fields of `grasp_props` by name: how well it holds, forces, palm, joints.
        props: Fields of `object_props` by name: names, mass properties, frames.
        conditions: Fields of `conditions` by name: friction, colours, light, camera, noise.
    """

    image: npt.NDArray[np.float32]
    mask: npt.NDArray[np.uint8]
    grasp: npt.NDArray[np.float32]
    grasp_held: npt.NDArray[np.float32]
    trial_id: int
    grasp_props: dict[str, Any]
    props: dict[str, Any]
    conditions: dict[str, Any]


class GraspDataset:
    """One split of a data file as a sequence of samples.

    Works with torch's DataLoader and any number of workers: each process opens the file when it
    first reads from it, and a pickle holds no open file.

    Args:
        path: `grasping_oto.hdf5` or `grasping_otm.hdf5`.
        split: `train`, `valid` or `test`.

    Attributes:
        path, split: As given.
        camera: Camera of the images and of the grasps' frame, `oto` or `otm`.
        K: Camera matrix (3, 3) [px].
        image_size: Edge of the square images [px].

    Raises:
        DataError: If the file is missing, of another kind or schema, or the split is unknown.
    """

    def __init__(self, path: str | Path, *, split: str = "train") -> None:
        if split not in SPLITS:
            raise DataError(f"split must be one of {', '.join(SPLITS)}, got {split!r}")
        self.path, self.split = Path(path), split
        self._file: h5py.File | None = None
        self._process = -1
        try:
            with open_hdf5(self.path) as file:
                # The version first: another schema may have other fields.
                refuse_other_schema(self.path, file.attrs["schema_version"])
                self._length = len(file[split]["grasps"])
                self.image_size = int(file[split]["images"].shape[-1])
                self.K = np.array(file.attrs["K"])
                self.camera = str(file.attrs["camera"])
        except (OSError, KeyError) as error:
            raise DataError(
                f"{self.path}: must be a data file of drakegrasp, got none ({error})"
            ) from None

    def __len__(self) -> int:
        return self._length

    def __getitem__(self, index: int) -> Sample:
        # As a list: negative from the end, IndexError beyond it.
        index = operator.index(index)
        if not -self._length <= index < self._length:
            raise IndexError(f"index must be below {self._length}, got {index}")

        group = self._open()[self.split]
        row = index % self._length
        values = {f.name: _value(group[f.name], row, f.dtype) for f in DATA_FIELDS}
        return Sample(
            image=values["images"],
            mask=values["masks"],
            grasp=values["grasps"],
            grasp_held=values["grasps_held"],
            trial_id=int(values["trial_id"]),
            grasp_props=_group(values, "grasp_props/"),
            props=_group(values, "object_props/"),
            conditions=_group(values, "conditions/"),
        )

    def __iter__(self) -> Iterator[Sample]:
        return (self[i] for i in range(len(self)))

    def column(self, name: str) -> npt.NDArray[Any]:
        """Return all rows (n, ...) of a field, e.g. `grasps` or `grasp_props/stable`.

        Raises:
            DataError: If there is no such field.
        """
        return self.rows(name, 0, len(self))

    def rows(self, name: str, start: int, stop: int) -> npt.NDArray[Any]:
        """Return the rows `start` to `stop` - 1 of a field, fewer where the split ends.

        Raises:
            DataError: If there is no such field.
        """
        names = {f.name: f for f in DATA_FIELDS}
        if name not in names:
            raise DataError(f"field must be one of {', '.join(names)}, got {name!r}")
        dataset = self._open()[self.split][name]
        if names[name].dtype == "str":
            return np.asarray(dataset.asstr()[start:stop])
        return np.asarray(dataset[start:stop])

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_file": None, "_process": -1}

    def __repr__(self) -> str:
        return f"GraspDataset({str(self.path)!r}, split={self.split!r}): {len(self)} grasps"

    def _open(self) -> h5py.File:
        # An open HDF5 file must not cross a fork: each process opens its own.
        if self._file is None or self._process != os.getpid():
            self._file = open_hdf5(self.path)
            self._process = os.getpid()
        return self._file


def _group(values: dict[str, Any], prefix: str) -> dict[str, Any]:
    """Return the values whose names begin with a prefix, without it."""
    return {k.removeprefix(prefix): v for k, v in values.items() if k.startswith(prefix)}


def _value(dataset: h5py.Dataset, row: int, dtype: str) -> Any:
    """Return one row of a dataset; text as str."""
    value = dataset[row]
    return value.decode() if dtype == "str" else value
