"""Grasps in files of isaac_grasp, as other tools write them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation


def quaternion(X: np.ndarray) -> np.ndarray:
    """Return the rotation of a pose (4, 4) as w, x, y, z."""
    return Rotation.from_matrix(X[:3, :3]).as_quat(scalar_first=True)


def isaac_grasp(X_AB: np.ndarray, **stages: Any) -> dict[str, Any]:
    """Return a grasp with the pose of its gripper, and with other keys where given."""
    w, *xyz = quaternion(X_AB).tolist()
    place = {"position": X_AB[:3, 3].tolist(), "orientation": {"w": w, "xyz": xyz}}
    return {"confidence": 0.5, **place, **stages}


def write_isaac(path: Path, **grasps: Any) -> Path:
    """Write a file of grasps by their names, in their order."""
    tree = {"format": "isaac_grasp", "format_version": 1.0, "grasps": grasps}
    path.parent.mkdir(exist_ok=True)
    path.write_text(yaml.safe_dump(tree, sort_keys=False), encoding="utf-8")
    return path
