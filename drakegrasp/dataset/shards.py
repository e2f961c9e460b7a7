"""Immutable shards: what one work unit found, in one HDF5 file that is whole or absent.

A shard's header says what it is of. Its seal, see `drakegrasp.runtime.files`, shows any change
of a single bit.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

import h5py
import numpy as np
import numpy.typing as npt

from drakegrasp.dataset.hdf5 import AnyArray, write_field
from drakegrasp.dataset.schema import LOOK_FIELDS, SCHEMA_VERSION, TRIAL_FIELDS, Field
from drakegrasp.errors import DataError
from drakegrasp.runtime.files import atomic_hdf5, refuse_broken_seal

#: Fields of `/trials` that only the whole dataset can fill, so no shard has them.
ASSEMBLED_FIELDS = ("trial_id", "object")


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
    def label(self) -> str:
        """What it is of, in words."""
        return (
            f"{self.object_name}, palm poses {self.start} to {self.stop - 1}, "
            f"configuration {self.config_hash}, mesh {self.mesh_sha256[:12]}"
        )

    @property
    def file_name(self) -> str:
        """Name of the shard in its object's folder."""
        return f"{self.start:07d}-{self.stop:07d}.h5"

    def path(self, out: Path) -> Path:
        """Return where the shard is in a dataset's directory."""
        return out / "shards" / self.object_name / self.file_name

    def journal_path(self, out: Path) -> Path:
        """Return where the journal of a run of the unit is, see `drakegrasp.runtime.journal`."""
        return self.path(out).with_suffix(".journal")


@dataclass(frozen=True, kw_only=True, eq=False)
class Shard:
    """The arrays of a work unit: `trials` by TRIAL_FIELDS, `looks` by LOOK_FIELDS."""

    header: ShardHeader
    trials: Mapping[str, AnyArray]
    looks: Mapping[str, AnyArray]


def trial_columns() -> tuple[Field, ...]:
    """Return the fields of `/trials` that a shard has."""
    return tuple(f for f in TRIAL_FIELDS if f.name not in ASSEMBLED_FIELDS)


def write_shard(out: Path, shard: Shard) -> Path:
    """Write a shard into a dataset's directory and return its path."""
    path = shard.header.path(out)
    tables = (("trials", trial_columns(), shard.trials), ("looks", LOOK_FIELDS, shard.looks))
    with atomic_hdf5(path, sealed=True) as file:
        file.attrs.update(asdict(shard.header))
        file.attrs["schema_version"] = SCHEMA_VERSION
        for name, fields, columns in tables:
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
        DataError: If it is missing, truncated or changed by a single bit, or of another schema,
            configuration, mesh or range; the message names the file and the reason.
    """
    with _open_shard(path, header) as (file, found):
        return Shard(
            header=found,
            trials={f.name: file["trials"][f.name][:] for f in trial_columns()},
            looks={f.name: file["looks"][f.name][:] for f in LOOK_FIELDS},
        )


def read_outcomes(path: Path, header: ShardHeader, *, trust: bool = False) -> npt.NDArray[np.uint8]:
    """Return the outcomes of a shard's attempts, without its other columns.

    Args:
        path: Of the file.
        header: What it must be of.
        trust: Whether to leave out the check of its seal, which reads all of it.

    Raises:
        DataError: See `read_shard`.
    """
    with _open_shard(path, header, trust=trust) as (file, _):
        return np.asarray(file["trials/outcome"][:])


@contextmanager
def _open_shard(
    path: Path, header: ShardHeader | None, *, trust: bool = False
) -> Iterator[tuple[h5py.File, ShardHeader]]:
    if not trust:
        refuse_broken_seal(path)
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
            if header is not None and found != header:
                raise DataError(
                    f"{path}: must be a shard of {header.label}, got one of {found.label}"
                )
            yield file, found
    except (OSError, KeyError) as error:
        raise DataError(f"{path}: must be a complete shard, got another file ({error})") from None
