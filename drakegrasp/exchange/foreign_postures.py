"""Grasps in the formats of other tools, as rows of postures.

In: a file. Out: its `Rows`. Two formats:

* DexGraspBench (github JYChen18/DexGraspBench), which BODex and Dexonomy write, see
  `protocols.grasp_file`;
* isaac_grasp 1.0 (nvidia-isaac-ros.github.io, "Isaac Grasp File"): a YAML file of the grasps of one
  object, each with the gripper's pose in the object's frame and joints by name.

The object's frame is that of its mesh file. In what drakegrasp itself exports it is {O}, and
further keys say of each grasp its resting pose, preshape, trial, and the friction and mass under
which it held.
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
from drakegrasp.protocols.files import read_grasp_file
from drakegrasp.simulation.posture_table import CONDITIONS
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
    X_WM, no_object = quaternion_poses(pose[:, :3], pose[:, 3:])
    X_WL, no_hand = quaternion_poses(grasp[:, :3], grasp[:, 3:7])
    q = {stage: rows[:, 7:] for stage, rows in stored.postures.items()}
    numbers: dict[str, Any] = {"scale": stored.object_scale}
    count, trial = len(grasp), stored.trial_id
    if stored.exported:
        numbers = {"X_TO": X_WM}
        if stored.conditions is not None:
            numbers["conditions"] = np.tile(stored.conditions, (count, 1))
        if stored.start is not None:
            q["pregrasp"] = np.tile(stored.start, (count, 1))
    return Rows(
        objects=[PurePosixPath(stored.object_path).name] * len(grasp),
        X_FL=multiply(invert_pose(X_WM), X_WL),
        link=hand.palm_link,
        frame="object" if stored.exported else "mesh",
        q=q,
        joints=stored.joints,
        numbers=numbers,
        preshape=[stored.preshape] * count,
        of_trial=None if trial is None else np.full(count, trial, dtype=np.int64),
        hand=stored.hand or None,
        said=[path.name] * len(grasp),
        invalid=[one or other for one, other in zip(no_object, no_hand, strict=True)],
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

    # Each grasp with the joints of the first that names some.
    stages = [each.get("cspace_position") for each in grasps.values() if isinstance(each, dict)]
    named = next((stage for stage in stages if isinstance(stage, dict) and stage), None)
    if named is None:
        raise GraspError(f"{path}: grasps must have cspace_position, joints by name, got none")
    joints, invalid = [str(joint) for joint in named], [""] * len(grasps)
    ours = tree.get("created_with") == CREATED_WITH
    numbers = np.full((len(grasps), 7 + 2 * len(joints)), np.nan)
    known = np.full((len(grasps), 8 + len(CONDITIONS)), np.nan)
    preshape = [""] * len(grasps)
    for i, (name, grasp) in enumerate(grasps.items()):
        try:
            numbers[i] = _isaac_numbers(grasp, joints)
            if ours:
                known[i], preshape[i] = _of_export(grasp), str(grasp.get("preshape", ""))
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            invalid[i] = (
                f"{name} must have position, orientation and cspace_position of the joints "
                f"{', '.join(joints)}, got none ({one_line(error)})"
            )
    X_FL, reasons = quaternion_poses(numbers[:, :3], numbers[:, 3:7])
    X_TO, no_rest = quaternion_poses(known[:, :3], known[:, 3:7])
    told = np.isfinite(known[:, :7]).any(axis=1)
    invalid = [
        one or (f"resting_pose: {other}" if other and is_told else "")
        for one, other, is_told in zip(invalid, no_rest, told, strict=True)
    ]
    trials = known[:, 7]
    return Rows(
        objects=[path.stem] * len(grasps),
        X_FL=X_FL,
        link=hand.palm_link,
        frame="object" if ours else "mesh",
        q=dict(zip(("grasp", "pregrasp"), np.split(numbers[:, 7:], 2, axis=1), strict=True)),
        joints=joints,
        said=[
            f"{name}, confidence {grasp.get('confidence') if isinstance(grasp, dict) else None}"
            for name, grasp in grasps.items()
        ],
        invalid=[one or other for one, other in zip(invalid, reasons, strict=True)],
        numbers={"X_TO": X_TO, "conditions": known[:, 8:]},
        preshape=preshape,
        of_trial=None if np.isnan(trials).any() else trials.astype(np.int64),
        hand=str(tree["hand"]) if ours and "hand" in tree else None,
    )


def _of_export(grasp: Any) -> list[float]:
    """Return the object's pose (7,), the trial, and the conditions of a grasp; NaN if not told."""
    found, lies = [np.nan] * 7, grasp.get("resting_pose")
    if lies is not None:
        found = [*lies["position"], lies["orientation"]["w"], *lies["orientation"]["xyz"]]
    told = grasp.get("conditions", {})
    found += [grasp.get("trial_id", np.nan), *(told.get(name, np.nan) for name in CONDITIONS)]
    return [float(value) for value in found]


def _isaac_numbers(grasp: Any, joints: list[str]) -> list[float]:
    """Return position, quaternion, grasp and pregrasp of a grasp; NaN for a missing pregrasp."""
    turn, before = grasp["orientation"], grasp.get("pregrasp_cspace_position")
    q = [grasp["cspace_position"], before or dict.fromkeys(joints, np.nan)]
    place = [*grasp["position"], turn["w"], *turn["xyz"]]
    return [float(v) for v in (*place, *(stage[joint] for stage in q for joint in joints))]
