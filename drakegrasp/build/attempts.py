"""The diagrams of one object in this process, and one attempt on them.

In: a prepared object of a dataset. Out: a `Workbench`, kept for the next work unit of the same
object, on which attempts are tried and successes are looked at.
"""

from __future__ import annotations

import atexit
import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from drakegrasp.config import Config
from drakegrasp.dataset.prepared_objects import PreparedObject, load_prepared
from drakegrasp.dataset.shards import ShardHeader
from drakegrasp.errors import DataError
from drakegrasp.hand.description import load_hand
from drakegrasp.outcomes import Outcome
from drakegrasp.runtime.environment import release_memory
from drakegrasp.simulation.candidates import Attempt
from drakegrasp.simulation.construction import build_scene
from drakegrasp.simulation.scene import Scene
from drakegrasp.simulation.screen import Prediction, predict
from drakegrasp.simulation.trial import TrialRecord, run_attempt
from drakegrasp.vision.rendering import Renderer, build_renderer

#: Objects whose diagrams a process keeps; a unit follows units of the same object.
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
            self._renderer = build_renderer(self.prepared.model, self.config.camera)
        return self._renderer


_workbenches: dict[tuple[Path, str, str, str], Workbench] = {}


def workbench(out: Path, header: ShardHeader, config: Config) -> Workbench:
    """Return the diagrams of a unit's object, built now or kept from an earlier unit.

    Raises:
        DataError: If the object's files are damaged, or of another configuration or mesh.
    """
    key = (out, header.config_hash, header.object_name, header.mesh_sha256)
    if key not in _workbenches:
        prepared = load_prepared(out, header.object_name, config)
        if prepared.model.mesh_sha256 != header.mesh_sha256:
            raise DataError(f"{out}: {header.object_name} must be of the unit's mesh, got another")
        while len(_workbenches) >= KEPT_OBJECTS:
            del _workbenches[next(iter(_workbenches))]
        release_memory()  # what other objects left, also in preparing them
        scene = build_scene(prepared.model, config.physics, load_hand(config.hand))
        _workbenches[key] = Workbench(prepared=prepared, config=config, scene=scene)
    return _workbenches[key]


@atexit.register
def _leave_renderers_to_the_system() -> None:
    """Keep the renderers from being destroyed when the process ends.

    That would happen in another thread than the one that made them, which VTK answers with a
    page of warnings. A reference that nobody gives back keeps them until the process is gone.
    """
    for bench in _workbenches.values():
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(bench))


def predict_all(bench: Workbench, attempts: Sequence[Attempt]) -> list[Prediction | None]:
    """Return what geometry says of each attempt; asking for all at once is what is fast."""
    config, prepared = bench.config, bench.prepared
    hand = load_hand(config.hand)
    return predict(prepared.model, hand, prepared.X_TO, attempts, config.screen)


def try_on(bench: Workbench, attempt: Attempt, prediction: Prediction | None = None) -> TrialRecord:
    """Run one attempt; a scene in which Drake failed is replaced, never used again."""
    record = run_attempt(bench.scene, bench.prepared.X_TO, attempt, bench.config, prediction)
    if record.outcome is Outcome.SOLVER_ERROR:
        hand = load_hand(bench.config.hand)
        bench.scene = build_scene(bench.prepared.model, bench.config.physics, hand)
    return record
