"""Postures as DexGraspBench stores them, and verdicts on them under a protocol.

Input: a .npy file with postures and the pose of an object, which may come from an untrusted source,
the MJCF of a hand, and a protocol by name. Output: `StoredGrasps`, the `GraspMotion` of one grasp,
and one verdict per file, in order; a file that is not a valid grasp gets the verdict `invalid`.
Such a file is a pickle; only arrays, numbers, texts and containers are read from it, and no code is
run.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from drakegrasp.dataset.json_files import strict_json
from drakegrasp.errors import ConfigError, DataError, GraspError, MeshError
from drakegrasp.frames import Array
from drakegrasp.protocols.protocol import (
    GraspMotion,
    MujocoProtocol,
    PostureVerdict,
    Protocol,
    find_protocol,
)
from drakegrasp.registry import read_class, run_own
from drakegrasp.runtime.environment import require_mujoco
from drakegrasp.runtime.executor import Executor, in_order, run_here
from drakegrasp.runtime.plain_pickle import npy_header, read_plain_pickle

if TYPE_CHECKING:
    from drakegrasp.protocols.scene import ProtocolScene

#: Keys of the postures, in the order of `GraspMotion`.
POSTURES = {"pregrasp": "pregrasp_qpos", "grasp": "grasp_qpos", "squeeze": "squeeze_qpos"}
#: If the hand is farther from the object than this [m], the units are wrong.
FAR = 10.0
_ORIGIN = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
#: Number of scenes that a process caches: files of one object follow each other.
_SCENES = 4


@dataclass(frozen=True, kw_only=True, eq=False)
class StoredGrasps:
    """The n grasps of a file on one object, with a hand of m joints.

    A pose is a position [m] and a quaternion (w, x, y, z); the poses of hand and object share a
    frame.

    Attributes:
        postures: (n, 7 + m), pose of the hand's root and joint positions, by "grasp", and by
            "pregrasp" and "squeeze" if the file has them.
        object_pose: (n, 7), pose of the object; the origin if the file has none.
        object_path: Folder of the object.
        object_scale: (n,), scale of the object; NaN if the file does not state it.
        joints: (m,), names of the joints; None if the file does not state them.
        exported: Whether drakegrasp wrote the file. Then the object is on the table, and the
            following values may be known:
        hand, preshape: Names; empty if the file does not state them.
        trial_id: Id of the sample's trial.
        start: (m,), joint positions from which the fingers closed.
        conditions: (3,), friction of hand and table, and mass [kg].
    """

    postures: Mapping[str, Array]
    object_pose: Array
    object_path: str
    object_scale: Array
    joints: tuple[str, ...] | None
    exported: bool
    hand: str = ""
    preshape: str = ""
    trial_id: int | None = None
    start: Array | None = None
    conditions: Array | None = None


def is_grasp_file(path: Path) -> bool:
    """Return whether a .npy file contains Python objects, as such files do, instead of numbers."""
    try:
        with path.open("rb") as file:
            return bool(npy_header(file)[1].hasobject)
    except (OSError, EOFError, ValueError, TypeError, KeyError, ArithmeticError, MemoryError):
        return False


def read_grasp_file(path: Path) -> StoredGrasps:
    """Return the grasps of a file; their numbers may still be invalid.

    Raises:
        DataError: If the file does not contain grasps.
    """
    content = read_dictionary(path)
    for key in ("grasp_qpos", "obj_path"):
        if key not in content:
            raise DataError(f"must have {key}, got {', '.join(map(str, content))}")
    postures = {name: _rows(content, key) for name, key in POSTURES.items() if key in content}
    grasp = postures["grasp"]
    if any(each.shape != grasp.shape for each in postures.values()):
        raise DataError("the postures must have equal lengths")

    # Pose and scale of the object.
    count = len(grasp)
    poses = _rows({"obj_pose": _ORIGIN, **content}, "obj_pose")
    if poses.shape not in ((1, 7), (count, 7)):
        raise DataError(f"obj_pose must be 7 numbers for 1 or {count}, got {poses.shape}")
    scale = _numbers({"obj_scale": np.nan, **content}, "obj_scale").ravel()
    if len(scale) not in (1, count):
        raise DataError(f"obj_scale must be a number, for 1 or {count}, got {len(scale)}")
    return StoredGrasps(
        postures=postures,
        object_pose=np.broadcast_to(poses, (count, 7)),
        object_path=str(content["obj_path"]),
        object_scale=np.broadcast_to(scale, (count,)),
        joints=_names(content.get("joint_names")),
        exported="joint_units" in content,
        **(_of_export(content, grasp.shape[1] - 7) if "joint_units" in content else {}),
    )


def _of_export(content: Mapping[str, Any], joints: int) -> dict[str, Any]:
    """Return what an exported file of ours states about its sample."""
    found: dict[str, Any] = {n: str(content[n]) for n in ("hand", "preshape") if n in content}
    if "trial_id" in content:
        trial = content["trial_id"]
        if not isinstance(trial, int | np.integer):
            raise DataError(f"trial_id must be a whole number, got {trial!r}")
        found["trial_id"] = int(trial)
    for name, key, size in (("start", "start_qpos", joints), ("conditions", "conditions", 3)):
        if key in content:
            found[name] = _numbers(content, key)
            if found[name].shape != (size,):
                raise DataError(f"{key} must be {size} numbers, got {found[name].shape}")
    return found


def one_motion(grasps: StoredGrasps) -> GraspMotion:
    """Return the motion of the one grasp of a file.

    Raises:
        DataError: If there are several grasps, a posture is missing, or the numbers are not valid.
    """
    if len(grasps.object_pose) != 1:
        raise DataError(f"grasp_qpos must be a vector, got {len(grasps.object_pose)} of them")
    if missing := [key for name, key in POSTURES.items() if name not in grasps.postures]:
        raise DataError(f"must have {missing[0]}, got none")
    vectors = {name: _unit(grasps.postures[name][0], key) for name, key in POSTURES.items()}
    object_pose = _unit(grasps.object_pose[0], "obj_pose")
    if max(np.linalg.norm(q[:3] - object_pose[:3]) for q in vectors.values()) > FAR:
        raise DataError(f"the hand must be within {FAR:g} m of the object")
    return GraspMotion(**vectors, object_pose=object_pose)


def inner_path(path: str) -> Path:
    """Return a path that stays within the folder of the objects.

    Raises:
        DataError: If the path leaves the folder.
    """
    if Path(path).is_absolute() or ".." in Path(path).parts or "\0" in path:
        raise DataError(f"obj_path must be a path within the folder of the objects, got {path!r}")
    return Path(path)


def read_dictionary(path: Path) -> dict[str, Any]:
    """Return the dictionary of a file.

    Raises:
        DataError: If the file has no dictionary, or anything except arrays, numbers and texts.
    """
    try:
        content = read_plain_pickle(path)
    except GraspError as error:
        raise DataError(str(error).removeprefix(f"{path}: ")) from None
    if not isinstance(content, dict):
        raise DataError("must be a .npy file with a dictionary, got another array")
    return content


def _numbers(content: Mapping[str, Any], key: str) -> Array:
    try:
        return np.asarray(content[key], dtype=float)
    except (TypeError, ValueError):
        raise DataError(f"{key} must be numbers, got something else") from None


def _rows(content: Mapping[str, Any], key: str) -> Array:
    """Return vectors (n, 7 or more), each of which begins with a pose."""
    rows = np.atleast_2d(_numbers(content, key))
    if rows.ndim != 2 or not len(rows) or rows.shape[1] < 7:
        raise DataError(f"{key} must be rows of 7 numbers or more, got {rows.shape}")
    return rows


def _names(value: Any) -> tuple[str, ...] | None:
    names = value.tolist() if isinstance(value, np.ndarray) else value
    if names is None:
        return None
    if not isinstance(names, list | tuple) or not all(isinstance(name, str) for name in names):
        raise DataError("joint_names must be a list of texts, got something else")
    return tuple(names)


def _unit(vector: Array, key: str) -> Array:
    """Return a vector with its quaternion normalised to length 1."""
    if not np.isfinite(vector).all():
        raise DataError(f"{key} must be finite numbers, got others")
    length = np.linalg.norm(vector[3:7])
    if not length > 0.0:
        raise DataError(f"{key} must have a quaternion, got zeros")
    return np.concatenate([vector[:3], vector[3:7] / length, vector[7:]])


# Verdicts


@dataclass(frozen=True, kw_only=True)
class PostureTrials:
    """What the trials of many files share; plain data for any process.

    Attributes:
        protocol: Stored name of the protocol.
        code: Text of the file of a user-defined protocol.
        hand: MJCF of the hand.
        objects: Folder to which the object paths in the files are relative.
    """

    protocol: str
    hand: Path
    objects: Path
    code: str | None = None

    def rules(self) -> MujocoProtocol:
        """Return the protocol."""
        code = None if self.code is None else {self.protocol: self.code}
        found, _ = find_protocol(self.protocol, code)
        assert isinstance(found, MujocoProtocol)
        return found


#: Verdict of a trial, and 16 digits of the SHA-256 of hand and object.
PostureResult: TypeAlias = tuple[PostureVerdict, dict[str, str]]


def verify_postures(
    files: Sequence[Path | str], trials: PostureTrials, execute: Executor = run_here
) -> Iterator[PostureResult]:
    """Yield the verdicts on files in order, each with the digests of hand and object.

    Args:
        files: Files in DexGraspBench's format; a text instead of a path says why a row is not a
            valid grasp.
        trials: Result of `prepare_trials`.
        execute: Executor of the trials.

    Raises:
        HandError, MeshError, DataError: If the hand or an object cannot be used.
        ConfigError: If a user-defined protocol cannot be run.
    """
    return in_order(execute)(_verify_one, [(path, trials) for path in files])


def prepare_trials(name: str, hand: Path, objects: Path) -> PostureTrials:
    """Return the trials of a protocol. The arguments are checked here, and the files later.

    Args:
        name: Name of a protocol in the registry, or `FILE.py:NAME`.
        hand: MJCF of the hand.
        objects: Folder to which the object paths in the files are relative.

    Raises:
        ConfigError: If there is no such protocol, or it does not run in MuJoCo.
        HandError: If the MJCF cannot be used.
        MachineError: If MuJoCo is missing.
    """
    protocol, stored = find_protocol(name)
    if not isinstance(protocol, MujocoProtocol):
        raise ConfigError(f"protocol must be one that runs in mujoco, got {stored}")
    require_mujoco("mujoco")
    from drakegrasp.protocols.scene import hand_digest

    hand_digest(hand)
    code = None if stored == name else read_class(name)[1]
    return PostureTrials(protocol=stored, code=code, hand=hand, objects=objects)


def _verify_one(task: tuple[Path | str, PostureTrials]) -> PostureResult:
    """Return the verdict on one file."""
    path, trials = task
    if isinstance(path, str):
        return _invalid(path)
    try:
        stored = read_grasp_file(path)
        motion, folder = one_motion(stored), inner_path(stored.object_path)
        protocol, scene, digests = _scene(trials, folder, float(stored.object_scale[0]))
    except (DataError, MeshError) as error:
        return _invalid(str(error))
    if len(motion.grasp) != 7 + scene.joints:
        got = len(motion.grasp)
        return _invalid(f"a posture must be {7 + scene.joints} numbers, got {got}")
    if trials.code is None:
        verdict = protocol.run(scene, motion)
    else:
        verdict = run_own(trials.protocol, protocol.run, scene, motion)
    if not isinstance(verdict, PostureVerdict):
        raise ConfigError(f"{trials.protocol}: run must return a PostureVerdict, got {verdict!r}")
    return verdict, digests


def _invalid(what: str) -> PostureResult:
    return PostureVerdict(success=False, reason=f"invalid: {what}"), {}


@lru_cache(maxsize=_SCENES)
def _scene(
    trials: PostureTrials, path: Path, scale: float
) -> tuple[MujocoProtocol, ProtocolScene, dict[str, str]]:
    """Return the protocol, the scene of an object, and the digests of hand and object."""
    from drakegrasp.protocols.scene import ProtocolScene, hand_digest, read_object_folder

    protocol, thing = trials.rules(), read_object_folder(trials.objects / path, scale)
    scene = ProtocolScene(protocol, trials.hand, thing)
    return protocol, scene, {"hand": hand_digest(trials.hand), "object": thing.digest}


def describe(protocol: Protocol, stored: str) -> dict[str, Any]:
    """Return the description of a protocol for a result: name, source and numbers."""
    return {"protocol": stored, "source": protocol.source, "numbers": protocol.numbers()}


def json_line(index: int, file: Path | str, result: PostureResult, trials: PostureTrials) -> str:
    """Return a result as a line of strict JSON; values that were not measured are null."""
    verdict, digests = result
    line = {
        "index": index,
        "file": str(file),
        **asdict(verdict),
        **describe(trials.rules(), trials.protocol),
        "simulator": "mujoco",
        "versions": versions(),
        "digests": digests,
    }
    return strict_json(line)


def versions() -> dict[str, str]:
    """Return the versions of the packages that affect a verdict."""
    return {name: metadata.version(name) for name in ("drakegrasp", "mujoco")}
