"""Writing samples: from the looks of a shard to their places in both data files.

In: a part of the dataset and, by split, the ids of the trials that are samples. Out: rows
of `grasping_oto.hdf5` and `grasping_otm.hdf5`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import multiply
from drakegrasp.frames import X_WT, invert_pose, pack_pose, transform_points, unpack_pose
from drakegrasp.grasp import pack_grasp, transform_grasp
from drakegrasp.manifest import model_path
from drakegrasp.object_model import ObjectModel, load_object
from drakegrasp.parts import Part
from drakegrasp.schema import CAMERAS, DATA_FIELDS, SPLITS, sizes
from drakegrasp.shards import Shard, create_field, read_shard


def create_splits(
    file: h5py.File,
    ids: Mapping[str, npt.NDArray[np.int64]],
    shapes: Mapping[str, tuple[int, ...]],
) -> None:
    """Make the splits of a data file with room for their samples.

    Args:
        file: The data file.
        ids: Ids of the trials that are samples, by split.
        shapes: Of a row's columns, see `parts.Part`.
    """
    letters = sizes(
        fingers=shapes["closed_touching"][0],
        joints=shapes["closed_q"][0],
        image=shapes["image"][0],
    )
    for split, rows in ids.items():
        group = file.create_group(split)
        for field in DATA_FIELDS:
            dataset = create_field(group, field, field.row_shape(letters))
            dataset.resize(len(rows), axis=0)


def write_samples(
    files: Mapping[str, h5py.File],
    out: Path,
    part: Part,
    ids: Mapping[str, npt.NDArray[np.int64]],
) -> None:
    """Write the samples that come from one shard into their places in both files."""
    bounds = {s: np.searchsorted(ids[s], [part.first, part.first + part.rows]) for s in SPLITS}
    if all(start == stop for start, stop in bounds.values()):
        return
    shard = read_shard(part.header.path(out), part.header)
    model = load_object(model_path(out, part.header.object_name))
    look_of = {int(row): k for k, row in enumerate(shard.looks["row"])}
    for split, (start, stop) in bounds.items():
        for place in range(start, stop):
            trial_id = int(ids[split][place])
            row = trial_id - part.first
            for camera, file in files.items():
                sample = _sample(model, shard, row, look_of[row], camera)
                sample["trial_id"] = trial_id
                for field in DATA_FIELDS:
                    file[split][field.name][place] = sample[field.name]


def _sample(model: ObjectModel, shard: Shard, row: int, k: int, camera: str) -> dict[str, Any]:
    """Return a sample by the names of DATA_FIELDS, without its trial's id."""
    trials, looks = shard.trials, shard.looks
    X_TO = unpack_pose(trials["X_TO"][row])
    X_TC = {c: unpack_pose(looks[f"X_TC_{c}"][k]) for c in CAMERAS}
    grasp_O = pack_grasp(trials["closed_p_OQ"][row], trials["closed_nhat_Q_O"][row])
    R_TO = X_TO[:3, :3]
    properties = {
        "object_name": model.name,
        "class_name": model.class_name,
        "work2com": transform_points(X_TO, model.p_OOcm[None])[0],
        "work2inertia": multiply(multiply(R_TO, model.I_OOcm_O), R_TO.T).ravel(),
        "work2mass": [model.mass],
        "frame_cam2img_otm": looks["X_CI_otm"][k],
        "frame_cam2work_otm": pack_pose(invert_pose(X_TC["otm"])),
        "frame_cam2work_oto": pack_pose(invert_pose(X_TC["oto"])),
        "frame_work2cam_otm": pack_pose(X_TC["otm"]),
        "frame_work2cam_oto": pack_pose(X_TC["oto"]),
        "frame_world2obj": pack_pose(multiply(X_WT, X_TO)),
        "frame_world2work": pack_pose(X_WT),
    }
    return {
        "images": looks[f"image_{camera}"][k],
        "masks": looks[f"mask_{camera}"][k],
        "grasps": transform_grasp(multiply(invert_pose(X_TC[camera]), X_TO), grasp_O),
        **{f"object_props/{name}": value for name, value in properties.items()},
    }
