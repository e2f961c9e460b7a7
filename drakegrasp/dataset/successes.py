"""Successes: what filters and splits need of each grasp that held, and why it is no sample.

Input: rows of `/trials` and `/looks`. Output: a table with the identity of each attempt, columns of
its rows, and the columns below, each of which one function derives; a column whose sources are
missing is left out. From it follows the `Removal` of each: by our filters, user-defined filters,
outliers and rejections.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from drakegrasp import registry
from drakegrasp.arithmetic import multiply
from drakegrasp.config import CameraConfig, Config, FilterConfig, is_own_class
from drakegrasp.dataset import quality
from drakegrasp.dataset.hdf5 import AnyArray
from drakegrasp.dataset.schema import CAMERAS, with_derived
from drakegrasp.errors import ConfigError, listed
from drakegrasp.filters import NEEDED, Filter, Flags, Removal, first_removal, is_outlier
from drakegrasp.frames import Array, invert_pose, unpack_pose
from drakegrasp.grasp import unused_fingers
from drakegrasp.registry import own_class, run_own
from drakegrasp.table import Table
from drakegrasp.vision.camera import intrinsics, project

_UNUSED = ("unused", "closed_touching")
_GRASP = ("X_TO", "closed_p_OQ", "closed_nhat_Q_O")
_HELD = ("lifted_p_OQ", "lifted_nhat_Q_O")
_POSES = tuple(f"X_TC_{camera}" for camera in CAMERAS)
_MASKS = tuple(f"mask_{camera}" for camera in CAMERAS)


class Derived(NamedTuple):
    """A column: the columns that it needs, and the function that derives it from these rows."""

    needs: tuple[str, ...]
    of: Callable[[Table, CameraConfig], AnyArray]


#: The derived columns by their names, which are those of the functions below.
DERIVED: dict[str, Derived] = {}

_Function = Callable[[Table, CameraConfig], AnyArray]


def _derived(*needs: str) -> Callable[[_Function], _Function]:
    """Enter a function into DERIVED, with the columns of `/trials` and `/looks` that it needs."""

    def enter(function: _Function) -> _Function:
        DERIVED[function.__name__] = Derived(needs, function)
        return function

    return enter


@_derived(*_UNUSED)
def unused(t: Table, camera: CameraConfig) -> Flags:
    """Return the fingers (n, k) that the preshape leaves out."""
    return unused_fingers(t["unused"], t["closed_touching"].shape[1])


@_derived(*_UNUSED, "lifted_touching")
def complete(t: Table, camera: CameraConfig) -> Flags:
    """Return whether all used fingers touch after closing and after the lift, (n,)."""
    touching = t["closed_touching"] & t["lifted_touching"]
    return np.all(touching | unused(t, camera), axis=1)


@_derived(*_GRASP)
def grasp_T(t: Table, camera: CameraConfig) -> Array:
    """Return the grasps (n, 6k) in {T}."""
    X_TO = unpack_pose(t["X_TO"])
    nhat_Q_T = multiply(t["closed_nhat_Q_O"], np.swapaxes(X_TO[:, :3, :3], 1, 2))
    return _packed(_points(X_TO, t["closed_p_OQ"]), nhat_Q_T)


def _points(X_AB: Array, p_BQ: Array) -> Array:
    """Return points p_AQ (n, k, 3) of p_BQ (n, k, 3) [m] under poses (n, 4, 4)."""
    return multiply(p_BQ, np.swapaxes(X_AB[:, :3, :3], 1, 2)) + X_AB[:, None, :3, 3]


@_derived(*_HELD)
def held_O(t: Table, camera: CameraConfig) -> Array:
    """Return the contacts (n, 6k) in {O} at the end of the lift."""
    return _packed(*(t[name] for name in _HELD))


def _packed(points: Array, normals: Array) -> Array:
    """Return grasp vectors (n, 6k) of points and normals (n, k, 3)."""
    vectors = np.concatenate([points, normals], axis=1)
    return vectors.reshape(len(vectors), 3 * vectors.shape[1])


@_derived("lifted_other_links")
def other_links(t: Table, camera: CameraConfig) -> AnyArray:
    """Return the number of links (n,) besides fingertips that touch the object after the lift."""
    return t["lifted_other_links"]


@_derived(*_MASKS)
def seen(t: Table, camera: CameraConfig) -> Flags:
    """Return whether both masks have a pixel of the object, (n,)."""
    return np.all([t[name].any(axis=(1, 2)) for name in _MASKS], axis=0)


@_derived(*_GRASP, *_UNUSED, *_POSES)
def in_view(t: Table, camera: CameraConfig) -> Flags:
    """Return whether both cameras see all contacts of used fingers, (n,)."""
    X_TO = unpack_pose(t["X_TO"])
    p_TQ = _points(X_TO, t["closed_p_OQ"])
    every = np.ones(p_TQ.shape[:2], dtype=np.bool_)
    for name in _POSES:
        X_CT = invert_pose(unpack_pose(t[name]))
        every &= in_image(intrinsics(camera), camera.size, _points(X_CT, p_TQ))
    return np.all(every | unused(t, camera), axis=1)


def in_image(K: Array, size: int, p_CQ: Array) -> Flags:
    """Return which points (..., 3) [m] are in front of a camera and within its image [px]."""
    with np.errstate(invalid="ignore", divide="ignore"):
        uv = project(K, p_CQ.reshape(-1, 3)).reshape(*p_CQ.shape[:-1], 2)
        inside = np.all((uv >= 0.0) & (uv <= size - 1), axis=-1)
        return np.asarray(inside & (p_CQ[..., 2] > 0.0))


@_derived("X_TC_otm")
def camera_height(t: Table, camera: CameraConfig) -> Array:
    """Return the height (n,) of the cameras, which are at the same point, above the table [m]."""
    return np.asarray(unpack_pose(t["X_TC_otm"])[:, 2, 3])


@_derived("depth_otm")
def depth_variance(t: Table, camera: CameraConfig) -> Array:
    """Return the variance (n,) of the otm depth images [m^2]."""
    return np.asarray(t["depth_otm"].astype(float).var(axis=(1, 2)))


@_derived("surface_distance", *_UNUSED)
def surface_distance(t: Table, camera: CameraConfig) -> Array:
    """Return the largest distance (n,) of a used finger's contact from the surface [m]."""
    return np.where(unused(t, camera), 0.0, t["surface_distance"]).max(axis=1, initial=0.0)


