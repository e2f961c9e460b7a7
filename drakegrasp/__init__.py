"""Simulated multi-finger grasps with the images of every one, from a directory of meshes.

The names below are loaded when they are first used, so reading a dataset needs h5py and
NumPy only, and importing this package starts neither Drake nor Dask.
"""

from __future__ import annotations

from importlib import import_module, metadata
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from drakegrasp.api import (
        PlacedObject,
        build_dataset,
        make_benchmark,
        place_object,
        score,
        verify_grasp,
        verify_grasps,
        verify_rows,
    )
    from drakegrasp.build.pipeline import BuildReport
    from drakegrasp.build.replay import Replay, replay_trial
    from drakegrasp.config import Config
    from drakegrasp.dataset.checks.findings import Violation
    from drakegrasp.dataset.checks.run import check_dataset
    from drakegrasp.dataset.reader import GraspDataset, Sample
    from drakegrasp.dataset.trials import Trials
    from drakegrasp.errors import DrakegraspError
    from drakegrasp.grasp import pack_grasp, transform_grasp, unpack_grasp
    from drakegrasp.hand.description import Hand, load_hand
    from drakegrasp.hand.settings import load_config
    from drakegrasp.outcomes import Outcome
    from drakegrasp.scoring.run import Score
    from drakegrasp.verification.result import PoseTrial, Verification

__version__ = metadata.version("drakegrasp")

#: The module of each name.
_HOMES = {
    "BuildReport": "build.pipeline",
    "Config": "config",
    "DrakegraspError": "errors",
    "GraspDataset": "dataset.reader",
    "Hand": "hand.description",
    "Outcome": "outcomes",
    "PlacedObject": "api",
    "PoseTrial": "verification.result",
    "Replay": "build.replay",
    "Sample": "dataset.reader",
    "Score": "scoring.run",
    "Trials": "dataset.trials",
    "Verification": "verification.result",
    "Violation": "dataset.checks.findings",
    "build_dataset": "api",
    "check_dataset": "dataset.checks.run",
    "load_config": "hand.settings",
    "load_hand": "hand.description",
    "make_benchmark": "api",
    "pack_grasp": "grasp",
    "place_object": "api",
    "replay_trial": "build.replay",
    "score": "api",
    "transform_grasp": "grasp",
    "unpack_grasp": "grasp",
    "verify_grasp": "api",
    "verify_grasps": "api",
    "verify_rows": "api",
}

__all__ = [
    "BuildReport",
    "Config",
    "DrakegraspError",
    "GraspDataset",
    "Hand",
    "Outcome",
    "PlacedObject",
    "PoseTrial",
    "Replay",
    "Sample",
    "Score",
    "Trials",
    "Verification",
    "Violation",
    "build_dataset",
    "check_dataset",
    "load_config",
    "load_hand",
    "make_benchmark",
    "pack_grasp",
    "place_object",
    "replay_trial",
    "score",
    "transform_grasp",
    "unpack_grasp",
    "verify_grasp",
    "verify_grasps",
    "verify_rows",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'drakegrasp' has no attribute {name!r}")
    return getattr(import_module(f"drakegrasp.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
