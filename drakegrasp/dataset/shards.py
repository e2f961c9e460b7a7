"""Shards: the results of one work unit, in one immutable HDF5 file that is complete or absent.

The header of a shard identifies its work unit. Its seal, see `drakegrasp.runtime.files`, reveals
the change of any single bit.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

import h5py
import numpy as np

from drakegrasp.dataset.hdf5 import AnyArray, read_columns, write_fixed
from drakegrasp.dataset.opening import (
    Kind,
    differences,
    opened,
    read_codes,
    refuse_first,
    refuse_other_attributes,
)
from drakegrasp.dataset.paths import shards_folder
from drakegrasp.dataset.schema import LOOK_FIELDS, SCHEMA_VERSION, TRIAL_FIELDS, Field
from drakegrasp.errors import DataError
from drakegrasp.outcomes import Outcome
from drakegrasp.runtime.files import atomic_hdf5, refuse_broken_seal

#: Fields of `/trials` that are known for the whole dataset only; shards do not have them.
ASSEMBLED_FIELDS = ("trial_id", "object")
_ATTRIBUTES: Mapping[str, Kind] = {
    **dict.fromkeys(("config_hash", "mesh_sha256", "object_name"), str),
    **dict.fromkeys(("start", "stop"), int),
}


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


def write_shard(out: Path, shard: Shard) -> Path:
    """Write a shard into a dataset's directory and return its path."""
    path = shard.header.path(out)
    tables = (("trials", trial_columns(), shard.trials), ("looks", LOOK_FIELDS, shard.looks))
    with atomic_hdf5(path, sealed=True) as file:
        file.attrs.update(shard.header.stored)
        file.attrs["schema_version"] = SCHEMA_VERSION
        for name, fields, columns in tables:
            group = file.create_group(name)
            for field in fields:
                if field.optional and field.name not in columns:
                    continue
                write_fixed(group, field, np.asarray(columns[field.name]))
    return path


def read_shard(path: Path, header: ShardHeader | None = None, *, verify_seal: bool = True) -> Shard:
    """Return a shard.

    Args:
        path: Path of the file.
        header: Identity that the shard must have; any if None.
        verify_seal: Whether to hash the whole file and compare the hash with its seal.

    Raises:
        DataError: If the file is missing or truncated, if a single bit of it has changed, or if it
            belongs to another schema, configuration, mesh or range; the message names the file and
            the reason.
    """
    with open_shard(path, header, verify_seal=verify_seal) as (file, own_header):
        return Shard(
            header=own_header,
            trials=read_columns(file["trials"], trial_columns()),
            looks=read_columns(file["looks"], LOOK_FIELDS),
        )


@contextmanager
def open_shard(
    path: Path,
    header: ShardHeader | None,
    *,
    verify_seal: bool = True,
    again: bool = False,
) -> Iterator[tuple[h5py.File, ShardHeader]]:
    """Open a shard for reading, with its header, while the block runs.

    Args:
        path: Path of the file.
        header: Identity that the shard must have; any if None.
        verify_seal: Whether to verify the seal first, which reads the whole file.
        again: Whether the same work has opened the shard before; then only its identity is checked.

    Raises:
        DataError: See `read_shard`.
    """
    if verify_seal:
        refuse_broken_seal(path)
    with opened(path, "a complete shard", again=again) as file:
        refuse_other_attributes(path, file, _ATTRIBUTES)

        # Check the identity: a file may have been copied to the path of another unit.
        own_header = ShardHeader(
            config_hash=file.attrs["config_hash"],
            mesh_sha256=file.attrs["mesh_sha256"],
            object_name=file.attrs["object_name"],
            start=int(file.attrs["start"]),
            stop=int(file.attrs["stop"]),
        )
        if header is not None and own_header.stored != header.stored:
            raise DataError(
                f"{path}: must be a shard of {header.label}, got one of {own_header.label}"
            )

        # Check the columns, outcomes and row numbers.
        if not again:
            tables = {"trials": trial_columns(), "looks": LOOK_FIELDS}
            refuse_first(path, differences(file, tables))
            outcomes = read_codes(file["trials/outcome"], list(Outcome))
            read_codes(file["looks/row"], len(outcomes))
        yield file, own_header
