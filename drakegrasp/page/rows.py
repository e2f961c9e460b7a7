"""Rows of single attempts: their numbers, poses and images, read from the files when asked for."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import multiply
from drakegrasp.dataset.hdf5 import open_hdf5
from drakegrasp.dataset.paths import DATA_FILES, shards_folder
from drakegrasp.dataset.schema import CERTIFICATE_FIELDS, SPLITS
from drakegrasp.dataset.shards import trial_columns
from drakegrasp.dataset.trial_files import NONE
from drakegrasp.frames import Array, invert_pose, rotate_vectors, transform_points, unpack_pose
from drakegrasp.page.catalog import Snapshot
from drakegrasp.pictures.style import HIDDEN
from drakegrasp.vision.camera import camera_pose_otm, camera_pose_oto, intrinsics, project

#: Columns that the dots on a thumbnail need.
THUMBNAIL = ("X_TO", "X_OG", "X_C0C", "closed_p_OQ", "closed_nhat_Q_O")
#: Length of the arrows along the normals [m].
ARROW = 0.03
_CAMERA_POSES = {"oto": camera_pose_oto, "otm": camera_pose_otm}


@dataclass(frozen=True, kw_only=True, eq=False)
class Look:
    """The images of a success by one camera.

    Attributes:
        image: (4, S, S) float32: R, G, B in 0..1 and depth [m].
        mask: (S, S) uint8, 1 where the object is seen.
    """

    image: npt.NDArray[np.float32]
    mask: npt.NDArray[np.uint8]


@dataclass(frozen=True)
class Dot:
    """A contact on an image: its pixel, and that of the tip of its normal.

    Attributes:
        finger: In grasp order.
        u, v: Pixel of the contact.
        tip_u, tip_v: Pixel of the tip of its normal.
        hidden: Whether the object hides it.
    """

    finger: int
    u: float
    v: float
    tip_u: float
    tip_v: float
    hidden: bool


def read_rows(
    snapshot: Snapshot, places: Sequence[int], names: Sequence[str] | None = None
) -> list[dict[str, Any]]:
    """Return what `/trials` says of attempts.

    Args:
        snapshot: State of the files.
        places: Of the attempts in the table.
        names: Of the columns; all that a shard has if None.

    Raises:
        DataError: If a file was replaced meanwhile.
    """
    columns = snapshot.trials[places].columns(names or [f.name for f in trial_columns()])
    return [
        dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)
    ]


def read_look(snapshot: Snapshot, i: int, camera: str) -> Look | None:
    """Return the images of an attempt, or None if there are none.

    A sample's are in the data file. Those of other successes are in their shard.

    Raises:
        DataError: If a file was replaced meanwhile.
    """
    try:
        if snapshot.table.split[i] != NONE:
            look = _sample_look(snapshot, i, camera)
        else:
            look = _shard_look(snapshot, i, camera)
    except (OSError, KeyError, ValueError, IndexError):
        look = None
    snapshot.refuse_replaced()
    return look


def look_source(snapshot: Snapshot, i: int, camera: str) -> str:
    """Return in words which file `read_look` reads."""
    is_there = (snapshot.out / DATA_FILES[camera]).is_file()
    if snapshot.table.split[i] != NONE and is_there:
        return DATA_FILES[camera]
    return f"shards of {snapshot.key(i).object}"


def _sample_look(snapshot: Snapshot, i: int, camera: str) -> Look | None:
    split = SPLITS[snapshot.table.split[i]]
    row = int(np.searchsorted(snapshot.sample_ids[split], i))
    path = snapshot.out / DATA_FILES[camera]
    if not path.is_file():
        return _shard_look(snapshot, i, camera)
    with open_hdf5(path) as file:
        return Look(image=file[split]["images"][row], mask=file[split]["masks"][row])


def _shard_look(snapshot: Snapshot, i: int, camera: str) -> Look | None:
    key = snapshot.key(i)
    with open_hdf5(_shard_path(snapshot, i)) as file:
        if not _is_shard_of(snapshot, i, file):
            return None

        # The row of the attempt in its shard, then that of its images.
        trials, looks = file["trials"], file["looks"]
        here = trials["candidate"][:] == key.candidate
        here &= trials["standoff_index"][:] == key.standoff_index
        (rows,) = np.nonzero(here & (trials["child"][:] == key.child))
        (found,) = np.nonzero(looks["row"][:] == rows[0])
        if not len(found):
            return None
        k = int(found[0])
        return Look(image=looks[f"image_{camera}"][k], mask=looks[f"mask_{camera}"][k])


def _is_shard_of(snapshot: Snapshot, i: int, file: h5py.File) -> bool:
    """Return whether a shard is of the configuration and the mesh of an attempt."""
    number = snapshot.table.object[i]
    due = snapshot.own_hashes.get(snapshot.names[number], snapshot.config_hash)
    identity = (file.attrs["config_hash"], file.attrs["mesh_sha256"])
    return identity == (due, snapshot.meshes[number])


def _shard_path(snapshot: Snapshot, i: int) -> Path:
    """Return the path of the shard that holds an attempt; its end is that of the object's poses."""
    key = snapshot.key(i)
    *_, unit = snapshot.config.unit_ranges(key.candidate + 1)
    (path,) = shards_folder(snapshot.out, key.object).glob(f"{unit.start:07d}-*.h5")
    return path


