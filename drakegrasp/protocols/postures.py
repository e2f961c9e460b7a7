"""Verdicts on stored postures under a protocol, one line of JSON each.

In: grasp files of DexGraspBench's format, the MJCF of a hand and a protocol by name. Out: a
`PostureResult` per file, in order. A file that is no grasp has a verdict, too: `invalid`.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from importlib import metadata
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from drakegrasp import __version__
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
#: Scenes that a process keeps: files of an object follow each other.
_SCENES = 4


@dataclass(frozen=True, kw_only=True)
class PostureTrials:
    """What the trials of many files have in common; plain data for any process.

    Attributes:
        protocol: Its stored name.
        code: Text of a user's own protocol, by that name.
        hand: MJCF of the hand.
        objects: Folder to which the paths of objects in the files are relative.
    """

    protocol: str
    hand: Path
    objects: Path
    code: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class PostureResult:
    """The verdict on a file.

    Attributes:
        file: The file.
        verdict: What was measured.
        digests: 16 digits of the SHA-256 of hand and object.
    """

    file: Path
    verdict: PostureVerdict
    digests: Mapping[str, str]


def verify_postures(
    files: Sequence[Path | str], trials: PostureTrials, execute: Executor = run_here
) -> Iterator[PostureResult]:
    """Yield the verdicts on files, in their order.

    Args:
        files: Of DexGraspBench's format; a text says why a grasp is none.
        trials: From `prepare_trials`.
        execute: Runs the trials.

    Raises:
        HandError, MeshError, DataError: If the hand or an object cannot be used.
        ConfigError: If a user's own protocol cannot be run.
    """
    return in_order(execute)(_verify_one, [(path, trials) for path in files])


def prepare_trials(name: str, hand: Path, objects: Path) -> PostureTrials:
    """Return the trials of a protocol; everything but the files is checked here.

    Args:
        name: Of a protocol in the registry, or `FILE.py:NAME`.
        hand: MJCF of the hand.
        objects: Folder to which the paths of objects in the files are relative.

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
    code = {} if stored == name else {stored: read_class(name)[1]}
    return PostureTrials(protocol=stored, code=code, hand=hand, objects=objects)


def _verify_one(task: tuple[Path | str, PostureTrials]) -> PostureResult:
    """Return the verdict on one file."""
    path, trials = task
    if isinstance(path, str):
        return _invalid(Path(), path)
    try:
        stored = read_grasp_file(path)
        motion, folder = one_motion(stored), inner_path(stored.object_path)
        scene, digests = _scene(trials, folder, float(stored.object_scale[0]))
    except (DataError, MeshError) as error:
        return _invalid(path, str(error))

    if len(motion.grasp) != 7 + scene.joints:
        got = len(motion.grasp)
        return _invalid(path, f"a posture must be {7 + scene.joints} numbers, got {got}")
    protocol = _protocol(trials)
    if "@" in trials.protocol:
        verdict = run_own(trials.protocol, protocol.run, scene, motion)
    else:
        verdict = protocol.run(scene, motion)
    if not isinstance(verdict, PostureVerdict):
        raise ConfigError(f"{trials.protocol}: run must return a PostureVerdict, got {verdict!r}")
    return PostureResult(file=path, verdict=verdict, digests=digests)


def _invalid(path: Path, what: str) -> PostureResult:
    verdict = PostureVerdict(success=False, reason=f"invalid: {what}")
    return PostureResult(file=path, verdict=verdict, digests={})


def _protocol(trials: PostureTrials) -> MujocoProtocol:
    found, _ = find_protocol(trials.protocol, trials.code)
    assert isinstance(found, MujocoProtocol)
    return found


def _scene(trials: PostureTrials, path: Path, scale: float) -> tuple[ProtocolScene, dict[str, str]]:
    """Return the scene of an object, and the digests of hand and object."""
    key = json.dumps(dict(trials.code), sort_keys=True)
    return _kept_scene(trials.protocol, key, trials.hand, trials.objects / path, scale)


@lru_cache(maxsize=_SCENES)
def _kept_scene(
    name: str, code: str, hand: Path, folder: Path, scale: float
) -> tuple[ProtocolScene, dict[str, str]]:
    from drakegrasp.protocols.scene import ProtocolScene, hand_digest

    protocol, _ = find_protocol(name, json.loads(code))
    assert isinstance(protocol, MujocoProtocol)
    thing = read_object_folder(folder, scale)
    scene = ProtocolScene(protocol, hand, thing)
    return scene, {"hand": hand_digest(hand), "object": thing.digest}


def describe(protocol: Protocol, stored: str) -> dict[str, Any]:
    """Return what a result says of a protocol: name, source and numbers."""
    return {"protocol": stored, "source": protocol.source, "numbers": protocol.numbers()}


def json_line(index: int, result: PostureResult, trials: PostureTrials) -> str:
    """Return a result as a line of strict JSON; what was not measured is null."""
    verdict = {k: _plain(v) for k, v in asdict(result.verdict).items()}
    line = {
        "index": index,
        "file": str(result.file),
        **verdict,
        **_plain(describe(_protocol(trials), trials.protocol)),
        "simulator": "mujoco",
        "versions": versions(),
        "digests": dict(result.digests),
    }
    return json.dumps(line, allow_nan=False)


def versions() -> dict[str, str]:
    """Return the versions of what makes a verdict."""
    return {"drakegrasp": __version__, "mujoco": metadata.version("mujoco")}


def _plain(value: Any) -> Any:
    """Return a value of a protocol, which may be a user's own, as one of JSON."""
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, Mapping):
        return {str(key): _plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}") if isfinite(value) else None
    return value
