"""The files of DexGraspBench (github JYChen18/DexGraspBench), which BODex and Dexonomy write, too.

Samples of a dataset go out so that its code evaluates them, our own predictions so that a protocol
of MuJoCo tries them, and its grasps come in as attempts. Out: a folder whose content is copied into
that repository: hand (MJCF and YAML), objects (convex parts, and the volume from which the
benchmark has the density) and a .npy file per grasp, each a dictionary with the object's pose and
three postures of the hand. A posture is the palm link's position [m] and quaternion (w, x, y, z),
then the joints in the order of `joint_names` and the units of `joint_units`, rad or m:

* `grasp_qpos`: after closing, as it is stored;
* `pregrasp_qpos`: closing and coupled joints opened by `APART`, or as far as they were open;
* `squeeze_qpos`: the same joints closed further by `APART`: the command of a position controller
  that presses. The benchmark's own grasps go on from pregrasp and grasp by equal steps, too.

Keys that the benchmark does not read say under what the sample held: `hand`, `preshape`,
`trial_id`, `start_qpos` (the joints of the open hand) and `conditions` (friction of hand and table,
mass). All poses are over the table, in {T}. The hand is `mjcf.links`: gains, torques and
damping are those of the benchmark's Shadow Hand. Of predictions, objects stand as
`PlacedObject.X_TO_simulated` says; contacts become the posture of the first wrist pose that fits
them, and a grasp that lacks pregrasp or squeeze gets those of the export.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path, PurePosixPath
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import yaml
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from drakegrasp.arithmetic import multiply
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.paths import model_path
from drakegrasp.errors import DataError, GraspError
from drakegrasp.exchange.export import ClosedGrasp, read_closed_grasps
from drakegrasp.frames import Array, invert_pose
from drakegrasp.grasp import unused_fingers
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.kinematics import joint_positions
from drakegrasp.mesh.wavefront import hull_text
from drakegrasp.objects.model import ObjectModel, load_object
from drakegrasp.pictures.still_scene import StillScene
from drakegrasp.protocols.files import POSTURES, read_grasp_file
from drakegrasp.runtime.environment import require_mujoco
from drakegrasp.runtime.executor import Executor, run_here
from drakegrasp.runtime.progress import Report, silent
from drakegrasp.simulation.attempts import quaternion_poses, xyzw_poses
from drakegrasp.simulation.placement import PlacedObject
from drakegrasp.simulation.posture import Posture, joint_order
from drakegrasp.verification.placing import PlacedGrasp
from drakegrasp.verification.verify import first_fit

#: What `drakegrasp export --help` says of the format.
HELP = (
    "hand, objects and grasps as that benchmark's code evaluates them; needs pip install "
    "'drakegrasp[peer]'"
)

#: By how much pregrasp and squeeze are apart from the grasp [rad], of joints that slide by
#: `description.SLIDE`.
APART = 0.2
#: Where hand and objects are in the benchmark's repository, and the name of the experiment.
ASSETS, EXPERIMENT = Path("assets/drakegrasp"), "export"
OBJECTS = ASSETS / "objects"


def write_dexgraspbench(out: Path, folder: Path, progress: Report) -> int:
    """Write the files and return the number of samples; see `export.export_dataset`."""
    require_mujoco("mujoco", "coacd")
    from drakegrasp.mjcf.scene import convex_parts

    # The hand, by a name that the benchmark does not have.
    hand = load_hand(read_manifest(out).config.hand_source)
    files = BenchFiles(hand, folder)
    name = f"drakegrasp_{hand.name}"
    (folder / "config" / "hand").mkdir(parents=True)
    settings = yaml.safe_dump(hand_settings(hand), sort_keys=False)
    (folder / "config" / "hand" / f"{name}.yaml").write_text(settings, encoding="utf-8")

    # Object by object.
    grasps = list(read_closed_grasps(out))
    progress(0, len(grasps))
    done, data = 0, folder / "output" / f"{EXPERIMENT}_{name}" / "graspdata"
    for thing, same in groupby(grasps, key=lambda grasp: grasp.object_name):
        parts = convex_parts(load_object(model_path(out, thing)))
        write_object(folder / OBJECTS / thing, parts)
        for grasp in same:
            files.write_grasp(data / thing / f"{grasp.trial_id}.npy", grasp)
            done += 1
            progress(done, len(grasps))
    return done


class BenchFiles:
    """Writes a hand and grasps as the benchmark reads them.

    Attributes:
        hand_path: MJCF of the hand.
    """

    def __init__(self, hand: Hand, folder: Path) -> None:
        """Write the hand.

        Args:
            hand: The hand.
            folder: To which the paths of objects in the files are relative.
        """
        from drakegrasp.mjcf.links import make_hand_model, write_hand_model

        model = make_hand_model(hand)
        self.posed = StillScene(hand)
        self._joints = tuple(joint.name for joint in model.joints)
        self.hand_path = folder / ASSETS / "hand" / "hand.xml"
        write_hand_model(model, self.hand_path)

    def write_grasp(self, path: Path, grasp: ClosedGrasp, **known: Array | None) -> None:
        """Write a grasp.

        Args:
            path: Of its file.
            grasp: The grasp.
            known: (j,), joints of "pregrasp" and "squeeze" in the plant's order, where they are
                not to be derived from the grasp.
        """
        content: Any = grasp_dictionary(self.posed.hand, self.posed, self._joints, grasp)
        places = [self.posed.joints.index(name) for name in self._joints]
        for stage, q in known.items():
            if q is not None:
                content[POSTURES[stage]][7:] = q[places]
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, content)


def hand_settings(hand: Hand) -> dict[str, Any]:
    """Return what the benchmark's YAML says of a hand; fingertips have the names of their links."""
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
    """Write an object's convex parts, and their volume as its mass at a density of one.

    Args:
        folder: Of the object.
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
    """Return what the file of a grasp holds, see the module.

    Args:
        hand: The hand.
        posed: The same hand, which knows the order of the stored joints.
        joints: Names of the joints in the order of the file.
        grasp: The sample.
    """
    # The palm link's pose, and how far each joint moves: in proportion to its finger's closing,
    # if the grasp uses it.
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
            # No finger opens farther than it can.
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
    """Return the position nearest to one given between two others."""
    return min(max(at, min(one, other)), max(one, other))


def pose_vector(X_AB: npt.ArrayLike) -> Array:
    """Return a pose (4, 4) as (7,): position [m] and quaternion w, x, y, z with w >= 0."""
    X = np.asarray(X_AB, dtype=float)
    x, y, z, w = Rotation.from_matrix(X[:3, :3]).as_quat(canonical=True)
    return np.array([*X[:3, 3], w, x, y, z])


def read_dexgraspbench(path: Path, hand: Hand) -> dict[str, Any]:
    """Return the grasps of a .npy file as arguments of `make_attempts`, see `attempts`.

    The object's frame is that of its mesh file; in what drakegrasp itself exports it is {O}.

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
    xyzw = (xyzw_poses(rows[:, :3], rows[:, 3:7]) for rows in (pose, grasp))
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
        "X_FG_xyzw": multiply(invert_pose(next(xyzw)), next(xyzw)),
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


