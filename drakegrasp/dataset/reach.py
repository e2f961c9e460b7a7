"""What arms can do about the grasps of a dataset, read from OUT/reach/NAME.hdf5 and reach/clutter.

Samples are known by object, palm pose and stand-off, so a file also serves a dataset that grew
since; grasps of scenes by their row in clutter.hdf5.
`drakegrasp.reach.rows` writes the files.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import multiply
from drakegrasp.dataset.hdf5 import AnyArray, open_clutter_reach, open_reach, read_columns
from drakegrasp.dataset.paths import reach_names, reach_path
from drakegrasp.dataset.schema import CLUTTER_REACH_FIELDS, REACH_FIELDS
from drakegrasp.dataset.trials import Trials
from drakegrasp.errors import counted, printable
from drakegrasp.frames import unpack_pose
from drakegrasp.grasp import BANDS, elevation_bands

#: Columns that identify a grasp: of trials, and of a file of an arm.
IDENTITY = ("object_name", "candidate", "standoff_index")
OWN_IDENTITY = ("object", "candidate", "standoff_index")
#: Row of a grasp that an arm was not asked for.
NO_ROW = -1


@dataclass(frozen=True, kw_only=True, eq=False)
class ReachCount:
    """How many samples an arm reaches, by the band of `BANDS` from which the palm approaches.

    Attributes:
        name: Name of the arm's file.
        asked, reachable: (3,), samples for which it was asked, and those that it reaches.
    """

    name: str
    asked: npt.NDArray[np.int64]
    reachable: npt.NDArray[np.int64]

    def as_dict(self) -> dict[str, Any]:
        """Return the counts as JSON types."""
        asked, reachable = self.asked.tolist(), self.reachable.tolist()
        return {"name": self.name, "asked": asked, "reachable": reachable}

    def explain(self) -> str:
        """Return how many samples the arm reaches, in all and by elevation."""
        bands = zip(BANDS, self.reachable.tolist(), self.asked.tolist(), strict=True)
        parts = ", ".join(f"{low}-{high}° {part} of {whole}" for (low, high), part, whole in bands)
        total = f"{self.reachable.sum():,} of {counted(int(self.asked.sum()), 'sample')}"
        return printable(f"{self.name} reaches {total}; by elevation of the approach {parts}")


def count_reach(out: Path) -> list[ReachCount]:
    """Return how many samples each arm reaches that was asked.

    Raises:
        DataError: If a file is damaged.
    """
    found, samples = [], Trials(out).where(kept=True)
    columns = samples.columns((*IDENTITY, "X_TO", "X_OG"))
    X_TO, X_OG = (unpack_pose(columns[name]) for name in ("X_TO", "X_OG"))
    bands = elevation_bands(multiply(X_TO, X_OG))
    for name in reach_names(out):
        asked, reachable = (
            np.bincount(bands[chosen], minlength=len(BANDS))
            for chosen in is_reachable(out, name, columns)
        )
        found.append(ReachCount(name=name, asked=asked, reachable=reachable))
    return found


def is_reachable(
    out: Path, name: str, columns: Mapping[str, AnyArray]
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    """Return for grasps whether an arm was asked for them (n,), and whether it reaches them (n,).

    Args:
        out: Directory of the dataset.
        name: Name of the arm's file.
        columns: Columns IDENTITY of n trials.

    Raises:
        DataError: If there is no such file, or it is damaged.
    """
    with open_reach(reach_path(out, name)) as file:
        rows = read_columns(file["reach"], REACH_FIELDS, (*OWN_IDENTITY, "reachable"))
    place = rows_by_identity([rows[key] for key in OWN_IDENTITY], [columns[k] for k in IDENTITY])
    asked = place != NO_ROW
    reachable = asked.copy()
    reachable[asked] = rows.reachable[place[asked]]
    return asked, reachable


def reached_in_scenes(out: Path, free: npt.NDArray[np.bool_]) -> dict[str, npt.NDArray[np.bool_]]:
    """Return which grasps (n,) of clutter.hdf5 each arm reaches that was asked for all free ones.

    Args:
        out: Directory of the dataset.
        free: (n,), which of the grasps are free.

    Raises:
        DataError: If a file is damaged.
    """
    found = {}
    for name in reach_names(out, clutter=True):
        with open_clutter_reach(reach_path(out, name, clutter=True)) as file:
            rows = read_columns(file["clutter"], CLUTTER_REACH_FIELDS, ("grasp", "reachable"))
        if np.array_equal(rows.grasp, np.flatnonzero(free)):
            found[name] = np.zeros_like(free)
            found[name][rows.grasp] = rows.reachable
    return found


def rows_by_identity(
    table: Sequence[AnyArray], wanted: Sequence[AnyArray]
) -> npt.NDArray[np.int64]:
    """Return the row (m,) of a table with the identity of each wanted grasp, or NO_ROW.

    Args:
        table: Object, palm pose and stand-off (n,) of the table's rows.
        wanted: The same (m,) of the grasps.
    """
    places = {key: row for row, key in enumerate(zip(*(c.tolist() for c in table), strict=True))}
    keys = zip(*(column.tolist() for column in wanted), strict=True)
    return np.array([places.get(key, NO_ROW) for key in keys], dtype=np.int64)
