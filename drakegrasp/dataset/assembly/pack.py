"""Rows of the dataset, and how they come into its files.

A task packs some rows: what the client only has to put into the files. In: a range of rows that
begins and ends with a chunk, and their shards. Out: a part, a file with compressed chunks of the
columns of /trials, compressed images and masks of the samples among the rows, and the samples'
other columns. The client reads a part front to back, and removes it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import chain, islice
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import multiply
from drakegrasp.dataset.hdf5 import COLUMN_CHUNK, AnyArray, create_field, packed_chunk, read_column
from drakegrasp.dataset.paths import model_path
from drakegrasp.dataset.schema import (
    CAMERAS,
    DATA_FIELDS,
    SPLITS,
    TRIAL_FIELDS,
    stored_fields,
    with_derived,
)
from drakegrasp.dataset.shards import ShardHeader, open_shard, read_field, trial_columns
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
from drakegrasp.runtime.files import disk_full_named, temporary_name

#: Fields of a sample that are copied from /looks as they are stored, and their names there.
IMAGES = {"images": "image", "masks": "mask"}
#: Fields of a sample that are texts: of its object.
TEXTS = {"object_props/object_name": "name", "object_props/class_name": "class_name"}
_NUMBERS = tuple(f for f in DATA_FIELDS if f.name not in IMAGES and f.name not in TEXTS)
#: Rows of a task: some ten of the largest shards, 30 MB in memory.
TASK_ROWS = 8 * COLUMN_CHUNK
#: Offset of the chunk of an image, without its row.
_ORIGIN = {f.name: (0,) * len(f.axes) for f in DATA_FIELDS if f.name in IMAGES}


@dataclass(frozen=True, kw_only=True)
class ShardSlice:
    """The rows of a shard that the dataset takes, and their ids.

    Attributes:
        header: Of the shard.
        object: Row of its object in /objects.
        first: Id of the trial in its first row.
        rows: Number of rows taken, from the first.
    """

    header: ShardHeader
    object: int
    first: int
    rows: int


@dataclass(frozen=True, kw_only=True, eq=False)
class PackTask:
    """A range of rows to pack.

    Attributes:
        out: Directory of the dataset.
        part: Path of the file to write.
        start, stop: The range, ids of trials; the start is that of a chunk.
        slices: The shards that have rows in it, in order.
        ids: Ids of the trials in it that are samples, in rising order, by split.
        weights: Their weights.
        sizes: Lengths of the letters in the shapes of the fields.
        certified: Whether the files have HOLD_FIELDS.
    """

    out: str
    part: str
    start: int
    stop: int
    slices: tuple[ShardSlice, ...]
    ids: Mapping[str, npt.NDArray[np.int64]]
    weights: Mapping[str, Array]
    sizes: Mapping[str, int]
    certified: bool = False


@dataclass(frozen=True, kw_only=True, eq=False)
class Part:
    """What is in a part.

    Attributes:
        start: First row of its range.
        path: Of the file.
        chunks: Stored bytes of each chunk: of the first field of /trials, of the second, ...
        images: Stored bytes of each image and the filters that HDF5 skipped for it, by split,
            camera, field of IMAGES and sample.
        objects: Row of /objects of each sample, by split.
    """

    start: int
    path: str
    chunks: Sequence[int]
    images: Sequence[tuple[int, int]]
    objects: Mapping[str, npt.NDArray[np.int32]]


def pack_rows(task: PackTask) -> Part:
    """Pack a range of rows; a part that is there is replaced.

    Raises:
        DataError: If a shard is no longer there.
        DiskFullError: If there is no room for the part.
    """
    columns, samples = read_rows(task)

    # Write the part under a name of this process: another may be at the same one.
    temporary = temporary_name(Path(task.part))
    with disk_full_named(Path(task.out)):
        try:
            with temporary.open("xb") as stream:
                chunks = [stream.write(chunk) for chunk in _packed_columns(columns)]
                images = [
                    (stream.write(chunk), skipped)
                    for split in SPLITS
                    for chunk, skipped in chain.from_iterable(samples[split].images.values())
                ]
                for split in SPLITS:
                    for camera in CAMERAS:
                        np.save(stream, samples[split].numbers(camera), allow_pickle=False)
            temporary.replace(task.part)
        finally:
            temporary.unlink(missing_ok=True)
    return Part(
        start=task.start,
        path=task.part,
        chunks=chunks,
        images=images,
        objects={s: np.array(samples[s].objects, dtype=np.int32) for s in SPLITS},
    )


def read_rows(task: PackTask) -> tuple[dict[str, AnyArray], dict[str, SplitSamples]]:
    """Return the rows of a range: the columns of /trials, and the samples of each split.

    Raises:
        DataError: If a shard is no longer there.
    """
    # The survey has verified the seals.
    count = task.stop - task.start
    fields = stored_fields(TRIAL_FIELDS, certified=task.certified)
    columns = {f.name: np.empty((count, *f.row_shape(task.sizes)), f.dtype) for f in fields}
    columns["trial_id"][:] = np.arange(task.start, task.stop)
    samples = {
        split: SplitSamples(
            {camera: [np.zeros(0, record_type(task.sizes, task.certified))] for camera in CAMERAS},
            {(camera, name): [] for camera in CAMERAS for name in IMAGES},
        )
        for split in SPLITS
    }

    # Shard by shard.
    load = lru_cache(1)(load_object)  # the shards of an object come one after the other
    for piece in task.slices:
        path = piece.header.path(Path(task.out))
        with open_shard(path, piece.header, verify_seal=False, again=True) as (file, _):
            own = (field for field in trial_columns() if field.name in columns)
            trials = with_derived({f.name: read_field(file["trials"], f) for f in own})
            _fill_rows(columns, trials, piece, task)
            _add_samples(samples, trials, file["looks"], piece, task, load)
    return columns, samples


def unpack_rows(
    part: Part,
    columns: Sequence[h5py.Dataset],
    rows: Mapping[tuple[str, str], SampleRows],
) -> None:
    """Put the chunks of a part into the files, and remove it.

    Args:
        part: The part.
        columns: Datasets of TRIAL_FIELDS, with room for all rows.
        rows: The rows of the data files by split and camera.
    """
    path = Path(part.path)
    with path.open("rb") as stream:
        # The columns of the trials, each some chunks.
        each = len(part.chunks) // len(columns)
        for k, size in enumerate(part.chunks):
            column = columns[k // each]
            offset = (part.start + k % each * COLUMN_CHUNK, *(0,) * (column.ndim - 1))
            column.id.write_direct_chunk(offset, stream.read(size))

        # The samples: what is stored, then the numbers.
        images = iter(part.images)
        for split in SPLITS:
            for camera in CAMERAS:
                for name in IMAGES:
                    for size, skipped in islice(images, len(part.objects[split])):
                        rows[split, camera].add_image(name, stream.read(size), skipped)
        for split in SPLITS:
            for camera in CAMERAS:
                numbers = np.load(stream, allow_pickle=False)
                rows[split, camera].add_numbers(numbers, part.objects[split])
    path.unlink()


@dataclass(frozen=True, eq=False)
class SplitSamples:
    """The samples of a split among the rows of a task, in order.

    Attributes:
        records: (1,) arrays of all numbers of each, by camera.
        images: Stored bytes of each image and its skipped filters, by camera and field.
        objects: Row of /objects of each.
    """

    records: dict[str, list[AnyArray]]
    images: dict[tuple[str, str], list[tuple[bytes, int]]]
    objects: list[int] = field(default_factory=list)

    def numbers(self, camera: str) -> AnyArray:
        """Return all numbers of the samples, as records (n,)."""
        return np.concatenate(self.records[camera])


def _fill_rows(
    columns: Mapping[str, AnyArray],
    trials: Mapping[str, AnyArray],
    piece: ShardSlice,
    task: PackTask,
) -> None:
    """Copy the rows of a shard that are in the range of a task."""
    first, last = max(task.start, piece.first), min(task.stop, piece.first + piece.rows)
    to = slice(first - task.start, last - task.start)
    columns["object"][to] = piece.object
    for name, values in trials.items():
        columns[name][to] = values[first - piece.first : last - piece.first]


def _add_samples(
    samples: Mapping[str, SplitSamples],
    trials: Mapping[str, AnyArray],
    looks: h5py.Group,
    piece: ShardSlice,
    task: PackTask,
    load: Callable[[Path], ObjectModel],
) -> None:
    """Add the samples of a shard that are in the range of a task; `load` gives its object."""
    # Most shards of a hard object have none.
    first, last = max(task.start, piece.first), min(task.stop, piece.first + piece.rows)
    bounds = {split: np.searchsorted(task.ids[split], (first, last)) for split in SPLITS}
    if all(start == stop for start, stop in bounds.values()):
        return

    model = load(model_path(Path(task.out), piece.header.object_name))
    names = ("X_CI_otm", *(f"X_TC_{camera}" for camera in CAMERAS))
    poses = {name: read_column(looks, name) for name in names}
    images = {(c, name): looks[f"{own}_{c}"].id for c in CAMERAS for name, own in IMAGES.items()}
    look_of = {row: k for k, row in enumerate(read_column(looks, "row").tolist())}
    for split, (start, stop) in bounds.items():
        ids, weights = (values[split][start:stop].tolist() for values in (task.ids, task.weights))
        for trial_id, weight in zip(ids, weights, strict=True):
            row = trial_id - piece.first
            k = look_of[row]
            trial = {name: values[row] for name, values in trials.items()}
            look = {name: values[k] for name, values in poses.items()}
            samples[split].objects.append(piece.object)
            for camera in CAMERAS:
                values = sample_values(model, trial, look, camera)
                values |= {"trial_id": trial_id, "grasp_props/weight": weight}
                record = np.zeros_like(samples[split].records[camera][0], shape=1)
                for name, value in values.items():
                    record[name][0] = value
                samples[split].records[camera].append(record)
                for name in IMAGES:
                    skipped, chunk = images[camera, name].read_direct_chunk((k, *_ORIGIN[name]))
                    samples[split].images[camera, name].append((chunk, skipped))


def _packed_columns(columns: Mapping[str, AnyArray]) -> Iterator[bytes]:
    """Yield the chunks of the columns, field by field, from the first row on."""
    for values in columns.values():
        for start in range(0, len(values), COLUMN_CHUNK):
            yield packed_chunk(values[start : start + COLUMN_CHUNK], COLUMN_CHUNK)


def record_type(sizes: Mapping[str, int], certified: bool) -> np.dtype[Any]:
    """Return the type of a record of all numbers of a sample, by the names of DATA_FIELDS.

    Args:
        sizes: Lengths of the letters in the shapes.
        certified: Whether the files have HOLD_FIELDS.
    """
    fields = stored_fields(_NUMBERS, certified=certified)
    return np.dtype([(f.name, f.dtype, f.row_shape(sizes)) for f in fields])


class SampleRows:
    """The rows of a split of a data file, written a chunk at a time from the first to the last."""

    def __init__(
        self,
        file: h5py.File,
        split: str,
        count: int,
        sizes: Mapping[str, int],
        texts: Mapping[str, Sequence[str]],
        certified: bool,
    ) -> None:
        """Create the split.

        Args:
            file: The data file.
            split: Name of the split.
            count: Number of its samples.
            sizes: Lengths of the letters in the shapes.
            texts: By the names of TEXTS, the text of each object, by row of /objects.
            certified: Whether the files have HOLD_FIELDS.
        """
        self._group, self._texts = file.create_group(split), texts
        for each in stored_fields(DATA_FIELDS, certified=certified):
            create_field(self._group, each, each.row_shape(sizes), count)
        self._images = {name: self._group[name].id for name in IMAGES}
        self._origins = {n: (0,) * (self._group[n].ndim - 1) for n in IMAGES}
        self._next = dict.fromkeys(IMAGES, 0)
        self._written = 0
        self._waiting: list[tuple[AnyArray, npt.NDArray[np.int32]]] = []

    def add_image(self, name: str, chunk: bytes, skipped: int) -> None:
        """Write the next row of images or masks: its stored bytes, and the skipped filters."""
        offset = (self._next[name], *self._origins[name])
        self._images[name].write_direct_chunk(offset, chunk, skipped)
        self._next[name] += 1

    def add_numbers(self, records: AnyArray, objects: npt.NDArray[np.int32]) -> None:
        """Add the next records (n,), with the row of /objects of each."""
        self._waiting.append((records, objects))
        if sum(len(records) for records, _ in self._waiting) >= COLUMN_CHUNK:
            self.flush()

    def flush(self) -> None:
        """Write the rows that wait."""
        if not self._waiting:
            return
        records, objects = (np.concatenate(parts) for parts in zip(*self._waiting, strict=True))
        rows = slice(self._written, self._written + len(records))
        for name in records.dtype.names or ():
            self._group[name][rows] = records[name]
        for name, texts in self._texts.items():
            self._group[name][rows] = [texts[i] for i in objects]
        self._written, self._waiting = rows.stop, []


def sample_values(
    model: ObjectModel, trial: Mapping[str, Any], look: Mapping[str, Any], camera: str
) -> dict[str, Any]:
    """Return the numbers of a sample that follow from its trial, by the names of DATA_FIELDS.

    Args:
        model: The object.
        trial: Values of its row of /trials.
        look: Values of its row of /looks; images are not needed.
        camera: `oto` or `otm`.
    """
    # The poses of this sample.
    X_TO = unpack_pose(trial["X_TO"])
    X_TC = {c: unpack_pose(look[f"X_TC_{c}"]) for c in CAMERAS}
    X_CO = multiply(invert_pose(X_TC[camera]), X_TO)

    # Grasp, palm and forces in the frame of the file's camera. What is held is put in place with
    # the object: both go through its resting pose.
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

    # All others are columns of the trial.
    return values | {field.name: trial[field.of] for field in DATA_FIELDS if field.of in trial}
