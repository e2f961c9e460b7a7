"""What assembling decides: which successes are samples, in which split, and what each one weighs.

In: the surveys of all objects and the manifest. Out: the decisions, a few numbers per success: by
the rules of `filters`, the user's own, outliers and rejections, the split and the weights.
`assembly.pack` packs the rows accordingly, and `assemble` writes them; `checks` decides again and
compares.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from drakegrasp import registry
from drakegrasp.config import CameraConfig, Config, FilterConfig, is_own_class
from drakegrasp.dataset.assembly.split import split_samples, weigh_samples
from drakegrasp.dataset.assembly.survey import (
    Survey,
    SurveyTask,
    headers_by_object,
    join_seals,
    survey_object,
)
from drakegrasp.dataset.hdf5 import AnyArray
from drakegrasp.dataset.manifest import Manifest, origin_attributes
from drakegrasp.dataset.rejections import AttemptKey
from drakegrasp.dataset.schema import OBJECT_FIELDS, SUCCESS_FIELDS
from drakegrasp.dataset.shards import ShardHeader
from drakegrasp.errors import ConfigError, listed
from drakegrasp.filters import Flags, Removal, Rule, first_removal, is_outlier
from drakegrasp.frames import Array
from drakegrasp.registry import own_class, run_own
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
    """What becomes of the n successes of a dataset.

    Attributes:
        shards: What its shards hold.
        removal: (n,) uint8, the `Removal` of each.
        splits: Indices of the samples of each split among the successes, in rising order.
        weights: (n,), weight of each sample; NaN for a success that is not one.
    """

    shards: Shards
    removal: AnyArray
    splits: Mapping[str, npt.NDArray[np.int64]]
    weights: Array

    @cached_property
    def ids(self) -> dict[str, npt.NDArray[np.int64]]:
        """Ids of the trials that are samples, in rising order, by split."""
        return {
            split: self.shards.successes["trial_id"][rows] for split, rows in self.splits.items()
        }

    def columns(self) -> dict[str, AnyArray]:
        """Return the columns of /successes: why each success is, or is not, a sample."""
        own = self.shards.successes.only(*(f.name for f in SUCCESS_FIELDS))
        return {"removal": self.removal, **own}


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
    manifest: Manifest, shards: Shards, removed_by_own: npt.NDArray[np.bool_] | None = None
) -> Decisions:
    """Decide which successes are samples, in which split, and what each weighs.

    Args:
        manifest: Of the dataset: its filters and its split; what it rejects becomes no sample.
        shards: What its shards hold.
        removed_by_own: As for `judge_successes`.
    """
    # The filters.
    successes = shards.successes
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
    numbers = manifest.pose_numbers()
    rows = zip(successes["object"][kept], successes["resting"][kept], strict=True)
    poses = np.array([numbers[i][k] for i, k in rows], dtype=np.int64)
    weights[kept] = weigh_samples(poses, successes["X_OG"][kept])
    return Decisions(shards=shards, removal=removal, splits=splits, weights=weights)


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


#: The setting that names filters of the user's own.
_OWN = "filters.own"
#: Which successes a filter keeps, (n,) of bool if it does as it should.
_Keep: TypeAlias = Callable[[Table], Any]


def judge_successes(
    successes: Table,
    config: FilterConfig,
    rejected: Sequence[int] = (),
    removed_by_own: Flags | None = None,
) -> npt.NDArray[np.uint8]:
    """Return the `Removal` (n,) of each success.

    Args:
        successes: The n successes, with the columns of `dataset.assembly.survey`.
        config: Limits of the filters.
        rejected: Ids of trials that an inspection rejects.
        removed_by_own: (n,), which the user's own filters remove; None: the filters are run.

    Raises:
        ConfigError: If a filter of the user's own cannot be run, or returns something else.
    """
    if removed_by_own is None:
        removed_by_own = _removed_by_own(config, successes)

    # Filters that judge a grasp alone.
    removal = first_removal(successes, config)
    removal[removed_by_own & (removal == Removal.KEPT)] = Removal.OWN

    # Outliers among the grasps of an object that are left, with the same fingers.
    kept = removal == Removal.KEPT
    if config.outlier_sigma > 0.0:
        groups = np.column_stack([successes["object"], successes["unused"]])
        for group in np.unique(groups[kept], axis=0):
            rows = np.flatnonzero(kept & (groups == group).all(axis=1))
            outside = is_outlier(successes["grasp_T"][rows], config.outlier_sigma)
            removal[rows[outside]] = Removal.OUTLIER

    # The inspection comes last: it only sees samples.
    listed = np.isin(successes["trial_id"], np.asarray(rejected, dtype=np.int64))
    removal[listed & (removal == Removal.KEPT)] = Removal.REJECTED
    return removal


def own_filters(config: FilterConfig) -> list[_Keep]:
    """Return the filters that the configuration names: classes of a file, rules of packages.

    Raises:
        ConfigError: If one cannot be imported, or is something else.
    """
    return [_own_filter(name, config) for name in config.own]


def _own_filter(name: str, config: FilterConfig) -> _Keep:
    if is_own_class(name):
        found = own_class(name, config.code, key=_OWN, method="keep", takes=("successes",))
        return lambda successes: found().keep(successes)
    rule = registry.find("rules", name)
    if not isinstance(rule, Rule):
        raise ConfigError(f"rules: {name} must be a Rule, got {type(rule).__name__}")

    def keep(successes: Table) -> Flags:
        if missing := [column for column in rule.needs if not successes.has(column)]:
            columns = listed(sorted(successes.names))
            raise ConfigError(f"{name}: needs must be some of {columns}, got {listed(missing)}")
        return np.asarray(~rule.refuses(successes, config))

    return keep


def own_setting(config: FilterConfig) -> str:
    """Return the setting `KEY=VALUE` that gives the user's own filters again; empty without any.

    A dataset knows their files by name and no folder.
    """
    names = [name.partition("@")[0] for name in config.own]
    value = names[0] if len(names) == 1 else f"[{', '.join(names)}]"
    return f"{_OWN}={value}" if names else ""


def _removed_by_own(config: FilterConfig, successes: Table) -> Flags:
    """Return which successes (n,) a filter of the user's own does not keep."""
    due = (successes.count,)
    removed = np.zeros(due, dtype=np.bool_)
    if due == (0,):
        return removed
    for name, keep in zip(config.own, own_filters(config), strict=True):
        kept = np.asarray(run_own(name, keep, successes))
        if kept.dtype != np.bool_ or kept.shape != due:
            raise ConfigError(
                f"{name.partition('@')[0]}: keep must return {due} of bool, "
                f"got {kept.shape} of {kept.dtype}"
            )
        removed |= ~kept
    return removed


def count_samples(out: Path, header: ShardHeader, config: Config) -> int:
    """Return how many successes of a shard pass the filters, but for that of outliers.

    Raises:
        DataError: If the shard is missing or damaged.
    """
    filters = config.filters.model_copy(update={"outlier_sigma": 0.0})
    task = SurveyTask(out=str(out), object=0, headers=(header,), wanted=None, camera=config.camera)
    removal = judge_successes(survey_object(task).successes, filters)
    return int(np.count_nonzero(removal == Removal.KEPT))
