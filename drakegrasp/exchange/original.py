"""The layout of the released code of Veres, Moussa and Taylor (github mveres01/grasping).

Input: a dataset. Output: `grasping_oto.hdf5` and `grasping_otm.hdf5` in the form that the loaders
of the released code expect. Depth is the first channel of an image. A grasp is 9k numbers (27 for
three fingers: points, normals and forces). Cameras have the axes of V-REP's sensors: +X left, +Y
up, +Z forward.

Data for which the layout has no place are left out: masks, joints, palm, the grasp at the end of
the lift, and the conditions of an attempt except the mass, which is stored in `work2mass`. The
released files also have `unproj_z` and `unproj_y` in `object_props`, which only helped to find the
image frame; we do not write them. Our forces act from the fingertips on the object. The released
code does not state on which of the two bodies V-REP's forces act.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from drakegrasp.dataset.paths import DATA_FILES
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.schema import CAMERAS, DATA_FIELDS, SPLITS
from drakegrasp.frames import Array, invert_pose, make_pose, pack_pose, unpack_pose
from drakegrasp.runtime.files import atomic_hdf5
from drakegrasp.runtime.progress import Report

#: Description of the format in `drakegrasp export --help`.
HELP = "HDF5 as of the paper's released code: depth first, 27 numbers a grasp, axes of its cameras"

#: Pose of V-REP's camera axes V in our camera frame: a rotation by 180 degrees about +Z.
X_CV = make_pose(np.diag([-1.0, -1.0, 1.0]), [0.0, 0.0, 0.0])
#: Number of rows that are read at once; the images of 64 samples take 17 MB.
BATCH = 64
#: Fields of `object_props` that the released files also have.
PROPS = tuple(
    field.name
    for field in DATA_FIELDS
    if field.name.startswith("object_props/") and not field.name.endswith("class_name")
)


def write_original(out: Path, folder: Path, progress: Report) -> int:
    """Write both files and return the number of samples; see `export.export_dataset`."""
    done, total = 0, sum(len(_split(out, c, s)) for c in CAMERAS for s in SPLITS)
    for camera in CAMERAS:
        with atomic_hdf5(folder / DATA_FILES[camera]) as file:
            file.attrs["camera_axes"] = "+X left, +Y up, +Z forward"
            file.attrs["K"] = _split(out, camera, SPLITS[0]).K
            file.attrs["grasps"] = "points [m], outward unit normals, forces on the object [N]"
            for split in SPLITS:
                done = _write_split(file.create_group(split), _split(out, camera, split), done)
                progress(done, total)
    return done // len(CAMERAS)


def original_pose(name: str, packed: npt.ArrayLike) -> Array:
    """Return the packed poses (n, 12) of a field of `object_props` with V-REP's camera axes.

    Poses that do not refer to a camera are returned unchanged.
    """
    X = unpack_pose(packed)
    if name.startswith("frame_cam2"):
        X = invert_pose(X_CV) @ X
    elif "2cam_" in name:
        X = X @ X_CV
    return pack_pose(X)


def original_grasps(grasps: npt.ArrayLike, f_Q_C: npt.ArrayLike) -> Array:
    """Return grasps (n, 9k) in V-REP's camera axes.

    Args:
        grasps: Points [m] and normals (n, 6k) in our camera axes.
        f_Q_C: Contact forces (n, k, 3) [N] in our camera axes.
    """
    forces = np.asarray(f_Q_C, dtype=float)
    n, k, _ = forces.shape
    vectors = np.asarray(grasps, dtype=float).reshape(n, 2 * k, 3)
    every = np.concatenate([vectors, forces], axis=1) @ X_CV[:3, :3]
    return np.asarray(every.reshape(n, 9 * k))


def _split(out: Path, camera: str, split: str) -> GraspDataset:
    return GraspDataset(out / DATA_FILES[camera], split=split)


def _write_split(group: h5py.Group, data: GraspDataset, done: int) -> int:
    """Write the samples of a split; return `done` plus their number."""
    # Without the images, a row takes a few hundred bytes.
    columns: Mapping[str, Any] = {name: data.column(name) for name in PROPS}
    grasps = original_grasps(data.column("grasps"), data.column("grasp_props/f_Q_C"))
    group.create_dataset("grasps", data=grasps.astype(np.float32))
    for name, values in columns.items():
        if name.startswith("object_props/frame_"):
            frames = original_pose(name.removeprefix("object_props/"), values)
            group.create_dataset(name, data=frames.astype(np.float32))
        elif values.dtype.kind in "OUT":
            group.create_dataset(name, data=values.tolist(), dtype=h5py.string_dtype())
        else:
            group.create_dataset(name, data=values)

    # Images are written in batches, with depth as the first channel.
    size = data.image_size
    images = group.create_dataset(
        "images",
        shape=(len(data), 4, size, size),
        dtype=np.float32,
        chunks=(1, 4, size, size) if len(data) else None,
        compression="gzip" if len(data) else None,
        compression_opts=1 if len(data) else None,
    )
    for start in range(0, len(data), BATCH):
        batch = data.rows("images", start, start + BATCH)
        images[start : start + len(batch)] = np.roll(batch, 1, axis=1)
    return done + len(data)
