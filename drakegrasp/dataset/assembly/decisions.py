"""What assembling decides: which successes are samples, in which split, and what each one weighs.

In: the surveys of all objects and the manifest. Out: the decisions, a few numbers per success.
`assembly.pack` packs the rows accordingly, and `assemble` writes them; `checks` decides again and
compares.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from drakegrasp.config import CameraConfig
from drakegrasp.dataset.assembly.split import split_samples, weigh_samples
from drakegrasp.dataset.assembly.survey import Survey, headers_by_object, join_seals
from drakegrasp.dataset.filtering import judge_successes
from drakegrasp.dataset.hdf5 import AnyArray
from drakegrasp.dataset.manifest import Manifest, origin_attributes
from drakegrasp.dataset.rejections import AttemptKey
from drakegrasp.dataset.schema import OBJECT_FIELDS, SUCCESS_FIELDS
from drakegrasp.dataset.shards import ShardHeader
from drakegrasp.filters import Removal
from drakegrasp.frames import Array
from drakegrasp.table import Table, join
from drakegrasp.vision.camera import intrinsics


@dataclass(frozen=True, kw_only=True)
class ShardSlice:
    """The rows of a shard that the dataset takes, and their ids.

    Attributes:
        header: Of the shard.
        object: Row of its object in /objects.
        first: Id of the trial in its first row.
        rows: Number of rows taken, from the first.
    """

    header: ShardHeader
    object: int
    first: int
    rows: int


@dataclass(frozen=True, kw_only=True, eq=False)
class Shards:
    """What the shards of a dataset hold.

    Attributes:
        slices: The rows that the dataset takes of each shard, in order.
        successes: All successes among them, with their trials' ids.
        sizes: Lengths of the letters in the shapes of the fields.
        seals: Hash of the seals of the shards, hexadecimal.
    """

    slices: Sequence[ShardSlice]
    successes: Table
    sizes: Mapping[str, int]
    seals: str

    @property
    def count(self) -> int:
        """Number of rows of /trials."""
        return self.slices[-1].first + self.slices[-1].rows


@dataclass(frozen=True, kw_only=True, eq=False)
class Decisions:
    """What becomes of n successes.

    Attributes:
        successes: The successes.
        removal: (n,) uint8, the `Removal` of each.
        splits: Indices of the samples of each split among the successes, in rising order.
        weights: (n,), weight of each sample; NaN for a success that is not one.
    """

    successes: Table
    removal: AnyArray
    splits: Mapping[str, npt.NDArray[np.int64]]
    weights: Array

    @cached_property
    def ids(self) -> dict[str, npt.NDArray[np.int64]]:
        """Ids of the trials that are samples, in rising order, by split."""
        return {split: self.successes["trial_id"][rows] for split, rows in self.splits.items()}

    def columns(self) -> dict[str, AnyArray]:
        """Return the columns of /successes: why each success is, or is not, a sample."""
        return {"removal": self.removal, **self.successes.only(*(f.name for f in SUCCESS_FIELDS))}


def number_rows(surveys: Sequence[Survey], manifest: Manifest) -> Shards:
    """Return the rows of each shard, and all successes, from the surveys of a dataset's objects."""
    headers = headers_by_object(manifest)
    first, slices, parts = 0, list[ShardSlice](), []
    for survey in surveys:
        ids = survey.successes["trial_id"] + first
        parts.append(survey.successes.with_columns(trial_id=ids))
        # Shards behind the last wanted grasp give no rows.
        for header, rows in zip(headers[survey.object], survey.rows, strict=False):
            slices.append(ShardSlice(header=header, object=survey.object, first=first, rows=rows))
            first += rows
    return Shards(
        slices=slices,
        successes=join(parts),
        sizes=surveys[0].sizes,
        seals=join_seals({survey.object: survey.seals for survey in surveys}),
    )


def keys_of(manifest: Manifest, successes: Table) -> dict[AttemptKey, int]:
    """Return the trial id of each success, by its identity."""
    names = ("object", "candidate", "standoff_index", "child", "trial_id")
    rows = zip(*(successes[name].tolist() for name in names), strict=True)
    return {AttemptKey(manifest.objects[i].name, *key): t for i, *key, t in rows}


def decide(
    manifest: Manifest,
    successes: Table,
    removed_by_own: npt.NDArray[np.bool_] | None = None,
) -> Decisions:
    """Decide which successes are samples, in which split, and what each weighs.

    Args:
        manifest: Of the dataset: its filters and its split; what it rejects becomes no sample.
        successes: All successes of the dataset.
        removed_by_own: As for `judge_successes`.
    """
    # The filters.
    known = keys_of(manifest, successes)
    rejected = [known[key] for key in manifest.rejected if key in known]
    removal = judge_successes(successes, manifest.config.filters, rejected, removed_by_own)

    # Only first-round attempts are tested: the others are drawn about held ones.
    splits = _split_successes(manifest, successes, removal)
    refined = successes["child"][splits["test"]] > 0
    removal[splits["test"][refined]] = Removal.REFINED_TEST
    splits["test"] = splits["test"][~refined]

    # The weights, among all samples.
    kept = np.flatnonzero(removal == Removal.KEPT)
    weights = np.full(len(removal), np.nan)
    numbers, rows = (
        manifest.pose_numbers(),
        zip(successes["object"], successes["resting"], strict=True),
    )
    poses = np.array([numbers[i][k] for i, k in rows], dtype=np.int64)[kept]
    weights[kept] = weigh_samples(poses, successes["X_OG"][kept])
    return Decisions(successes=successes, removal=removal, splits=splits, weights=weights)


def _split_successes(
    manifest: Manifest, successes: Table, removal: AnyArray
) -> dict[str, npt.NDArray[np.int64]]:
    """Return which successes are samples of each split, in rising order."""
    # A first-round attempt and all that was refined from it go to one split.
    kept = np.flatnonzero(removal == Removal.KEPT)
    names = ("object", "candidate", "standoff_index")
    keys = np.column_stack([successes[name][kept] for name in names])
    _, first, family = np.unique(keys, axis=0, return_index=True, return_inverse=True)

    split = split_samples(
        successes["object"][kept[first]],
        [entry.mesh_name for entry in manifest.objects],
        [entry.class_name for entry in manifest.objects],
        manifest.groups,
        manifest.config.split,
        manifest.config.seed,
    )
    return {name: kept[np.isin(family.ravel(), families)] for name, families in split.items()}


def object_columns(manifest: Manifest) -> dict[str, AnyArray]:
    """Return the columns of /objects."""
    columns = {}
    for field in OBJECT_FIELDS:
        own = [getattr(entry, field.name) for entry in manifest.objects]
        values = [np.nan if value is None else value for value in own]
        columns[field.name] = np.array(
            values, dtype=object if field.dtype == "str" else field.dtype
        )
    return columns


def file_attributes(manifest: Manifest, seals: str, camera: str = "") -> dict[str, Any]:
    """Return the attributes of a file.

    Args:
        manifest: Of the dataset.
        seals: Hash of the seals of the shards, hexadecimal.
        camera: `oto` or `otm`; empty for the trials.
    """
    own = {"camera": camera, "split_by": manifest.split_rule} if camera else {}
    return {
        **origin_attributes(manifest.config, manifest.versions, manifest.fingers, manifest.joints),
        **lens_attributes(manifest.config.camera),
        "signature": manifest.signature(),
        "shards": seals,
        **own,
    }


def lens_attributes(camera: CameraConfig) -> dict[str, Any]:
    """Return what the attributes of a file say of the cameras."""
    return {"K": intrinsics(camera), "near": camera.near, "far": camera.far}
