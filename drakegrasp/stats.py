"""Counting what a dataset holds: the funnel by object and the paper's Table III."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import numpy.typing as npt

from drakegrasp.assemble import DATA_FILES, TRIALS_FILE
from drakegrasp.errors import DataError
from drakegrasp.filters import Removal
from drakegrasp.outcomes import Outcome
from drakegrasp.schema import SPLITS


@dataclass(frozen=True, kw_only=True, eq=False)
class Funnel:
    """What became of the candidates, by object.

    Attributes:
        names, classes: (m,), of the objects.
        candidates: (m,) palm poses that were tried, drawn from `distinct` different ones of
            `valid` combinations.
        distinct, valid: (m,).
        outcomes: (m, number of outcomes), attempts by object and outcome.
        removals: (m, number of removals), successes by object and reason of removal.
    """

    names: tuple[str, ...]
    classes: tuple[str, ...]
    candidates: npt.NDArray[np.int64]
    distinct: npt.NDArray[np.int64]
    valid: npt.NDArray[np.int64]
    outcomes: npt.NDArray[np.int64]
    removals: npt.NDArray[np.int64]


@dataclass(frozen=True, kw_only=True)
class SplitCount:
    """A row of the paper's Table III."""

    split: str
    samples: int
    objects: int
    classes: int


def count_funnel(out: Path) -> Funnel:
    """Return the funnel of a dataset.

    Raises:
        DataError: If trials.hdf5 is missing or damaged.
    """
    try:
        with h5py.File(out / TRIALS_FILE, "r") as file:
            objects = {name: values[:] for name, values in file["objects"].items()}
            index = file["trials/object"][:]
            outcome = file["trials/outcome"][:]
            success = file["successes/trial_id"][:]
            removal = file["successes/removal"][:]
    except (OSError, KeyError) as error:
        raise DataError(f"{out}: must hold {TRIALS_FILE}, got none ({error})") from None
    count = len(objects["name"])
    return Funnel(
        names=tuple(name.decode() for name in objects["name"]),
        classes=tuple(name.decode() for name in objects["class_name"]),
        candidates=objects["candidates"],
        distinct=objects["distinct"],
        valid=objects["valid"],
        outcomes=_count_pairs(index, outcome, count, 1 + max(Outcome)),
        removals=_count_pairs(index[success], removal, count, 1 + max(Removal)),
    )


def count_splits(out: Path) -> list[SplitCount]:
    """Return samples, objects and classes of each split.

    Raises:
        DataError: If the data files are missing or damaged.
    """
    path = out / DATA_FILES["oto"]
    try:
        with h5py.File(path, "r") as file:
            return [
                SplitCount(
                    split=split,
                    samples=len(file[split]["grasps"]),
                    objects=len(set(file[split]["object_props/object_name"][:])),
                    classes=len(set(file[split]["object_props/class_name"][:])),
                )
                for split in SPLITS
            ]
    except (OSError, KeyError) as error:
        raise DataError(f"{path}: must be a data file, got none ({error})") from None


def _count_pairs(
    rows: npt.NDArray[np.int32], columns: npt.NDArray[np.uint8], height: int, width: int
) -> npt.NDArray[np.int64]:
    counts = np.zeros((height, width), dtype=np.int64)
    np.add.at(counts, (rows, columns), 1)
    return counts
