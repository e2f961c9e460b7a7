"""The samples of a dataset as postures: where palm, joints and object are when fingers have closed.

In: the directory of a dataset. Out: a `ClosedGrasp` per sample, in the order of trials.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drakegrasp.dataset.opening import refuse_other_codes
from drakegrasp.dataset.paths import DATA_FILES
from drakegrasp.dataset.schema import NO_PRESHAPE
from drakegrasp.dataset.trial_files import sample_ids
from drakegrasp.dataset.trials import Trials
from drakegrasp.frames import Array, unpack_pose
from drakegrasp.hand.description import Hand
from drakegrasp.simulation.postures.table import CONDITIONS


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
        unused: Fingers that its preshape leaves out, as bits: 1 for the first finger.
        preshape: Index of the hand's preshape; None: it is of none.
        conditions: (3,), friction of hand and table and mass [kg] of the trial; None: not known.
    """

    trial_id: int
    split: str
    object_name: str
    X_TO: Array
    X_TG: Array
    q: Array
    spread: float
    unused: int = 0
    preshape: int | None = None
    conditions: Array | None = None

    def preshape_name(self, hand: Hand) -> str:
        """Return the name of its preshape of a hand; empty if it is of none."""
        none = self.preshape is None or not hand.preshapes
        return "" if none else hand.preshape_names[self.preshape or 0]


def read_closed_grasps(out: Path) -> Iterator[ClosedGrasp]:
    """Yield the samples of a dataset in the order of its trials: each object's are together.

    Raises:
        DataError: If a file of the dataset is missing or not of the dataset.
    """
    # Which trials are samples, and of which split.
    trials = Trials(out)
    ids = sample_ids(out)
    split_of = {row: split for split, rows in ids.items() for row in rows.tolist()}
    rows = np.array(sorted(split_of), dtype=np.int64)
    refuse_other_codes(out / DATA_FILES["oto"], "trial_id", rows, len(trials))

    # Their postures.
    names = ("object_name", "X_TO", "X_OG", "closed_q", "spread", "unused", "preshape")
    samples = trials[rows].columns((*names, *CONDITIONS))
    conditions = np.column_stack([samples[name] for name in CONDITIONS])
    X_TO, X_OG = (unpack_pose(samples[name]) for name in ("X_TO", "X_OG"))
    for i, row in enumerate(rows.tolist()):
        yield ClosedGrasp(
            trial_id=row,
            split=split_of[row],
            object_name=samples["object_name"][i],
            X_TO=X_TO[i],
            X_TG=X_TO[i] @ X_OG[i],
            q=samples["closed_q"][i],
            spread=float(samples["spread"][i]),
            unused=int(samples["unused"][i]),
            preshape=None if (k := int(samples["preshape"][i])) == NO_PRESHAPE else k,
            conditions=conditions[i],
        )