def contact_dots(
    snapshot: Snapshot,
    row: dict[str, Any],
    camera: str,
    look: Look | None = None,
    *,
    contacts: tuple[Array, Array] | None = None,
) -> list[Dot]:
    """Return where a camera sees contacts; those behind it are left out.

    Args:
        snapshot: With the configuration of the cameras.
        row: With the columns THUMBNAIL.
        camera: `oto` or `otm`.
        look: Its images, which tell what the object hides; without them nothing is hidden.
        contacts: Points and normals (k, 3) in {O}; those of the row after closing if None.
    """
    # The contacts and the tips of their normals in {C}.
    p_OQ, nhat_Q_O = contacts or (row["closed_p_OQ"], row["closed_nhat_Q_O"])
    config = snapshot.config.camera
    X_TO, X_OG = unpack_pose(row["X_TO"]), unpack_pose(row["X_OG"])
    X_TC = _CAMERA_POSES[camera](multiply(X_TO, X_OG), config, unpack_pose(row["X_C0C"]))
    X_CO = multiply(invert_pose(X_TC), X_TO)
    p_CQ, nhat_Q_C = transform_points(X_CO, p_OQ), rotate_vectors(X_CO, nhat_Q_O)

    def is_hidden(finger: int, u: float, v: float) -> bool:
        return look is not None and _is_hidden(look, u, v, float(p_CQ[finger, 2]))

    return dots_of(intrinsics(config), p_CQ, nhat_Q_C, config.near, is_hidden)


def dots_of(
    K: Array,
    p_CQ: Array,
    nhat_Q_C: Array,
    near: float,
    is_hidden: Callable[[int, float, float], bool],
) -> list[Dot]:
    """Return contacts (k, 3) in {C} as dots; those that are not before the near plane are left out.

    Args:
        K: (3, 3), camera matrix [px].
        p_CQ: (k, 3), points [m]; NaN where there is none.
        nhat_Q_C: (k, 3), normals; their tips are at `ARROW` times them.
        near: Near plane [m].
        is_hidden: Whether the camera does not see a finger's contact, which it has at u, v [px].
    """
    p_CE, dots = p_CQ + ARROW * np.nan_to_num(nhat_Q_C), []
    for finger, (point, tip) in enumerate(zip(p_CQ, p_CE, strict=True)):
        if np.isfinite(point).all() and min(point[2], tip[2]) > near:
            (u, v), (tip_u, tip_v) = project(K, np.array([point, tip])).tolist()
            dots.append(Dot(finger, u, v, tip_u, tip_v, is_hidden(finger, u, v)))
    return dots


def _is_hidden(look: Look, u: float, v: float, depth: float) -> bool:
    """Return whether something nearer is seen at the pixel of a contact, as on contact sheets."""
    last = look.image.shape[-1] - 1
    column, row = (min(max(round(x), 0), last) for x in (u, v))
    return depth > float(look.image[3, row, column]) + HIDDEN


def read_certificate(snapshot: Snapshot, i: int) -> dict[str, float]:
    """Return how robust a success is, by the names of CERTIFICATE_FIELDS; NaN if not certified.

    Raises:
        DataError: If a file was replaced meanwhile.
    """
    group, key = ("successes", "trial_id") if snapshot.assembled else ("looks", "row")
    part, row = snapshot.trials.part_of(i)
    try:
        with open_hdf5(part.path) as file:
            (found,) = np.nonzero(file[group][key][:] == row)
            certificate = {f.name: float(file[group][f.name][found[0]]) for f in CERTIFICATE_FIELDS}
    except (OSError, KeyError, ValueError, IndexError):
        certificate = {f.name: float("nan") for f in CERTIFICATE_FIELDS}
    snapshot.refuse_replaced()
    return certificate
