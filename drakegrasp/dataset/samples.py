"""The shards in the order of the dataset's rows, and the samples that are copied from them.

In: the manifest, the shards and, by split, the ids of the trials that are samples. Out: rows of
`grasping_oto.hdf5` and `grasping_otm.hdf5`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import multiply
from drakegrasp.dataset.hdf5 import create_field
from drakegrasp.dataset.manifest import Manifest
from drakegrasp.dataset.paths import model_path
from drakegrasp.dataset.schema import CAMERAS, CONDITION_FIELDS, DATA_FIELDS, SPLITS, sizes
from drakegrasp.dataset.shards import (
    Shard,
    ShardHeader,
    read_outcomes,
    read_shard,
    trial_columns,
)
from drakegrasp.frames import (
    X_WT,
    Array,
    invert_pose,
    pack_pose,
    rotate_vectors,
    transform_points,
    unpack_pose,
)
from drakegrasp.grasp import pack_grasp, transform_grasp
from drakegrasp.objects.model import ObjectModel, load_object
from drakegrasp.outcomes import Outcome
from drakegrasp.runtime.files import read_seal


@dataclass(frozen=True, kw_only=True, eq=False)
class ShardSlice:
    """The rows of a shard that the dataset takes, and their place.

    Attributes:
        header: Of the shard.
        object: Row of its object in /objects.
        first: Id of the trial in its first row.
        rows: Number of rows taken, from the first.
        shapes: Shape of one row of each column, and of an image as "image".
    """

    header: ShardHeader
    object: int
    first: int
    rows: int
    shapes: Mapping[str, tuple[int, ...]]


def walk_shards(out: Path, manifest: Manifest) -> Iterator[tuple[ShardSlice, Shard]]:
    """Yield the shards in the order of their rows, each object's up to its last wanted grasp.

    Raises:
        DataError: If a shard is missing or damaged.
    """
    index = {entry.name: i for i, entry in enumerate(manifest.objects)}
    wanted: dict[str, int | None] = dict.fromkeys(index, manifest.config.max_grasps)
    first = 0
    for header in manifest.headers():
        name = header.object_name
        if wanted[name] == 0:
            continue
        shard = read_shard(header.path(out), header)
        rows, wanted[name] = rows_within(shard, wanted[name])
        shapes = {f.name: shard.trials[f.name].shape[1:] for f in trial_columns()}
        shapes["image"] = shard.looks["mask_oto"].shape[1:]
        shard_slice = ShardSlice(
            header=header, object=index[name], first=first, rows=rows, shapes=shapes
        )
        yield shard_slice, shard
        first += rows


def used_headers(out: Path, manifest: Manifest) -> Iterator[ShardHeader]:
    """Yield the work units whose shards `walk_shards` yields, without reading images.

    Raises:
        DataError: If `max_grasps` is set and a shard is missing or of something else.
    """
    wanted = dict.fromkeys((e.name for e in manifest.objects), manifest.config.max_grasps)
    for header in manifest.headers():
        left = wanted[header.object_name]
        if left is None:
            yield header
        elif left > 0:
            yield header
            outcomes = read_outcomes(header.path(out), header, verify_seal=False)
            wanted[header.object_name] = left - int(np.count_nonzero(outcomes == Outcome.SUCCESS))


def shards_sha256(out: Path, manifest: Manifest) -> str:
    """Return a hash of the seals of all shards that the files are made from, hexadecimal.

    Raises:
        DataError: As for `used_headers`, or if a shard has no seal.
    """
    digest = hashlib.sha256()
    for header in used_headers(out, manifest):
        digest.update(read_seal(header.path(out)))
    return digest.hexdigest()


def rows_within(shard: Shard, wanted: int | None) -> tuple[int, int | None]:
    """Return how many rows of a shard an object needs, and how many grasps it wants after it.

    The rows end with the last wanted grasp. So a dataset does not depend on how many more
    attempts the workers had begun when enough grasps were there.

    Args:
        shard: The shard.
        wanted: Number of grasps that the object still wants; None for all.
    """
    hits = np.flatnonzero(shard.trials["outcome"] == Outcome.SUCCESS)
    if wanted is None or len(hits) < wanted:
        return len(shard.trials["outcome"]), None if wanted is None else wanted - len(hits)
    return int(hits[wanted - 1]) + 1, 0


def create_splits(
    file: h5py.File,
    ids: Mapping[str, npt.NDArray[np.int64]],
    shapes: Mapping[str, tuple[int, ...]],
) -> None:
    """Create the splits of a data file, with room for their samples.

    Args:
        file: The data file.
        ids: Ids of the trials that are samples, by split.
        shapes: Shapes of one row, see `ShardSlice`.
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
    shard_slice: ShardSlice,
    ids: Mapping[str, npt.NDArray[np.int64]],
) -> None:
    """Copy the samples of one shard to their places in both data files.

    Args:
        files: The data files by camera, with their splits.
        out: Directory of the dataset.
        shard_slice: Place of the shard, from `walk_shards`, which has verified its seal.
        ids: Ids of the trials that are samples, in rising order, by split.

    Raises:
        DataError: If the shard is no longer there.
    """
    # Most shards of a hard object have no sample: do not read those.
    header, first = shard_slice.header, shard_slice.first
    bounds = {s: np.searchsorted(ids[s], [first, first + shard_slice.rows]) for s in SPLITS}
    if all(start == stop for start, stop in bounds.values()):
        return

    shard = read_shard(header.path(out), header, verify_seal=False)
    model = load_object(model_path(out, header.object_name))
    look_of = {int(row): k for k, row in enumerate(shard.looks["row"])}
    for split, (start, stop) in bounds.items():
        for place in range(start, stop):
            trial_id = int(ids[split][place])
            row = trial_id - first
            for camera, file in files.items():
                sample = _sample(model, shard, row, look_of[row], camera)
                sample["trial_id"] = trial_id
                for field in DATA_FIELDS:
                    file[split][field.name][place] = sample[field.name]


