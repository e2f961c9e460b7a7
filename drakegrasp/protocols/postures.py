"""Verdicts on stored postures under a protocol, one line of JSON each.

Input: grasp files in DexGraspBench's format, the MJCF of a hand, and a protocol by name. Output:
one verdict per file, in order. A file that is not a valid grasp gets the verdict `invalid`.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from importlib import metadata
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from drakegrasp.errors import ConfigError, DataError, MeshError
from drakegrasp.protocols.files import inner_path, one_motion, read_grasp_file, read_object_folder
from drakegrasp.protocols.protocol import MujocoProtocol, PostureVerdict, Protocol, find_protocol
from drakegrasp.registry import read_class, run_own
from drakegrasp.runtime.environment import require_mujoco
from drakegrasp.runtime.executor import Executor, in_order, run_here

if TYPE_CHECKING:
    from drakegrasp.protocols.scene import ProtocolScene

#: Significant digits of the numbers in JSON.
DIGITS = 6
#: Number of scenes that a process caches: files of one object follow each other.
_SCENES = 4


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
    from drakegrasp.protocols.scene import ProtocolScene, hand_digest

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
    return json.dumps(_plain(line), allow_nan=False)


def versions() -> dict[str, str]:
    """Return the versions of the packages that affect a verdict."""
    return {name: metadata.version(name) for name in ("drakegrasp", "mujoco")}


def _plain(value: Any) -> Any:
    """Return a value of a protocol, possibly a user-defined one, as a JSON value."""
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, Mapping):
        return {str(key): _plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}") if isfinite(value) else None
    return value
