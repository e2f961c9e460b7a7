"""Made-up successes for filters."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from drakegrasp.config import FilterConfig
from drakegrasp.dataset.successes import judge_alone, judge_successes
from drakegrasp.filters import first_removal
from drakegrasp.table import Table


def good(count: int) -> Table:
    """Successes that every filter keeps."""
    rng = np.random.default_rng(0)
    return Table(
        trial_id=np.arange(count, dtype=np.int64) * 3,
        object=np.zeros(count, dtype=np.int32),
        candidate=np.arange(count, dtype=np.int32),
        standoff_index=np.zeros(count, dtype=np.uint8),
        resting=np.zeros(count, dtype=np.uint8),
        X_OG=np.tile(np.eye(4), (count, 1, 1)),
        grasp_T=rng.normal(size=(count, 18)),
        lifted_O=rng.normal(size=(count, 18)),
        complete=np.ones(count, dtype=bool),
        unused=np.zeros((count, 3), dtype=bool),
        other_links=np.zeros(count, dtype=np.uint8),
        slip=np.full(count, 0.010),
        turn=np.full(count, np.deg2rad(9.9)),
        seen=np.ones(count, dtype=bool),
        in_view=np.ones(count, dtype=bool),
        camera_height=np.full(count, 0.3),
        depth_variance=np.full(count, 0.01),
        surface_distance=np.full(count, 1e-4),
        normal_angle=np.full(count, np.deg2rad(29.0)),
        anomaly=np.full(count, 1.0),
        penetration=np.full(count, 1e-3),
        imbalance=np.full(count, 0.01),
        normal_sum=np.full(count, 0.3),
    )


def judge(
    successes: Table, config: FilterConfig, rejected: Sequence[int] = ()
) -> npt.NDArray[np.uint8]:
    """Return why each is no sample, by the rules and by what needs all of them."""
    successes = successes.with_columns(by_filter=first_removal(successes, config))
    return judge_successes(judge_alone(successes, config), config, rejected)
