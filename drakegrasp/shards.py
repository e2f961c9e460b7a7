"""Immutable shards: what one work unit found, in one HDF5 file that is whole or absent.

A file is written under a temporary name in its own folder, closed, synced and renamed, so
a reader never sees half of one and a crash leaves nothing but a temporary file. A shard's
header says what it is of; its checksum covers every array.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from drakegrasp.errors import DataError
from drakegrasp.schema import LOOK_FIELDS, SCHEMA_VERSION, TRIAL_FIELDS, Field

AnyArray = npt.NDArray[Any]

#: Fields of `/trials` that only the whole dataset can fill, so no shard has them.
ASSEMBLED_FIELDS = ("trial_id", "object")
#: Deflate compresses by 1,032 at most; more means that a size in the file is wrong.
MAX_COMPRESSION = 1032
#: Rows in a chunk of a column of small values.
COLUMN_CHUNK = 2048
#: Suffix of a file that is being written; what is left of one after a crash may be deleted.
TEMPORARY_SUFFIX = ".tmp"


@dataclass(frozen=True, kw_only=True)
class ShardHeader:
    """What a shard is of: the identity of a work unit.

    Attributes:
        config_hash: `Config.simulation_hash` of the dataset.
        mesh_sha256: Hash of the object's mesh and scale.
        object_name: Name of the object.
        start, stop: Range of its candidates.
    """

    config_hash: str
    mesh_sha256: str
    object_name: str
    start: int
    stop: int

    @property
    def file_name(self) -> str:
        """Name of the shard in its object's folder."""
        return f"{self.start:07d}-{self.stop:07d}.h5"

    def path(self, out: Path) -> Path:
        """Return where the shard is in a dataset's directory."""
        return out / "shards" / self.object_name / self.file_name


@dataclass(frozen=True, kw_only=True, eq=False)
class Shard:
    """The arrays of a work unit: `trials` by TRIAL_FIELDS, `looks` by LOOK_FIELDS."""

    header: ShardHeader
    trials: Mapping[str, AnyArray]
    looks: Mapping[str, AnyArray]


def trial_columns() -> tuple[Field, ...]:
    """Return the fields of `/trials` that a shard has."""
    return tuple(f for f in TRIAL_FIELDS if f.name not in ASSEMBLED_FIELDS)


@contextmanager
def atomic_hdf5(path: Path) -> Iterator[h5py.File]:
    """Open a new HDF5 file that appears at `path` only when the block ends well.

    Raises:
        OSError: If the disk is full or the folder cannot be written; nothing is left behind.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}{TEMPORARY_SUFFIX}")
    try:
        with h5py.File(temporary, "w") as file:
            yield file
        sync_and_rename(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def sync_and_rename(temporary: Path, path: Path) -> None:
    """Make a finished temporary file durable and give it its name, in one step for readers."""
    for name, flags in ((temporary, os.O_RDONLY), (path.parent, os.O_RDONLY | os.O_DIRECTORY)):
        if name == path.parent:
            temporary.replace(path)
        descriptor = os.open(name, flags)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def create_field(group: h5py.Group, field: Field, shape: tuple[int, ...]) -> h5py.Dataset:
    """Create an empty, growing dataset of a field whose rows have a shape.

    Unit, frame and meaning become attributes. Images get a chunk per sample, because
    loaders read them one by one in random order.
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
    """Write all rows of one field, see `create_field`."""
    dataset = create_field(group, field, values.shape[1:])
    dataset.resize(len(values), axis=0)
    if len(values):
        dataset[...] = values
    return dataset


def write_shard(out: Path, shard: Shard) -> Path:
    """Write a shard into a dataset's directory and return its path."""
    path = shard.header.path(out)
    with atomic_hdf5(path) as file:
        file.attrs.update(asdict(shard.header))
        file.attrs["schema_version"] = SCHEMA_VERSION
        file.attrs["checksum"] = _checksum(shard)
        for name, fields, columns in _tables(shard):
            group = file.create_group(name)
            for field in fields:
                write_field(group, field, np.asarray(columns[field.name]))
    return path


def read_shard(path: Path, header: ShardHeader | None = None) -> Shard:
    """Return a shard, whole and unharmed.

    Args:
        path: Of the file.
        header: What it must be of, if that matters.

    Raises:
        DataError: If it is truncated, of another schema, configuration, mesh or range, or
            its checksum disagrees; the message names the file and the reason.
    """
    try:
        with h5py.File(path, "r") as file:
            version = int(file.attrs["schema_version"])
            if version != SCHEMA_VERSION:
                raise DataError(f"{path}: schema must be {SCHEMA_VERSION}, got {version}")
            found = ShardHeader(
                config_hash=str(file.attrs["config_hash"]),
                mesh_sha256=str(file.attrs["mesh_sha256"]),
                object_name=str(file.attrs["object_name"]),
                start=int(file.attrs["start"]),
                stop=int(file.attrs["stop"]),
            )
            _refuse_impossible_sizes(file, path.stat().st_size)
            shard = Shard(
                header=found,
                trials={f.name: file["trials"][f.name][:] for f in trial_columns()},
                looks={f.name: file["looks"][f.name][:] for f in LOOK_FIELDS},
            )
            checksum = str(file.attrs["checksum"])
    except (OSError, KeyError, RuntimeError, ValueError, TypeError, MemoryError) as error:
        if isinstance(error, DataError):
            raise
        raise DataError(f"{path}: must be a complete shard, got a damaged file ({error})") from None
    if header is not None and found != header:
        raise DataError(f"{path}: must be a shard of {header}, got one of {found}")
    if _checksum(shard) != checksum:
        raise DataError(f"{path}: checksum must be {checksum[:12]}…, got other content")
    return shard


def _refuse_impossible_sizes(file: h5py.File, file_size: int) -> None:
    """Refuse columns that cannot have come from a file of this size before memory is taken."""
    for group in ("trials", "looks"):
        datasets = list(file[group].values())
        if len({len(dataset) for dataset in datasets}) != 1:
            raise ValueError(f"columns of {group} differ in length")
        if any(dataset.nbytes > MAX_COMPRESSION * file_size for dataset in datasets):
            raise ValueError(f"a column of {group} is larger than the file can hold")


def _tables(shard: Shard) -> tuple[tuple[str, tuple[Field, ...], Mapping[str, AnyArray]], ...]:
    return (("trials", trial_columns(), shard.trials), ("looks", LOOK_FIELDS, shard.looks))


def _checksum(shard: Shard) -> str:
    digest = hashlib.sha256(repr(shard.header).encode())
    for name, fields, columns in _tables(shard):
        for field in fields:
            values = np.ascontiguousarray(columns[field.name], dtype=np.dtype(field.dtype))
            digest.update(f"{name}/{field.name}{values.shape}".encode())
            digest.update(values.tobytes())
    return digest.hexdigest()
