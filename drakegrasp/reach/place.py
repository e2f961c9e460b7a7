"""Where around an arm the grasps of a dataset are reachable.

Input: an assembled dataset and an arm. Output: places on the table, and the fraction of some
samples that the arm reaches if their objects are moved there, without being turned.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.trials import Trials
from drakegrasp.frames import Array, make_pose
from drakegrasp.hand.description import load_hand
from drakegrasp.reach.arm import TABLE_SIZE, Arm, mount_of
from drakegrasp.reach.cell import make_cell
from drakegrasp.reach.reaching import Grasp, reach_grasp
from drakegrasp.reach.rows import ReachTask, sample_tasks
from drakegrasp.runtime.environment import one_thread
from drakegrasp.runtime.executor import Executor, in_order, run_here
from drakegrasp.runtime.progress import Report, silent

#: Distance of two places, and of the outermost ones from the table's edge [m].
SPACING, EDGE = 0.15, 0.05
#: Largest number of samples, spread evenly over the dataset.
MOST = 24


@dataclass(frozen=True, kw_only=True, eq=False)
class ReachMap:
    """The fraction of the samples that an arm reaches at m places.

    Attributes:
        p_TS: (m, 2), the places [m].
        share: (m,), fraction of the samples.
        count: Number of samples.
    """

    p_TS: Array
    share: Array
    count: int


def map_reach(
    out: str | Path, arm: Arm, *, execute: Executor = run_here, progress: Report = silent
) -> ReachMap:
    """Return where on the table an arm reaches the samples of a dataset.

    Args:
        out: Directory of an assembled dataset.
        arm: The arm, see `load_arm`.
        execute: Runs the tasks.
        progress: Called with the number of completed objects and of all objects.

    Raises:
        ConfigError: If the arm, or the dataset's hand on it, cannot be used.
        DataError: If there is no dataset, or it is damaged.
    """
    manifest, samples = read_manifest(Path(out)), Trials(out).where(kept=True)
    source = manifest.config.hand_source
    make_cell(arm, source, mount_of(arm, load_hand(source)))  # fails early
    chosen = np.unique(np.linspace(0, len(samples) - 1, min(MOST, len(samples))).astype(int))
    tasks = list(sample_tasks(Path(out), manifest, samples[chosen], arm))
    places, found = _places(), Counter[int]()
    progress(0, len(tasks))
    for done, reached in enumerate(in_order(execute)(partial(_reached, places), tasks), start=1):
        found.update(dict(enumerate(reached.tolist())))
        progress(done, len(tasks))
    share = np.array([found[k] for k in range(len(places))]) / max(1, len(chosen))
    return ReachMap(p_TS=places, share=share, count=len(chosen))


def _places() -> Array:
    """Return places (m, 2) on the table [m], symmetric about its centre."""
    half = TABLE_SIZE[0] / 2.0 - EDGE
    steps = SPACING * np.arange(-int(half / SPACING), int(half / SPACING) + 1)
    return np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)


@one_thread
def _reached(places: Array, task: ReachTask) -> npt.NDArray[np.int64]:
    """Return how many grasps of an object the arm reaches at each place (m,)."""
    cell, field, grasps = task.asked()
    return np.array(
        [
            sum(reach_grasp(cell, field, _moved(grasp, place)).reachable for grasp in grasps)
            for place in places
        ]
    )


def _moved(grasp: Grasp, place: Array) -> Grasp:
    """Return a grasp whose object is moved by a place (2,) [m]."""
    moved = make_pose(np.eye(3), [*place, 0.0])
    return replace(
        grasp,
        X_TO=moved @ grasp.X_TO,
        X_TG=moved @ grasp.X_TG,
        p_TG_lifted=grasp.p_TG_lifted + moved[:3, 3],
    )
