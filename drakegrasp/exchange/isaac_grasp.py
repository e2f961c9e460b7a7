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
from drakegrasp.frames import invert_pose
from drakegrasp.grasp import unused_fingers
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.kinematics import joint_positions
from drakegrasp.mesh.surfaces import obj_text
from drakegrasp.runtime.progress import Report
from drakegrasp.simulation.attempts import CONDITIONS, quaternion_poses
from drakegrasp.simulation.posture import joint_order
from drakegrasp.yaml_text import parse_yaml

#: Value with which our files state their origin.
CREATED_WITH = "drakegrasp"
#: Keys of the joint positions of the grasp and of the pregrasp.
_STAGES = ("cspace_position", "pregrasp_cspace_position")
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
    order = joint_order(hand)
    X_OB = multiply(multiply(invert_pose(grasp.X_TO), grasp.X_TG), invert_pose(hand.X_BG))
    x, y, z, w, *xyz = pose_vector(X_OB).tolist()
    closed = dict(zip(order, grasp.q.tolist(), strict=True))

    # Before the grasp, the fingers that it uses are open; the other joints do not move.
    used = ~unused_fingers(grasp.unused, hand.num_fingers)
    moved = np.asarray(hand.joint_gain[:, 1:][:, used].any(axis=1))
    moves = dict(zip(hand.joint_names, moved.tolist(), strict=True))
    opened = joint_positions(hand, grasp.spread, [0.0] * hand.num_fingers)
    entry: dict[str, Any] = {
        "confidence": 1.0,
        "position": [x, y, z],
        "orientation": {"w": w, "xyz": xyz},
        "cspace_position": closed,
        "pregrasp_cspace_position": {n: opened[n] if moves[n] else closed[n] for n in order},
        "trial_id": grasp.trial_id,
    }

    # The resting pose of the object, and the other conditions of the trial.
    x, y, z, w, *xyz = pose_vector(grasp.X_TO).tolist()
    entry["resting_pose"] = {"position": [x, y, z], "orientation": {"w": w, "xyz": xyz}}
    if name := grasp.preshape_name(hand):
        entry["preshape"] = name
    if grasp.conditions is not None:
        entry["conditions"] = dict(zip(CONDITIONS, grasp.conditions.tolist(), strict=True))
    return entry


def read_isaac_grasp(path: Path, hand: Hand) -> dict[str, Any]:
    """Return the grasps of a file as arguments of `make_attempts`.

    The object has the name of the mesh file that the file states, or else of the file. Its frame is
    the frame of its mesh file; in a file that drakegrasp exported, this is {O}. A grasp without
    `cspace_position` is a palm pose without joints, as GraspGen writes it.

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
    grasps = tree.get("grasps")
    if not isinstance(grasps, dict) or not grasps:
        raise GraspError(f"{path}: grasps must be there, got none")
    try:
        scale = _number(tree.get("object_scale", np.nan))
    except (TypeError, ValueError) as error:
        raise GraspError(f"{path}: object_scale must be a number, got {one_line(error)}") from None

    # Read from each grasp the joints that the first grasp with joints names. A grasp without
    # joints is a palm pose without joints.
    told = [each for each in grasps.values() if isinstance(each, dict)]
    stages = [each[key] for each in told for key in _STAGES if key in each]
    named = next((stage for stage in stages if isinstance(stage, dict) and stage), None)
    if named is None and stages:
        raise GraspError(f"{path}: grasps must have cspace_position, joints by name, got none")
    joints, invalid = [str(joint) for joint in named or ()], [""] * len(grasps)
    stated = np.full(len(grasps), np.nan)
    alone = np.zeros(len(grasps), dtype=bool)
    ours = tree.get("created_with") == CREATED_WITH
    numbers = np.full((len(grasps), 7 + 2 * len(joints)), np.nan)
    known = np.full((len(grasps), 8 + len(CONDITIONS)), np.nan)
    preshape = [""] * len(grasps)
    for i, (name, grasp) in enumerate(grasps.items()):
        try:
            numbers[i] = _isaac_numbers(grasp, joints)
            alone[i], stated[i] = _STAGES[0] not in grasp, _number(grasp.get("confidence", np.nan))
            if ours:
                known[i], preshape[i] = _of_export(grasp), str(grasp.get("preshape", ""))
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            must, names = "position and orientation", ", ".join(joints)
            if joints:
                must = f"position, orientation and cspace_position of the joints {names}"
            invalid[i] = f"{name} must have {must}, got others ({one_line(error)})"
    X_FL, reasons = quaternion_poses(numbers[:, :3], numbers[:, 3:7])
    X_TO, no_rest = quaternion_poses(known[:, :3], known[:, 3:7])
    lies = np.isfinite(known[:, :7]).any(axis=1)
    invalid = [
        one or (f"resting_pose: {other}" if other and is_told else "")
        for one, other, is_told in zip(invalid, no_rest, lies, strict=True)
    ]
    trials = known[:, 7]
    grasp_q, pregrasp_q = np.split(numbers[:, 7:], 2, axis=1)
    return {
        "objects": [PureWindowsPath(str(tree.get("object_file", path))).stem] * len(grasps),
        "X_FG": X_FL,
        "link": hand.palm_link,
        "frame": "object" if ours else "mesh",
        **({"q_grasp": grasp_q, "q_pregrasp": pregrasp_q, "joints": joints} if joints else {}),
        "alone": alone,
        "confidence": None if ours or np.isnan(stated).all() else stated,
        "said": [
            f"{name}, confidence {grasp.get('confidence') if isinstance(grasp, dict) else None}"
            for name, grasp in grasps.items()
        ],
        "invalid": [one or other for one, other in zip(invalid, reasons, strict=True)],
        "X_TO": X_TO,
        "conditions": known[:, 8:],
        "preshape": preshape,
        "trial": None if np.isnan(trials).any() else trials.astype(np.int64),
        "of_objects": not ours,
        "scale": np.full(len(grasps), scale),
        "gripper": PureWindowsPath(str(tree.get("gripper_file", ""))).stem,
        "hand": str(tree["hand"]) if ours and "hand" in tree else None,
    }


def _of_export(grasp: Any) -> list[float]:
    """Return the object's pose (7,), the trial and the conditions of a grasp; NaN if not stated."""
    found, lies = [np.nan] * 7, grasp.get("resting_pose")
    if lies is not None:
        found = [*lies["position"], lies["orientation"]["w"], *lies["orientation"]["xyz"]]
    told = grasp.get("conditions", {})
    found += [grasp.get("trial_id", np.nan), *(told.get(name, np.nan) for name in CONDITIONS)]
    return [_number(value) for value in found]


def _number(value: Any) -> float:
    """Return a number; YAML reads some numbers, e.g. 1e-3, as text.

    Raises:
        TypeError, ValueError: If it is none.
    """
    if isinstance(value, bool):
        raise TypeError(f"{value}")
    return float(value)


def _isaac_numbers(grasp: Any, joints: list[str]) -> list[float]:
    """Return position, quaternion, joints at grasp and pregrasp; NaN for missing numbers."""
    turn, nothing = grasp["orientation"], dict.fromkeys(joints, np.nan)
    closed, before = _STAGES
    q = [grasp.get(closed, nothing), grasp.get(before) or nothing]
    place = [*grasp["position"], turn["w"], *turn["xyz"]]
    return [_number(v) for v in (*place, *(stage[joint] for stage in q for joint in joints))]
