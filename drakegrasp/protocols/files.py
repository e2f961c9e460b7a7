"""Grasps and objects as DexGraspBench stores them.

Input: a .npy file with postures and the pose of an object, and the object's folder, which may come
from an untrusted source. Output: `StoredGrasps`, the `GraspMotion` of one grasp, and an
`ObjectFolder`. Such a file is a pickle; only arrays, numbers, texts and containers are read from
it, and no code is run.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drakegrasp.errors import DataError, GraspError, one_line
from drakegrasp.foreign_files import read_json
from drakegrasp.frames import Array
from drakegrasp.protocols.protocol import GraspMotion
from drakegrasp.runtime.plain_pickle import npy_header, read_plain_pickle

#: Keys of the postures, in the order of `GraspMotion`.
POSTURES = {"pregrasp": "pregrasp_qpos", "grasp": "grasp_qpos", "squeeze": "squeeze_qpos"}
#: If the hand is farther from the object than this [m], the units are wrong.
FAR = 10.0
_ORIGIN = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class StoredGrasps:
    """The n grasps of a file on one object, with a hand of m joints.

    A pose is a position [m] and a quaternion (w, x, y, z); the poses of hand and object share a
    frame.

    Attributes:
        postures: (n, 7 + m), pose of the hand's root and joint positions, by "grasp", and by
            "pregrasp" and "squeeze" if the file has them.
        object_pose: (n, 7), pose of the object; the origin if the file has none.
        object_path: Folder of the object.
        object_scale: (n,), scale of the object; NaN if the file does not state it.
        joints: (m,), names of the joints; None if the file does not state them.
        exported: Whether drakegrasp wrote the file. Then the object is on the table, and the
            following values may be known:
        hand, preshape: Names; empty if the file does not state them.
        trial_id: Id of the sample's trial.
        start: (m,), joint positions from which the fingers closed.
        conditions: (3,), friction of hand and table, and mass [kg].
    """

    postures: Mapping[str, Array]
    object_pose: Array
    object_path: str
    object_scale: Array
    joints: tuple[str, ...] | None
    exported: bool
    hand: str = ""
    preshape: str = ""
    trial_id: int | None = None
    start: Array | None = None
    conditions: Array | None = None


def is_grasp_file(path: Path) -> bool:
    """Return whether a .npy file contains Python objects, as such files do, instead of numbers."""
    try:
        with path.open("rb") as file:
            return bool(npy_header(file)[1].hasobject)
    except (OSError, EOFError, ValueError, TypeError, KeyError, ArithmeticError, MemoryError):
        return False


def read_grasp_file(path: Path) -> StoredGrasps:
    """Return the grasps of a file; their numbers may still be invalid.

    Raises:
        DataError: If the file does not contain grasps.
    """
    content = read_dictionary(path)
    for key in ("grasp_qpos", "obj_path"):
        if key not in content:
            raise DataError(f"must have {key}, got {', '.join(map(str, content))}")
    postures = {name: _rows(content, key) for name, key in POSTURES.items() if key in content}
    grasp = postures["grasp"]
    if any(each.shape != grasp.shape for each in postures.values()):
        raise DataError("the postures must have equal lengths")

    # Pose and scale of the object.
    count = len(grasp)
    poses = _rows({"obj_pose": _ORIGIN, **content}, "obj_pose")
    if poses.shape not in ((1, 7), (count, 7)):
        raise DataError(f"obj_pose must be 7 numbers for 1 or {count}, got {poses.shape}")
    scale = _numbers({"obj_scale": np.nan, **content}, "obj_scale").ravel()
    if len(scale) not in (1, count):
        raise DataError(f"obj_scale must be a number, for 1 or {count}, got {len(scale)}")
    return StoredGrasps(
        postures=postures,
        object_pose=np.broadcast_to(poses, (count, 7)),
        object_path=str(content["obj_path"]),
        object_scale=np.broadcast_to(scale, (count,)),
        joints=_names(content.get("joint_names")),
        exported="joint_units" in content,
        **(_of_export(content, grasp.shape[1] - 7) if "joint_units" in content else {}),
    )


def _of_export(content: Mapping[str, Any], joints: int) -> dict[str, Any]:
    """Return what an exported file of ours states about its sample."""
    found: dict[str, Any] = {n: str(content[n]) for n in ("hand", "preshape") if n in content}
    if "trial_id" in content:
        trial = content["trial_id"]
        if not isinstance(trial, int | np.integer):
            raise DataError(f"trial_id must be a whole number, got {trial!r}")
        found["trial_id"] = int(trial)
    for name, key, size in (("start", "start_qpos", joints), ("conditions", "conditions", 3)):
        if key in content:
            found[name] = _numbers(content, key)
            if found[name].shape != (size,):
                raise DataError(f"{key} must be {size} numbers, got {found[name].shape}")
    return found


def one_motion(grasps: StoredGrasps) -> GraspMotion:
    """Return the motion of the one grasp of a file.

    Raises:
        DataError: If there are several grasps, a posture is missing, or the numbers are not valid.
    """
    if len(grasps.object_pose) != 1:
        raise DataError(f"grasp_qpos must be a vector, got {len(grasps.object_pose)} of them")
    if missing := [key for name, key in POSTURES.items() if name not in grasps.postures]:
        raise DataError(f"must have {missing[0]}, got none")
    vectors = {name: _unit(grasps.postures[name][0], key) for name, key in POSTURES.items()}
    object_pose = _unit(grasps.object_pose[0], "obj_pose")
    if max(np.linalg.norm(q[:3] - object_pose[:3]) for q in vectors.values()) > FAR:
        raise DataError(f"the hand must be within {FAR:g} m of the object")
    return GraspMotion(**vectors, object_pose=object_pose)


def inner_path(path: str) -> Path:
    """Return a path that stays within the folder of the objects.

    Raises:
        DataError: If the path leaves the folder.
    """
    if Path(path).is_absolute() or ".." in Path(path).parts or "\0" in path:
        raise DataError(f"obj_path must be a path within the folder of the objects, got {path!r}")
    return Path(path)


def read_dictionary(path: Path) -> dict[str, Any]:
    """Return the dictionary of a file.

    Raises:
        DataError: If the file has no dictionary, or anything except arrays, numbers and texts.
    """
    try:
        content = read_plain_pickle(path)
    except GraspError as error:
        raise DataError(str(error).removeprefix(f"{path}: ")) from None
    if not isinstance(content, dict):
        raise DataError("must be a .npy file with a dictionary, got another array")
    return content


def _numbers(content: Mapping[str, Any], key: str) -> Array:
    try:
        return np.asarray(content[key], dtype=float)
    except (TypeError, ValueError):
        raise DataError(f"{key} must be numbers, got something else") from None


def _rows(content: Mapping[str, Any], key: str) -> Array:
    """Return vectors (n, 7 or more), each of which begins with a pose."""
    rows = np.atleast_2d(_numbers(content, key))
    if rows.ndim != 2 or not len(rows) or rows.shape[1] < 7:
        raise DataError(f"{key} must be rows of 7 numbers or more, got {rows.shape}")
    return rows


def _names(value: Any) -> tuple[str, ...] | None:
    names = value.tolist() if isinstance(value, np.ndarray) else value
    if names is None:
        return None
    if not isinstance(names, list | tuple) or not all(isinstance(name, str) for name in names):
        raise DataError("joint_names must be a list of texts, got something else")
    return tuple(names)


def _unit(vector: Array, key: str) -> Array:
    """Return a vector with its quaternion normalised to length 1."""
    if not np.isfinite(vector).all():
        raise DataError(f"{key} must be finite numbers, got others")
    length = np.linalg.norm(vector[3:7])
    if not length > 0.0:
        raise DataError(f"{key} must have a quaternion, got zeros")
    return np.concatenate([vector[:3], vector[3:7] / length, vector[7:]])


#: Paths of the parts and of the volume within the folder of an object.
PARTS, INFO = "urdf/meshes", "info/simplified.json"


@dataclass(frozen=True, kw_only=True)
class ObjectFolder:
    """Convex parts in the object's frame {O}.

    Attributes:
        parts: Wavefront files, sorted by name.
        scale: Factor by which their coordinates are multiplied.
        volume: Volume of the scaled object [m^3].
        digest: 16 digits of the SHA-256 of the parts and the volume.
    """

    parts: tuple[Path, ...]
    scale: float
    volume: float
    digest: str


def read_object_folder(folder: Path, scale: float) -> ObjectFolder:
    """Return the object of a folder.

    Args:
        folder: Folder in DexGraspBench's layout.
        scale: Scale of the object.

    Raises:
        DataError: If the folder has no parts, or its volume cannot be read.
    """
    parts = tuple(sorted((folder / PARTS).glob("*.obj")))
    if not parts:
        raise DataError(f"{folder / PARTS}: must hold the object's convex parts (.obj), got none")
    if not (math.isfinite(scale) and scale > 0.0):
        raise DataError(f"{folder}: scale must be a positive number, got {scale}")
    try:
        info = read_json(folder / INFO)
        unit = info["mass"] / (info["density"] * info["scale"] ** 3)
    except (KeyError, TypeError, ArithmeticError, OSError, ValueError) as error:
        raise DataError(
            f"{folder / INFO}: must have mass, density and scale, got {one_line(error)}"
        ) from None
    if not (math.isfinite(unit) and unit > 0.0):
        raise DataError(f"{folder / INFO}: the volume must be positive, got {unit}")

    # The digest identifies the object, whatever the name of its folder.
    text = hashlib.sha256()
    for part in parts:
        text.update(part.read_bytes())
    text.update(repr((unit, scale)).encode())
    return ObjectFolder(
        parts=parts, scale=scale, volume=unit * scale**3, digest=text.hexdigest()[:16]
    )
