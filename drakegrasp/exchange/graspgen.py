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
from drakegrasp.exchange.attempts import is_graspgen
from drakegrasp.exchange.columns import validate_size
from drakegrasp.foreign_files import read_json
from drakegrasp.frames import as_numbers
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
        X_MA = _poses(grasps["transforms"])
        held = np.asarray(grasps["object_in_gripper"], dtype=float)
        scale = float(as_numbers(thing["scale"], "scale must be a number"))
        name = Path(str(thing["file"])).stem
        gripper = tree.get("gripper", {}).get("name")
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        got = listed(sorted(map(str, tree))) if isinstance(tree, dict) else type(tree).__name__
        raise GraspError(
            f"{path}: must be a file of GraspGen's datasets, with object (file, scale) and grasps "
            f"(transforms, object_in_gripper), got {got} ({one_line(error)})"
        ) from None
    return _raw(gripper, [name] * len(X_MA), X_MA, np.full(len(X_MA), scale), held)


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
        validate_size(sum(group["pred_grasps"].nbytes for group in groups))

        # What the groups of the objects and the file as a whole state.
        try:
            parts = [_predicted(group) for group in groups]
            gripper = file.get("misc/gripper_name")
            gripper = None if gripper is None else gripper.asstr()[()]
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise GraspError(
                f"{path}: objects must have asset_path, asset_scale, pred_grasps and confidence, "
                f"got others ({one_line(error)})"
            ) from None
    if not parts:
        raise GraspError(f"{path}: objects must have pred_grasps, got none")
    names, *columns = zip(*parts, strict=True)
    return _raw(gripper, [name for each in names for name in each], *map(np.concatenate, columns))


def _names(item: object) -> list[str]:
    return list(item) if isinstance(item, h5py.Group) else []


def _predicted(group: h5py.Group) -> tuple[list[str], Any, Any, Any]:
    """Return object name, pose, scale and confidence of each grasp of one object."""
    X_MA = _poses(group["pred_grasps"][()])
    name = Path(group["asset_path"].asstr()[()]).stem
    confidence = as_numbers(group["confidence"][()], "confidence must be numbers")
    scale = np.full(len(X_MA), float(group["asset_scale"][()]))
    return [name] * len(X_MA), X_MA, scale, confidence.ravel()


def _poses(numbers: Any) -> Any:
    """Return numbers as poses (n, 4, 4).

    Raises:
        ValueError: If they do not have this shape.
    """
    X = as_numbers(numbers, "poses must be numbers")
    if X.ndim != 3 or X.shape[1:] != (4, 4):
        raise ValueError(f"poses must be of shape (n, 4, 4), got {X.shape}")
    return X


def _raw(
    gripper: str | None, objects: list[str], X_MA: Any, scale: Any, confidence: Any
) -> dict[str, Any]:
    return {
        "gripper": gripper,
        "objects": objects,
        "X_FG": X_MA,
        "link": LINK,
        "frame": "mesh",
        "scale": scale,
        "confidence": confidence,
        "said": [f"grasp {i}, confidence {stated:g}" for i, stated in enumerate(confidence)],
        "of_objects": True,
    }
