"""The scenes and renderers that a process caches: building one costs as much as an attempt.

Input: an object, and what to simulate or draw it with. Output: its scene or its renderer, new or
cached. The keys are digests of the content, so copies of an object share scenes and renderers.
Objects under the same physics and hand also share a diagram, see `swap_object`. A scene that is
reset gives the same bits as a new scene, so earlier use changes nothing.
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

from drakegrasp.arithmetic import Array
from drakegrasp.config import (
    CameraConfig,
    Config,
    HandSource,
    PhysicsConfig,
    with_whole_lifts,
)
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.objects.model import ObjectModel
from drakegrasp.simulation.attempt import Attempt, disturbed, usual_conditions
from drakegrasp.simulation.construction import build_scene, swap_object
from drakegrasp.simulation.scene import Scene
from drakegrasp.simulation.screen import centred
from drakegrasp.simulation.trial import TrialRecord, run_attempt
from drakegrasp.vision.rendering import Renderer, build_renderer

#: Number of cached scenes and renderers: a build needs those of two objects. For a hand with
#: preshapes, between which attempts alternate, one more is cached per preshape.
KEPT = 4
#: Number of cached diagrams, each for one hand and one physics except for its friction; one more
#: per preshape.
DIAGRAMS, FRICTIONS = 2, ("friction_hand", "friction_table")

_Kept = TypeVar("_Kept", Scene, Renderer)

#: The most recently used entry is the last.
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
    # A hand whose files have changed is loaded again and becomes another key.
    physics, known = model.own_physics(physics), load_hand(source)
    hand, more = known.at(preshape), len(known.preshapes)
    shape = (model.collision_vertices, model.collision_faces, model.half_extents)
    mass = (model.p_OOcm, model.I_OOcm_O, np.float64(model.mass))
    key = "scene", _digest(model.name, *shape, *mass), physics, hand
    return _cached(key, lambda: _make_scene(model, physics, hand, DIAGRAMS + more), KEPT + more)


def run_cached(model: ObjectModel, X_TO: Array, attempt: Attempt, config: Config) -> TrialRecord:
    """Return the record of an attempt in the cached scene of an object, see `run_attempt`.

    A scene in which Drake failed is never used again.
    """
    scene = cached_scene(model, config.physics, config.hand_source, attempt.preshape)
    record = run_attempt(scene, X_TO, attempt, config)
    if record.outcome.inconclusive:
        forget_scenes()
    return record


def repeat_disturbed(
    model: ObjectModel, X_TO: Array, attempt: Attempt, config: Config
) -> list[TrialRecord]:
    """Return the records of disturbed repeats; inconclusive repeats are left out.

    Repeats use the time step of the trial and are lifted to the end. The stored trial is not one.

    Args:
        model: The object.
        X_TO: Resting pose of the object, (4, 4).
        attempt: A lifted attempt; the noise is relative to its friction and mass.
        config: The rules; `robustness` has the number of repeats.
    """
    # Whether a grasp holds is decided by a whole lift.
    config, hand = with_whole_lifts(config), load_hand(config.hand_source)
    known = attempt.conditions or usual_conditions(model, config.physics)
    repeats = centred(model, hand, list(disturbed(attempt, known, config.robustness.repeats)))
    records = [run_cached(model, X_TO, each, config) for each in repeats]
    return [record for record in records if not record.outcome.inconclusive]


def _make_scene(model: ObjectModel, physics: PhysicsConfig, hand: Hand, most: int) -> Scene:
    """Return the scene of an object on a cached or new diagram; keep at most `most` diagrams."""
    # An attempt sets friction in the context, so one diagram serves any friction.
    key = physics.model_copy(update=dict.fromkeys(FRICTIONS)), hand
    known = _diagrams.pop(key, None)
    if known is not None:
        _diagrams[key] = known
        return swap_object(known, model, physics)
    while len(_diagrams) >= most:
        _forget(_diagrams.pop(next(iter(_diagrams))).plant)
    return _diagrams.setdefault(key, build_scene(model, physics, hand))


def cached_renderer(model: ObjectModel, config: CameraConfig) -> Renderer:
    """Return the renderer of an object; use it only in the thread that first requested it."""
    key = "renderer", _digest(model.name, model.visual_vertices, model.visual_faces), config
    return _cached(key, lambda: build_renderer(model, config))


def forget_scenes() -> None:
    """Drop every scene, because a scene in which Drake failed must not be used again."""
    with _lock:
        _diagrams.clear()
        _forget()


def _cached(key: Hashable, build: Callable[[], _Kept], most: int = KEPT) -> _Kept:
    with _lock:
        kept = _kept.pop(key, None)
        if kept is None:
            while len(_kept) >= most:
                # The diagram of a scene stays, and its context is freed without help.
                if isinstance(_kept.pop(next(iter(_kept))), Renderer):
                    gc.collect()
            kept = build()
        _kept[key] = kept
        return cast(_Kept, kept)


def _forget(plant: MultibodyPlant | None = None) -> None:
    """Drop the scenes of a plant, or all scenes if None."""
    for key, kept in list(_kept.items()):
        if isinstance(kept, Scene) and plant in (None, kept.plant):
            del _kept[key]
    # Diagrams are in reference cycles and own memory that Python does not count.
    gc.collect()


def _digest(name: str, *arrays: npt.NDArray[np.generic] | np.float64) -> str:
    """Return a digest of an object: its name, which decides its colour, and arrays."""
    digest = hashlib.sha256(name.encode())
    for array in arrays:
        digest.update(array.tobytes())
    return digest.hexdigest()


@atexit.register
def _leave_renderers_to_the_system() -> None:
    """Keep the renderers from being destroyed when the process ends.

    They would be destroyed in another thread than the one that created them, and VTK would print a
    page of warnings. A reference that is never released keeps them until the process has ended.
    """
    for diagram in _kept.values():
        if isinstance(diagram, Renderer):
            ctypes.pythonapi.Py_IncRef(ctypes.py_object(diagram))
