"""Try published grasps of the Shadow Hand in Drake, by the rules of DexGraspBench.

Input: the MJCF of DexGraspBench's Shadow Hand, and folders of its grasp files, with objects in its
layout below `--assets`. Output: a line of JSON per grasp, and the number of held grasps. If
verdicts of `drakegrasp verify --protocol dexgraspbench` on the same files are given, also the
number of equal verdicts.

A grasp is held if the object stays in the hand whichever of its six axes points up. The closed hand
is lifted by 10 cm six times, with an object of 0.1 kg and a friction of 0.6, and the object must
move by less than 5 cm and turn by less than 15 degrees in the hand. As in the benchmark, any link
may touch the object. In the benchmark the object floats while the hand closes; here it is fixed.
The motors are those of the benchmark: 5 N m/rad, at most 3 N m; the last two joints of a finger
have 10 N m/rad each instead of those of their tendon. Unlike in the benchmark, the hand may overlap
the object at the start, and contacts follow Drake's model: a pair has no coefficient of torsion,
because torsion follows from the patch.

    python pipelines/measurements/shadow_in_drake.py HAND.xml GRASPS --assets DIR --out LINES.jsonl
        [--mujoco VERDICTS.jsonl]
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import trimesh
import yaml
from pydrake.multibody.tree import PdControllerGains

from drakegrasp.arithmetic import multiply
from drakegrasp.config import Config
from drakegrasp.frames import Array, invert_pose, make_pose
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.draft.source import read_model
from drakegrasp.hand.draft.urdf import write_urdf
from drakegrasp.hand.file_format import Finger
from drakegrasp.hand.settings import load_config
from drakegrasp.objects.model import prepare_object
from drakegrasp.objects.sources import MeshSource
from drakegrasp.outcomes import Outcome
from drakegrasp.protocols.files import read_grasp_file, read_object_folder
from drakegrasp.simulation import construction, trial
from drakegrasp.simulation.attempts import quaternion_poses
from drakegrasp.simulation.construction import build_scene
from drakegrasp.simulation.posture import make_posture, start_of
from drakegrasp.simulation.scene import Scene

#: The palm link and its position in the root of the hand [m]; fingers with their closing joints.
PALM, p_RB = "rh_palm", (0.0, 0.0, 0.034)
FINGERS = {"ff": "FFJ3", "mf": "MFJ3", "rf": "RFJ3", "lf": "LFJ3", "th": "THJ2"}
#: Maximum torque of a motor [N m], and the joint error at which it is reached [rad].
EFFORT, SATURATED = 3.0, 0.6
#: Last two joints of a finger, which share a motor; its torque depends on the sum of their errors.
TENDON = ("J1", "J2")
#: Limits of the object's displacement [m] and rotation [rad]; height of the lift [m].
MOVED, TURNED, LIFT = 0.05, np.deg2rad(15.0), 0.1
SETTINGS = (
    *("objects.mass=0.1", "physics.friction_hand=0.6", "lift.stop_when=never", "lift.hold_time=1"),
    "lift.drive=torque",
)


def main() -> None:
    """Try each grasp, or continue a stopped run; print how many grasps are held."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("hand", type=Path, metavar="HAND.xml")
    parser.add_argument("grasps", type=Path, metavar="GRASPS")
    parser.add_argument(
        "--assets", type=Path, required=True, help="folder at which obj_path begins"
    )
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--mujoco", type=Path, help="verdicts of verify --protocol")
    given = parser.parse_args()

    config = load_config("fast", overrides=list(SETTINGS))
    _replace_rules()
    known = given.out.read_text(encoding="utf-8").splitlines() if given.out.exists() else []
    done = {json.loads(line)["file"]: json.loads(line) for line in known}
    with tempfile.TemporaryDirectory() as scratch, given.out.open("a", encoding="utf-8") as lines:
        hand, joints = make_hand(given.hand, Path(scratch))
        bench = Bench(
            hand=hand, joints=joints, assets=given.assets, scratch=Path(scratch), config=config
        )
        for path in sorted(given.grasps.rglob("*.npy")):
            file = str(path.relative_to(given.grasps))
            if file not in done:
                done[file] = {"file": file, **bench.try_grasp(path)}
                lines.write(json.dumps(done[file]) + "\n")
                lines.flush()
    _say(list(done.values()), given.mujoco, given.grasps)


def _replace_rules() -> None:
    """Allow any link to touch, and use the motors of the benchmark."""
    rules: Any = trial
    rules.open_hand_collides = lambda scene: False
    rules.judge_closed = rules.judge_lifted = lambda *_, **__: Outcome.SUCCESS
    motors: Any = construction
    motors.SOFT, add_motor = SATURATED, motors._add_motor

    def add_tendon(plant: Any, name: str, joint: Any, finger: Finger, gains: Any) -> Any:
        if joint.name().endswith(TENDON) and finger.name != "th":
            gains = PdControllerGains(p=2.0 * gains.p, d=2.0 * gains.d)
        return add_motor(plant, name, joint, finger, gains)

    motors._add_motor = add_tendon


