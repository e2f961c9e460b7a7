"""Packs rows of the dataset and copies them into its files.

A task packs a range of rows, so that the client only has to copy them into the files. Input: a
range of rows that begins and ends at chunk borders, and the shards of these rows. Output: a part,
which is an HDF5 file with the compressed chunks of the columns of /trials, the compressed images
and masks of the samples among the rows, and the samples' other columns as records. The client
copies a part and removes it.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import multiply
from drakegrasp.dataset.assembly.survey import Decisions, ShardSlice
from drakegrasp.dataset.hdf5 import (
    COLUMN_CHUNK,
    AnyArray,
    create_field,
    read_column,
    write_field,
)
from drakegrasp.dataset.manifest import Manifest
from drakegrasp.dataset.paths import model_path
from drakegrasp.dataset.schema import (
    CAMERAS,
    DATA_FIELDS,
    TRIAL_FIELDS,
    Field,
    stored_fields,
    with_derived,
)
from drakegrasp.dataset.shards import open_shard, read_field, trial_columns
from drakegrasp.frames import (
    X_WT,
    invert_pose,
    pack_pose,
    rotate_vectors,
    transform_points,
    unpack_pose,
)
from drakegrasp.grasp import pack_grasp, transform_grasp
from drakegrasp.objects.model import ObjectModel, load_object
from drakegrasp.runtime.files import atomic_hdf5, disk_full_named, temporary_name

#: Image fields of a sample, copied from /looks as they are stored, and their names there.
IMAGES = {"images": "image", "masks": "mask"}
#: Text fields of a sample, and the attributes of its object that they repeat.
TEXTS = {"object_props/object_name": "name", "object_props/class_name": "class_name"}
#: Rows of a task: about ten of the largest shards, 30 MB in memory.
TASK_ROWS = 8 * COLUMN_CHUNK

#: A split and a camera.
Place = tuple[str, str]
#: All numbers of the samples at a place as records (n,): the names are those of DATA_FIELDS and
#: `object`, the row of /objects. And for each field of IMAGES the stored bytes of each sample, with
#: the mask of the filters that HDF5 skipped.
Records = dict[Place, AnyArray]
Images = dict[Place, dict[str, list[tuple[bytes, int]]]]


@dataclass(frozen=True, kw_only=True, eq=False)
class PackTask:
    """A range of rows to pack.

    Attributes:
        out: Directory of the dataset.
        part: Path of the file to write.
        start, stop: Range of trial ids; the start is the first row of a chunk.
        slices: The shards that have rows in the range, in order.
        ids: For each split the ids of the trials in the range that are samples, in rising order.
        firsts: For each split the row of the first of these samples.
        sizes: Lengths of the letters in the shapes of the fields.
        repeats: Whether the files have ROBUST_FIELDS.
    """

    out: str
    part: str
    start: int
    stop: int
    slices: tuple[ShardSlice, ...]
    ids: Mapping[str, npt.NDArray[np.int64]]
    firsts: Mapping[str, int]
    sizes: Mapping[str, int]
    repeats: bool


def pack_tasks(out: Path, decisions: Decisions, *, repeats: bool) -> Iterator[PackTask]:
    """Yield the tasks that pack the rows, from the first to the last."""
    shards, ids = decisions.shards, decisions.ids
    slices, firsts = shards.slices, [piece.first for piece in shards.slices]
    for start in range(0, shards.count, TASK_ROWS):
        stop = min(start + TASK_ROWS, shards.count)
        # From the shard in which the range begins to the shard in which it ends.
        within = slices[bisect_right(firsts, start) - 1 : bisect_left(firsts, stop)]
        bounds = {split: np.searchsorted(rows, (start, stop)) for split, rows in ids.items()}
        yield PackTask(
            out=str(out),
            part=str(temporary_name(out / f"rows-{start}")),
            start=start,
            stop=stop,
            slices=tuple(within),
            ids={split: ids[split][a:b] for split, (a, b) in bounds.items()},
            firsts={split: int(a) for split, (a, _) in bounds.items()},
            sizes=shards.sizes,
            repeats=repeats,
        )


# A part


def pack_rows(task: PackTask) -> PackTask:
    """Write the part of a range of rows, replacing an existing part; return the task.

    Raises:
        DataError: If a shard no longer exists.
        DiskFullError: If the disk has no room for the part.
    """
    columns, records, images = read_rows(task)
    with disk_full_named(Path(task.out)), atomic_hdf5(Path(task.part)) as file:
        group = file.create_group("trials")
        for field in _fields_of(task):
            write_field(group, field, columns[field.name])
        for (split, camera), values in records.items():
            group = file.create_group(f"{split}/{camera}")
            group["records"] = values
            for field in (field for field in DATA_FIELDS if field.name in IMAGES):
                own = images[split, camera][field.name]
                rows = create_field(group, field, field.row_shape(task.sizes), len(own))
                for row, (chunk, skipped) in enumerate(own):
                    rows.id.write_direct_chunk((row, *_within(rows)), chunk, skipped)
    return task


def unpack_rows(
    task: PackTask, files: Mapping[str, h5py.File], texts: Mapping[str, Sequence[str]]
) -> None:
    """Copy the part of a task into the files and remove the part.

    Args:
        task: The task.
        files: For each camera its open data file, which has space for all rows; for the key "" the
            file of the trials.
        texts: See `sample_texts`.
    """
    with h5py.File(task.part) as part:
        for name, column in part["trials"].items():
            _copy_chunks(column, files[""]["trials"][name], task.start)
        for split, first in task.firsts.items():
            for camera, of_camera in part[split].items():
                target, records = files[camera][split], of_camera["records"][:]
                for name in IMAGES:
                    _copy_chunks(of_camera[name], target[name], first)
                rows = slice(first, first + len(records))
                columns = {name: records[name] for name in records.dtype.names[1:]}
                columns |= {name: [t[i] for i in records["object"]] for name, t in texts.items()}
                for name, values in columns.items():
                    target[name][rows] = values
    Path(task.part).unlink()


def _copy_chunks(column: h5py.Dataset, target: h5py.Dataset, first: int) -> None:
    """Copy the stored chunks of a column to rows that begin at a chunk border."""
    for row in range(0, len(column), column.chunks[0]):
        skipped, chunk = column.id.read_direct_chunk((row, *_within(column)))
        target.id.write_direct_chunk((first + row, *_within(column)), chunk, skipped)


def _within(column: h5py.Dataset) -> tuple[int, ...]:
    """Return the position of a chunk without its row."""
    return (0,) * (column.ndim - 1)


def sample_texts(manifest: Manifest) -> dict[str, list[str]]:
    """Return, for each name of TEXTS, the texts of all objects in the order of /objects."""
    return {
        name: [getattr(entry, attribute) for entry in manifest.objects]
        for name, attribute in TEXTS.items()
    }


# Rows


def read_rows(task: PackTask) -> tuple[dict[str, AnyArray], Records, Images]:
    """Return the rows of a range: columns of /trials, and samples of each split and camera.

    Raises:
        DataError: If a shard no longer exists.
    """
    # The seals are not verified here, since the survey has verified them.
    count, places = task.stop - task.start, [(s, c) for s in task.ids for c in CAMERAS]
    columns = {
        f.name: np.empty((count, *f.row_shape(task.sizes)), f.dtype) for f in _fields_of(task)
    }
    columns["trial_id"][:] = np.arange(task.start, task.stop)
    numbers = [
        (field.name, field.dtype, field.row_shape(task.sizes))
        for field in stored_fields(DATA_FIELDS, repeats=task.repeats)
        if field.name not in (*IMAGES, *TEXTS)
    ]
    kind = np.dtype([("object", np.int32, ()), *numbers])
    records = {place: np.zeros(len(task.ids[place[0]]), kind) for place in places}
    images: Images = {place: {name: [] for name in IMAGES} for place in places}

    # Read shard by shard.
    load = lru_cache(1)(load_object)  # the shards of an object follow each other
    for piece in task.slices:
        first, last = max(task.start, piece.first), min(task.stop, piece.first + piece.rows)
        path = piece.header.path(Path(task.out))
        with open_shard(path, piece.header, verify_seal=False, again=True) as (file, _):
            own = (field for field in trial_columns() if field.name in columns)
            trials = with_derived({f.name: read_field(file["trials"], f) for f in own})
            to = slice(first - task.start, last - task.start)
            columns["object"][to] = piece.object
            for name, values in trials.items():
                columns[name][to] = values[first - piece.first : last - piece.first]
            _add_samples(records, images, trials, file["looks"], piece, task, load)
    return columns, records, images


def _fields_of(task: PackTask) -> tuple[Field, ...]:
    return stored_fields(TRIAL_FIELDS, repeats=task.repeats)


def _add_samples(
    records: Records,
    images: Images,
    trials: Mapping[str, AnyArray],
    looks: h5py.Group,
    piece: ShardSlice,
    task: PackTask,
    load: Callable[[Path], ObjectModel],
) -> None:
    """Add the samples of a shard that are in the range of a task; `load` loads its object."""
    # Most shards of a difficult object have no samples.
    bounds = {
        split: np.searchsorted(ids, (piece.first, piece.first + piece.rows)).tolist()
        for split, ids in task.ids.items()
    }
    if all(start == stop for start, stop in bounds.values()):
        return

    model = load(model_path(Path(task.out), piece.header.object_name))
    names = ("X_CI_otm", *(f"X_TC_{camera}" for camera in CAMERAS))
    poses = {name: read_column(looks, name) for name in names}
    look_of = {row: k for k, row in enumerate(read_column(looks, "row").tolist())}
    for split, (start, stop) in bounds.items():
        for i in range(start, stop):
            trial_id = int(task.ids[split][i])
            row = trial_id - piece.first
            k = look_of[row]
            trial = {name: values[row] for name, values in trials.items()}
            look = {name: values[k] for name, values in poses.items()}
            known = {"object": piece.object, "trial_id": trial_id}
            for camera in CAMERAS:
                for name, value in (sample_values(model, trial, look, camera) | known).items():
                    records[split, camera][name][i] = value
                for name, own in IMAGES.items():
                    stored = looks[f"{own}_{camera}"]
                    skipped, chunk = stored.id.read_direct_chunk((k, *_within(stored)))
                    images[split, camera][name].append((chunk, skipped))


def sample_values(
    model: ObjectModel, trial: Mapping[str, Any], look: Mapping[str, Any], camera: str
) -> dict[str, Any]:
    """Return the numbers of a sample that follow from its trial, by the names of DATA_FIELDS.

    Args:
        model: The object.
        trial: Values of the trial's row of /trials.
        look: Values of the trial's row of /looks; images are not needed.
        camera: `oto` or `otm`.
    """
    # Poses of this sample.
    X_TO = unpack_pose(trial["X_TO"])
    X_TC = {c: unpack_pose(look[f"X_TC_{c}"]) for c in CAMERAS}
    X_CO = multiply(invert_pose(X_TC[camera]), X_TO)

    # Grasp, palm and forces in the frame of the file's camera. The held grasp is expressed with the
    # object in its resting pose: both grasps are transformed with X_CO.
    values: dict[str, Any] = {}
    for suffix, when, X_OG in (("", "closed", "X_OG"), ("_held", "lifted", "X_OG_lifted")):
        grasp = pack_grasp(trial[f"{when}_p_OQ"], trial[f"{when}_nhat_Q_O"])
        values[f"grasps{suffix}"] = transform_grasp(X_CO, grasp)
        X_CG = multiply(X_CO, unpack_pose(trial[X_OG]))
        values[f"grasp_props/X_CG{suffix}"] = pack_pose(X_CG)
        f_Q_C = rotate_vectors(X_CO, trial[f"{when}_f_Q_O"])
        values[f"grasp_props/f_Q_C{suffix}"] = f_Q_C

    # Frames and mass properties, which do not depend on the camera of the file.
    R_TO = X_TO[:3, :3]
    I_OOcm_T = multiply(multiply(R_TO, model.I_OOcm_O), R_TO.T).ravel()
    properties = {
        "work2com": transform_points(X_TO, model.p_OOcm[None])[0],
        "work2inertia": trial["mass"] / model.mass * I_OOcm_T,
        "frame_cam2img_otm": look["X_CI_otm"],
        **{f"frame_cam2work_{c}": pack_pose(invert_pose(X)) for c, X in X_TC.items()},
        **{f"frame_work2cam_{c}": pack_pose(X) for c, X in X_TC.items()},
        "frame_world2obj": pack_pose(multiply(X_WT, X_TO)),
        "frame_world2work": pack_pose(X_WT),
    }
    values |= {f"object_props/{name}": value for name, value in properties.items()}

    # All other fields are columns of the trial.
    return values | {field.name: trial[field.of] for field in DATA_FIELDS if field.of in trial}
