"""A file of verification results for rows of the dataset of boxes, written without a simulator."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np

from drakegrasp.dataset.hdf5 import write_field
from drakegrasp.dataset.reader import GraspDataset, PredictedRows
from drakegrasp.dataset.schema import SCHEMA_VERSION, VERIFICATION_FIELDS, sizes
from drakegrasp.dataset.trials import Trials
from drakegrasp.outcomes import Outcome

#: By how much the first contact of each prediction was asked elsewhere than it was reached [m];
#: None where the hand was never closed. And how each ended.
ERRORS = (0.004, 0.012, None, 0.007)
ENDS = (Outcome.SUCCESS, Outcome.SUCCESS, Outcome.START_COLLISION, Outcome.DROPPED)


def write_predictions(out: Path, path: Path) -> Path:
    """Write the results of four predictions, for the first two rows of `train` in turns."""
    data = GraspDataset(out / "grasping_oto.hdf5", split="train")
    rows = PredictedRows.of(data, np.array([0, 1, 0, 1]))
    true = Trials(out)[rows.trial_id.tolist()].columns()
    columns = {
        field.name: np.full(4, "", dtype=object)
        if field.dtype == "str"
        else field.empty(4, sizes(fingers=3, joints=8, image=0))
        for field in VERIFICATION_FIELDS
    }
    columns["object"][:] = data.column("object_props/object_name")[rows.row]
    columns["outcome"][:], columns["reason"][:] = ENDS, [f"it <{end.label}>" for end in ENDS]
    for i, error in enumerate(ERRORS):
        columns["p_OQ"][i], columns["nhat_Q_O"][i] = true["closed_p_OQ"][i], [0.0, 0.0, 1.0]
        columns["p_OQ"][i, 0, 2] += error or 0.0
        if error is not None:
            for name in ("X_OG", "closed_q", "closed_p_OQ", "closed_nhat_Q_O", "closed_f_Q_O"):
                columns[name][i] = true[name][i]
            columns["contact_error"][i] = [error, 0.0, 0.0]
    for name in ("lifted", "matches", "lifted_any"):
        columns[name][:] = columns["outcome"] == Outcome.SUCCESS
    columns["precision"][:] = [True, False, False, False]
    with h5py.File(path, "w") as file:
        file.attrs["schema_version"] = SCHEMA_VERSION
        group = file.create_group("grasps")
        for field in VERIFICATION_FIELDS:
            write_field(group, field, columns[field.name])
        rows.write(file)
    return path
