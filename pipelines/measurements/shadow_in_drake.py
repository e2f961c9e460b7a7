"""Tries grasps of the Shadow Hand that others publish in Drake, as DexGraspBench tries them.

In: the MJCF of DexGraspBench's Shadow Hand, and folders of its grasp files, with objects in its
layout below `--assets`. Out: a line of JSON per grasp, and how many are held. With verdicts of
`drakegrasp verify --protocol dexgraspbench` of the same files, how many are the same.

A grasp is held if the object stays in the hand whichever of its six axes points up: the closed
hand is lifted by 10 cm six times, with an object of 0.1 kg and a friction of 0.6, and the object
moves by less than 5 cm and turns by less than 15 degrees in the hand. As there any link may touch
it, and it floats, here fixed while the hand closes. Motors are the benchmark's: 5 N m/rad, at most
3 N m; the last two joints of a finger have 10 N m/rad each for those of their tendon. Other than
there the hand may overlap the object at the start, and contacts are Drake's: a pair has no
coefficient of torsion, it follows from the patch.

    python pipelines/measurements/shadow_in_drake.py HAND.xml GRASPS --assets DIR --out LINES.jsonl
        [--root DIR] [--mujoco VERDICTS.jsonl]
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
import yaml
from pydrake.multibody.tree import PdControllerGains

from drakegrasp.arithmetic import multiply
from drakegrasp.commissioning.draft.model import read_model
from drakegrasp.commissioning.draft.run import write_urdf
from drakegrasp.commissioning.draft.source import read_source
from drakegrasp.config import Config
from drakegrasp.frames import Array, invert_pose, make_pose
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.file_format import Finger
from drakegrasp.hand.settings import load_config
from drakegrasp.objects.model import prepare_object
from drakegrasp.objects.sources import MeshSource, file_frame
from drakegrasp.outcomes import Outcome
from drakegrasp.protocols.files import read_grasp_file, read_object_folder
from drakegrasp.simulation import construction, trial
from drakegrasp.simulation.attempts import quaternion_poses
from drakegrasp.simulation.construction import build_scene
from drakegrasp.simulation.posture import make_posture, start_of
from drakegrasp.simulation.scene import Scene

#: The palm in the root of the benchmark's hand [m]; its fingers, first the joint that closes one.
PALM, p_RB = "rh_palm", (0.0, 0.0, 0.034)
FINGERS = {"ff": "FFJ3", "mf": "MFJ3", "rf": "RFJ3", "lf": "LFJ3", "th": "THJ2"}
#: Motors [N m], [rad].
EFFORT, SATURATED = 3.0, 0.6
#: Joints of fingers that have one motor, whose torque turns both by what both are off together.
TENDON = ("J1", "J2")
#: By so much the object may move [m] and turn [rad]; the lift [m].
MOVED, TURNED, LIFT = 0.05, np.deg2rad(15.0), 0.1
SETTINGS = (
    *("objects.mass=0.1", "physics.friction_hand=0.6", "lift.stop_when=never", "lift.hold_time=1"),
    *("lift.least_chance=0", "lift.least_depth_variance=0", "lift.drive=torque"),
)


def main() -> None:
    """Try each grasp, or go on where it stopped; print how many are held."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("hand", type=Path, metavar="HAND.xml")
    parser.add_argument("grasps", type=Path, metavar="GRASPS")
    parser.add_argument("--assets", type=Path, required=True, help="where obj_path begins")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--root", type=Path, action="append", default=[], help="of the meshes")
    parser.add_argument("--mujoco", type=Path, help="verdicts of verify --protocol")
    given = parser.parse_args()

    config = load_config("fast", overrides=list(SETTINGS))
    _replace_rules()
    known = given.out.read_text(encoding="utf-8").splitlines() if given.out.exists() else []
    done = {json.loads(line)["file"]: json.loads(line) for line in known}
    with tempfile.TemporaryDirectory() as scratch, given.out.open("a", encoding="utf-8") as lines:
        hand, joints = make_hand(given.hand, given.root, Path(scratch))
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
    """Let any link touch, and motors be those of the benchmark."""
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


def make_hand(path: Path, roots: list[Path], folder: Path) -> tuple[Hand, list[str]]:
    """Return the benchmark's hand, of whose fingers no link is apart, and its joints in order."""
    source = read_source(path, {}, roots)
    write_urdf(read_model(source), folder / "shadow.urdf", [])
    (world,) = source.root.iter("worldbody")
    joints = [joint.get("name", "") for joint in world.iter("joint")]
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
    """What all grasps are tried with.

    Attributes:
        hand: The hand.
        joints: Its joints in the order of the files.
        assets: Folder at which the paths of objects begin.
        scratch: Folder of object files.
        config: The rules.
    """

    hand: Hand
    joints: list[str]
    assets: Path
    scratch: Path
    config: Config

    def try_grasp(self, path: Path) -> dict[str, Any]:
        """Return whether the grasp of a file is held, also with the fingertips alone."""
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
        attempt = replace(start_of(posture, self.hand), audited=True)

        # Each axis of the object's frame points up once, until one lets it fall.
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
        """Return the pose of an object, one of whose six axes points up, below the lift's target.

        Args:
            axis: 0 to 2: x, y, z; 3 to 5: the opposite.
            X_OG: Pose of the palm.
        """
        up = np.eye(3)[axis % 3] * (1.0 if axis < 3 else -1.0)
        side = np.eye(3)[(axis + 1) % 3]
        X_TO = make_pose(np.array([side, np.cross(up, side), up]), np.zeros(3))
        X_TO[:3, 3] = self.config.lift.p_TG - multiply(X_TO, X_OG)[:3, 3] - [0.0, 0.0, LIFT]
        return X_TO

    @cache  # noqa: B019
    def scene_of(self, folder: str, scale: float) -> tuple[Scene, Array]:
        """Return the scene of an object of convex parts, and the pose X_OM of their frame."""
        parts = read_object_folder(self.assets / folder, scale).parts
        hulls: Any = [trimesh.load_mesh(part).convex_hull for part in parts]
        path = self.scratch / f"{Path(folder).name}.obj"
        trimesh.util.concatenate(hulls).export(path)
        source = MeshSource(name=path.stem, class_name="thing", path=path, scale=scale)
        model = prepare_object(source, self.config.objects)
        return build_scene(model, self.config.physics, self.hand), file_frame(source)


def _say(found: list[dict[str, Any]], mujoco: Path | None, grasps: Path) -> None:
    """Print how many are held, and how many have the verdict of MuJoCo."""
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
