"""The files of DexGraspBench (github JYChen18/DexGraspBench), also written by BODex and Dexonomy.

This module writes samples of a dataset for evaluation by the benchmark's code, writes our own
predictions for the MuJoCo protocols, and reads grasps of the benchmark as attempts.

Output: a folder whose content is copied into the benchmark's repository. It has the hand (MJCF and
YAML), the objects (convex parts, and their volume, from which the benchmark computes the density)
and a .npy file per grasp. This file is a dictionary with the object's pose and three postures of
the hand. A posture is the palm link's position [m] and quaternion (w, x, y, z), followed by the
joint positions in the order of `joint_names` and the units of `joint_units`, rad or m:

* `grasp_qpos`: after closing, as stored in the dataset;
* `pregrasp_qpos`: closing and coupled joints opened by `APART`, but not beyond the open hand;
* `squeeze_qpos`: the same joints closed further by `APART`. A position controller with this command
  presses on the object. In the benchmark's own grasps, the step from grasp to squeeze also equals
  the step from pregrasp to grasp.

Keys that the benchmark does not read state the conditions under which the sample held: `hand`,
`preshape`, `trial_id`, `start_qpos` (the joints of the open hand) and `conditions` (friction of
hand and table, mass). All poses are in {T}, with the object on the table. `mjcf` builds the
hand; its gains, torques and damping are those of the benchmark's Shadow Hand. The object of a
prediction is at `PlacedObject.X_TO_simulated`. Contacts become the posture of the first wrist pose
that fits them. A grasp without pregrasp or squeeze gets the postures described above.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import numpy.typing as npt
import yaml
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from drakegrasp.arithmetic import multiply
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.errors import DataError, GraspError
from drakegrasp.exchange.export import ClosedGrasp, samples_by_object
from drakegrasp.frames import Array, invert_pose
from drakegrasp.grasp import unused_fingers
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.kinematics import joint_positions
from drakegrasp.mesh.surfaces import hull_text
from drakegrasp.objects.model import ObjectModel
from drakegrasp.protocols.postures import POSTURES, read_grasp_file
from drakegrasp.runtime.environment import require_mujoco
from drakegrasp.runtime.executor import Executor, run_here
from drakegrasp.runtime.progress import Report, silent
from drakegrasp.simulation.attempts import quaternion_poses
from drakegrasp.simulation.placement import PlacedObject
from drakegrasp.simulation.posture import Posture
from drakegrasp.verification.placing import PlacedGrasp
from drakegrasp.verification.verify import first_fit

if TYPE_CHECKING:
    from drakegrasp.pictures.still_scene import StillScene

#: Description of the format in `drakegrasp export --help`.
HELP = (
    "hand, objects and grasps as that benchmark's code evaluates them; needs pip install "
    "'drakegrasp[peer]'"
)

#: Distance of pregrasp and squeeze from the grasp [rad]. For prismatic joints it is multiplied by
#: `description.SLIDE` [m/rad].
APART = 0.2
#: Folder of hand and objects in the benchmark's repository, and the name of the experiment.
ASSETS, EXPERIMENT = Path("assets/drakegrasp"), "export"
OBJECTS = ASSETS / "objects"


def write_dexgraspbench(out: Path, folder: Path, progress: Report) -> int:
    """Write the files and return the number of samples; see `export.export_dataset`."""
    require_mujoco("mujoco", "coacd")
    from drakegrasp.mjcf import convex_parts

    # Write the hand under a name that the benchmark does not use.
    hand = load_hand(read_manifest(out).config.hand_source)
    files = BenchFiles(hand, folder)
    name = f"drakegrasp_{hand.name}"
    (folder / "config" / "hand").mkdir(parents=True)
    settings = yaml.safe_dump(hand_settings(hand), sort_keys=False)
    (folder / "config" / "hand" / f"{name}.yaml").write_text(settings, encoding="utf-8")

    # Write object by object.
    count, data = 0, folder / "output" / f"{EXPERIMENT}_{name}" / "graspdata"
    for model, samples in samples_by_object(out, progress):
        write_object(folder / OBJECTS / model.name, convex_parts(model))
        for grasp in samples:
            files.write_grasp(data / model.name / f"{grasp.trial_id}.npy", grasp)
        count += len(samples)
    return count


class BenchFiles:
    """Writes a hand and grasps in the layout that the benchmark reads.

    Attributes:
        hand_path: Path of the hand's MJCF file.
    """

    def __init__(self, hand: Hand, folder: Path) -> None:
        """Write the hand.

        Args:
            hand: The hand.
            folder: Folder to which object paths in the files are relative.
        """
        from drakegrasp.mjcf import make_hand_model, write_hand_model
        from drakegrasp.pictures.still_scene import StillScene

        model = make_hand_model(hand)
        self.posed = StillScene(hand)
        self._joints = tuple(joint.name for joint in model.joints)
        self.hand_path = folder / ASSETS / "hand" / "hand.xml"
        write_hand_model(model, self.hand_path)

    def write_grasp(self, path: Path, grasp: ClosedGrasp, **known: Array | None) -> None:
        """Write a grasp.

        Args:
            path: Path of the grasp file.
            grasp: The grasp.
            known: (j,), joint positions of "pregrasp" and "squeeze" in the plant's order. Those
                that are missing or None are derived from the grasp.
        """
        content: Any = grasp_dictionary(self.posed.hand, self.posed, self._joints, grasp)
        places = [self.posed.joints.index(name) for name in self._joints]
        for stage, q in known.items():
            if q is not None:
                content[POSTURES[stage]][7:] = q[places]
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, content)


def hand_settings(hand: Hand) -> dict[str, Any]:
    """Return the content of the benchmark's YAML file of a hand; fingertips have link names."""
    tips = list(hand.fingertip_links)
    return {
        "xml_path": str(ASSETS / "hand" / "hand.xml"),
        "mocap": True,
        "exclude_table_contact": None,
        "color": [0.45, 0.48, 0.52, 1.0],
        "finger_prefix": tips,
        "valid_body_name": list(hand.link_chains),
        "tip_body_name": tips,
    }