def make_hand(path: Path, folder: Path) -> tuple[Hand, list[str]]:
    """Return the benchmark's hand and its joints in order; all links of a finger may touch."""
    write_urdf(read_model(path), folder / "shadow.urdf", [])
    joints = [joint.name for joint in mujoco.MjSpec.from_file(str(path)).joints]
    fingers = []
    for name, joint in FINGERS.items():
        behind = [f"rh_{joint[:-1]}{n}" for n in range(1, int(joint[-1]))]
        fingers.append({
            "name": name,
            "fingertip": f"rh_{name}distal",
            "closing_joint": f"rh_{joint}",
            "torque_limit": EFFORT,
            "coupled": [{"joint": other, "ratio": 1.0} for other in behind],
            "pad_point": [0.0, 0.0, 0.0],
            "required": False,
        })  # fmt: skip
    moved = {
        f"rh_{joint[:-1]}{n}" for joint in FINGERS.values() for n in range(1, 1 + int(joint[-1]))
    }
    tree = {
        "version": 1,
        "model": "shadow.urdf",
        "palm": {"link": PALM, "p_BG": [0.0, 0.0, 0.0]},
        "fingers": fingers,
        "preshape": {joint: 0.0 for joint in joints if joint not in moved},
        "closing_speed_deg": 60.0,
        "standoffs": [0.05],
    }
    (folder / "shadow_hand.yaml").write_text(yaml.safe_dump(tree), encoding="utf-8")
    return load_hand(str(folder / "shadow_hand.yaml")), joints


@dataclass(frozen=True, kw_only=True, eq=False)
class Bench:
    """Everything that is shared by the trials of all grasps.

    Attributes:
        hand: The hand.
        joints: Names of the hand's joints in the order of the files.
        assets: Folder at which the paths of objects begin.
        scratch: Folder for object files.
        config: Configuration of the trials.
    """

    hand: Hand
    joints: list[str]
    assets: Path
    scratch: Path
    config: Config

    def try_grasp(self, path: Path) -> dict[str, Any]:
        """Return whether the grasp of a file is held, and whether by the fingertips alone."""
        stored = read_grasp_file(path)
        scene, X_OM = self.scene_of(stored.object_path, float(stored.object_scale[0]))
        X_WM, X_WR = (
            quaternion_poses(rows[:, :3], rows[:, 3:7])[0]
            for rows in (stored.object_pose, stored.postures["grasp"])
        )
        X_RB = make_pose(np.eye(3), p_RB)
        X_OB = multiply(X_OM, multiply(invert_pose(X_WM), multiply(X_WR, X_RB)))
        q: dict[str, Any] = {f"q_{name}": rows[0, 7:] for name, rows in stored.postures.items()}
        posture = make_posture(self.hand, X_OB, **q, joints=self.joints)
        attempt = start_of(posture, self.hand)

        # Each axis of the object's frame points up once, until the object falls.
        found: dict[str, Any] = {"held": True, "tips": True, "axes": 0, "slip": 0.0}
        for axis in range(6):
            record = trial.run_attempt(
                scene, self.pose_of(axis, posture.X_OG), attempt, self.config
            )
            end, closed = record.lift, record.closed
            if end is None or closed is None:
                outcome = f"{record.outcome.label} {record.message}".strip()
                return {**found, "held": False, "tips": False, "outcome": outcome}
            hand, links = end.contacts.touching.any(), end.contacts.other_links
            held = (hand or links > 0) and end.slip < MOVED and end.turn < TURNED
            found["slip"], found["held"] = max(found["slip"], end.slip), bool(held)
            found["tips"] &= bool(held) and closed.contacts.other_links == links == 0
            if not held:
                return {**found, "turn": end.turn}
            found["axes"] += 1
        return found

    def pose_of(self, axis: int, X_OG: Array) -> Array:
        """Return X_TO with one of the object's six axes up, so that the lift ends at its target.

        Args:
            axis: Number of the axis: 0 to 2 for x, y, z; 3 to 5 for the opposite directions.
            X_OG: Pose of the palm.
        """
        up = np.eye(3)[axis % 3] * (1.0 if axis < 3 else -1.0)
        side = np.eye(3)[(axis + 1) % 3]
        X_TO = make_pose(np.array([side, np.cross(up, side), up]), np.zeros(3))
        X_TO[:3, 3] = self.config.lift.p_TG - multiply(X_TO, X_OG)[:3, 3] - [0.0, 0.0, LIFT]
        return X_TO

    @cache  # noqa: B019
    def scene_of(self, folder: str, scale: float) -> tuple[Scene, Array]:
        """Return the scene of an object made of convex parts, and the pose X_OM of their frame."""
        parts = read_object_folder(self.assets / folder, scale).parts
        hulls: Any = [trimesh.load_mesh(part).convex_hull for part in parts]
        path = self.scratch / f"{Path(folder).name}.obj"
        trimesh.util.concatenate(hulls).export(path)
        source = MeshSource(name=path.stem, class_name="thing", path=path, scale=scale)
        model = prepare_object(source, self.config.objects)
        return build_scene(model, self.config.physics, self.hand), model.X_OM


def _say(found: list[dict[str, Any]], mujoco: Path | None, grasps: Path) -> None:
    """Print how many grasps are held, and how many have the same verdict in MuJoCo."""
    held, tips = (sum(each[key] for each in found) for key in ("held", "tips"))
    sys.stdout.write(f"held {held} of {len(found)}, with fingertips alone {tips}\n")
    if mujoco is None:
        return
    lines = map(json.loads, mujoco.read_text(encoding="utf-8").splitlines())
    other = {line["file"].rpartition(f"{grasps.name}/")[2]: line["success"] for line in lines}
    both = [(each["held"], other[each["file"]]) for each in found if each["file"] in other]
    equal = sum(one == two for one, two in both)
    sys.stdout.write(f"MuJoCo: held {sum(b for _, b in both)}; equal {equal} of {len(both)}\n")


if __name__ == "__main__":
    main()
