"""Successes: what filters and splits need of each lifted grasp, and why it is no sample.

Input: rows of `/trials` and `/looks`. Output: a table with the identity of each attempt, columns of
its rows, and columns that follow from them. From it follows the `Removal` of each: by our filters,
user-defined filters, outliers and rejections. A `UnitSummary` has this table of a work unit, so
that its shard is read again only to copy its rows.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from drakegrasp import registry
from drakegrasp.arithmetic import multiply
from drakegrasp.config import CameraConfig, Config, FilterConfig, is_own_class
from drakegrasp.dataset import quality
from drakegrasp.dataset.hdf5 import AnyArray, read_columns, sizes_in
from drakegrasp.dataset.schema import CAMERAS, LOOK_FIELDS, TRIAL_FIELDS, with_derived
from drakegrasp.dataset.shards import Shard, ShardHeader, open_shard
from drakegrasp.errors import ConfigError, listed
from drakegrasp.filters import NEEDED, Filter, Flags, Removal, first_removal, is_outlier
from drakegrasp.frames import Array, invert_pose, unpack_pose
from drakegrasp.grasp import unused_fingers
from drakegrasp.outcomes import Outcome
from drakegrasp.registry import own_class, run_own
from drakegrasp.table import Table
from drakegrasp.vision.camera import intrinsics, project

#: Columns of `/trials` that are copied: the identity of the attempt, and values of filters.
COPIED = (
    *("candidate", "standoff_index", "resting"),
    *(field.name for field in TRIAL_FIELDS if field.name in NEEDED),
)
#: Columns of `/trials` and of `/looks` that `summary_of` reads.
_OF_TRIALS = (
    *("outcome", *COPIED),
    *("X_TO", "X_OG", "closed_p_OQ", "closed_nhat_Q_O", "lifted_p_OQ", "lifted_nhat_Q_O"),
    *("closed_touching", "lifted_touching", *quality.COLUMNS),
)
_POSES = tuple(f"X_TC_{camera}" for camera in CAMERAS)
_MASKS = tuple(f"mask_{camera}" for camera in CAMERAS)


@dataclass(frozen=True, kw_only=True, eq=False)
class UnitSummary:
    """What a build and the assembled files need of a work unit before its rows are copied.

    Attributes:
        header: Header of the unit.
        seal: Seal of its shard.
        sizes: Lengths of the letters in the shapes of the fields.
        attempts: (n,), number of attempts at each of its n palm poses.
        outcomes: Number of attempts by outcome.
        errors: Number of solver errors by message; empty for a unit that was read.
        successes: The successes, see `successes_of`; `by_filter` counts user-defined filters, too.
    """

    header: ShardHeader
    seal: bytes
    sizes: Mapping[str, int]
    attempts: npt.NDArray[np.int64]
    outcomes: Mapping[Outcome, int]
    errors: Mapping[str, int]
    successes: Table


def read_summary(out: Path, header: ShardHeader, config: Config) -> UnitSummary:
    """Return the summary of a work unit whose shard is in a dataset's directory.

    Raises:
        DataError: If the shard is missing, damaged or of another unit.
        ConfigError: If a user-defined filter cannot be run.
    """
    with open_shard(header.path(out), header) as (file, seal):
        trials = read_columns(file["trials"], TRIAL_FIELDS, dict.fromkeys(_OF_TRIALS))
        looks = read_columns(file["looks"], LOOK_FIELDS, ("row", *_POSES, *_MASKS))
        depth = file["looks/image_otm"][:, 3] if looks.count else np.zeros((0, 1, 1))
        sizes = sizes_in(file["trials"], TRIAL_FIELDS) | sizes_in(file["looks"], LOOK_FIELDS)
    shard = Shard(header=header, trials=trials, looks=looks)
    return summary_of(shard, seal, sizes, depth, config)


def summary_of(
    shard: Shard,
    seal: bytes,
    sizes: Mapping[str, int],
    depth_otm: AnyArray,
    config: Config,
    errors: Mapping[str, int] | None = None,
) -> UnitSummary:
    """Return the summary of a work unit, each of whose successes is judged here, once.

    Args:
        shard: The results of the unit; of its images only the masks are needed.
        seal: Seal of its file.
        sizes: Lengths of the letters in the shapes of the fields.
        depth_otm: (n, S, S), otm depth images of the n successes [m].
        config: Configuration of the dataset.
        errors: Number of solver errors by message.

    Raises:
        ConfigError: If a user-defined filter cannot be run.
    """
    header, trials = shard.header, Table(shard.trials)
    looks = Table(shard.looks).only("row", *_POSES, *_MASKS)
    rows = trials[looks["row"]].with_columns(looks, depth_otm=depth_otm)
    outcomes, counts = np.unique(trials["outcome"], return_counts=True)
    palms = trials["candidate"] - header.start
    return UnitSummary(
        header=header,
        seal=seal,
        sizes=sizes,
        attempts=np.bincount(palms, minlength=header.stop - header.start),
        outcomes={Outcome(o): n for o, n in zip(outcomes.tolist(), counts.tolist(), strict=True)},
        errors=errors or {},
        successes=judge_alone(successes_of(rows, config), config.filters),
    )


def successes_of(rows: Mapping[str, AnyArray], config: Config) -> Table:
    """Return what filters and splits need of n successes of a work unit.

    `trial_id` is the row in the unit's /trials, `object` is 0, and `by_filter` is the reason of the
    first filter of ours that rejects the success.

    Args:
        rows: Columns of the successes' rows of `/trials` and `/looks`, by their names there;
            `depth_otm` (n, S, S) are their otm depth images [m]. If the poses of the cameras or the
            images are missing, the columns that follow from them are, too.
        config: Configuration, whose camera and limits of filters are used.
    """
    t = Table(with_derived(rows))
    unused = unused_fingers(t["unused"], t["closed_touching"].shape[1])
    touching = t["closed_touching"] & t["lifted_touching"]
    anomaly = quality.anomaly(t)

    # The grasp in {T}.
    X_TO = unpack_pose(t["X_TO"])
    p_TQ = _points(X_TO, t["closed_p_OQ"])
    nhat_Q_T = multiply(t["closed_nhat_Q_O"], np.swapaxes(X_TO[:, :3, :3], 1, 2))

    successes = t.only(*COPIED).with_columns(
        {name: anomaly.values[name] for name in ("penetration", "imbalance", "normal_sum")},
        object=np.zeros(t.count, dtype=np.int32),
        X_OG=unpack_pose(t["X_OG"]),
        unused=unused,
        complete=np.all(touching | unused, axis=1),
        grasp_T=_packed(p_TQ, nhat_Q_T),
        lifted_O=_packed(t["lifted_p_OQ"], t["lifted_nhat_Q_O"]),
        other_links=t["lifted_other_links"],
        surface_distance=_largest(t["surface_distance"], unused),
        normal_angle=_largest(t["normal_angle"], unused),
        anomaly=anomaly.score,
    )
    if t.has(*_POSES):
        in_view = unused | _in_view(t, p_TQ, config.camera)
        height = unpack_pose(t["X_TC_otm"])[:, 2, 3]  # both cameras are at the same point
        successes = successes.with_columns(in_view=in_view.all(axis=1), camera_height=height)
    if t.has(*_MASKS):
        seen = np.all([t[name].any(axis=(1, 2)) for name in _MASKS], axis=0)
        variance = t["depth_otm"].astype(float).var(axis=(1, 2))
        successes = successes.with_columns(seen=seen, depth_variance=variance)
    if t.has("row"):
        successes = successes.with_columns(trial_id=t["row"].astype(np.int64))
    return successes.with_columns(by_filter=first_removal(successes, config.filters))


def _points(X_AB: Array, p_BQ: Array) -> Array:
    """Return points p_AQ (n, k, 3) of p_BQ (n, k, 3) [m] under poses (n, 4, 4)."""
    return multiply(p_BQ, np.swapaxes(X_AB[:, :3, :3], 1, 2)) + X_AB[:, None, :3, 3]


def _packed(points: Array, normals: Array) -> Array:
    """Return grasp vectors (n, 6k) of points and normals (n, k, 3)."""
    vectors = np.concatenate([points, normals], axis=1)
    return vectors.reshape(len(vectors), 3 * vectors.shape[1])


def _largest(values: Array, unused: Flags) -> Array:
    """Return the largest value (n,) of a used finger, of values (n, k) that are not negative."""
    return np.where(unused, 0.0, values).max(axis=1, initial=0.0)


def _in_view(t: Table, p_TQ: Array, camera: CameraConfig) -> Flags:
    """Return which points (n, k) both cameras see, given p_TQ (n, k, 3) [m]."""
    X_CT = [invert_pose(unpack_pose(t[name])) for name in _POSES]
    seen = [in_image(intrinsics(camera), camera.size, _points(X, p_TQ)) for X in X_CT]
    return np.all(seen, axis=0)


def in_image(K: Array, size: int, p_CQ: Array) -> Flags:
    """Return which points (..., 3) [m] are in front of a camera and within its image [px]."""
    with np.errstate(invalid="ignore", divide="ignore"):
        uv = project(K, p_CQ.reshape(-1, 3)).reshape(*p_CQ.shape[:-1], 2)
        inside = np.all((uv >= 0.0) & (uv <= size - 1), axis=-1)
        return np.asarray(inside & (p_CQ[..., 2] > 0.0))


# Removals

#: The setting that names user-defined filters.
_OWN = "filters.own"
#: A filter: returns which successes it keeps, (n,) of bool if it is correct.
_Keep: TypeAlias = Callable[[Table], Any]


def judge_successes(
    successes: Table,
    config: FilterConfig,
    rejected: Sequence[int] = (),
    unreachable: Flags | None = None,
) -> npt.NDArray[np.uint8]:
    """Return the `Removal` (n,) of each success.

    Args:
        successes: The n successes, as `judge_alone` returns them.
        config: Limits of the filters.
        rejected: Ids of trials that an inspection rejects.
        unreachable: (n,), which successes the arm of `config.reachable` does not reach, or was not
            asked for; None without such an arm.
    """
    removal = successes["by_filter"].copy()

    # Outliers among the remaining grasps of an object that use the same fingers.
    kept = removal == Removal.KEPT
    if config.outlier_sigma > 0.0:
        groups = np.column_stack([successes["object"], successes["unused"]])
        for group in np.unique(groups[kept], axis=0):
            rows = np.flatnonzero(kept & (groups == group).all(axis=1))
            outside = is_outlier(successes["grasp_T"][rows], config.outlier_sigma)
            removal[rows[outside]] = Removal.OUTLIER

    # An arm is asked for samples, and an inspection sees samples: they come last.
    if unreachable is not None:
        removal[unreachable & (removal == Removal.KEPT)] = Removal.UNREACHABLE
    is_rejected = np.isin(successes["trial_id"], np.asarray(rejected, dtype=np.int64))
    removal[is_rejected & (removal == Removal.KEPT)] = Removal.REJECTED
    return removal


def own_filters(config: FilterConfig) -> list[_Keep]:
    """Return the filters that the configuration names: classes in files, or those of packages.

    Raises:
        ConfigError: If a filter cannot be imported, or is not a filter.
    """
    return [_own_filter(name, config) for name in config.own]


def _own_filter(name: str, config: FilterConfig) -> _Keep:
    if is_own_class(name):
        found = own_class(name, config.code, key=_OWN, method="keep", takes=("successes",))
        return lambda successes: found().keep(successes)
    named = registry.find("filters", name)
    if not isinstance(named, Filter):
        raise ConfigError(f"filters: {name} must be a Filter, got {type(named).__name__}")

    def keep(successes: Table) -> Flags:
        if missing := [column for column in named.needs if not successes.has(column)]:
            columns = listed(sorted(successes.names))
            raise ConfigError(f"{name}: needs must be some of {columns}, got {listed(missing)}")
        return np.asarray(~named.refuses(successes, config))

    return keep


def own_setting(config: FilterConfig) -> str:
    """Return the setting `KEY=VALUE` that names the user-defined filters; empty if there are none.

    A dataset stores the names of their files without folders.
    """
    names = [name.partition("@")[0] for name in config.own]
    value = names[0] if len(names) == 1 else f"[{', '.join(names)}]"
    return f"{_OWN}={value}" if names else ""


def judge_alone(successes: Table, config: FilterConfig) -> Table:
    """Return successes whose `by_filter` counts the user-defined filters, which are asked here.

    Raises:
        ConfigError: If a user-defined filter cannot be run, or returns something else than bools.
    """
    due, removal = (successes.count,), successes["by_filter"].copy()
    if due == (0,):
        return successes
    for name, keep in zip(config.own, own_filters(config), strict=True):
        kept = np.asarray(run_own(name, keep, successes))
        if kept.dtype != np.bool_ or kept.shape != due:
            raise ConfigError(
                f"{name.partition('@')[0]}: keep must return {due} of bool, "
                f"got {kept.shape} of {kept.dtype}"
            )
        removal[~kept & (removal == Removal.KEPT)] = Removal.OWN
    return successes.with_columns(by_filter=removal)
