"""Grasps in the formats of other tools, as rows of postures.

In: a file. Out: its `Rows`. Two formats:

* DexGraspBench (github JYChen18/DexGraspBench), which BODex and Dexonomy write: a .npy file with a
  pickled dictionary of a grasp or of several. `pregrasp_qpos`, `grasp_qpos` and `squeeze_qpos` are
  the position [m] and the quaternion (w, x, y, z) of the hand's root, then the joints; `obj_pose`
  the object's in the same frame, `obj_scale` its scale, `obj_path` its folder.
* isaac_grasp 1.0 (nvidia-isaac-ros.github.io, "Isaac Grasp File"): a YAML file of the grasps of one
  object, each with the gripper's pose in the object's frame and joints by name.

The object's frame is that of its mesh file. In what drakegrasp itself exports it is {O}.
"""

from __future__ import annotations

from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import yaml

from drakegrasp.arithmetic import multiply
from drakegrasp.errors import GraspError, one_line
from drakegrasp.exchange.posture_rows import Rows, quaternion_poses
from drakegrasp.frames import Array, invert_pose
from drakegrasp.hand.description import Hand
from drakegrasp.runtime.plain_pickle import read_plain_pickle
from drakegrasp.yaml_text import parse_yaml

#: The postures of DexGraspBench, by what they are to us.
QPOS = {"grasp": "grasp_qpos", "pregrasp": "pregrasp_qpos", "squeeze": "squeeze_qpos"}
#: What an isaac_grasp file of ours says of its origin.
CREATED_WITH = "drakegrasp"


def read_dexgraspbench(path: Path, hand: Hand) -> Rows:
    """Return the grasps of a .npy file of DexGraspBench.

    Raises:
        GraspError: If it is none.
    """
    content = read_plain_pickle(path)
    if not isinstance(content, dict):
        raise GraspError(f"{path}: must hold a dictionary, got {type(content).__name__}")
    for key in ("grasp_qpos", "obj_path"):
        if key not in content:
            got = ", ".join(map(str, content))
            raise GraspError(f"{path}: {key} must be in the dictionary, got {got}")
    qpos = {
        stage: _vectors(path, content[key], key) for stage, key in QPOS.items() if key in content
    }
    grasp = qpos["grasp"]

    # The root of the hand in the object's frame, in metres.
    count = len(grasp)
    for stage, rows in qpos.items():
        if len(rows) != count:
            raise GraspError(f"{path}: {QPOS[stage]} must be of {count} rows, got {len(rows)}")
    obj_pose = content.get("obj_pose", [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    pose = _vectors(path, obj_pose, "obj_pose")
    if pose.shape not in ((1, 7), (count, 7)):
        raise GraspError(f"{path}: obj_pose must be 7 numbers for 1 or {count}, got {pose.shape}")
    pose = np.broadcast_to(pose, (count, 7))
    X_WM = quaternion_poses(pose[:, :3], pose[:, 3:])
    X_WL = quaternion_poses(grasp[:, :3], grasp[:, 3:7])
    try:
        scale = np.broadcast_to(
            np.asarray(content.get("obj_scale", np.nan), dtype=float).ravel(), (count,)
        )
    except (TypeError, ValueError):
        raise GraspError(f"{path}: obj_scale must be one number, got something else") from None
    own = "joint_units" in content
    return Rows(
        objects=[PurePosixPath(str(content["obj_path"])).name] * count,
        X_FL=multiply(invert_pose(X_WM), X_WL),
        link=hand.palm_link,
        frame="object" if own else "mesh",
        q={stage: rows[:, 7:] for stage, rows in qpos.items()},
        joints=_names(path, content.get("joint_names")),
        numbers={} if own else {"scale": scale},
        said=[path.name] * count,
    )


def _vectors(path: Path, value: Any, key: str) -> Array:
    """Return numbers as rows (n, m) of at least seven."""
    try:
        rows = np.atleast_2d(np.asarray(value, dtype=float))
    except (TypeError, ValueError):
        raise GraspError(f"{path}: {key} must be numbers, got something else") from None
    if rows.ndim != 2 or rows.shape[1] < 7:
        raise GraspError(f"{path}: {key} must be rows of a pose and joints, got {rows.shape}")
    return rows


def _names(path: Path, value: Any) -> list[str] | None:
    if value is None:
        return None
    names = value.tolist() if isinstance(value, np.ndarray) else value
    if not isinstance(names, list | tuple) or not all(isinstance(name, str) for name in names):
        raise GraspError(f"{path}: joint_names must be a list of texts, got something else")
    return list(names)


def read_isaac_grasp(path: Path, hand: Hand) -> Rows:
    """Return the grasps of an isaac_grasp file; its name is that of the object.

    Raises:
        GraspError: If it is none.
    """
    try:
        tree: Any = parse_yaml(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise GraspError(f"{path}: must be YAML, got: {one_line(error)}") from None
    if not isinstance(tree, dict) or tree.get("format") != "isaac_grasp":
        raise GraspError(f"{path}: format must be isaac_grasp, got another file")
    if str(tree.get("format_version")) not in ("1.0", "1"):
        raise GraspError(f"{path}: format_version must be 1.0, got {tree.get('format_version')!r}")
    grasps = tree.get("grasps")
    if not isinstance(grasps, dict) or not grasps:
        raise GraspError(f"{path}: grasps must be there, got none")

    # Each grasp with the same joints.
    first = next(iter(grasps.values()))
    named = first.get("cspace_position") if isinstance(first, dict) else None
    joints = list(named) if isinstance(named, dict) else []
    places, q, said = list[Any](), dict[str, list[Any]](), list[str]()
    for name, grasp in grasps.items():
        place = f"{path}: {name}"
        try:
            turn = grasp["orientation"]
            places.append([*grasp["position"], turn["w"], *turn["xyz"]])
            stages = {"grasp": grasp["cspace_position"]}
            stages |= {"pregrasp": at} if (at := grasp.get("pregrasp_cspace_position")) else {}
            for stage in ("grasp", "pregrasp"):
                at = stages.get(stage, dict.fromkeys(joints, np.nan))
                q.setdefault(stage, []).append([float(at[joint]) for joint in joints])
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise GraspError(
                f"{place} must have position, orientation and cspace_position of the joints "
                f"{', '.join(map(str, joints))}, got none ({one_line(error)})"
            ) from None
        said.append(f"{name}, confidence {grasp.get('confidence')}")
    try:
        poses = np.array(places, dtype=float).reshape(len(grasps), 7)
    except (TypeError, ValueError):
        raise GraspError(f"{path}: position and orientation must be 3 and 4 numbers") from None
    return Rows(
        objects=[path.stem] * len(grasps),
        X_FL=quaternion_poses(poses[:, :3], poses[:, 3:]),
        link=hand.palm_link,
        frame="object" if tree.get("created_with") == CREATED_WITH else "mesh",
        q=q,
        joints=[str(joint) for joint in joints],
        said=said,
    )
