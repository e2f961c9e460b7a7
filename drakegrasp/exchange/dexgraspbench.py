"""The format of DexGraspBench (github JYChen18/DexGraspBench): a .npy file per grasp.

In: a dataset. Out: `grasps/<object>/<trial_id>.npy`, each a dictionary with the object's pose and
three postures of the hand, and `objects/<object>/mesh.obj`. A posture is the palm link's position
[m] and quaternion (w, x, y, z), then the joints in the order of `joint_names` and the units of
`joint_units`, rad or m:

* `pregrasp_qpos`: where the attempt begins, fingers open at its spread;
* `grasp_qpos`: after closing, as it is stored;
* `squeeze_qpos`: the same, closing and coupled joints moved a tenth further: the command of a
  position controller that presses, as the benchmark makes it of grasps that have none.

All poses are over the table, in {T}. The benchmark evaluates a grasp with its own model of a hand,
whose joints and root must be those of ours.
"""

from __future__ import annotations

from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from drakegrasp.arithmetic import multiply
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.paths import model_path
from drakegrasp.exchange.closed_grasps import ClosedGrasp, read_closed_grasps
from drakegrasp.frames import Array, invert_pose
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.mesh.wavefront import obj_text
from drakegrasp.objects.model import load_object
from drakegrasp.runtime.progress import Report
from drakegrasp.visualization.still_scene import StillScene

#: By how much of their path the fingers are commanded to close further.
SQUEEZE = 0.1


def write_dexgraspbench(out: Path, folder: Path, progress: Report) -> int:
    """Write a file per sample and return their number; see `export.export_dataset`."""
    hand = load_hand(read_manifest(out).config.hand)
    posed, grasps = StillScene(hand), list(read_closed_grasps(out))
    progress(0, len(grasps))
    done = 0
    for name, same in groupby(grasps, key=lambda grasp: grasp.object_name):
        # The mesh of the object, in {O}.
        model = load_object(model_path(out, name))
        mesh = folder / "objects" / name / "mesh.obj"
        mesh.parent.mkdir(parents=True)
        mesh.write_text(
            obj_text(model.visual_vertices, model.visual_faces, normals=False), encoding="utf-8"
        )

        (folder / "grasps" / name).mkdir(parents=True)
        for grasp in same:
            content: Any = grasp_dictionary(hand, posed, grasp)
            np.save(folder / "grasps" / name / f"{grasp.trial_id}.npy", content)
            done += 1
            progress(done, len(grasps))
    return done


def grasp_dictionary(hand: Hand, posed: StillScene, grasp: ClosedGrasp) -> dict[str, Any]:
    """Return what the file of a grasp holds, see the module.

    Args:
        hand: The hand.
        posed: The same hand, which knows the order of its joints.
        grasp: The sample.
    """
    # The palm link's pose, and the joints at the three instants.
    X_TB = multiply(grasp.X_TG, invert_pose(hand.X_BG))
    start = posed.positions(grasp.spread)
    spread = np.isin(posed.joints, hand.spread.joints)
    squeezed = grasp.q + SQUEEZE * np.where(spread, 0.0, grasp.q - start)

    return {
        "obj_pose": pose_vector(grasp.X_TO),
        "obj_scale": 1.0,
        "obj_path": f"objects/{grasp.object_name}",
        "pregrasp_qpos": np.concatenate([pose_vector(X_TB), start]),
        "grasp_qpos": np.concatenate([pose_vector(X_TB), grasp.q]),
        "squeeze_qpos": np.concatenate([pose_vector(X_TB), squeezed]),
        "joint_names": list(posed.joints),
        "joint_units": [hand.joint_units[name] for name in posed.joints],
    }


def pose_vector(X_AB: npt.ArrayLike) -> Array:
    """Return a pose (4, 4) as (7,): position [m] and quaternion w, x, y, z with w >= 0."""
    X = np.asarray(X_AB, dtype=float)
    x, y, z, w = Rotation.from_matrix(X[:3, :3]).as_quat(canonical=True)
    return np.array([*X[:3, 3], w, x, y, z])
