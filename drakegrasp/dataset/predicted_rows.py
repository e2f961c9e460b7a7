"""Which rows of a dataset a file of verification results is about.

In: a data file and rows of it, or a file of results. Out: `PredictedRows`. Trial ids tell the rows
whatever the filters and the split of the dataset become; they hold as long as it has the same
shards.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import numpy.typing as npt

from drakegrasp.dataset.hdf5 import write_field
from drakegrasp.dataset.opening import open_samples
from drakegrasp.dataset.schema import PREDICTED_ROW_FIELDS

#: Group of a file of results, beside that of the verdicts.
GROUP = "rows"


@dataclass(frozen=True, kw_only=True, eq=False)
class PredictedRows:
    """The row of a dataset for each of n predictions.

    Attributes:
        split, camera: Of the data file.
        shards: Hash of what the dataset was assembled from, as its files have it.
        row: (n,) int64, in the split.
        trial_id: (n,) int64, row of trials.hdf5.
    """

    split: str
    camera: str
    shards: str
    row: npt.NDArray[np.int64]
    trial_id: npt.NDArray[np.int64]

    @classmethod
    def of(cls, path: Path, split: str, rows: npt.NDArray[np.int64]) -> PredictedRows:
        """Return the rows of a split of a data file.

        Raises:
            DataError: If the file is missing, damaged, or differs from the schema.
        """
        with open_samples(path) as file:
            return cls(
                split=split,
                camera=str(file.attrs["camera"]),
                shards=str(file.attrs["shards"]),
                row=rows,
                trial_id=file[split]["trial_id"][:][rows],
            )

    def write(self, file: h5py.File) -> None:
        """Write the rows into a file of results."""
        group = file.create_group(GROUP)
        group.attrs.update({name: getattr(self, name) for name in ("split", "camera", "shards")})
        for field in PREDICTED_ROW_FIELDS:
            write_field(group, field, getattr(self, field.name))


def read_predicted_rows(file: h5py.File) -> PredictedRows | None:
    """Return the rows that a file of results is about; None if it does not say so."""
    group = file.get(GROUP)
    try:
        return PredictedRows(
            split=str(group.attrs["split"]),
            camera=str(group.attrs["camera"]),
            shards=str(group.attrs["shards"]),
            row=group["row"][:].astype(np.int64),
            trial_id=group["trial_id"][:].astype(np.int64),
        )
    except (AttributeError, KeyError, TypeError, ValueError):
        return None