def write_object(folder: Path, parts: Sequence[Array]) -> None:
    """Write the convex parts of an object, and their total volume as the mass at a density of one.

    Args:
        folder: Folder of the object.
        parts: The corners (n, 3) of each part in {O} [m].
    """
    (folder / "urdf" / "meshes").mkdir(parents=True)
    for number, corners in enumerate(parts):
        path = folder / "urdf" / "meshes" / f"convex_piece_{number:03d}.obj"
        path.write_text(hull_text(corners), encoding="utf-8")
    volume = float(sum(ConvexHull(corners).volume for corners in parts))
    (folder / "info").mkdir()
    info = json.dumps({"scale": 1.0, "density": 1.0, "mass": volume})
    (folder / "info" / "simplified.json").write_text(info, encoding="utf-8")


def grasp_dictionary(
    hand: Hand, posed: StillScene, joints: Sequence[str], grasp: ClosedGrasp
) -> dict[str, Any]:
    """Return the content of a grasp file, as the module docstring describes it.

    Args:
        hand: The hand.
        posed: The same hand as a still scene, which has the order of the stored joints.
        joints: Names of the joints in the order of the file.
        grasp: The sample.
    """
    # The palm link's pose, and the step of each joint. The step is proportional to the closing of
    # the joint's finger, and zero if the grasp does not use the finger.
    X_TB = pose_vector(multiply(grasp.X_TG, invert_pose(hand.X_BG)))
    step = dict.fromkeys(hand.joint_names, 0.0)
    closing = APART * hand.closing_unit
    closing[unused_fingers(grasp.unused, hand.num_fingers)] = 0.0
    for name, gain in zip(hand.joint_names, hand.joint_gain[:, 1:], strict=True):
        step[name] = float(gain @ closing)
    open_at = dict(zip(posed.joints, posed.positions(grasp.spread), strict=True))
    closed = dict(zip(posed.joints, grasp.q, strict=True))

    def posture(share: float) -> Array:
        q = [closed[name] + share * step[name] for name in joints]
        if share < 0.0:
            # No joint opens beyond its position in the open hand.
            q = [
                _between(at, open_at[name], closed[name])
                for name, at in zip(joints, q, strict=True)
            ]
        return np.concatenate([X_TB, q])

    known: dict[str, Any] = {"preshape": grasp.preshape_name(hand)}
    if grasp.conditions is not None:
        known["conditions"] = np.asarray(grasp.conditions)
    start = [open_at[name] if step[name] else closed[name] for name in joints]
    return {
        "obj_pose": pose_vector(grasp.X_TO),
        "obj_scale": 1.0,
        "obj_path": str(OBJECTS / grasp.object_name),
        "pregrasp_qpos": posture(-1.0),
        "grasp_qpos": posture(0.0),
        "squeeze_qpos": posture(1.0),
        "joint_names": list(joints),
        "joint_units": [hand.joint_units[name] for name in joints],
        "hand": hand.name,
        "trial_id": grasp.trial_id,
        "start_qpos": np.array(start),
        **known,
    }


