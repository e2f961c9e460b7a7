"""What assembling reads from the shards before it writes a row, and what it decides.

The shards of each object are read in order: their seals are verified, their rows are counted, and
the columns of their successes are collected. From these follows which successes are samples, and in
which split each sample is. This keeps a few numbers per success, whatever the number of attempts.
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import h5py
import numpy as np
import numpy.typing as npt

from drakegrasp.dataset.hdf5 import AnyArray, read_columns, sizes_in
from drakegrasp.dataset.manifest import Manifest
from drakegrasp.dataset.rejections import AttemptKey
from drakegrasp.dataset.schema import LOOK_FIELDS, TRIAL_FIELDS
from drakegrasp.dataset.shards import ShardHeader, open_shard
from drakegrasp.dataset.split import Home, find_homes, split_samples
from drakegrasp.dataset.successes import LOOK_COLUMNS, TRIAL_COLUMNS, judge_successes, successes_of
from drakegrasp.errors import DataError
from drakegrasp.filters import Removal
from drakegrasp.runtime.files import read_seal
from drakegrasp.runtime.progress import Report, silent
from drakegrasp.table import Table, join


@dataclass(frozen=True, kw_only=True)
class ShardRows:
    """The rows that the dataset takes from a shard: the first ones.

    Attributes:
        header: Header of the shard.
        object: Row of the shard's object in /objects.
        first: Id of the trial in the shard's first row.
        count: Number of rows taken.
    """

    header: ShardHeader
    object: int
    first: int
    count: int


@dataclass(frozen=True, kw_only=True, eq=False)
class Survey:
    """Rows and successes of all shards of a dataset.

    Attributes:
        shards: The rows that the dataset takes from each shard, in order.
        successes: The successes among these rows, with the columns of `successes_of` and the ids of
            their trials.
        sizes: Lengths of the letters in the shapes of the fields.
        seals: Hash of the seals of the shards, see `shards_sha256`.
    """

    shards: Sequence[ShardRows]
    successes: Table
    sizes: Mapping[str, int]
    seals: str

    @property
    def count(self) -> int:
        """Number of rows of /trials."""
        return self.shards[-1].first + self.shards[-1].count


def survey(
    out: Path,
    manifest: Manifest,
    known: Mapping[ShardHeader, Table] | None = None,
    *,
    progress: Report = silent,
) -> Survey:
    """Survey the shards of a dataset.

    Args:
        out: Directory of the dataset.
        manifest: Its manifest.
        known: The successes of each shard, as `successes_of` returns them; None: they are read
            from the shards.
        progress: Called with the number of surveyed shards and the number of all.

    Raises:
        DataError: If a shard is missing or damaged, or no object has a palm pose.
    """
    headers, letters = list(manifest.headers()), dict[str, int]()
    numbers = {entry.name: i for i, entry in enumerate(manifest.objects)}
    shards, tables, first = list[ShardRows](), list[Table](), 0
    for header in headers:
        i = numbers[header.object_name]
        with open_shard(header.path(out), header) as file:
            # The rows end with the last palm pose that the dataset takes. So a dataset does not
            # depend on how many more attempts the workers had begun.
            palms, tried = file["trials/candidate"][:], manifest.objects[i].tried
            count = len(palms) if tried is None else int(np.count_nonzero(palms < tried))
            if known is None:
                successes = successes_of(shard_successes(file), manifest.config)
            else:
                successes = known[header]
            if not letters:
                letters = sizes_in(file["trials"], TRIAL_FIELDS)
                letters |= sizes_in(file["looks"], LOOK_FIELDS)
        successes = successes[successes["trial_id"] < count]
        own = np.full(successes.count, i, dtype=np.int32)
        ids = first + successes["trial_id"]
        tables.append(successes.with_columns(object=own, trial_id=ids))
        shards.append(ShardRows(header=header, object=i, first=first, count=count))
        first += count
        progress(len(shards), 2 * len(headers))
    if not shards:
        raise DataError(f"{out}: no object has a palm pose to try")
    seals = shards_sha256(out, manifest)
    return Survey(shards=shards, successes=join(tables), sizes=letters, seals=seals)


def shard_successes(file: h5py.File) -> Table:
    """Return the columns of a shard's successes from which those of `successes_of` follow.

    `row` is each success's row of the shard's /trials.
    """
    row = read_columns(file["looks"], LOOK_FIELDS, ("row",))["row"]
    trials = read_columns(file["trials"], TRIAL_FIELDS, TRIAL_COLUMNS)[row]
    looks = read_columns(file["looks"], LOOK_FIELDS, LOOK_COLUMNS)
    images = file["looks/image_otm"]
    depth = images[:, 3] if len(row) else np.zeros((0, 1, 1))
    return trials.with_columns(looks, row=row, depth_otm=depth)


def shards_sha256(out: Path, manifest: Manifest) -> str:
    """Return a hash of the seals of all shards that the files are made from, hexadecimal.

    The seals are not verified.

    Raises:
        DataError: If a shard is missing.
    """
    whole = hashlib.sha256()
    for headers in filter(None, headers_by_object(manifest)):
        seals = b"".join(read_seal(header.path(out)) for header in headers)
        whole.update(hashlib.sha256(seals).digest())
    return whole.hexdigest()


def headers_by_object(manifest: Manifest) -> list[tuple[ShardHeader, ...]]:
    """Return the work units of each object."""
    by_name: dict[str, list[ShardHeader]] = {entry.name: [] for entry in manifest.objects}
    for header in manifest.headers():
        by_name[header.object_name].append(header)
    return [tuple(headers) for headers in by_name.values()]


@dataclass(frozen=True, kw_only=True, eq=False)
class Decisions:
    """What is decided about the n successes of a dataset.

    Attributes:
        manifest: Manifest of the dataset, in which each object that has samples has its split, if
            whole objects are split.
        survey: Rows and successes of the dataset's shards.
        removal: (n,) uint8, the `Removal` of each success.
        splits: Indices of the samples of each split among the successes, in rising order.
    """

    manifest: Manifest
    survey: Survey
    removal: AnyArray
    splits: Mapping[str, npt.NDArray[np.int64]]

    @cached_property
    def ids(self) -> dict[str, npt.NDArray[np.int64]]:
        """For each split the ids of the trials that are samples, in rising order."""
        return {
            split: self.survey.successes["trial_id"][rows] for split, rows in self.splits.items()
        }


def keys_of(manifest: Manifest, successes: Table) -> dict[AttemptKey, int]:
    """Return the trial id of each success, by the identity of its attempt."""
    names = ("object", "candidate", "standoff_index", "trial_id")
    rows = zip(*(successes[name].tolist() for name in names), strict=True)
    return {AttemptKey(manifest.objects[i].name, *key): t for i, *key, t in rows}


def decide(manifest: Manifest, survey: Survey) -> Decisions:
    """Decide which successes are samples, and the split of each sample.

    Args:
        manifest: Manifest of the dataset, with filters, split and rejected attempts.
        survey: Rows and successes of the dataset's shards.
    """
    # Apply the filters.
    successes = survey.successes
    known = keys_of(manifest, successes)
    rejected = [known[key] for key in manifest.rejected if key in known]
    removal = judge_successes(successes, manifest.config.filters, rejected)

    # Split the samples.
    kept = np.flatnonzero(removal == Removal.KEPT)
    manifest = _with_homes(manifest, set(successes["object"][kept].tolist()))
    split = split_samples(
        successes["object"][kept],
        [entry.name for entry in manifest.objects],
        [entry.class_name for entry in manifest.objects],
        manifest.groups,
        known_homes(manifest),
        manifest.config.split,
        manifest.config.seed,
    )
    splits = {name: kept[rows] for name, rows in split.items()}
    return Decisions(manifest=manifest, survey=survey, removal=removal, splits=splits)


def known_homes(manifest: Manifest) -> dict[str, Home]:
    """Return the split of each group that was in one before; none if the split is by class.

    Raises:
        DataError: If objects of a group were in two splits.
    """
    homes, first = dict[str, Home](), dict[str, str]()
    if manifest.config.split.by == "class":
        return homes
    for group, entry in zip(manifest.groups, manifest.objects, strict=True):
        if entry.split is None:
            continue
        if homes.setdefault(group, entry.split) != entry.split:
            raise DataError(
                f"{first[group]} and {entry.name} must be in one split to be of one group "
                f"({group}), got them in {homes[group]} and {entry.split}"
            )
        first.setdefault(group, entry.name)
    return homes


def _with_homes(manifest: Manifest, present: Collection[int]) -> Manifest:
    """Return a manifest with the splits of its objects.

    Args:
        manifest: The manifest.
        present: Rows in /objects of the objects that have samples.
    """
    rules, groups = manifest.config.split, manifest.groups
    if rules.by == "class":
        return manifest
    known = known_homes(manifest)
    homes = {**known, **find_homes({groups[i] for i in present}, known, rules)}
    objects = tuple(
        replace(entry, split=homes.get(group))
        for group, entry in zip(groups, manifest.objects, strict=True)
    )
    return replace(manifest, objects=objects)
