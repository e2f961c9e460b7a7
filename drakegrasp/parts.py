"""Which rows of which shards make up a dataset, in which order."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drakegrasp.manifest import Manifest
from drakegrasp.outcomes import Outcome
from drakegrasp.shards import Shard, ShardHeader, read_shard, trial_columns


@dataclass(frozen=True, kw_only=True, eq=False)
class Part:
    """A shard's place in the dataset: its first row, how many rows are taken, their shapes."""

    header: ShardHeader
    object: int
    first: int
    rows: int
    shapes: Mapping[str, tuple[int, ...]]


def walk_parts(out: Path, manifest: Manifest) -> Iterator[tuple[Part, Shard]]:
    """Yield the shards in the order of their rows, each object's up to its last wanted grasp."""
    index = {entry["name"]: i for i, entry in enumerate(manifest.objects)}
    wanted: dict[str, int | None] = dict.fromkeys(index, manifest.config.max_grasps)
    first = 0
    for header in manifest.headers():
        name = header.object_name
        if wanted[name] == 0:
            continue
        shard = read_shard(header.path(out), header)
        rows, wanted[name] = rows_within(shard, wanted[name])
        shapes = {f.name: shard.trials[f.name].shape[1:] for f in trial_columns()}
        shapes["image"] = shard.looks["mask_oto"].shape[1:]
        yield (
            Part(header=header, object=index[name], first=first, rows=rows, shapes=shapes),
            shard,
        )
        first += rows


def rows_within(shard: Shard, wanted: int | None) -> tuple[int, int | None]:
    """Return how many rows of a shard an object needs, and how many grasps it then wants.

    The rows end with the last wanted grasp, so what is in a dataset does not depend on how
    far work had gone when enough was found.
    """
    hits = np.flatnonzero(shard.trials["outcome"] == Outcome.SUCCESS)
    if wanted is None or len(hits) < wanted:
        return len(shard.trials["outcome"]), None if wanted is None else wanted - len(hits)
    return int(hits[wanted - 1]) + 1, 0
