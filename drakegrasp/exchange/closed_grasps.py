"""The samples of a dataset as postures: where palm, joints and object are when fingers have closed.

In: the directory of a dataset. Out: a `ClosedGrasp` per sample, in the order of trials.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drakegrasp.dataset.hdf5 import read_names
from drakegrasp.dataset.layout.opening import open_trials, read_codes, refuse_other_codes
from drakegrasp.dataset.paths import DATA_FILES, TRIALS_FILE
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.schema import SPLITS
from drakegrasp.frames import Array, unpack_pose


@dataclass(frozen=True, kw_only=True, eq=False)
class ClosedGrasp:
    """A sample when its fingers have closed on the resting object.

    Attributes:
        trial_id: Row of /trials.
        split: `train`, `valid` or `test`.
        object_name: Name of the object.
        X_TO, X_TG: Poses (4, 4) of the object and of the palm over the table.
        q: (n,), positions of the hand's joints [rad or m], in the plant's order.
        spread: Angle of the spread joints [rad].
    """

    trial_id: int
    split: str
    object_name: str
    X_TO: Array
    X_TG: Array
    q: Array
    spread: float


def read_closed_grasps(out: Path) -> Iterator[ClosedGrasp]:
    """Yield the samples of a dataset in the order of its trials: each object's are together.

    Raises:
        DataError: If a file of the dataset is missing or not of the dataset.
    """
    # Which trials are samples, and of which split.
    split_of: dict[int, str] = {}
    for split in SPLITS:
        data = GraspDataset(out / DATA_FILES["oto"], split=split)
        split_of |= dict.fromkeys(data.column("trial_id").tolist(), split)
    rows = np.array(sorted(split_of), dtype=np.int64)

    # Their postures, from the file of all trials.
    path = out / TRIALS_FILE
    with open_trials(path) as file:
        trials = file["trials"]
        names = read_names(file["objects/name"])
        refuse_other_codes(out / DATA_FILES["oto"], "trial_id", rows, len(trials["object"]))
        objects = read_codes(trials["object"], len(names))[rows]
        X_TO, X_OG, q, spread = (
            trials[key][rows] for key in ("X_TO", "X_OG", "closed_q", "spread")
        )

    for i, row in enumerate(rows.tolist()):
        pose = unpack_pose(X_TO[i])
        yield ClosedGrasp(
            trial_id=row,
            split=split_of[row],
            object_name=str(names[objects[i]]),
            X_TO=pose,
            X_TG=pose @ unpack_pose(X_OG[i]),
            q=q[i],
            spread=float(spread[i]),
        )