@_derived("normal_angle", *_UNUSED)
def normal_angle(t: Table, camera: CameraConfig) -> Array:
    """Return the largest angle (n,) of a used finger's normal from that of the surface [rad]."""
    return np.where(unused(t, camera), 0.0, t["normal_angle"]).max(axis=1, initial=0.0)


@_derived(*quality.COLUMNS)
def anomaly(t: Table, camera: CameraConfig) -> Array:
    """Return the score (n,) of `quality.anomaly`."""
    return quality.anomaly(t).score


@_derived(*quality.COLUMNS)
def penetration(t: Table, camera: CameraConfig) -> Array:
    """Return the largest depth (n,) of the object in a fingertip [m]."""
    return quality.anomaly(t).values["penetration"]


@_derived(*quality.COLUMNS)
def imbalance(t: Table, camera: CameraConfig) -> Array:
    """Return the imbalance (n,) of the fingertips' forces, as a fraction of the weight."""
    return quality.anomaly(t).values["imbalance"]


@_derived(*quality.COLUMNS)
def normal_sum(t: Table, camera: CameraConfig) -> Array:
    """Return the length (n,) of the sum of the contact normals, per finger."""
    return quality.anomaly(t).values["normal_sum"]


@_derived("X_OG")
def X_OG(t: Table, camera: CameraConfig) -> Array:
    """Return the poses (n, 4, 4) of the palm in {O}."""
    return unpack_pose(t["X_OG"])


