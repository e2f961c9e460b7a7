"""The format isaac_grasp 1.0 (nvidia-isaac-ros.github.io, "Isaac Grasp File").

Input: a dataset. Output: a file `<object>.yaml` per object, and `meshes/<object>.obj`, the object
in {O} [m]. For each sample the YAML file has the pose of the palm link in {O}, the joint positions
after closing and those of the open hand. The format allows additional keys. Ours state the
conditions under which the sample held, so that the file can be read back as the same trial.
"""

from __future__ import annotations

from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np
import yaml

from drakegrasp.arithmetic import multiply
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.errors import GraspError, one_line
from drakegrasp.exchange.dexgraspbench import pose_vector
from drakegrasp.exchange.export import ClosedGrasp, samples_by_object
from drakegrasp.foreign_files import read_text
from drakegrasp.frames import Array, invert_pose
from drakegrasp.grasp import unused_fingers
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.kinematics import joint_positions
from drakegrasp.mesh.surfaces import obj_text
from drakegrasp.runtime.progress import Report
from drakegrasp.simulation.attempts import CONDITIONS, quaternion_poses
from drakegrasp.yaml_text import parse_yaml

#: Value with which our files state their origin.
CREATED_WITH = "drakegrasp"
#: Keys of the joint positions of the grasp and of the pregrasp.
_STAGES = ("cspace_position", "pregrasp_cspace_position")
#: A pose that is not stated.
_NOWHERE = {"position": [np.nan] * 3, "orientation": {"w": np.nan, "xyz": [np.nan] * 3}}
#: Description of the format in `drakegrasp export --help`.
HELP = "a YAML file per object: poses of the palm link, joints by name"


def write_isaac_grasp(out: Path, folder: Path, progress: Report) -> int:
    """Write the samples of a dataset and return their number; see `export.export_dataset`."""
    hand = load_hand(read_manifest(out).config.hand_source)
    (folder / "meshes").mkdir()
    count = 0
    for model, samples in samples_by_object(out, progress):
        text = obj_text(model.visual_vertices, model.visual_faces, normals=False)
        (folder / "meshes" / f"{model.name}.obj").write_text(text, encoding="utf-8")
        tree = {
            "format": "isaac_grasp",
            "format_version": 1.0,
            "created_with": CREATED_WITH,
            "object_frame": "centre of the bounding box, as in meshes/",
            "gripper_frame": hand.palm_link,
            "hand": hand.name,
            "grasps": {f"trial_{each.trial_id}": grasp_entry(hand, each) for each in samples},
        }
        text = yaml.safe_dump(tree, sort_keys=False, default_flow_style=None, width=1000)
        (folder / f"{model.name}.yaml").write_text(text, encoding="utf-8")
        count += len(samples)
    return count


def grasp_entry(hand: Hand, grasp: ClosedGrasp) -> dict[str, Any]:
    """Return the entry of a sample in the file."""
    order = hand.joint_order
    X_OB = multiply(multiply(invert_pose(grasp.X_TO), grasp.X_TG), invert_pose(hand.X_BG))
    closed = dict(zip(order, grasp.q.tolist(), strict=True))

    # Before the grasp, the fingers that it uses are open; the other joints do not move.
    used = ~unused_fingers(grasp.unused, hand.num_fingers)
    moved = np.asarray(hand.joint_gain[:, 1:][:, used].any(axis=1))
    moves = dict(zip(hand.joint_names, moved.tolist(), strict=True))
    opened = joint_positions(hand, grasp.spread, [0.0] * hand.num_fingers)
    entry: dict[str, Any] = {
        "confidence": 1.0,
        **_pose_entry(X_OB),
        "cspace_position": closed,
        "pregrasp_cspace_position": {n: opened[n] if moves[n] else closed[n] for n in order},
        "trial_id": grasp.trial_id,
        "resting_pose": _pose_entry(grasp.X_TO),
    }
    if name := grasp.preshape_name(hand):
        entry["preshape"] = name
    if grasp.conditions is not None:
        entry["conditions"] = dict(zip(CONDITIONS, grasp.conditions.tolist(), strict=True))
    return entry


def _pose_entry(X_AB: Array) -> dict[str, Any]:
    x, y, z, w, *xyz = pose_vector(X_AB).tolist()
    return {"position": [x, y, z], "orientation": {"w": w, "xyz": xyz}}


