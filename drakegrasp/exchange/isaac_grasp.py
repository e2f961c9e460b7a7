"""The format isaac_grasp 1.0 (nvidia-isaac-ros.github.io, "Isaac Grasp File"): a YAML per object.

In: a dataset. Out: `<object>.yaml`, with the pose of the palm link in {O} of each sample, the
joints after closing and those of the open hand, and `meshes/<object>.obj`, the object in {O} [m].
The format allows more keys: those of ours say under what the sample held, so that the file read
back gives the same trial.
"""

from __future__ import annotations

from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from drakegrasp.arithmetic import multiply
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.paths import model_path
from drakegrasp.exchange.dexgraspbench import pose_vector
from drakegrasp.exchange.export import ClosedGrasp, read_closed_grasps
from drakegrasp.exchange.foreign_postures import CREATED_WITH
from drakegrasp.frames import invert_pose
from drakegrasp.grasp import unused_fingers
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.kinematics import joint_positions
from drakegrasp.mesh.wavefront import obj_text
from drakegrasp.objects.model import load_object
from drakegrasp.runtime.progress import Report
from drakegrasp.simulation.posture import joint_order
from drakegrasp.simulation.posture_table import CONDITIONS

#: What `drakegrasp export --help` says of the format.
HELP = "a YAML file per object: poses of the palm link, joints by name"


def write_isaac_grasp(out: Path, folder: Path, progress: Report) -> int:
    """Write the samples of a dataset and return their number; see `export.export_dataset`."""
    hand = load_hand(read_manifest(out).config.hand_source)
    grasps = list(read_closed_grasps(out))
    (folder / "meshes").mkdir()
    done = 0
    for name, same in groupby(grasps, key=lambda grasp: grasp.object_name):
        model = load_object(model_path(out, name))
        text = obj_text(model.visual_vertices, model.visual_faces, normals=False)
        (folder / "meshes" / f"{name}.obj").write_text(text, encoding="utf-8")

        entries = {f"trial_{grasp.trial_id}": grasp_entry(hand, grasp) for grasp in same}
        tree = {
            "format": "isaac_grasp",
            "format_version": 1.0,
            "created_with": CREATED_WITH,
            "object_frame": "centre of the bounding box, as in meshes/",
            "gripper_frame": hand.palm_link,
            "hand": hand.name,
            "grasps": entries,
        }
        text = yaml.safe_dump(tree, sort_keys=False, default_flow_style=None, width=1000)
        (folder / f"{name}.yaml").write_text(text, encoding="utf-8")
        done += len(entries)
        progress(done, len(grasps))
    return done


def grasp_entry(hand: Hand, grasp: ClosedGrasp) -> dict[str, Any]:
    """Return what the file says of a sample, which held."""
    order = joint_order(hand)
    X_OB = multiply(multiply(invert_pose(grasp.X_TO), grasp.X_TG), invert_pose(hand.X_BG))
    x, y, z, w, *xyz = pose_vector(X_OB).tolist()
    closed = dict(zip(order, grasp.q.tolist(), strict=True))

    # Fingers that the grasp uses are open before it; the other joints stay where they are.
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

    # How the object lay, and what else the trial had.
    x, y, z, w, *xyz = pose_vector(grasp.X_TO).tolist()
    entry["resting_pose"] = {"position": [x, y, z], "orientation": {"w": w, "xyz": xyz}}
    if name := grasp.preshape_name(hand):
        entry["preshape"] = name
    if grasp.conditions is not None:
        entry["conditions"] = dict(zip(CONDITIONS, grasp.conditions.tolist(), strict=True))
    return entry
