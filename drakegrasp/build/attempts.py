"""One attempt on an object of a dataset.

In: a prepared object of a dataset. Out: a `Workbench`, on which attempts are tried and successes
are rendered. Prepared objects are kept for the next work unit of the same object, and so are the
diagrams (`simulation.scene_cache`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from drakegrasp.config import Config
from drakegrasp.dataset.prepared_objects import PreparedObject, load_prepared
from drakegrasp.dataset.shards import ShardHeader
from drakegrasp.errors import DataError
from drakegrasp.hand.description import load_hand
from drakegrasp.outcomes import Outcome
from drakegrasp.runtime.environment import release_memory
from drakegrasp.simulation.candidates import Attempt
from drakegrasp.simulation.scene import Scene
from drakegrasp.simulation.scene_cache import cached_renderer, cached_scene, forget_scenes
from drakegrasp.simulation.screen import Prediction, predict
from drakegrasp.simulation.trial import TrialRecord, run_attempt
from drakegrasp.vision.rendering import Renderer

#: Prepared objects that a process keeps; a unit follows units of the same object.
KEPT_OBJECTS = 2


@dataclass(eq=False)
class Workbench:
    """The diagrams of one object in this process; the renderer is made when first needed."""

    prepared: PreparedObject
    config: Config
    scene: Scene
    _renderer: Renderer | None = None

    @property
    def renderer(self) -> Renderer:
        """The object's renderer."""
        if self._renderer is None:
            self._renderer = cached_renderer(self.prepared.model, self.config.camera)
        return self._renderer


def workbench(out: Path, header: ShardHeader, config: Config) -> Workbench:
    """Return the diagrams of a unit's object, built now or kept from an earlier unit.

    Raises:
        DataError: If the object's files are damaged, or of another configuration or mesh.
    """
    prepared = _load(out, header.object_name, header.mesh_sha256, config)
    scene = cached_scene(prepared.model, config.physics, config.hand)
    return Workbench(prepared=prepared, config=config, scene=scene)


@lru_cache(maxsize=KEPT_OBJECTS)
def _load(out: Path, name: str, mesh_sha256: str, config: Config) -> PreparedObject:
    prepared = load_prepared(out, name, config)
    if prepared.model.mesh_sha256 != mesh_sha256:
        raise DataError(f"{out}: {name} must be of the unit's mesh, got another")
    release_memory()  # what other objects left, also in preparing them
    return prepared


def predict_all(bench: Workbench, attempts: Sequence[Attempt]) -> list[Prediction | None]:
    """Return what geometry says of each attempt; asking for all at once is what is fast."""
    config, prepared = bench.config, bench.prepared
    hand = load_hand(config.hand)
    return predict(prepared.model, hand, prepared.X_TO, attempts, config.screen)


def try_on(bench: Workbench, attempt: Attempt, prediction: Prediction | None = None) -> TrialRecord:
    """Run one attempt; a scene in which Drake failed is replaced, never used again."""
    record = run_attempt(bench.scene, bench.prepared.X_TO, attempt, bench.config, prediction)
    if record.outcome is Outcome.SOLVER_ERROR:
        forget_scenes()
        bench.scene = cached_scene(bench.prepared.model, bench.config.physics, bench.config.hand)
    return record
