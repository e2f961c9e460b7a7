"""Shards: the results of one work unit, in one immutable HDF5 file that is complete or absent.

The header of a shard identifies its work unit. Its seal, see `drakegrasp.runtime.files`, reveals
the change of any single bit.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from io import BytesIO
from pathlib import Path

import h5py
import numpy as np

from drakegrasp.dataset.hdf5 import AnyArray, opened_sealed, write_fixed
from drakegrasp.dataset.paths import shards_folder
from drakegrasp.dataset.schema import (
    LOOK_FIELDS,
    SCHEMA_VERSION,
    TRIAL_FIELDS,
    Field,
    validate_schema_version,
)
from drakegrasp.errors import DataError
from drakegrasp.runtime.files import FORMAT, SEAL_SIZE, write_sealed

#: Fields of `/trials` that are known for the whole dataset only; shards do not have them.
ASSEMBLED_FIELDS = ("trial_id", "object")


@dataclass(frozen=True, kw_only=True)
class ShardHeader:
    """The identity of a work unit.

    Attributes:
        config_hash: `Config.simulation_hash` of the dataset.
        mesh_sha256: Hash of the object's mesh file and of the object's attributes.
        object_name: Name of the object.
        start, stop: Range of the object's candidates.
    """

    config_hash: str
    mesh_sha256: str
    object_name: str
    start: int
    stop: int

    @property
    def stored(self) -> dict[str, str | int]:
        """The identity as the attributes of the shard's file."""
        return asdict(self)

    @property
    def label(self) -> str:
        """The work unit in words, for messages."""
        return (
            f"{self.object_name}, palm poses {self.start} to {self.stop - 1}, "
            f"configuration {self.config_hash}, mesh {self.mesh_sha256[:12]}"
        )

    @property
    def file_name(self) -> str:
        """Name of the shard in its object's folder."""
        return f"{self.start:07d}-{self.stop:07d}.h5"

    def path(self, out: Path) -> Path:
        """Return the path of the shard in a dataset's directory."""
        return shards_folder(out, self.object_name) / self.file_name

    def journal_path(self, out: Path) -> Path:
        """Return the path of the work unit's journal, see `drakegrasp.runtime.journal`."""
        return self.path(out).with_suffix(".journal")


@dataclass(frozen=True, kw_only=True, eq=False)
class Shard:
    """The results of a work unit.

    Attributes:
        header: Identity of the unit.
        trials: Columns by the names of `trial_columns`, a row per attempt; optional columns may be
            missing.
        looks: Columns by the names of LOOK_FIELDS, a row per success.
    """

    header: ShardHeader
    trials: Mapping[str, AnyArray]
    looks: Mapping[str, AnyArray]


def trial_columns() -> tuple[Field, ...]:
    """Return the fields of `/trials` that a shard has."""
    return tuple(f for f in TRIAL_FIELDS if f.name not in ASSEMBLED_FIELDS and f.derive is None)


def write_shard(out: Path, shard: Shard) -> bytes:
    """Write a shard into a dataset's directory and return its seal."""
    tables = (("trials", trial_columns(), shard.trials), ("looks", LOOK_FIELDS, shard.looks))
    content = BytesIO()
    with h5py.File(content, "w", userblock_size=SEAL_SIZE, libver=FORMAT) as file:
        file.attrs.update(shard.header.stored)
        file.attrs["schema_version"] = SCHEMA_VERSION
        for name, fields, columns in tables:
            group = file.create_group(name)
            for field in fields:
                if field.optional and field.name not in columns:
                    continue
                write_fixed(group, field, np.asarray(columns[field.name]))
    return write_sealed(shard.header.path(out), content)


@contextmanager
def open_shard(
    path: Path, header: ShardHeader, *, verify: bool = True
) -> Iterator[tuple[h5py.File, bytes]]:
    """Open a shard for reading while the block runs; yield it and its seal.

    Args:
        path: Path of the file.
        header: Identity that the shard must have.
        verify: Whether to verify the seal first, which reads the whole file.

    Raises:
        DataError: If the file is missing or truncated, if a single bit of it has changed, or if it
            belongs to another schema, configuration, mesh or range; the message names the file and
            the reason.
    """
    with opened_sealed(path, "shard", verify=verify) as (file, seal):
        validate_schema_version(path, file.attrs.get("schema_version"))

        # Check the identity: a file may have been copied to the path of another unit.
        own = ShardHeader(**{name: file.attrs[name] for name in header.stored})
        if own.stored != header.stored:
            raise DataError(f"{path}: must be a shard of {header.label}, got one of {own.label}")
        yield file, seal
