"""The scenes and renderers that a process keeps: building one costs as much as an attempt.

In: an object, and what to simulate or draw it with. Out: its scene or its renderer, built now or
kept from before. They are known by a digest of what they hold, so a copy of an object shares
them. Objects under the same physics and hand also share a diagram, see `swap_object`. A scene that
is reset gives the same bits as a new one, so earlier use changes nothing.
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
from pydrake.multibody.plant import MultibodyPlant

from drakegrasp.config import CameraConfig, HandSource, PhysicsConfig
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.objects.model import ObjectModel
from drakegrasp.simulation.construction import build_scene, swap_object
from drakegrasp.simulation.scene import Scene
from drakegrasp.vision.rendering import Renderer, build_renderer

#: How many scenes and renderers are kept: a build needs those of two objects. With those of a hand
#: in its preshapes, which attempts take in turns, there are as many more.
KEPT = 4
#: How many diagrams of scenes are kept, each for one hand and one physics but for its friction; as
#: many more for preshapes.
DIAGRAMS, FRICTIONS = 2, ("friction_hand", "friction_table")

_Kept = TypeVar("_Kept", Scene, Renderer)

#: The last in order is the last used.
_kept: dict[Hashable, Scene | Renderer] = {}
_diagrams: dict[Hashable, Scene] = {}
_lock = threading.Lock()


def cached_scene(
    model: ObjectModel, physics: PhysicsConfig, source: HandSource, preshape: int | None = None
) -> Scene:
    """Return the scene of an object with a hand.

    Args:
        model: The object.
        physics: See `build_scene`.
        source: See `load_hand`.
        preshape: Index of a preshape, see `Hand.at`.
    """
    # A hand whose files have changed is loaded anew, and is then another key.
    physics, known = model.own_physics(physics), load_hand(source)
    hand, more = known.at(preshape), len(known.preshapes)
    shape = (model.collision_vertices, model.collision_faces, model.half_extents)
    mass = (model.p_OOcm, model.I_OOcm_O, np.float64(model.mass))
    key = "scene", _digest(model.name, *shape, *mass), physics, hand
    return _cached(key, lambda: _make_scene(model, physics, hand, DIAGRAMS + more), KEPT + more)


def _make_scene(model: ObjectModel, physics: PhysicsConfig, hand: Hand, most: int) -> Scene:
    """Return the scene of an object, on a diagram that is kept or on a new one of so many."""
    # An attempt sets friction in the context, so a diagram serves any.
    key = physics.model_copy(update=dict.fromkeys(FRICTIONS)), hand
    known = _diagrams.pop(key, None)
    if known is not None:
        _diagrams[key] = known
        return swap_object(known, model, physics)
    while len(_diagrams) >= most:
        _forget(_diagrams.pop(next(iter(_diagrams))).plant)
    return _diagrams.setdefault(key, build_scene(model, physics, hand))


def cached_renderer(model: ObjectModel, config: CameraConfig) -> Renderer:
    """Return the renderer of an object; use it in the thread that asked for it first."""
    key = "renderer", _digest(model.name, model.visual_vertices, model.visual_faces), config
    return _cached(key, lambda: build_renderer(model, config))


def forget_scenes() -> None:
    """Drop every scene: one in which Drake failed must not be used again."""
    with _lock:
        _diagrams.clear()
        _forget()


def _cached(key: Hashable, build: Callable[[], _Kept], most: int = KEPT) -> _Kept:
    with _lock:
        kept = _kept.pop(key, None)
        if kept is None:
            while len(_kept) >= most:
                # The diagram of a scene stays, and its context goes by itself.
                if isinstance(_kept.pop(next(iter(_kept))), Renderer):
                    gc.collect()
            kept = build()
        _kept[key] = kept
        return cast(_Kept, kept)


def _forget(plant: MultibodyPlant | None = None) -> None:
    """Drop the scenes of a plant, or all."""
    for key, kept in list(_kept.items()):
        if isinstance(kept, Scene) and plant in (None, kept.plant):
            del _kept[key]
    # Diagrams sit in reference cycles and own memory that Python does not count.
    gc.collect()


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
