"""Simulated multi-finger grasps and their images, from a directory of meshes.

The names below are loaded when they are first used. So reading a dataset needs only h5py and
NumPy, and importing this package starts neither Drake nor Dask.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from drakegrasp.api.building import (
        build_clutter,
        build_dataset,
        make_benchmark,
        make_clutter_benchmark,
    )
    from drakegrasp.api.scoring import predict_scenes, score
    from drakegrasp.api.verifying import (
        verify_grasp,
        verify_grasps,
    )
    from drakegrasp.cluster.connect import connect
    from drakegrasp.config import Config
    from drakegrasp.dataset.check import Violation, check_dataset
    from drakegrasp.dataset.clutter import Clutter, load_scene
    from drakegrasp.dataset.reader import GraspDataset, Sample
    from drakegrasp.dataset.scenes import SceneDataset, SceneRows
    from drakegrasp.dataset.trials import Trials
    from drakegrasp.errors import (
        BlankImageError,
        ConfigError,
        DataError,
        DiskFullError,
        DrakegraspError,
        GraspError,
        HandError,
        MachineError,
        MeshError,
    )
    from drakegrasp.generation.pipeline import BuildReport
    from drakegrasp.generation.replay import Replay, replay_clutter, replay_trial
    from drakegrasp.grasp import pack_grasp, transform_grasp, unpack_grasp
    from drakegrasp.hand.description import Hand, load_hand
    from drakegrasp.hand.settings import load_config
    from drakegrasp.outcomes import Outcome
    from drakegrasp.reach.arm import Arm, load_arm
    from drakegrasp.reach.rows import reach_dataset
    from drakegrasp.scoring.predicting import propose
    from drakegrasp.scoring.ranking import Ranking, rank, seen_neighbours
    from drakegrasp.scoring.run import Score
    from drakegrasp.simulation.attempts import make_posture
    from drakegrasp.simulation.placement import PlacedObject, place_object, run_trial
    from drakegrasp.simulation.posture import Posture
    from drakegrasp.verification.result import PoseTrial, Verification
    from drakegrasp.vision.depth_image import cloud_from_depth, fit_table

    __version__: str

#: The module of each name.
_HOMES = {
    "Arm": "reach.arm",
    "BlankImageError": "errors",
    "BuildReport": "generation.pipeline",
    "Clutter": "dataset.clutter",
    "Config": "config",
    "ConfigError": "errors",
    "DataError": "errors",
    "DiskFullError": "errors",
    "DrakegraspError": "errors",
    "GraspDataset": "dataset.reader",
    "GraspError": "errors",
    "Hand": "hand.description",
    "HandError": "errors",
    "MachineError": "errors",
    "MeshError": "errors",
    "Outcome": "outcomes",
    "PlacedObject": "simulation.placement",
    "PoseTrial": "verification.result",
    "Posture": "simulation.posture",
    "Ranking": "scoring.ranking",
    "Replay": "generation.replay",
    "Sample": "dataset.reader",
    "SceneDataset": "dataset.scenes",
    "SceneRows": "dataset.scenes",
    "Score": "scoring.run",
    "Trials": "dataset.trials",
    "Verification": "verification.result",
    "Violation": "dataset.check",
    "build_clutter": "api.building",
    "build_dataset": "api.building",
    "check_dataset": "dataset.check",
    "cloud_from_depth": "vision.depth_image",
    "connect": "cluster.connect",
    "fit_table": "vision.depth_image",
    "load_arm": "reach.arm",
    "load_config": "hand.settings",
    "load_hand": "hand.description",
    "load_scene": "dataset.clutter",
    "make_benchmark": "api.building",
    "make_clutter_benchmark": "api.building",
    "make_posture": "simulation.attempts",
    "pack_grasp": "grasp",
    "place_object": "simulation.placement",
    "predict_scenes": "api.scoring",
    "propose": "scoring.predicting",
    "rank": "scoring.ranking",
    "reach_dataset": "reach.rows",
    "replay_clutter": "generation.replay",
    "replay_trial": "generation.replay",
    "run_trial": "simulation.placement",
    "score": "api.scoring",
    "seen_neighbours": "scoring.ranking",
    "transform_grasp": "grasp",
    "unpack_grasp": "grasp",
    "verify_grasp": "api.verifying",
    "verify_grasps": "api.verifying",
}

__all__ = [
    "Arm",
    "BlankImageError",
    "BuildReport",
    "Clutter",
    "Config",
    "ConfigError",
    "DataError",
    "DiskFullError",
    "DrakegraspError",
    "GraspDataset",
    "GraspError",
    "Hand",
    "HandError",
    "MachineError",
    "MeshError",
    "Outcome",
    "PlacedObject",
    "PoseTrial",
    "Posture",
    "Ranking",
    "Replay",
    "Sample",
    "SceneDataset",
    "SceneRows",
    "Score",
    "Trials",
    "Verification",
    "Violation",
    "build_clutter",
    "build_dataset",
    "check_dataset",
    "cloud_from_depth",
    "connect",
    "fit_table",
    "load_arm",
    "load_config",
    "load_hand",
    "load_scene",
    "make_benchmark",
    "make_clutter_benchmark",
    "make_posture",
    "pack_grasp",
    "place_object",
    "predict_scenes",
    "propose",
    "rank",
    "reach_dataset",
    "replay_clutter",
    "replay_trial",
    "run_trial",
    "score",
    "seen_neighbours",
    "transform_grasp",
    "unpack_grasp",
    "verify_grasp",
    "verify_grasps",
]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib import metadata  # takes longer to load than the rest of this module

        return metadata.version("drakegrasp")
    if name not in _HOMES:
        raise AttributeError(f"module 'drakegrasp' has no attribute {name!r}")
    return getattr(import_module(f"drakegrasp.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
