"""Postprocessing: which successes become samples.

Pure functions of arrays. A filter removes a grasp from the two data files, never from
trials.hdf5. A removal has one reason: the first filter that applies. The filters of images and
contacts are the paper's (Veres et al., "Postprocessing"); those of the hold are our own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from drakegrasp.config import FilterConfig
from drakegrasp.errors import ConfigError
from drakegrasp.frames import Array
from drakegrasp.outcomes import Removal
from drakegrasp.runtime.user_code import own_class, run_own

#: The setting that names filters of the user's own.
_OWN = "filters.own"


@dataclass(frozen=True, kw_only=True, eq=False)
class Successes:
    """What the filters need of n successes.

    Attributes:
        trial_id: (n,) int64, row of /trials.
        object: (n,) int32, row of /objects.
        candidate, standoff_index, child: (n,), which attempt of its object.
        resting: (n,), index of the object's resting pose.
        X_OG: (n, 4, 4), pose of the palm at the start.
        grasp_T: (n, 6k), grasps in the table-top frame [m, -].
        held_O: (n, 6k), contacts at the end of the lift in {O} [m, -].
        complete: (n,) bool, whether every fingertip that is used touches, after closing and after
            the lift.
        unused: (n, k) bool, the fingers that the preshape leaves out: their contacts are NaN.
        other_links: (n,), number of other links that touch the object after the lift.
        slip, turn: (n,), how far the object moved [m] and turned [rad] in the hand.
        seen: (n,) bool, whether both masks have object pixels.
        in_view: (n,) bool, whether all contacts project into both images.
        camera_height: (n,), of the cameras above the table [m].
        depth_variance: (n,), of the otm depth image [m^2].
        surface_distance: (n,), largest of the contacts' distances from the surface [m].
        normal_angle: (n,), largest angle of the contacts' normals from those of the surface [rad].
        suspicion: (n,), score of `dataset.suspicion`.
        penetration, imbalance, normal_sum: (n,), parts of it [m], [-], [-].
        certified_share, certified_friction: (n,), see the schema; no filter uses them.
    """

    trial_id: npt.NDArray[np.int64]
    object: npt.NDArray[np.int32]
    candidate: npt.NDArray[np.integer]
    standoff_index: npt.NDArray[np.integer]
    child: npt.NDArray[np.integer]
    resting: npt.NDArray[np.integer]
    X_OG: Array
    grasp_T: Array
    held_O: Array
    complete: npt.NDArray[np.bool_]
    unused: npt.NDArray[np.bool_]
    other_links: npt.NDArray[np.integer]
    slip: Array
    turn: Array
    seen: npt.NDArray[np.bool_]
    in_view: npt.NDArray[np.bool_]
    camera_height: Array
    depth_variance: Array
    surface_distance: Array
    normal_angle: Array
    suspicion: Array
    penetration: Array
    imbalance: Array
    normal_sum: Array
    certified_share: Array
    certified_friction: Array


def judge_successes(
    successes: Successes,
    config: FilterConfig,
    rejected: Sequence[int] = (),
    removed_by_own: npt.NDArray[np.bool_] | None = None,
) -> npt.NDArray[np.uint8]:
    """Return the `Removal` (n,) of each success.

    Args:
        successes: The n successes.
        config: Limits of the filters.
        rejected: Ids of trials that an inspection rejects.
        removed_by_own: (n,), which the user's own filters remove; None: the filters are run.

    Raises:
        ConfigError: If a filter of the user's own cannot be run, or returns something else.
    """
    if removed_by_own is None:
        removed_by_own = _removed_by_own(config, successes)

    # Filters that judge a grasp alone. Of a finger that is not used a contact is NaN.
    unused = np.tile(np.repeat(successes.unused, 3, axis=1), 2)
    removal = np.full(len(successes.trial_id), Removal.KEPT, dtype=np.uint8)
    for reason, bad in (
        # A grasp vector has a contact of every finger that its preshape uses.
        (Removal.MISSING_FINGER, ~successes.complete),
        *breaks_hold(config, successes.other_links, successes.slip, successes.turn),
        (Removal.NOT_SEEN, ~successes.seen),
        (Removal.OUT_OF_VIEW, ~successes.in_view),
        (Removal.BISECTS_TABLE, successes.camera_height < config.min_camera_height),
        (Removal.FLAT_DEPTH, successes.depth_variance < config.min_depth_variance),
        # The mean normal of opposed patches has length zero: normalised it is NaN.
        (Removal.OFF_SURFACE, ~(np.isfinite(successes.grasp_T) | unused).all(axis=1)),
        (Removal.OFF_SURFACE, ~(np.isfinite(successes.held_O) | unused).all(axis=1)),
        *_beyond(
            (Removal.OFF_SURFACE, successes.surface_distance, config.max_surface_distance),
            (Removal.NORMAL_OFF, np.degrees(successes.normal_angle), config.max_normal_angle_deg),
            (Removal.SUSPICIOUS, successes.suspicion, config.max_suspicion),
            (Removal.SUSPICIOUS, successes.penetration, config.max_penetration),
            (Removal.SUSPICIOUS, successes.imbalance, config.max_imbalance),
            (Removal.SUSPICIOUS, successes.normal_sum, config.max_normal_sum),
        ),
        (Removal.OWN, removed_by_own),
    ):
        removal[bad & (removal == Removal.KEPT)] = reason

    # Outliers among the grasps of an object that are left, with the same fingers.
    kept = removal == Removal.KEPT
    if config.outlier_sigma > 0.0:
        groups = np.column_stack([successes.object, successes.unused])
        for group in np.unique(groups[kept], axis=0):
            rows = np.flatnonzero(kept & (groups == group).all(axis=1))
            outside = is_outlier(successes.grasp_T[rows], config.outlier_sigma)
            removal[rows[outside]] = Removal.OUTLIER

    # The inspection comes last: it only sees samples.
    listed = np.isin(successes.trial_id, np.asarray(rejected, dtype=np.int64))
    removal[listed & (removal == Removal.KEPT)] = Removal.REJECTED
    return removal


def breaks_hold(
    config: FilterConfig, other_links: npt.ArrayLike, slip: npt.ArrayLike, turn: npt.ArrayLike
) -> list[tuple[Removal, npt.NDArray[np.bool_]]]:
    """Return which successes (n,) break each limit of the hold that is on, in the filters' order.

    Args:
        config: The limits.
        other_links: (n,), number of other links that touch the object after the lift.
        slip: (n,), how far the object moved in the hand during the lift [m].
        turn: (n,), how far it turned in the hand [rad].
    """
    if config.require == "held":
        return []
    return _beyond(
        (Removal.OTHER_LINKS, np.asarray(other_links), config.other_links),
        (Removal.SLID, np.asarray(slip), config.max_slip),
        (Removal.TURNED, np.degrees(turn), config.max_turn_deg),
    )


def _beyond(
    *rules: tuple[Removal, npt.NDArray[Any], float | None],
) -> list[tuple[Removal, npt.NDArray[np.bool_]]]:
    """Return which values (n,) are not within each limit that is on; NaN is within none."""
    return [(reason, ~(values <= limit)) for reason, values, limit in rules if limit is not None]


def own_filters(config: FilterConfig) -> list[type[Any]]:
    """Return the classes of the user's own filters.

    Raises:
        ConfigError: If one cannot be imported, or is of another signature.
    """
    return [
        own_class(name, config.code, key=_OWN, method="keep", takes=("successes",))
        for name in config.own
    ]


def own_setting(config: FilterConfig) -> str:
    """Return the setting `KEY=VALUE` that gives the user's own filters again; empty without any.

    A dataset knows their files by name and no folder.
    """
    names = [name.partition("@")[0] for name in config.own]
    value = names[0] if len(names) == 1 else f"[{', '.join(names)}]"
    return f"{_OWN}={value}" if names else ""


def _removed_by_own(config: FilterConfig, successes: Successes) -> npt.NDArray[np.bool_]:
    """Return which successes (n,) a filter of the user's own does not keep."""
    due = successes.trial_id.shape
    removed = np.zeros(due, dtype=np.bool_)
    if due == (0,):
        return removed
    for name, found in zip(config.own, own_filters(config), strict=True):
        kept = np.asarray(run_own(name, lambda found=found: found().keep(successes)))
        if kept.dtype != np.bool_ or kept.shape != due:
            raise ConfigError(
                f"{name.partition('@')[0]}: keep must return {due} of bool, "
                f"got {kept.shape} of {kept.dtype}"
            )
        removed |= ~kept
    return removed


def is_outlier(values: Array, sigma: float) -> npt.NDArray[np.bool_]:
    """Return for rows (n, d) whether a component is more than sigma deviations from its mean.

    Among n values none is more than sqrt(n - 1) deviations from the mean (Samuelson's
    inequality), so the paper's 4 sigma removes nothing from objects with fewer than 18 grasps.
    """
    deviation = values.std(axis=0)
    return np.any(np.abs(values - values.mean(axis=0)) > sigma * deviation, axis=1)
