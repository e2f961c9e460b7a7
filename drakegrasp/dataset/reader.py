"""Reading a dataset. Imports h5py and NumPy, but not Drake, trimesh or Dask.

torch is imported when samples become tensors.

>>> data = GraspDataset("OUT/grasping_oto.hdf5", split="train")   # doctest: +SKIP
>>> data[0].image.shape, data[0].grasp.shape                      # doctest: +SKIP
((4, 128, 128), (18,))
"""

from __future__ import annotations

import hashlib
import operator
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload
from weakref import WeakSet

import h5py
import numpy as np
import numpy.typing as npt

from drakegrasp.dataset.hdf5 import (
    ImageRows,
    open_hdf5,
    open_samples,
    opened,
    read_columns,
    says_damage,
    write_field,
)
from drakegrasp.dataset.schema import DATA_FIELDS, PREDICTED_ROW_FIELDS, SPLITS
from drakegrasp.errors import DataError, MachineError, first_line
from drakegrasp.foreign_files import validate_local
from drakegrasp.grasp import unused_fingers

if TYPE_CHECKING:
    import torch

#: The fields of a sample, by name.
FIELDS = {field.name: field for field in DATA_FIELDS}


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Sample:
    """One grasp with the image of its camera.

    Attributes:
        image: (4, S, S) float32: R, G, B in 0..1 and depth [m].
        mask: (S, S) uint8, 1 where the object is seen.
        grasp: (6k,) float32, contact points [m], then outward unit normals, in the camera frame,
            after closing.
        grasp_lifted: (6k,) float32, the same for the contacts that hold the object after the lift,
            placed on the object in its resting pose.
        fingers: (k,) bool, fingers that the grasp uses; contacts of other fingers are NaN.
        trial_id: Row of /trials in trials.hdf5.
        grasp_props: Fields of `grasp_props` by name: how well it holds, forces, palm, joints.
        props: Fields of `object_props` by name: names, mass properties, frames.
        conditions: Fields of `conditions` by name: friction, colours, light, camera, noise.
        dataset, row: Origin of the sample: the dataset and the row of its split. Copies and pickles
            keep both.
    """

    image: npt.NDArray[np.float32]
    mask: npt.NDArray[np.uint8]
    grasp: npt.NDArray[np.float32]
    grasp_lifted: npt.NDArray[np.float32]
    fingers: npt.NDArray[np.bool_]
    trial_id: int
    grasp_props: dict[str, Any]
    props: dict[str, Any]
    conditions: dict[str, Any]
    dataset: GraspDataset
    row: int

    def __repr__(self) -> str:
        return (
            f"Sample({self.props['object_name']!r}, row {self.row} of {self.dataset.split} in "
            f"{self.dataset.path.name}, trial {self.trial_id})"
        )


