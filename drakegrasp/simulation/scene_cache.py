"""The scenes that a process keeps, because building one costs as much as simulating.

A scene that is reset gives the same bits as a new one, so who used it before does not matter.
"""

from __future__ import annotations

import gc
import hashlib
import threading

import numpy as np

from drakegrasp.config import PhysicsConfig
from drakegrasp.hand.description import load_hand
from drakegrasp.objects.model import ObjectModel
from drakegrasp.simulation.construction import build_scene
from drakegrasp.simulation.scene import Scene

#: How many are kept: the same object with the hand and without, twice.
KEPT = 4

_scenes: dict[tuple[str, PhysicsConfig, str | None], Scene] = {}
_one_at_a_time = threading.Lock()


def scene_of(model: ObjectModel, physics: PhysicsConfig, hand: str | None) -> Scene:
    """Return the scene of an object, built now or kept, with a hand by name or without one."""
    key = (_simulated(model), physics, hand)
    with _one_at_a_time:
        scene = _scenes.pop(key, None)
        if scene is None:
            while len(_scenes) >= KEPT:
                del _scenes[next(iter(_scenes))]
                # Diagrams sit in reference cycles and own memory that Python does not count.
                gc.collect()
            scene = build_scene(model, physics, None if hand is None else load_hand(hand))
        _scenes[key] = scene  # the last in order is the last used
        return scene


def forget_scenes() -> None:
    """Drop every scene: one in which Drake failed must not be used again."""
    with _one_at_a_time:
        _scenes.clear()
        gc.collect()


def _simulated(model: ObjectModel) -> str:
    """Return a digest of what of an object is simulated: a copy of it is the same object."""
    digest = hashlib.sha256(model.name.encode())
    parts = (model.collision_vertices, model.collision_faces, model.p_OOcm, model.I_OOcm_O)
    for part in (*parts, np.float64(model.mass)):
        digest.update(part.tobytes())
    return digest.hexdigest()
