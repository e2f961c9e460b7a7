"""Counts of a dataset: the funnel by object, the paper's Table III, and grasps among others."""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import multiply
from drakegrasp.dataset.assemble import validate_assembled
from drakegrasp.dataset.hdf5 import AnyArray
from drakegrasp.dataset.paths import CLUTTER_FILE, TRIALS_FILE
from drakegrasp.dataset.reach import count_reach, reached_in_scenes
from drakegrasp.dataset.scenes import SceneDataset, validate_state
from drakegrasp.dataset.schema import NOT_TRIED, SPLITS
from drakegrasp.dataset.trials import NONE, Trials
from drakegrasp.errors import counted, printable
from drakegrasp.filters import Removal
from drakegrasp.frames import unpack_pose
from drakegrasp.grasp import BANDS, approach_cells, distinct_grasps, elevation_bands
from drakegrasp.outcomes import Outcome
from drakegrasp.table import Table

#: Columns of the attempts that a funnel counts.
_COUNTED = ("object", "outcome", "removal", "standoff_index", "precision", "stable")


@dataclass(frozen=True, kw_only=True, eq=False)
class Funnel:
    """Numbers of candidates, outcomes and removals of each of m objects.

    Attributes:
        names, classes: (m,), names and classes of the objects.
        candidates: (m,), palm poses that were tried.
        outcomes: (m, 1 + max(Outcome)), attempts by object and outcome.
        precision, stable: (m,), successes that are precision grasps, and those that are also
            stable.
        removals: (m, 1 + max(Removal)), successes by object and reason of removal.
        elevations: (m, 3), distinct grasps among the samples, see `distinct_grasps`, by object and
            by the band of `BANDS` from which the palm approaches; grasps of an object in one
            resting pose are compared, in the order of their trials.
        approach_cells: (m,), cells in which the object has a sample, see `approach_cells`.
        in_splits, distinct_in_splits: (m, 3), samples, and distinct ones, by object and split.
    """

    names: tuple[str, ...]
    classes: tuple[str, ...]
    candidates: npt.NDArray[np.int64]
    outcomes: npt.NDArray[np.int64]
    precision: npt.NDArray[np.int64]
    stable: npt.NDArray[np.int64]
    removals: npt.NDArray[np.int64]
    elevations: npt.NDArray[np.int64]
    approach_cells: npt.NDArray[np.int64]
    in_splits: npt.NDArray[np.int64]
    distinct_in_splits: npt.NDArray[np.int64]

    @property
    def samples(self) -> npt.NDArray[np.int64]:
        """(m,), samples of each object."""
        return self.removals[:, Removal.KEPT]

    @property
    def distinct(self) -> npt.NDArray[np.int64]:
        """(m,), distinct grasps among the samples of each object."""
        return self.elevations.sum(axis=1)

    @property
    def splits(self) -> list[SplitCount]:
        """The rows of the paper's Table III."""
        classes, counts = np.array(self.classes), list[SplitCount]()
        for i, split in enumerate(SPLITS):
            own = self.in_splits[:, i] > 0
            counts.append(
                SplitCount(
                    split=split,
                    samples=int(self.in_splits[:, i].sum()),
                    distinct=int(self.distinct_in_splits[:, i].sum()),
                    objects=int(own.sum()),
                    classes=len(np.unique(classes[own])),
                )
            )
        return counts


@dataclass(frozen=True, kw_only=True)
class SplitCount:
    """Samples of a split, distinct ones, and their objects and classes."""

    split: str
    samples: int
    distinct: int
    objects: int
    classes: int


def palms_in_files(out: Path) -> dict[str, int]:
    """Return the number of palm poses of each object in the files; empty if there are none.

    Raises:
        DataError: If trials.hdf5 is damaged.
    """
    if not os.path.lexists(out / TRIALS_FILE):
        return {}
    trials = Trials(out)
    palms = np.zeros(len(trials.objects["name"]), dtype=np.int64)
    np.maximum.at(palms, trials["object"], trials["candidate"] + 1)
    return dict(zip(trials.objects["name"].tolist(), palms.tolist(), strict=True))


def count_funnel(out: Path) -> Funnel:
    """Return the funnel of a dataset.

    Raises:
        DataError: If trials.hdf5 is missing, or it or a data file is damaged.
    """
    trials = Trials(out)
    names, classes = (tuple(trials.objects[key].tolist()) for key in ("name", "class_name"))
    count, rows = len(names), Table(trials.columns(_COUNTED))
    lifted = rows[rows.removal != NONE]

    # The samples; without data files, they are in no split.
    kept = trials.where(kept=True)
    samples = Table(kept.columns(("object", "resting", "X_TO", "X_OG", "split")))
    X_TO, X_OG = unpack_pose(samples.X_TO), unpack_pose(samples.X_OG)
    distinct = distinct_grasps(np.column_stack([samples.object, samples.resting]), X_OG)
    in_split, shape = samples.split < len(SPLITS), (count, len(SPLITS))
    in_splits, distinct_in_splits = (
        _count(shape, samples.object[rows], samples.split[rows])
        for rows in (in_split, in_split & distinct)
    )

    # From where their palms approach.
    bands = elevation_bands(multiply(X_TO[distinct], X_OG[distinct]))
    cells = np.unique(np.column_stack([samples.object, approach_cells(X_OG)]), axis=0)

    return Funnel(
        names=names,
        classes=classes,
        candidates=_count((count,), rows.object[rows.standoff_index == 0]),
        outcomes=_count((count, 1 + max(Outcome)), rows.object, rows.outcome),
        precision=_count((count,), rows.object[rows.precision]),
        stable=_count((count,), rows.object[rows.stable]),
        removals=_count((count, 1 + max(Removal)), lifted.object, lifted.removal),
        elevations=_count((count, len(BANDS)), samples.object[distinct], bands),
        approach_cells=_count((count,), cells[:, 0]),
        in_splits=in_splits,
        distinct_in_splits=distinct_in_splits,
    )


