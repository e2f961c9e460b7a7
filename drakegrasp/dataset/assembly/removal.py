"""Why successes are no samples: the rules of `filters`, user-defined filters, outliers, rejections.

Input: a table of successes, see `assembly.successes`. Output: the `Removal` of each.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from drakegrasp import registry
from drakegrasp.config import Config, FilterConfig, is_own_class
from drakegrasp.dataset.assembly.successes import successes_of
from drakegrasp.errors import ConfigError, listed
from drakegrasp.filters import Flags, Removal, Rule, first_removal, is_outlier
from drakegrasp.registry import own_class, run_own
from drakegrasp.table import Table

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
        successes: The n successes, with the columns of `dataset.assembly.successes`, and of
            `by_rule` if the rules have been applied to each before.
        config: Limits of the filters.
        rejected: Ids of trials that an inspection rejects.

    Raises:
        ConfigError: If a user-defined filter cannot be run, or returns something else than bools.
    """
    # Filters that judge each grasp by itself.
    known = successes.has("by_rule")
    removal = successes["by_rule"].copy() if known else first_removal(successes, config)
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
    """Return the filters that the configuration names: classes in files, or rules of packages.

    Raises:
        ConfigError: If a filter cannot be imported, or is not a filter.
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


def successes_by_rule(rows: Table, config: Config) -> Table:
    """Return the successes of a shard, with the first rule that removes each as column `by_rule`.

    Args:
        rows: Columns of the n successes, see `survey.shard_successes`.
        config: Configuration, whose camera and limits of filters are used.
    """
    successes = successes_of(rows, config.camera)
    return successes.with_columns(
        trial_id=rows["row"].astype(np.int64), by_rule=first_removal(successes, config.filters)
    )


def find_hits(successes: Table, config: Config) -> tuple[tuple[int, int], ...]:
    """Return the candidates and stand-offs of the successes that count for a target.

    They pass all filters except the one of outliers, which needs all grasps of an object.
    """
    filters = config.filters.model_copy(update={"outlier_sigma": 0.0})
    successes = successes[judge_successes(successes, filters) == Removal.KEPT]
    names = ("candidate", "standoff_index")
    return tuple(zip(*(successes[name].tolist() for name in names), strict=True))