def _between(at: float, one: float, other: float) -> float:
    """Return a position, clamped to the range between two others."""
    return min(max(at, min(one, other)), max(one, other))


def pose_vector(X_AB: npt.ArrayLike) -> Array:
    """Return a pose (4, 4) as (7,): position [m] and quaternion w, x, y, z with w >= 0."""
    X = np.asarray(X_AB, dtype=float)
    x, y, z, w = Rotation.from_matrix(X[:3, :3]).as_quat(canonical=True)
    return np.array([*X[:3, 3], w, x, y, z])


def read_dexgraspbench(path: Path, hand: Hand) -> dict[str, Any]:
    """Return the grasps of a .npy file as arguments of `make_attempts`, see `attempts`.

    The object's frame is the frame of its mesh file; in a file that drakegrasp exported, this is
    {O}.

    Raises:
        GraspError: If the file is not a grasp file of DexGraspBench.
    """
    try:
        stored = read_grasp_file(path)
    except DataError as error:
        raise GraspError(f"{path}: {error}") from None

    # The pose of the hand's root in the object's frame [m].
    grasp, pose = stored.postures["grasp"], stored.object_pose
    X_WM, no_object = quaternion_poses(pose[:, :3], pose[:, 3:])
    X_WL, no_hand = quaternion_poses(grasp[:, :3], grasp[:, 3:7])
    q = {f"q_{stage}": rows[:, 7:] for stage, rows in stored.postures.items()}
    numbers: dict[str, Any] = {"scale": stored.object_scale}
    count, trial = len(grasp), stored.trial_id
    if stored.exported:
        numbers = {"X_TO": X_WM}
        if stored.conditions is not None:
            numbers["conditions"] = np.tile(stored.conditions, (count, 1))
        if stored.start is not None:
            q["q_pregrasp"] = np.tile(stored.start, (count, 1))
    return {
        "objects": [PurePosixPath(stored.object_path).name] * count,
        "X_FG": multiply(invert_pose(X_WM), X_WL),
        "link": hand.palm_link,
        "frame": "object" if stored.exported else "mesh",
        **q,
        "joints": stored.joints,
        **numbers,
        "preshape": [stored.preshape] * count,
        "trial": None if trial is None else np.full(count, trial, dtype=np.int64),
        "hand": stored.hand or None,
        "said": [path.name] * count,
        "invalid": [one or other for one, other in zip(no_object, no_hand, strict=True)],
    }


#: An object on the table, and a posture in {O}, or the reason why the row is invalid.
PlacedPosture: TypeAlias = tuple[PlacedObject, Posture | str]