class GraspDataset:
    """One split of a data file as a sequence of samples.

    Any number of forked or spawned processes may read: each opens the file when it first reads from
    it, and a pickle holds no open file. A file that was rewritten in the meantime is rejected,
    because its rows may differ. `to_torch` returns tensors for torch's DataLoader.

    Args:
        path: `grasping_oto.hdf5` or `grasping_otm.hdf5`.
        split: `train`, `valid` or `test`.
        fewer_fingers: Whether to read a split in which some grasps leave fingers out. The contacts
            of these fingers are NaN and must not enter training unnoticed, so such a split is
            rejected by default. `Sample.fingers` tells which fingers a grasp uses.

    Attributes:
        path: Absolute path of the file, since the working directory may change.
        split: The split.
        camera: Camera of the images and of the grasps' frame, `oto` or `otm`.
        K: Camera matrix (3, 3) [px].
        image_size: Edge of the square images [px].
        content: Hash that identifies the samples of the split and their dataset.
        emptiness: What is said of the split if it has no samples.

    Raises:
        DataError: If the file is missing, damaged or differs from the schema, if the split is
            unknown, or if it has grasps with fewer fingers and `fewer_fingers` is false.
    """

    #: Whether some samples leave fingers out.
    has_fewer_fingers: bool = False

    def __init__(
        self, path: str | Path, *, split: str = "train", fewer_fingers: bool = False
    ) -> None:
        if split not in SPLITS:
            raise DataError(f"split must be one of {', '.join(SPLITS)}, got {split!r}")
        validate_local(path)
        self.path, self.split = Path(path).absolute(), split
        self._file: h5py.File | None = None
        self._fields: dict[str, h5py.Dataset | ImageRows | npt.NDArray[Any]] = {}
        self._process = -1

        # Facts about the split in the file.
        with open_samples(self.path) as file:
            self._length = len(file[split]["grasps"])
            self.emptiness = emptiness_of(split, [s for s in SPLITS if len(file[s]["grasps"])])
            self.image_size = int(file[split]["images"].shape[-1])
            self.K = np.array(file.attrs["K"])
            self.camera = str(file.attrs["camera"])
            self.content = _content(file, split)
            unused = file[split].get("grasp_props/unused")
            fewer = 0 if unused is None else np.count_nonzero(unused[:])

        # Contacts with NaN must be requested.
        self.has_fewer_fingers = bool(fewer)
        if fewer and not fewer_fingers:
            raise DataError(
                f"{self.path}: {split} must have contacts of all fingers, got {fewer} of "
                f"{self._length} grasps that leave some out, whose contacts are NaN: commands need "
                "a split of a hand whose preshapes close all fingers; in Python "
                "GraspDataset(..., fewer_fingers=True) reads these"
            )

    def __len__(self) -> int:
        return self._length

    @overload
    def __getitem__(self, index: int | np.integer) -> Sample: ...

    @overload
    def __getitem__(
        self, index: slice | Sequence[int] | npt.NDArray[np.integer]
    ) -> list[Sample]: ...

    def __getitem__(
        self, index: int | np.integer | slice | Sequence[int] | npt.NDArray[np.integer]
    ) -> Sample | list[Sample]:
        """Return the sample at an index, or a list of samples for a slice or a list of indices."""
        if isinstance(index, slice):
            return [self[i] for i in range(len(self))[index]]
        if np.ndim(index) == 1 and not isinstance(index, tuple):  # type: ignore[arg-type]
            return [self[i] for i in index]  # type: ignore[union-attr]
        row = self.row_of(index)  # type: ignore[arg-type]
        values = {field.name: self.value(field.name, row) for field in DATA_FIELDS}
        return Sample(
            image=values["images"],
            mask=values["masks"],
            grasp=values["grasps"],
            grasp_lifted=values["grasps_lifted"],
            fingers=~unused_fingers(values["grasp_props/unused"], len(values["grasps"]) // 6),
            trial_id=int(values["trial_id"]),
            grasp_props=_group(values, "grasp_props/"),
            props=_group(values, "object_props/"),
            conditions=_group(values, "conditions/"),
            dataset=self,
            row=row,
        )

    def row_of(self, index: int | np.integer) -> int:
        """Return the row of an index, which counts from the end if it is negative.

        Raises:
            IndexError: If the index is out of range.
        """
        index = operator.index(index)
        if not -self._length <= index < self._length:
            below = f"index must be below {self._length}, got {index}"
            raise IndexError(below if self._length else self.emptiness)
        return index % self._length

    def __iter__(self) -> Iterator[Sample]:
        return (self[i] for i in range(len(self)))

    def value(self, name: str, row: int) -> Any:
        """Return a field of one row; an array is a copy, text a str.

        Raises:
            KeyError: If there is no such field.
        """
        try:
            value: Any = self._field(name)[row]
            return value.decode() if FIELDS[name].dtype == "str" else value
        except Exception as error:
            raise self._as_damage(error) from None

    def column(self, name: str) -> npt.NDArray[Any]:
        """Return all rows (n, ...) of a field, e.g. `grasps` or `grasp_props/stable`.

        Raises:
            DataError: If there is no such field.
        """
        return self.rows(name, 0, len(self))

    def rows(self, name: str, start: int, stop: int) -> npt.NDArray[Any]:
        """Return the rows `start` to `stop` - 1 of a field; fewer if the split ends before.

        Raises:
            DataError: If there is no such field.
        """
        _validate_fields([name])
        group = self._open()[self.split]
        try:
            return read_columns(group, DATA_FIELDS, (name,), slice(start, stop))[name]
        except Exception as error:
            raise self._as_damage(error) from None

    def to_torch(self, fields: Sequence[str] = ("images", "grasps")) -> TorchSamples:
        """Return the split as tensors, for `torch.utils.data.DataLoader`.

        Args:
            fields: Names of the fields of a sample, as `column` takes them.

        Raises:
            DataError: If there is no such field.
            MachineError: If torch is not installed.
        """
        _validate_fields(fields)
        if find_spec("torch") is None:
            raise MachineError("to_torch needs torch, got none: pip install 'drakegrasp[torch]'")
        return TorchSamples(self, fields)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_file": None, "_fields": {}, "_process": -1}

    def __repr__(self) -> str:
        return f"GraspDataset({str(self.path)!r}, split={self.split!r}): {len(self)} grasps"

    def _field(self, name: str) -> h5py.Dataset | ImageRows | npt.NDArray[Any]:
        """Return a field of the file that this process has opened; the field is cached."""
        group = self._open()[self.split]
        if name not in self._fields:
            field = group.get(name)
            if field is None:
                field = read_columns(group, DATA_FIELDS, (name,))[name]
            self._fields[name] = ImageRows(field) if FIELDS[name].sample else field
        return self._fields[name]

    def _open(self) -> h5py.File:
        """Return the file, opened by this process."""
        if self._process == os.getpid():
            return self._file

        # An open HDF5 file must not cross a fork. All files that the parent had open are closed
        # first, since HDF5 would reuse one of their handles instead of opening the file again.
        for reader in {self, *_open_readers}:
            if reader._process != os.getpid():
                reader._close()

        # The rows of another file would be other samples.
        try:
            file = open_hdf5(self.path)
            if _content(file, self.split) != self.content:
                raise OSError("one with other samples")
        except (OSError, KeyError) as error:
            raise DataError(
                f"{self.path}: must hold the samples that it held when the dataset was opened, "
                f"got: {error}"
            ) from None
        self._file, self._process = file, os.getpid()
        _open_readers.add(self)
        return file

    def _as_damage(self, error: Exception) -> Exception:
        """Return an error as a `DataError` that names the file if the file is damaged."""
        if isinstance(error, DataError) or not says_damage(error):
            return error
        return DataError(f"{self.path}: must be undamaged, got: {first_line(error)}")

    def _close(self) -> None:
        if self._file is not None:
            self._file.close()
        self._file, self._fields, self._process = None, {}, -1


class TorchSamples:
    """Samples as dictionaries from field names to tensors of torch; a text field is a str.

    It has the interface of `torch.utils.data.Dataset`: torch collates the items and moves them
    between processes. Each process opens the file itself, and keeps the fields that are not images
    in memory: 72 bytes a sample for `grasps`.

    Args:
        data: The split.
        fields: Names of the fields, as `GraspDataset.column` takes them.

    Attributes:
        data, fields: The arguments.
    """

    def __init__(self, data: GraspDataset, fields: Sequence[str]) -> None:
        self.data, self.fields = data, tuple(fields)
        self._columns: dict[str, npt.NDArray[Any]] = {}

    def __len__(self) -> int:
        return len(self.data)

    def __getitem__(self, index: int) -> dict[str, Any]:
        row = self.data.row_of(index)
        return {name: self._value(name, row) for name in self.fields}

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_columns": {}}

    def _value(self, name: str, row: int) -> torch.Tensor | str:
        """Return a field of a sample; a tensor is a copy that the caller may change."""
        import torch

        if FIELDS[name].sample:
            return torch.from_numpy(self.data.value(name, row))
        if name not in self._columns:
            self._columns[name] = self.data.column(name)
        value = self._columns[name][row]
        return str(value) if isinstance(value, str) else torch.from_numpy(np.array(value))


#: Readers with an open file, opened here or in the process from which this one was forked.
_open_readers: WeakSet[GraspDataset] = WeakSet()


def emptiness_of(split: str, filled: Sequence[str]) -> str:
    """Return what is said of an empty split; it names the splits that have rows."""
    return f"split {split} is empty; not empty: {', '.join(filled) or 'none'}"


def _content(file: h5py.File, split: str) -> str:
    """Return a hash that identifies the samples of a split and their dataset."""
    digest = hashlib.sha256(str(file.attrs.get("signature")).encode())
    digest.update(file[split]["trial_id"][:].tobytes())
    return digest.hexdigest()


def _validate_fields(names: Sequence[str]) -> None:
    for name in names:
        if name not in FIELDS:
            raise DataError(f"field must be one of {', '.join(FIELDS)}, got {name!r}")


def _group(values: dict[str, Any], prefix: str) -> dict[str, Any]:
    """Return the values whose names begin with a prefix, without the prefix."""
    return {k.removeprefix(prefix): v for k, v in values.items() if k.startswith(prefix)}


#: Group of the rows in a file of results, which also has a group of verdicts.
ROWS_GROUP = "rows"


@dataclass(frozen=True, kw_only=True, eq=False)
class PredictedRows:
    """The dataset row of each of n predictions, as a file of results holds them.

    Trial ids identify the rows even if the filters or the split of the dataset change; they are
    valid as long as the dataset has the same shards.

    Attributes:
        split, camera: Split and camera of the data file; the camera of scenes is "view".
        shards: Hash of the shards that the dataset was assembled from, as its files have it.
        row: (n,) int64, rows of the split.
        trial_id: (n,) int64, rows of trials.hdf5.
    """

    split: str
    camera: str
    shards: str
    row: npt.NDArray[np.int64]
    trial_id: npt.NDArray[np.int64]

    @classmethod
    def of(cls, data: GraspDataset, rows: npt.NDArray[np.int64]) -> PredictedRows:
        """Return the rows of a split of a data file, or of the views of scenes.

        Raises:
            DataError: If the file is missing or damaged.
        """
        with opened(data.path, "a data file or scenes of drakegrasp") as file:
            shards, ids = str(file.attrs["shards"]), data.column("trial_id")[rows]
        return cls(split=data.split, camera=data.camera, shards=shards, row=rows, trial_id=ids)

    def write(self, file: h5py.File) -> None:
        """Write the rows into a file of results."""
        group = file.create_group(ROWS_GROUP)
        group.attrs.update({name: getattr(self, name) for name in ("split", "camera", "shards")})
        for field in PREDICTED_ROW_FIELDS:
            write_field(group, field, getattr(self, field.name))


def read_predicted_rows(file: h5py.File) -> PredictedRows | None:
    """Return the rows that a file of results belongs to; None if the file does not state them."""
    group, said = file.get(ROWS_GROUP), dict[str, Any]()
    try:
        said |= {name: str(group.attrs[name]) for name in ("split", "camera", "shards")}
        said |= {f.name: group[f.name][:].astype(f.dtype) for f in PREDICTED_ROW_FIELDS}
    except (AttributeError, KeyError, TypeError, ValueError):
        return None
    return PredictedRows(**said)