def read_isaac_grasp(path: Path, hand: Hand) -> dict[str, Any]:
    """Return the grasps of a file as arguments of `make_attempts`.

    The object has the name of the mesh file that the file states, or else of the file. Its frame is
    the frame of its mesh file; in a file that drakegrasp exported, this is {O}. A grasp without
    `cspace_position` is a palm pose without joints, as GraspGen writes it.

    Raises:
        GraspError: If the file is not an isaac_grasp file.
    """
    tree = _read_tree(path)
    grasps, ours = tree["grasps"], tree.get("created_with") == CREATED_WITH
    joints = _joint_names(path, grasps)
    must = "position and orientation"
    if joints:
        must = f"position, orientation and cspace_position of the joints {', '.join(joints)}"
    rows, invalid = [], []
    for name, grasp in grasps.items():
        try:
            rows.append(_row(grasp, joints, ours))
            invalid.append("")
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            rows.append(_row(_NOWHERE, joints, ours=False))
            invalid.append(f"{name} must have {must}, got others ({one_line(error)})")

    # The poses, and why a row has none; a grasp need not state the object's.
    columns = {key: np.array([row[key] for row in rows]) for key in rows[0]}
    X_FL, no_palm = quaternion_poses(*np.split(columns["palm"], [3], axis=1))
    X_TO, no_rest = quaternion_poses(*np.split(columns["rest"], [3], axis=1))
    lies = np.isfinite(columns["rest"]).any(axis=1)
    no_rest = [f"resting_pose: {why}" if why else "" for why in np.where(lies, no_rest, "")]
    trials, stated = columns["trial"], columns["confidence"]
    return {
        "objects": [PureWindowsPath(str(tree.get("object_file", path))).stem] * len(grasps),
        "X_FG": X_FL,
        "link": hand.palm_link,
        "frame": "object" if ours else "mesh",
        "q_grasp": columns["q_grasp"] if joints else None,
        "q_pregrasp": columns["q_pregrasp"] if joints else None,
        "joints": joints or None,
        "alone": columns["alone"],
        "confidence": None if ours or np.isnan(stated).all() else stated,
        "said": [
            f"{name}, confidence {grasp.get('confidence') if isinstance(grasp, dict) else None}"
            for name, grasp in grasps.items()
        ],
        "invalid": [a or b or c for a, b, c in zip(invalid, no_rest, no_palm, strict=True)],
        "X_TO": X_TO,
        "conditions": columns["conditions"],
        "preshape": columns["preshape"].tolist(),
        "trial": None if np.isnan(trials).any() else trials.astype(np.int64),
        "of_objects": not ours,
        "scale": np.full(len(grasps), tree["object_scale"]),
        "gripper": PureWindowsPath(str(tree.get("gripper_file", ""))).stem,
        "hand": str(tree["hand"]) if ours and "hand" in tree else None,
    }


def _read_tree(path: Path) -> dict[str, Any]:
    """Return the content of a file, which has grasps; its scale is a number, NaN if not stated.

    Raises:
        GraspError: If the file is not an isaac_grasp file.
    """
    try:
        tree: Any = parse_yaml(read_text(path))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise GraspError(f"{path}: must be YAML, got: {one_line(error)}") from None
    if not isinstance(tree, dict) or tree.get("format") != "isaac_grasp":
        raise GraspError(f"{path}: format must be isaac_grasp, got another file")
    if str(tree.get("format_version")) not in ("1.0", "1"):
        raise GraspError(f"{path}: format_version must be 1.0, got {tree.get('format_version')!r}")
    if not isinstance(tree.get("grasps"), dict) or not tree["grasps"]:
        raise GraspError(f"{path}: grasps must be there, got none")
    try:
        return {**tree, "object_scale": _number(tree.get("object_scale", np.nan))}
    except (TypeError, ValueError) as error:
        raise GraspError(f"{path}: object_scale must be a number, got {one_line(error)}") from None


def _joint_names(path: Path, grasps: dict[str, Any]) -> list[str]:
    """Return the joints that the first grasp with joints names; none if all are palm poses alone.

    Raises:
        GraspError: If grasps have joint positions, but none has names of joints.
    """
    told = [each for each in grasps.values() if isinstance(each, dict)]
    stages = [each[key] for each in told for key in _STAGES if key in each]
    named = next((stage for stage in stages if isinstance(stage, dict) and stage), None)
    if named is None and stages:
        raise GraspError(f"{path}: grasps must have cspace_position, joints by name, got none")
    return [str(joint) for joint in named or ()]


def _row(grasp: Any, joints: list[str], ours: bool) -> dict[str, Any]:
    """Return what a grasp states; NaN, or no preshape, for what it does not.

    Raises:
        KeyError, TypeError, ValueError, AttributeError: If it is no grasp.
    """
    (closed, before), nothing = _STAGES, dict.fromkeys(joints, np.nan)
    trial = grasp if ours else {}
    conditions = trial.get("conditions", {})
    return {
        "palm": _place(grasp),
        "q_grasp": [_number(grasp.get(closed, nothing)[joint]) for joint in joints],
        "q_pregrasp": [_number((grasp.get(before) or nothing)[joint]) for joint in joints],
        "alone": closed not in grasp,
        "confidence": _number(grasp.get("confidence", np.nan)),
        "rest": _place(trial.get("resting_pose") or _NOWHERE),
        "trial": _number(trial.get("trial_id", np.nan)),
        "conditions": [_number(conditions.get(name, np.nan)) for name in CONDITIONS],
        "preshape": str(trial.get("preshape", "")),
    }


def _place(stated: Any) -> list[float]:
    """Return a position and a quaternion w, x, y, z (7,)."""
    (x, y, z), turn = stated["position"], stated["orientation"]
    i, j, k = turn["xyz"]
    return [_number(value) for value in (x, y, z, turn["w"], i, j, k)]


def _number(value: Any) -> float:
    """Return a number; YAML reads some numbers, e.g. 1e-3, as text.

    Raises:
        TypeError, ValueError: If it is none.
    """
    if isinstance(value, bool):
        raise TypeError(f"{value}")
    return float(value)
