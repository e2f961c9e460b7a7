"""The diagrams that a process keeps: building one costs as much as simulating an attempt.

In: an object, and what to simulate or draw it with. Out: its scene or its renderer, built now or
kept from before. Diagrams are known by a digest of what they hold, so a copy of an object shares
its diagrams. A scene that is reset gives the same bits as a new one, so earlier use changes
nothing.
"""

from __future__ import annotations

import atexit
import ctypes
import gc
import hashlib
import threading
from collections.abc import Callable, Hashable
from typing import TypeVar, cast

import numpy as np
import numpy.typing as npt

from drakegrasp.config import CameraConfig, PhysicsConfig
from drakegrasp.hand.description import load_hand
from drakegrasp.objects.model import ObjectModel
from drakegrasp.simulation.construction import build_scene
from drakegrasp.simulation.scene import Scene
from drakegrasp.vision.rendering import Renderer, build_renderer

#: How many diagrams are kept: a build needs the scene and the renderer of two objects.
KEPT = 4

_Diagram = TypeVar("_Diagram", Scene, Renderer)

#: The last in order is the last used.
_kept: dict[Hashable, Scene | Renderer] = {}
_lock = threading.Lock()


def cached_scene(
    model: ObjectModel, physics: PhysicsConfig, hand_name: str, preshape: int | None = None
) -> Scene:
    """Return the scene of an object with a hand, by its name or YAML file.

    Args:
        model: The object.
        physics: See `build_scene`.
        hand_name: See `load_hand`.
        preshape: Index of a preshape, see `Hand.at`.
    """
    # A hand whose files have changed is loaded anew, and is then another key.
    hand = load_hand(hand_name).at(preshape)
    return _cached((*_scene_key(model, physics), hand), lambda: build_scene(model, physics, hand))


def _scene_key(model: ObjectModel, physics: PhysicsConfig) -> tuple[Hashable, ...]:
    """Return what a scene is known by, but for its hand."""
    shape = (model.collision_vertices, model.collision_faces, model.half_extents)
    mass = (model.p_OOcm, model.I_OOcm_O, np.float64(model.mass))
    return "scene", _digest(model.name, *shape, *mass), model.own_physics(physics)


def cached_renderer(model: ObjectModel, config: CameraConfig) -> Renderer:
    """Return the renderer of an object; use it in the thread that asked for it first."""
    key = "renderer", _digest(model.name, model.visual_vertices, model.visual_faces), config
    return _cached(key, lambda: build_renderer(model, config))


def forget_scenes() -> None:
    """Drop every scene: one in which Drake failed must not be used again."""
    with _lock:
        for key in [key for key, diagram in _kept.items() if isinstance(diagram, Scene)]:
            del _kept[key]
        gc.collect()


def _cached(key: Hashable, build: Callable[[], _Diagram]) -> _Diagram:
    with _lock:
        diagram = _kept.pop(key, None)
        if diagram is None:
            while len(_kept) >= KEPT:
                del _kept[next(iter(_kept))]
                # Diagrams sit in reference cycles and own memory that Python does not count.
                gc.collect()
            diagram = build()
        _kept[key] = diagram
        return cast(_Diagram, diagram)


def _digest(name: str, *arrays: npt.NDArray[np.generic] | np.float64) -> str:
    """Return a digest of an object: its name, from which its colour follows, and arrays."""
    digest = hashlib.sha256(name.encode())
    for array in arrays:
        digest.update(array.tobytes())
    return digest.hexdigest()


@atexit.register
def _leave_renderers_to_the_system() -> None:
    """Keep the renderers from being destroyed when the process ends.

    That would happen in another thread than the one that made them, which VTK answers with a
    page of warnings. A reference that is never returned keeps them until the process is gone.
    """
    for diagram in _kept.values():
        if isinstance(diagram, Renderer):
            ctypes.pythonapi.Py_IncRef(ctypes.py_object(diagram))