#: Columns that are copied: the identity of the attempt, and what the filters need besides.
COPIED = tuple(
    name
    for name in (
        "candidate",
        "standoff_index",
        "resting",
        *dict.fromkeys(("slip", "turn", *NEEDED)),
    )
    if name not in DERIVED
)
#: Columns of `/looks` and of `/trials` from which the columns of successes follow; `depth_otm` is
#: the depth in `image_otm`.
LOOK_COLUMNS = (*_MASKS, *_POSES)
TRIAL_COLUMNS = tuple(
    name
    for name in dict.fromkeys(
        (*COPIED, *(need for each in DERIVED.values() for need in each.needs))
    )
    if name not in (*LOOK_COLUMNS, "depth_otm")
)


def successes_of(rows: Mapping[str, AnyArray], config: Config) -> Table:
    """Return what filters and splits need of n successes of a work unit.

    `trial_id` is the row in the unit's /trials, `object` is 0, and `by_filter` is the reason of the
    first filter that rejects the success: it is judged once, here.

    Args:
        rows: Columns of the successes' rows of `/trials` and `/looks`, by their names there;
            `depth_otm` (n, S, S) are their otm depth images [m].
        config: Configuration, whose camera and limits of filters are used.
    """
    t = Table(with_derived(rows))
    derived = {n: d.of(t, config.camera) for n, d in DERIVED.items() if t.has(*d.needs)}
    successes = t.only(*COPIED).with_columns(derived, object=np.zeros(t.count, dtype=np.int32))
    if t.has("row"):
        successes = successes.with_columns(trial_id=t["row"].astype(np.int64))
    return successes.with_columns(by_filter=first_removal(successes, config.filters))


# Removals

#: The setting that names user-defined filters.
_OWN = "filters.own"
#: A filter: returns which successes it keeps, (n,) of bool if it is correct.
_Keep: TypeAlias = Callable[[Table], Any]


def judge_successes(
    successes: Table,
    config: FilterConfig,
    rejected: Sequence[int] = (),
) -> npt.NDArray[np.uint8]:
    """Return the `Removal` (n,) of each success.

    Args:
        successes: The n successes, with the columns of `successes_of`.
        config: Limits of the filters.
        rejected: Ids of trials that an inspection rejects.

    Raises:
        ConfigError: If a user-defined filter cannot be run, or returns something else than bools.
    """
    # Filters that judge each grasp by itself.
    removal = successes["by_filter"].copy()
    own = _removed_by_own(config, successes)
    removal[own & (removal == Removal.KEPT)] = Removal.OWN

    # Outliers among the remaining grasps of an object that use the same fingers.
    kept = removal == Removal.KEPT
    if config.outlier_sigma > 0.0:
        groups = np.column_stack([successes["object"], successes["unused"]])
        for group in np.unique(groups[kept], axis=0):
            rows = np.flatnonzero(kept & (groups == group).all(axis=1))
            outside = is_outlier(successes["grasp_T"][rows], config.outlier_sigma)
            removal[rows[outside]] = Removal.OUTLIER

    # The inspection comes last, since it only saw samples.
    listed = np.isin(successes["trial_id"], np.asarray(rejected, dtype=np.int64))
    removal[listed & (removal == Removal.KEPT)] = Removal.REJECTED
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


def _removed_by_own(config: FilterConfig, successes: Table) -> Flags:
    """Return which successes (n,) are removed by a user-defined filter."""
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


def find_hits(successes: Table, config: Config) -> tuple[tuple[int, int], ...]:
    """Return the candidates and stand-offs of the successes that count for a target.

    They pass all filters except the one of outliers, which needs all grasps of an object.
    """
    filters = config.filters.model_copy(update={"outlier_sigma": 0.0})
    successes = successes[judge_successes(successes, filters) == Removal.KEPT]
    names = ("candidate", "standoff_index")
    return tuple(zip(*(successes[name].tolist() for name in names), strict=True))
