"""Simulated multi-finger grasps with the images of every one, from a directory of meshes.

The names below are loaded when they are first used, so reading a dataset needs h5py and
NumPy only, and importing this package starts neither Drake nor Dask.
"""

from __future__ import annotations

from importlib import import_module, metadata
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from drakegrasp.check import check_dataset
    from drakegrasp.cluster import build_dataset, verify_grasps
    from drakegrasp.config import Config, load_config
    from drakegrasp.dataset import GraspDataset
    from drakegrasp.grasp import pack_grasp, transform_grasp, unpack_grasp
    from drakegrasp.hand import load_hand
    from drakegrasp.outcomes import Outcome
    from drakegrasp.placed import place_object
    from drakegrasp.replay import replay_trial
    from drakegrasp.verification import Verification
    from drakegrasp.verifying import verify_grasp

__version__ = metadata.version("drakegrasp")

_HOMES = {
    "Config": "config",
    "GraspDataset": "dataset",
    "Outcome": "outcomes",
    "Verification": "verification",
    "build_dataset": "cluster",
    "check_dataset": "check",
    "load_config": "config",
    "load_hand": "hand",
    "pack_grasp": "grasp",
    "place_object": "placed",
    "replay_trial": "replay",
    "transform_grasp": "grasp",
    "unpack_grasp": "grasp",
    "verify_grasp": "verifying",
    "verify_grasps": "cluster",
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