def _sample(model: ObjectModel, shard: Shard, row: int, k: int, camera: str) -> dict[str, Any]:
    """Return a sample by the names of DATA_FIELDS, without its trial's id.

    Args:
        model: The object.
        shard: The shard.
        row: Row of its /trials.
        k: Row of its /looks.
        camera: `oto` or `otm`.
    """
    trials, looks = shard.trials, shard.looks

    # The poses of this sample.
    X_TO = unpack_pose(trials["X_TO"][row])
    X_TC = {c: unpack_pose(looks[f"X_TC_{c}"][k]) for c in CAMERAS}
    X_CO = multiply(invert_pose(X_TC[camera]), X_TO)

    # What does not depend on the camera of the file.
    R_TO, mass = X_TO[:3, :3], trials["mass"][row]
    properties = {
        "object_name": model.name,
        "class_name": model.class_name,
        "work2com": transform_points(X_TO, model.p_OOcm[None])[0],
        "work2inertia": mass
        / model.mass
        * multiply(multiply(R_TO, model.I_OOcm_O), R_TO.T).ravel(),
        "work2mass": [mass],
        "frame_cam2img_otm": looks["X_CI_otm"][k],
        "frame_cam2work_otm": pack_pose(invert_pose(X_TC["otm"])),
        "frame_cam2work_oto": pack_pose(invert_pose(X_TC["oto"])),
        "frame_work2cam_otm": pack_pose(X_TC["otm"]),
        "frame_work2cam_oto": pack_pose(X_TC["oto"]),
        "frame_world2obj": pack_pose(multiply(X_WT, X_TO)),
        "frame_world2work": pack_pose(X_WT),
    }

    # Image, mask, and the grasps in the frame of the file's camera.
    trial = {name: values[row] for name, values in trials.items()}
    return {
        "images": looks[f"image_{camera}"][k],
        "masks": looks[f"mask_{camera}"][k],
        "grasps": _grasp(X_CO, trial, "closed"),
        "grasps_held": _grasp(X_CO, trial, "lifted"),
        **{f"grasp_props/{name}": value for name, value in _grasp_props(X_CO, trial).items()},
        **{f"object_props/{name}": value for name, value in properties.items()},
        **{f"conditions/{f.name}": trial[f.name] for f in CONDITION_FIELDS},
    }


def _grasp(X_CO: Array, trial: Mapping[str, Any], when: str) -> Array:
    """Return a trial's grasp (6k,) in a camera's frame, when `closed` or `lifted`."""
    return transform_grasp(X_CO, pack_grasp(trial[f"{when}_p_OQ"], trial[f"{when}_nhat_Q_O"]))


def _grasp_props(X_CO: Array, trial: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of `grasp_props` of a trial, in the frame of a camera.

    What is held is put in place with the object: both go through its resting pose.
    """
    names = ("precision", "stable", "slip", "turn", "slip_released", "turn_released")
    return {
        **{name: trial[name] for name in names},
        "other_links_held": trial["lifted_other_links"],
        "X_CG": pack_pose(multiply(X_CO, unpack_pose(trial["X_OG"]))),
        "X_CG_held": pack_pose(multiply(X_CO, unpack_pose(trial["X_OG_lifted"]))),
        "q": trial["closed_q"],
        "q_held": trial["lifted_q"],
        "f_Q_C": rotate_vectors(X_CO, trial["closed_f_Q_O"]),
        "f_Q_C_held": rotate_vectors(X_CO, trial["lifted_f_Q_O"]),
        "area": trial["closed_area"],
        "area_held": trial["lifted_area"],
    }
