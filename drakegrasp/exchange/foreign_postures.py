"""Grasps in the formats of other tools, as rows of postures.

In: a file. Out: its `Rows`. Two formats:

* DexGraspBench (github JYChen18/DexGraspBench), which BODex and Dexonomy write, see
  `protocols.grasp_file`;
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
from drakegrasp.errors import DataError, GraspError, one_line
from drakegrasp.exchange.posture_rows import Rows, quaternion_poses
from drakegrasp.frames import invert_pose
from drakegrasp.hand.description import Hand
from drakegrasp.protocols.grasp_file import read_grasp_file
from drakegrasp.yaml_text import parse_yaml

#: What an isaac_grasp file of ours says of its origin.
CREATED_WITH = "drakegrasp"


def read_dexgraspbench(path: Path, hand: Hand) -> Rows:
    """Return the grasps of a .npy file of DexGraspBench.

    Raises:
        GraspError: If it is none.
    """
    try:
        stored = read_grasp_file(path)
    except DataError as error:
        raise GraspError(f"{path}: {error}") from None

    # The root of the hand in the object's frame, in metres.
    grasp, pose = stored.postures["grasp"], stored.object_pose
    X_WM = quaternion_poses(pose[:, :3], pose[:, 3:])
    X_WL = quaternion_poses(grasp[:, :3], grasp[:, 3:7])
    return Rows(
        objects=[PurePosixPath(stored.object_path).name] * len(grasp),
        X_FL=multiply(invert_pose(X_WM), X_WL),
        link=hand.palm_link,
        frame="object" if stored.exported else "mesh",
        q={stage: rows[:, 7:] for stage, rows in stored.postures.items()},
        joints=stored.joints,
        numbers={} if stored.exported else {"scale": stored.object_scale},
        said=[path.name] * len(grasp),
    )


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
