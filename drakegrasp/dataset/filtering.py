"""The filters of a whole dataset: the rules, those of the user's own, outliers and rejections."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from drakegrasp import registry
from drakegrasp.config import FilterConfig, is_own_class
from drakegrasp.errors import ConfigError, listed
from drakegrasp.filters import Flags, Removal, Rule, first_removal, is_outlier
from drakegrasp.registry import own_class, run_own
from drakegrasp.table import Table

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