#: An object on the table, and a posture in {O}; or the reason, for a bad row.
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
    """Write grasps, and return the MJCF of the hand, and the file of each or why there is none.

    Args:
        grasps: In the caller's order.
        hand: Their hand.
        folder: To which the paths of objects in the files are relative.
        execute: Cuts and writes the objects.
        keep: Folder that keeps the convex parts of objects for the next call; None keeps none.
        report: Is told how many objects are written.

    Raises:
        OSError: If a folder cannot be written.
    """
    # The hand, and where its spread is among the joints.
    files = BenchFiles(hand, folder)
    spread = joint_order(hand).index(hand.spread.joints[0]) if hand.spread.joints else None

    # Each object once.
    things = (placed.model for placed, posture in grasps if isinstance(posture, Posture))
    models = {model.name: model for model in things}
    report(0, len(models))
    tasks = [(model, folder / OBJECTS / name, keep) for name, model in models.items()]
    for done, _ in enumerate(execute(_write_parts, tasks), start=1):
        report(done, len(models))

    # Each grasp.
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
    """Cut an object into convex parts and write them."""
    from drakegrasp.mjcf.scene import convex_parts, kept_convex_parts

    model, folder, keep = task
    write_object(folder, convex_parts(model) if keep is None else kept_convex_parts(model, keep))


def fitted_postures(
    grasps: Sequence[PlacedGrasp], execute: Executor = run_here
) -> list[PlacedPosture]:
    """Return the posture of each grasp, in the given order; of contacts the first wrist pose."""
    contacts = [(i, g) for i, g in enumerate(grasps) if not g.invalid and g.method != "posture"]
    fitted = dict(execute(_fit, contacts))

    def posture_of(i: int, grasp: PlacedGrasp) -> Posture | str:
        if grasp.invalid or i in fitted:
            return grasp.invalid or fitted[i]
        if np.isnan(grasp.attempt.q_grasp).all():
            return "joints must be given with a protocol, got a palm pose alone"
        # Nobody named its resting pose.
        if (count := len(grasp.stands)) > 1:
            return f"resting must be 0 to {count - 1} with a protocol, got none"
        return grasp.posture(grasp.placed)

    return [(grasp.placed, posture_of(i, grasp)) for i, grasp in enumerate(grasps)]


def _fit(task: tuple[int, PlacedGrasp]) -> tuple[int, Posture]:
    """Return the number of a grasp of contacts, and the posture of its first wrist pose."""
    number, grasp = task
    fit, hand = first_fit(grasp), load_hand(grasp.config.hand_source)
    named = joint_positions(hand, fit.spread, fit.closing)
    return number, Posture(fit.X_OG, np.array([named[name] for name in joint_order(hand)]))
