"""A shard of random values, and one that is read whole."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from drakegrasp.dataset.hdf5 import read_columns
from drakegrasp.dataset.schema import LOOK_FIELDS, Field, sizes
from drakegrasp.dataset.shards import Shard, ShardHeader, open_shard, trial_columns, write_shard
from drakegrasp.outcomes import Outcome
from drakegrasp.runtime.files import validate_seal

SIZES = sizes(fingers=3, joints=8, image=8)


HEADER = ShardHeader(
    config_hash="0123456789abcdef",
    mesh_sha256="f" * 64,
    object_name="24_mug_final",
    start=50,
    stop=100,
)


def column(field: Field, count: int, rng: np.random.Generator) -> npt.NDArray[Any]:
    """Return rows of random bytes of a field's type: every NaN, infinity and denormal, too."""
    shape, dtype = (count, *field.row_shape(SIZES)), np.dtype(field.dtype)
    if dtype.kind == "b":
        return rng.integers(0, 2, shape).astype(bool)
    return np.frombuffer(rng.bytes(dtype.itemsize * int(np.prod(shape))), dtype).reshape(shape)


def some_shard(*, trials: int = 12, looks: int = 3, seed: int = 0) -> Shard:
    rng = np.random.default_rng(seed)
    shard = Shard(
        header=HEADER,
        trials={f.name: column(f, trials, rng) for f in trial_columns()},
        looks={f.name: column(f, looks, rng) for f in LOOK_FIELDS},
    )
    # Two columns stand for something that there is.
    outcome = np.array(list(Outcome), dtype=np.uint8)[shard.trials["outcome"] % len(Outcome)]
    return replace(
        shard,
        trials={**shard.trials, "outcome": outcome},
        looks={**shard.looks, "row": np.arange(looks, dtype=np.int32)},
    )


def written_shard(out: Path, shard: Shard) -> Path:
    """Write a shard and return its path."""
    write_shard(out, shard)
    return shard.header.path(out)


def read_shard(path: Path, header: ShardHeader | None = None) -> Shard:
    """Return a shard; without a header, that of any work unit."""
    if header is None:
        validate_seal(path)
        with h5py.File(path) as file:
            header = ShardHeader(**{name: file.attrs[name] for name in HEADER.stored})
    with open_shard(path, header) as (file, _):
        return Shard(
            header=header,
            trials=read_columns(file["trials"], trial_columns()),
            looks=read_columns(file["looks"], LOOK_FIELDS),
        )