def _count(shape: tuple[int, ...], *cells: AnyArray) -> npt.NDArray[np.int64]:
    """Return how often each cell of an array of a shape occurs among cells, by its indices."""
    flat = np.ravel_multi_index(cells, shape)
    return np.bincount(flat, minlength=np.prod(shape)).reshape(shape)


def lifted_note(funnel: Funnel) -> str:
    """Return why there may be more lifted grasps than were counted; empty if there is no reason."""
    moved = int(funnel.outcomes[:, Outcome.MOVED].sum())
    if not moved:
        return ""
    ended = f"{counted(moved, 'lift')} ended early, without a verdict (moved)"
    why = "because the object moved more in the hand than a sample may"
    return f"the number of lifted grasps is a lower bound: {ended}, {why}"


@dataclass(frozen=True, kw_only=True)
class ClutterCount:
    """Numbers of grasps in scenes of several objects with the same surroundings.

    Attributes:
        surroundings: Their name.
        scenes: Number of scenes.
        grasps: All grasps.
        free: Grasps whose way is free by geometry.
        tried: Free grasps that were tried in simulation.
        kept, clean: Tried grasps with these labels.
        neighbour_hit: Tried grasps with this outcome.
        reachable: Free grasps that arms reach which were asked, by the names of their files.
    """

    surroundings: str
    scenes: int
    grasps: int
    free: int
    tried: int
    kept: int
    clean: int
    neighbour_hit: int
    reachable: dict[str, int]

    def explain(self) -> str:
        """Return how many grasps are free, and how the tried ones ended."""
        free = f"{self.free:,} of {counted(self.grasps, 'grasp')} free"
        if self.grasps:
            free += f" ({self.free / self.grasps:.0%})"
        free += "".join(f", {name} reaches {n:,} of these" for name, n in self.reachable.items())
        tried = f"{self.kept:,} kept, {self.clean:,} clean, {self.neighbour_hit:,} hit a neighbour"
        where = f"{counted(self.scenes, 'scene')} of several objects ({self.surroundings})"
        return printable(f"{where}: {free}; of {self.tried:,} tried {tried}")


def count_clutter(out: Path) -> list[ClutterCount]:
    """Return the counts of clutter.hdf5 by surroundings; empty if there is no such file.

    Raises:
        DataError: If the file is damaged, or was made from other trials.
    """
    path = out / CLUTTER_FILE
    if not os.path.lexists(path):
        return []
    validate_state(path, Trials(out))

    # The labels of each grasp, and what is around it.
    tables = SceneDataset(path, points=None).tables
    around, grasps = tables["scenes"]["surroundings"], tables["grasps"]
    where, outcome = around[grasps["scene"]], grasps["outcome"]
    labels = {name: grasps[name] for name in ("free", "kept", "clean")}
    labels["tried"] = outcome != NOT_TRIED
    labels["neighbour_hit"] = outcome == Outcome.NEIGHBOUR_HIT
    reached = reached_in_scenes(out, labels["free"])

    return [
        ClutterCount(
            surroundings=name,
            scenes=int((around == name).sum()),
            grasps=int((where == name).sum()),
            **{key: int((has & (where == name)).sum()) for key, has in labels.items()},
            reachable={arm: int((has & (where == name)).sum()) for arm, has in reached.items()},
        )
        for name in sorted(set(around))
    ]


def counts_as_dict(out: Path) -> dict[str, Any]:
    """Return the counts of a dataset as JSON types; labels without a count are left out.

    Args:
        out: Directory of the dataset.

    Raises:
        DataError: If there is no dataset, or a file cannot be read.
    """
    validate_assembled(out)
    funnel = count_funnel(out)

    def labelled(members: type[Outcome] | type[Removal], counts: AnyArray) -> dict[str, int]:
        return {each.label: int(counts[each]) for each in members if counts[each]}

    def numbers(i: int, *names: str) -> dict[str, int]:
        return {name: int(getattr(funnel, name)[i]) for name in names}

    objects = [
        {
            "name": name,
            "class": funnel.classes[i],
            "candidates": int(funnel.candidates[i]),
            "outcomes": labelled(Outcome, funnel.outcomes[i]),
            **numbers(i, "precision", "stable"),
            "removals": labelled(Removal, funnel.removals[i]),
            **numbers(i, "samples", "distinct", "approach_cells"),
            "elevations": {
                f"{low}-{high}": int(count)
                for (low, high), count in zip(BANDS, funnel.elevations[i], strict=True)
            },
        }
        for i, name in enumerate(funnel.names)
    ]
    found = {
        "path": str(out),
        "objects": objects,
        "splits": [asdict(split) for split in funnel.splits],
    }
    # Most datasets have no files of arms.
    if counts := count_reach(out):
        found["reach"] = [count.as_dict() for count in counts]
    if among := count_clutter(out):
        found["clutter"] = [asdict(count) for count in among]
    return found
