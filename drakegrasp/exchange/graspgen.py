"""The file formats of GraspGen (github NVlabs/GraspGen) other than isaac_grasp.

Input: a JSON file of GraspGen's datasets, with the grasps of one object and whether each grasp held
the object, or the HDF5 file that `scripts/inference_graspgen.py` writes, with the predicted grasps
of many objects and their confidence. Output: palm poses without joints. They are poses of
GraspGen's gripper frame (`graspgen` in a hand file) in the axes of the mesh file, in metres.

GraspGen's demo writes isaac_grasp, which `drakegrasp.exchange.isaac_grasp` reads.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np

from drakegrasp.dataset.hdf5 import open_hdf5
from drakegrasp.errors import GraspError, listed, one_line
from drakegrasp.exchange.attempts import is_graspgen, refuse_large
from drakegrasp.foreign_files import read_json
from drakegrasp.hand.description import Hand

#: Name of GraspGen's gripper frame in hand files.
LINK = "graspgen"


def read_graspgen_json(path: Path, hand: Hand) -> dict[str, Any]:
    """Return the grasps of a file of GraspGen's datasets as arguments of `make_attempts`.

    Grasps that held their object are ranked first.

    Raises:
        GraspError: If the file is not a file of GraspGen's datasets.
    """
    try:
        tree: Any = read_json(path)
    except (OSError, ValueError) as error:
        raise GraspError(f"{path}: must be JSON, got: {one_line(error)}") from None
    try:
        thing, grasps = tree["object"], tree["grasps"]
        X_MA, held = _poses(grasps["transforms"]), grasps["object_in_gripper"]
        held = np.asarray(held, dtype=float)
        scale = float(thing["scale"])
        name = Path(str(thing["file"])).stem
    except (KeyError, TypeError, ValueError) as error:
        got = listed(sorted(map(str, tree))) if isinstance(tree, dict) else type(tree).__name__
        raise GraspError(
            f"{path}: must be a file of GraspGen's datasets, with object (file, scale) and grasps "
            f"(transforms, object_in_gripper), got {got} ({one_line(error)})"
        ) from None
    return _raw([name] * len(X_MA), X_MA, np.full(len(X_MA), scale), held)


def read_graspgen_hdf5(path: Path, hand: Hand) -> dict[str, Any] | None:
    """Return the predictions of a file as arguments of `make_attempts`.

    Returns:
        The arguments; None if the file does not hold predictions of GraspGen.

    Raises:
        GraspError: If the file holds such predictions but is damaged.
    """
    with open_hdf5(path) as file:
        if not is_graspgen(file):
            return None
        groups = list[h5py.Group]()
        file["objects"].visititems(
            lambda _, item: groups.append(item) if "pred_grasps" in _names(item) else None
        )
        refuse_large(sum(group["pred_grasps"].nbytes for group in groups))
        try:
            parts = [_predicted(group) for group in groups]
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise GraspError(
                f"{path}: objects must have asset_path, asset_scale, pred_grasps and confidence, "
                f"got others ({one_line(error)})"
            ) from None
    if not parts:
        raise GraspError(f"{path}: objects must have pred_grasps, got none")
    names, *columns = zip(*parts, strict=True)
    return _raw([name for each in names for name in each], *map(np.concatenate, columns))


def _names(item: object) -> list[str]:
    return list(item) if isinstance(item, h5py.Group) else []


def _predicted(group: h5py.Group) -> tuple[list[str], Any, Any, Any]:
    """Return object name, pose, scale and confidence of each grasp of one object."""
    X_MA = _poses(group["pred_grasps"][()])
    name = Path(group["asset_path"].asstr()[()]).stem
    scale, confidence = float(group["asset_scale"][()]), group["confidence"][()].astype(float)
    return [name] * len(X_MA), X_MA, np.full(len(X_MA), scale), confidence.ravel()


def _poses(numbers: Any) -> Any:
    """Return numbers as poses (n, 4, 4).

    Raises:
        ValueError: If they do not have this shape.
    """
    X = np.asarray(numbers, dtype=float)
    if X.ndim != 3 or X.shape[1:] != (4, 4):
        raise ValueError(f"poses must be of shape (n, 4, 4), got {X.shape}")
    return X


def _raw(objects: list[str], X_MA: Any, scale: Any, confidence: Any) -> dict[str, Any]:
    return {
        "objects": objects,
        "X_FG": X_MA,
        "link": LINK,
        "frame": "mesh",
        "scale": scale,
        "confidence": confidence,
        "said": [f"grasp {i}, confidence {stated:g}" for i, stated in enumerate(confidence)],
        "of_objects": True,
    }
