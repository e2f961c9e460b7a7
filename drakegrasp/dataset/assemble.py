"""From shards to trials.hdf5, grasping_oto.hdf5 and grasping_otm.hdf5, and their data card.

In: a directory whose work units are all done. Out: the three files, all or none, and their card.
Two passes over the shards keep memory at the images of one shard and a few numbers per success,
whatever the size of the dataset. Imports no Drake.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np
import numpy.typing as npt

from drakegrasp.dataset.card.content import content_of
from drakegrasp.dataset.card.files import card_files
from drakegrasp.dataset.filters import Removal, Successes, judge_successes, split_samples
from drakegrasp.dataset.hdf5 import AnyArray, create_field, write_field
from drakegrasp.dataset.layout.opening import open_samples, open_trials, read_codes
from drakegrasp.dataset.lock import build_lock
from drakegrasp.dataset.manifest import (
    Manifest,
    manifest_text,
    read_manifest,
    with_postprocessing,
    write_origin,
)
from drakegrasp.dataset.paths import DATA_FILES, FILE_NAME, TRIALS_FILE
from drakegrasp.dataset.rejections import AttemptKey, find_keys
from drakegrasp.dataset.samples import (
    ShardSlice,
    create_splits,
    shards_sha256,
    walk_shards,
    write_samples,
)
from drakegrasp.dataset.schema import (
    CAMERAS,
    CERTIFICATE_FIELDS,
    OBJECT_FIELDS,
    SPLITS,
    SUCCESS_FIELDS,
    TRIAL_FIELDS,
)
from drakegrasp.dataset.shards import Shard, trial_columns
from drakegrasp.dataset.suspicion import suspicion
from drakegrasp.errors import DataError
from drakegrasp.frames import Array, invert_pose, transform_points, unpack_pose
from drakegrasp.grasp import pack_grasp, transform_grasp, unpack_grasp
from drakegrasp.runtime.file_set import replaced_together
from drakegrasp.runtime.files import disk_full_named, new_hdf5, sweep_temporary
from drakegrasp.runtime.progress import Report, silent
from drakegrasp.vision.camera import intrinsics, project


@dataclass(frozen=True, kw_only=True)
class Assembly:
    """What the files of a dataset hold.

    Attributes:
        trials: Number of attempts.
        grasps: Number of successes.
        removed: Number of successes by reason of removal; `Removal.KEPT` are the samples.
        samples: Number of samples by split.
    """

    trials: int
    grasps: int
    removed: dict[Removal, int]
    samples: dict[str, int]


def assemble(
    out: Path,
    *,
    overrides: Sequence[str] = (),
    rejected: Sequence[int | AttemptKey] = (),
    progress: Report = silent,
) -> Assembly:
    """Write the three files of a dataset whose work units are all done.

    Args:
        out: Directory of the dataset.
        overrides: `key=value` texts that change the filters or the split of the dataset.
        rejected: Trials that an inspection rejects, by id or identity; they become no samples.
        progress: Called with the number of shards read and to read.

    Raises:
        ConfigError: If an override cannot be used; nothing is changed.
        DataError: If a shard is missing or damaged, what is rejected is no success, or another
            process builds in the directory; the old files and filters stay.
        DiskFullError: If there is no room; the old files and filters stay.
    """
    # The lock would make a missing directory.
    if not out.is_dir():
        read_manifest(out)
    with build_lock(out):
        manifest = with_postprocessing(read_manifest(out), overrides)
        return assemble_locked(out, manifest, rejected=rejected, progress=progress)


def assemble_locked(
    out: Path,
    manifest: Manifest,
    *,
    rejected: Sequence[int | AttemptKey] | None = None,
    progress: Report = silent,
) -> Assembly:
    """Write the three files, their card and the manifest; the caller holds the lock.

    Args:
        out: Directory of the dataset.
        manifest: Of the dataset; it may have other filters or another split than the one there.
        rejected: As for `assemble`; those of the manifest if None, as far as they are successes.
        progress: As for `assemble`.
    """
    sweep_temporary(out)
    with disk_full_named(out), replaced_together(out) as new:
        # First pass: copy the trials, and learn of each success what the filters need.
        trials_path = new(TRIALS_FILE)
        with new_hdf5(trials_path) as trials:
            slices, successes = _write_trials(trials, out, manifest, progress)

            # Decide which successes are samples, and in which split.
            known = _keys(manifest, successes)
            if rejected is not None:
                manifest = replace(manifest, rejected=find_keys(rejected, known, out))
            ids_rejected = [known[key] for key in manifest.rejected if key in known]
            removal = judge_successes(successes, manifest.config.filters, ids_rejected)
            _write_removal(trials, successes, removal)
            ids = _split_ids(manifest, successes, removal)
            origin = {"signature": manifest.signature(), "shards": shards_sha256(out, manifest)}
            _write_attributes(trials, manifest, origin)

        # Second pass: copy the samples. It reads the shards again, because the split of a sample
        # depends on the successes of all shards, and their images do not fit into memory.
        data_paths = {camera: new(DATA_FILES[camera]) for camera in CAMERAS}
        with ExitStack() as stack:
            files = {c: stack.enter_context(new_hdf5(path)) for c, path in data_paths.items()}
            for camera, file in files.items():
                _write_attributes(file, manifest, {**origin, "camera": camera})
                create_splits(file, ids, slices[0].shapes)
            for done, shard_slice in enumerate(slices, start=len(slices) + 1):
                write_samples(files, out, shard_slice, ids)
                progress(done, 2 * len(slices))

        # What the files hold, in words and numbers. Filters, split and rejections change with the
        # files that they made.
        content = content_of(manifest, trials_path, data_paths["oto"])
        for name, text in card_files(content).items():
            new(name).write_bytes(text)
        new(FILE_NAME).write_bytes(manifest_text(manifest))
    return summarise(out)


def _write_trials(
    file: h5py.File, out: Path, manifest: Manifest, progress: Report
) -> tuple[list[ShardSlice], Successes]:
    """Write /objects and /trials; return the place of each shard, and all successes.

    Raises:
        DataError: If a shard is missing or damaged, or there is none.
    """
    K = intrinsics(manifest.config.camera)
    _write_objects(file, manifest)
    slices, successes = [], []
    for shard_slice, shard in walk_shards(out, manifest):
        _append_trials(file, shard_slice, shard)
        slices.append(shard_slice)
        successes.append(_successes(shard_slice, shard, K))
        progress(len(slices), 2 * manifest.units)
    if not slices:
        raise DataError(f"{out}: no object has a palm pose to try")
    return slices, _concatenate(successes)


def _keys(manifest: Manifest, successes: Successes) -> dict[AttemptKey, int]:
    """Return the trial id of each success, by its identity."""
    columns = (successes.object, successes.candidate, successes.standoff_index, successes.trial_id)
    rows = zip(*(column.tolist() for column in columns), strict=True)
    return {AttemptKey(manifest.objects[i].name, c, s): t for i, c, s, t in rows}


def summarise(out: Path) -> Assembly:
    """Return what the files of a dataset hold.

    Raises:
        DataError: If they are missing or damaged.
    """
    with open_trials(out / TRIALS_FILE) as trials, open_samples(out / DATA_FILES["oto"]) as data:
        removal = read_codes(trials["successes/removal"], list(Removal))
        reasons, counts = np.unique(removal, return_counts=True)
        return Assembly(
            trials=len(trials["trials/outcome"]),
            grasps=len(removal),
            removed={Removal(int(r)): int(n) for r, n in zip(reasons, counts, strict=True)},
            samples={split: len(data[split]["trial_id"]) for split in SPLITS},
        )


def _write_attributes(file: h5py.File, manifest: Manifest, origin: Mapping[str, str]) -> None:
    camera = manifest.config.camera
    write_origin(file, manifest.config, manifest.versions, manifest.fingers)
    file.attrs.update(origin)
    file.attrs["K"] = intrinsics(camera)
    file.attrs["near"], file.attrs["far"] = camera.near, camera.far


def _write_objects(file: h5py.File, manifest: Manifest) -> None:
    group = file.create_group("objects")
    for field in OBJECT_FIELDS:
        own = [getattr(entry, field.name) for entry in manifest.objects]
        values = [np.nan if value is None else value for value in own]
        dtype = object if field.dtype == "str" else field.dtype
        write_field(group, field, np.array(values, dtype=dtype))


def _append_trials(file: h5py.File, shard_slice: ShardSlice, shard: Shard) -> None:
    """Append the rows of a shard to /trials."""
    group = file.require_group("trials")
    first, rows = shard_slice.first, shard_slice.rows

    # Only the whole dataset knows the number of a row and of its object.
    columns = {f.name: shard.trials[f.name][:rows] for f in trial_columns()}
    columns["trial_id"] = np.arange(first, first + rows, dtype=np.int64)
    columns["object"] = np.full(rows, shard_slice.object, dtype=np.int32)

    for field in TRIAL_FIELDS:
        values = columns[field.name]
        if field.name not in group:
            create_field(group, field, values.shape[1:])
        dataset = group[field.name]
        dataset.resize(first + rows, axis=0)
        dataset[first:] = values


def _successes(shard_slice: ShardSlice, shard: Shard, K: Array) -> Successes:
    """Return what the filters need of a shard's successes."""
    taken = shard.looks["row"] < shard_slice.rows
    rows = shard.looks["row"][taken]
    trials = {name: values[rows] for name, values in shard.trials.items()}
    looks = {name: values[taken] for name, values in shard.looks.items()}

    # The grasps in {T}, and whether both cameras see all their contacts.
    X_TO = unpack_pose(trials["X_TO"])
    grasps = [
        transform_grasp(X, pack_grasp(p, n))
        for X, p, n in zip(X_TO, trials["closed_p_OQ"], trials["closed_nhat_Q_O"], strict=True)
    ]
    length = 6 * trials["closed_touching"].shape[1]
    in_view = [
        all(_in_view(K, looks[f"mask_{c}"][i], looks[f"X_TC_{c}"][i], grasp) for c in CAMERAS)
        for i, grasp in enumerate(grasps)
    ]

    doubts = suspicion(trials)
    return Successes(
        candidate=trials["candidate"],
        standoff_index=trials["standoff_index"],
        trial_id=shard_slice.first + rows.astype(np.int64),
        object=np.full(len(rows), shard_slice.object, dtype=np.int32),
        grasp_T=np.array(grasps).reshape(-1, length),
        held_O=np.concatenate(
            [
                trials[f"lifted_{name}"].reshape(len(rows), length // 2)
                for name in ("p_OQ", "nhat_Q_O")
            ],
            axis=1,
        ),
        complete=np.all(trials["closed_touching"] & trials["lifted_touching"], axis=1),
        other_links=trials["lifted_other_links"],
        slip=trials["slip"],
        turn=trials["turn"],
        seen=np.all([looks[f"mask_{c}"].any(axis=(1, 2)) for c in CAMERAS], axis=0),
        in_view=np.array(in_view, dtype=bool),
        # Both cameras are at the same point.
        camera_height=unpack_pose(looks["X_TC_otm"])[:, 2, 3],
        depth_variance=looks["image_otm"][:, 3].astype(float).var(axis=(1, 2)),
        surface_distance=trials["surface_distance"].max(axis=1, initial=0.0),
        normal_angle=trials["normal_angle"].max(axis=1, initial=0.0),
        suspicion=doubts.score,
        **{name: doubts.values[name] for name in ("penetration", "imbalance", "normal_sum")},
        **{field.name: looks[field.name] for field in CERTIFICATE_FIELDS},
    )


def _in_view(K: Array, mask: AnyArray, X_TC: Array, grasp_T: Array) -> bool:
    """Return whether all contacts of a grasp are before a camera and within its image."""
    p_TQ, _ = unpack_grasp(grasp_T)
    p_CQ = transform_points(invert_pose(unpack_pose(X_TC)), p_TQ)
    uv = project(K, p_CQ)
    return bool(np.all(p_CQ[:, 2] > 0.0) and np.all(uv >= 0.0) and np.all(uv <= len(mask) - 1))


def _concatenate(successes: Sequence[Successes]) -> Successes:
    names = [f.name for f in dataclasses.fields(Successes)]
    return Successes(**{n: np.concatenate([getattr(s, n) for s in successes]) for n in names})


def _write_removal(file: h5py.File, successes: Successes, removal: AnyArray) -> None:
    """Write /successes: why each success is, or is not, a sample."""
    group = file.create_group("successes")
    for field in SUCCESS_FIELDS:
        values = removal if field.name == "removal" else getattr(successes, field.name)
        write_field(group, field, values)


def _split_ids(
    manifest: Manifest, successes: Successes, removal: AnyArray
) -> dict[str, npt.NDArray[np.int64]]:
    """Return the trial ids of the samples, by split."""
    kept = np.flatnonzero(removal == Removal.KEPT)
    split = split_samples(
        successes.object[kept],
        [entry.name for entry in manifest.objects],
        [entry.class_name for entry in manifest.objects],
        manifest.config.split,
        manifest.config.seed,
    )
    return {name: successes.trial_id[kept[rows]] for name, rows in split.items()}
