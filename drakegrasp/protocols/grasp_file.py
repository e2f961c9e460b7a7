"""A grasp as DexGraspBench stores it: a .npy file with three postures and the pose of an object.

In: the file, which may be a stranger's. Out: a `StoredGrasp`. Such a file is a pickle; only arrays,
numbers, texts and containers are read from it, and no code runs.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drakegrasp.errors import DataError, GraspError
from drakegrasp.frames import Array
from drakegrasp.protocols.protocol import GraspMotion
from drakegrasp.runtime.plain_pickle import read_plain_pickle

#: Keys of the postures, in the order of `GraspMotion`.
POSTURES = ("pregrasp_qpos", "grasp_qpos", "squeeze_qpos")
#: A hand farther from the object is a mistake of units [m].
FAR = 10.0


@dataclass(frozen=True, kw_only=True, eq=False)
class StoredGrasp:
    """A grasp of a file.

    Attributes:
        motion: The postures and the object's pose.
        object_path: Folder of the object, relative to that of all objects.
        object_scale: Its scale.
    """

    motion: GraspMotion
    object_path: Path
    object_scale: float


def read_grasp_file(path: Path) -> StoredGrasp:
    """Return the grasp of a file.

    Raises:
        DataError: If the file is none of a grasp, or its numbers cannot be a grasp's.
    """
    content = read_dictionary(path)
    missing = [k for k in (*POSTURES, "obj_pose", "obj_scale", "obj_path") if k not in content]
    if missing:
        raise DataError(f"must have {missing[0]}, got none")

    pregrasp, grasp, squeeze = (_vector(content, key) for key in POSTURES)
    if not pregrasp.shape == grasp.shape == squeeze.shape:
        raise DataError("the three postures must have equal lengths")
    object_pose = _vector(content, "obj_pose")
    if len(object_pose) != 7:
        raise DataError(f"obj_pose must be 7 numbers, got {len(object_pose)}")
    if max(np.linalg.norm(q[:3] - object_pose[:3]) for q in (pregrasp, grasp, squeeze)) > FAR:
        raise DataError(f"the hand must be within {FAR:g} m of the object")
    return StoredGrasp(
        motion=GraspMotion(
            pregrasp=pregrasp, grasp=grasp, squeeze=squeeze, object_pose=object_pose
        ),
        object_path=_inner_path(content["obj_path"]),
        object_scale=float(_numbers(content, "obj_scale").reshape(-1)[0]),
    )


def read_dictionary(path: Path) -> dict[str, Any]:
    """Return the dictionary of a file.

    Raises:
        DataError: If the file has none, or other things than arrays, numbers and texts.
    """
    try:
        content = read_plain_pickle(path)
    except GraspError as error:
        raise DataError(str(error).removeprefix(f"{path}: ")) from None
    if not isinstance(content, dict):
        raise DataError("must be a .npy file with a dictionary, got another array")
    return content


def _numbers(content: dict[str, Any], key: str) -> Array:
    """Return the numbers of a key, at least one."""
    try:
        numbers = np.asarray(content[key], dtype=float)
    except (TypeError, ValueError):
        raise DataError(f"{key} must be numbers, got something else") from None
    if not numbers.size or not np.isfinite(numbers).all():
        raise DataError(f"{key} must be finite numbers, got others")
    return numbers


def _vector(content: dict[str, Any], key: str) -> Array:
    """Return a vector that begins with a pose; its quaternion becomes a unit one."""
    vector = _numbers(content, key).copy()
    if vector.ndim != 1 or len(vector) < 7:
        raise DataError(f"{key} must be a vector of 7 numbers or more, got {vector.shape}")
    length = np.linalg.norm(vector[3:7])
    if not length > 0.0:
        raise DataError(f"{key} must have a quaternion, got zeros")
    vector[3:7] /= length
    return vector


def _inner_path(value: Any) -> Path:
    """Return a path that does not leave the folder of the objects."""
    path = Path(str(value))
    if path.is_absolute() or ".." in path.parts or "\0" in str(value):
        raise DataError(
            f"obj_path must be a path within the folder of the objects, got {str(path)!r}"
        )
    return path
