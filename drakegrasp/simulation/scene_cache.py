"""The scenes and renderers that a process caches, and the trials in cached scenes.

Input: an object, and what to simulate or draw it with. Output: its scene or its renderer, new or
cached. The keys are digests of the content, so copies of an object share scenes and renderers. A
scene that is reset gives the same bits as a new scene, so earlier use changes nothing.
"""

from __future__ import annotations

import ctypes
import hashlib
import threading
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache

import numpy as np
import numpy.typing as npt

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
from drakegrasp.objects.surroundings import Neighbourhood
from drakegrasp.runtime.environment import release_memory
from drakegrasp.simulation.attempt import Attempt, disturbed, usual_conditions
from drakegrasp.simulation.closing import centred
from drakegrasp.simulation.construction import build_scene
from drakegrasp.simulation.scene import Scene
from drakegrasp.simulation.screen import Screening
from drakegrasp.simulation.trial import TrialRecord, run_attempt
from drakegrasp.vision.rendering import Renderer, build_renderer

#: Number of objects whose scenes and renderers are cached.
KEPT = 2

_lock = threading.Lock()


@dataclass(frozen=True)
class _Content:
    """An object and what is around it, equal to others with the same digest."""

    digest: str
    model: ObjectModel = field(compare=False)
    around: Neighbourhood | None = field(compare=False, default=None)


def _content(model: ObjectModel, *arrays: npt.NDArray[np.generic] | np.float64) -> _Content:
    """Return an object as a key: its name, which decides its colour, and arrays."""
    digest = hashlib.sha256(model.name.encode())
    for array in arrays:
        digest.update(array.tobytes())
    return _Content(digest.hexdigest(), model)


@lru_cache(maxsize=KEPT)
def _scenes(content: _Content, physics: PhysicsConfig, hand: Hand) -> Callable[[int | None], Scene]:
    """Return a function that returns the scene of a preshape, the same one in each call."""
    _free_dropped(_scenes.cache_info().misses)
    around = content.around
    return cache(lambda shape: build_scene(content.model, physics, hand.at(shape), around=around))


@lru_cache(maxsize=KEPT)
def _renderer(content: _Content, config: CameraConfig) -> Renderer:
    _free_dropped(_renderer.cache_info().misses)
    return build_renderer(content.model, config)


def _free_dropped(number: int) -> None:
    """Free what a cache has dropped when it makes the entry of a number, counted from one.

    Diagrams are in reference cycles and own memory that Python does not count. An entry is dropped
    after the next one was made, so the first `KEPT` + 1 find nothing to free.
    """
    if number > KEPT + 1:
        release_memory()


# At the end of the process, cached renderers would be destroyed in another thread than the one that
# created them, and VTK would print a page of warnings. A reference that is never released keeps
# them until the process has ended.
ctypes.pythonapi.Py_IncRef(ctypes.py_object(_renderer))


def cached_scene(
    model: ObjectModel,
    physics: PhysicsConfig,
    source: HandSource,
    preshape: int | None = None,
    around: Neighbourhood | None = None,
) -> Scene:
    """Return the scene of an object with a hand.

    Args:
        model: The object.
        physics: See `build_scene`.
        source: See `load_hand`. A hand whose files have changed is loaded again.
        preshape: Index of a preshape, see `Hand.at`.
        around: What is around the object, see `build_scene`.
    """
    shape = (model.collision_vertices, model.collision_faces, model.half_extents)
    mass = (model.p_OOcm, model.I_OOcm_O, np.float64(model.mass))
    content = _content(model, *shape, *mass)
    if around is not None:
        content = replace(content, digest=content.digest + around.digest(), around=around)
    with _lock:
        return _scenes(content, model.own_physics(physics), load_hand(source))(preshape)


def cached_renderer(model: ObjectModel, config: CameraConfig) -> Renderer:
    """Return the renderer of an object; use it only in the thread that first requested it."""
    content = _content(model, model.visual_vertices, model.visual_faces)
    with _lock:
        return _renderer(content, config)


def forget_scenes() -> None:
    """Drop every scene, because a scene must not be used again after an inconclusive trial."""
    with _lock:
        _scenes.cache_clear()


def run_cached(
    model: ObjectModel,
    X_TO: Array,
    attempt: Attempt,
    config: Config,
    around: Neighbourhood | None = None,
) -> TrialRecord:
    """Return the record of an attempt in the cached scene of an object, see `run_in`."""
    scene = cached_scene(model, config.physics, config.hand_source, attempt.preshape, around)
    return run_in(scene, X_TO, attempt, config)


def run_in(
    scene: Scene,
    X_TO: Array,
    attempt: Attempt,
    config: Config,
    screening: Screening | None = None,
) -> TrialRecord:
    """Return the record of an attempt in a scene, see `run_attempt`.

    After an inconclusive trial no scene of the cache is used again.
    """
    record = run_attempt(scene, X_TO, attempt, config, screening)
    if record.outcome.inconclusive:
        forget_scenes()
    return record


def repeat_disturbed(
    model: ObjectModel, X_TO: Array, attempt: Attempt, config: Config
) -> list[TrialRecord]:
    """Return the records of disturbed repeats; inconclusive repeats are left out.

    Repeats use the time step of the trial and whole lifts. The stored trial is not one.

    Args:
        model: The object.
        X_TO: Resting pose of the object, (4, 4).
        attempt: An attempt with a lift; the noise is relative to its friction and mass.
        config: The rules; `robustness` has the number of repeats.
    """
    # Whether a grasp holds is decided by a whole lift.
    config, hand = with_whole_lifts(config), load_hand(config.hand_source)
    known = attempt.conditions or usual_conditions(model, config.physics)
    repeats = centred(model, hand, list(disturbed(attempt, known, config.robustness.repeats)))
    records = [run_cached(model, X_TO, each, config) for each in repeats]
    return [record for record in records if not record.outcome.inconclusive]