def write_grasps(
    grasps: Sequence[PlacedPosture],
    hand: Hand,
    folder: Path,
    *,
    execute: Executor = run_here,
    keep: Path | None = None,
    report: Report = silent,
) -> tuple[Path, list[Path | str]]:
    """Write grasps in the layout of the benchmark.

    Args:
        grasps: The grasps, each with its object.
        hand: The hand of all grasps.
        folder: Folder to which object paths in the files are relative.
        execute: Runs the decomposition and writing of the objects.
        keep: Folder in which the convex parts of objects are cached for the next call; None:
            they are not cached.
        report: Called with the number of objects written and of all objects.

    Returns:
        The path of the hand's MJCF file, and for each grasp, in the given order, the path of its
        file or the reason why there is none.

    Raises:
        OSError: If a folder cannot be written.
    """
    # Write the hand; find the index of its spread joint.
    files = BenchFiles(hand, folder)
    spread = hand.joint_order.index(hand.spread.joints[0]) if hand.spread.joints else None

    # Write each object once.
    things = (placed.model for placed, posture in grasps if isinstance(posture, Posture))
    models = {model.name: model for model in things}
    report(0, len(models))
    tasks = [(model, folder / OBJECTS / name, keep) for name, model in models.items()]
    for done, _ in enumerate(execute(_write_parts, tasks), start=1):
        report(done, len(models))

    # Write each grasp.
    found = list[Path | str]()
    for number, (placed, posture) in enumerate(grasps):
        if isinstance(posture, str):
            found.append(posture)
            continue
        assert posture.q_grasp is not None, "`fitted_postures` refuses a palm pose alone"
        grasp = ClosedGrasp(
            trial_id=number,
            split="",
            object_name=placed.model.name,
            X_TO=placed.X_TO_simulated,
            X_TG=placed.X_TO_simulated @ posture.X_OG,
            q=posture.q_grasp,
            spread=0.0 if spread is None else float(posture.q_grasp[spread]),
        )
        path = folder / "grasps" / f"{number}.npy"
        files.write_grasp(path, grasp, pregrasp=posture.q_pregrasp, squeeze=posture.q_squeeze)
        found.append(path)
    return files.hand_path, found


def _write_parts(task: tuple[ObjectModel, Path, Path | None]) -> None:
    """Decompose an object into convex parts and write them."""
    from drakegrasp.mjcf import convex_parts, kept_convex_parts

    model, folder, keep = task
    write_object(folder, convex_parts(model) if keep is None else kept_convex_parts(model, keep))


def fitted_postures(
    grasps: Sequence[PlacedGrasp], execute: Executor = run_here
) -> list[PlacedPosture]:
    """Return the posture of each grasp, in the given order.

    For contacts it is the posture of the first wrist pose that fits them.
    """
    contacts = [(i, g) for i, g in enumerate(grasps) if not (g.invalid or g.postures)]
    fitted = dict(execute(_fit, contacts))

    def posture_of(i: int, grasp: PlacedGrasp) -> Posture | str:
        if grasp.invalid or i in fitted:
            return grasp.invalid or fitted[i]
        if grasp.postures[0].q_grasp is None:
            return "joints must be given with a protocol, got a palm pose alone"
        # The prediction does not name the resting pose.
        if (count := len(grasp.stands)) > 1:
            return f"resting must be 0 to {count - 1} with a protocol, got none"
        return grasp.postures[0]

    return [(grasp.placed, posture_of(i, grasp)) for i, grasp in enumerate(grasps)]


def _fit(task: tuple[int, PlacedGrasp]) -> tuple[int, Posture]:
    """Return the number of a grasp given as contacts, and the posture of its first wrist pose."""
    number, grasp = task
    fit, hand = first_fit(grasp), load_hand(grasp.config.hand_source)
    named = joint_positions(hand, fit.spread, fit.closing)
    return number, Posture(fit.X_OG, np.array([named[name] for name in hand.joint_order]))
