"""Simulated multi-finger grasps with the images of every one, from a directory of meshes.

The names below are loaded when they are first used, so reading a dataset needs h5py and
NumPy only, and importing this package starts neither Drake nor Dask.
"""

from __future__ import annotations

from importlib import import_module, metadata
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from drakegrasp.api import build_dataset, verify_grasp, verify_grasps
    from drakegrasp.build.replay import replay_trial
    from drakegrasp.config import Config, load_config
    from drakegrasp.dataset.checks.run import check_dataset
    from drakegrasp.dataset.reader import GraspDataset
    from drakegrasp.grasp import pack_grasp, transform_grasp, unpack_grasp
    from drakegrasp.hand.description import load_hand
    from drakegrasp.outcomes import Outcome
    from drakegrasp.simulation.placement import place_object
    from drakegrasp.verification.result import Verification

__version__ = metadata.version("drakegrasp")

_HOMES = {
    "Config": "config",
    "GraspDataset": "dataset.reader",
    "Outcome": "outcomes",
    "Verification": "verification.result",
    "build_dataset": "api",
    "check_dataset": "dataset.checks.run",
    "load_config": "config",
    "load_hand": "hand.description",
    "pack_grasp": "grasp",
    "place_object": "simulation.placement",
    "replay_trial": "build.replay",
    "transform_grasp": "grasp",
    "unpack_grasp": "grasp",
    "verify_grasp": "api",
    "verify_grasps": "api",
}

__all__ = [
    "Config",
    "GraspDataset",
    "Outcome",
    "Verification",
    "build_dataset",
    "check_dataset",
    "load_config",
    "load_hand",
    "pack_grasp",
    "place_object",
    "replay_trial",
    "transform_grasp",
    "unpack_grasp",
    "verify_grasp",
    "verify_grasps",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'drakegrasp' has no attribute {name!r}")
    return getattr(import_module(f"drakegrasp.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
