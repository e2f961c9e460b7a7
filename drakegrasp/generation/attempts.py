"""One object's trial setup in this process, and the steps of a trial on it.

In: a prepared object of a dataset, and attempts. Out: what geometry predicts of them, the records
of their trials, how contacts lie on the surface, and the views of a grasp. Nothing is written
here, see `drakegrasp.generation.columns`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import multiply
from drakegrasp.config import Config
from drakegrasp.dataset.prepared_objects import PreparedObject, load_prepared
from drakegrasp.dataset.schema import CAMERAS
from drakegrasp.dataset.shards import ShardHeader
from drakegrasp.errors import DataError, MachineError
from drakegrasp.frames import Array
from drakegrasp.hand.description import load_hand
from drakegrasp.objects.model import ContactFit, ObjectModel, fit_contacts
from drakegrasp.outcomes import Outcome
from drakegrasp.runtime.environment import release_memory
from drakegrasp.simulation.attempts import posture_attempts
from drakegrasp.simulation.candidates import Attempt, children, family_member, make_attempts
from drakegrasp.simulation.conditions import draw_conditions, usual_conditions
from drakegrasp.simulation.scene import Scene
from drakegrasp.simulation.scene_cache import cached_renderer, cached_scene, forget_scenes
from drakegrasp.simulation.screen import Prediction, centred, predict
from drakegrasp.simulation.trial import TrialRecord, lift_on, run_attempt
from drakegrasp.vision.camera import camera_pose_otm, camera_pose_oto, image_frame, intrinsics
from drakegrasp.vision.depth_sensor import spoil_depth
from drakegrasp.vision.rendering import Renderer, paint, render

#: Prepared objects that a process keeps: the next unit is mostly of the same object.
KEPT_OBJECTS = 2


@dataclass(eq=False)
class TrialSetup:
    """What every trial of an object needs.

    Attributes:
        prepared: The object, its resting poses and its palm poses.
        config: All the rules.
        scene: Physics of object, table and hand. A scene in which Drake failed is replaced.
    """

    prepared: PreparedObject
    config: Config
    scene: Scene
    _renderer: Renderer | None = None

    def scene_of(self, attempt: Attempt) -> Scene:
        """Return the scene of an attempt: the hand may be in a preshape."""
        if attempt.preshape is None:
            return self.scene
        model, config = self.prepared.model, self.config
        return cached_scene(model, config.physics, config.hand_source, attempt.preshape)

    @property
    def renderer(self) -> Renderer:
        """The object's renderer, built when it is first needed."""
        if self._renderer is None:
            self._renderer = cached_renderer(self.prepared.model, self.config.camera)
        return self._renderer


@dataclass(frozen=True, kw_only=True, eq=False)
class View:
    """What one camera sees of the resting object.

    Attributes:
        image: (4, S, S) float32, R, G, B in 0..1 and depth [m].
        mask: (S, S) uint8, 1 where the object is seen.
        X_TC: Pose of the camera in the table-top frame, (4, 4).
        X_CI: The object's frame as the image shows it, (4, 4); None where none was estimated.
    """

    image: npt.NDArray[np.float32]
    mask: npt.NDArray[np.uint8]
    X_TC: Array
    X_CI: Array | None = None


def trial_setup(out: Path, header: ShardHeader, config: Config) -> TrialSetup:
    """Return the setup of a unit's object; what it holds is kept from an earlier unit.

    Raises:
        DataError: If the object's files are damaged, or of another configuration or mesh.
    """
    prepared = _load(out, header.object_name, header.mesh_sha256, config)
    scene = cached_scene(prepared.model, config.physics, config.hand_source)
    return TrialSetup(prepared=prepared, config=config, scene=scene)


@lru_cache(maxsize=KEPT_OBJECTS)
def _load(out: Path, name: str, mesh_sha256: str, config: Config) -> PreparedObject:
    prepared = load_prepared(out, name, config)
    # A mesh may have changed since the unit was planned.
    if prepared.model.mesh_sha256 != mesh_sha256:
        raise DataError(
            f"{out}: the prepared {name} must be of the work unit's mesh {mesh_sha256[:12]}, "
            f"got {prepared.model.mesh_sha256[:12]}"
        )
    release_memory()  # what other objects left, also in preparing them
    return prepared


def list_attempts(prepared: PreparedObject, indices: range, config: Config) -> list[Attempt]:
    """Return the attempts of a range of an object's candidates, with their conditions."""
    model, drawn = prepared.model, prepared.candidates
    place: Any = {"name": model.name, "seed": config.seed}
    hand = load_hand(config.hand_source)
    if drawn.postures is None:
        count = len(hand.preshapes)
        made = list(make_attempts(drawn, indices, config.candidates, **place, preshapes=count))
    else:
        made = list(posture_attempts(drawn, indices, hand, **place))
    made = [replace(a, unused=hand.unused_in(a.preshape)) for a in made] if hand.preshapes else made
    made = centred(model, hand, made)
    return [_with_conditions(attempt, model, config) for attempt in made]


def list_children(prepared: PreparedObject, parent: Attempt, config: Config) -> list[Attempt]:
    """Return the attempts about that of a grasp that holds, with their conditions."""
    model = prepared.model
    made = children(parent, config.refine, name=model.name, seed=config.seed)
    made = centred(model, load_hand(config.hand_source), made)
    return [_with_conditions(attempt, model, config) for attempt in made]


def find_attempt(
    prepared: PreparedObject, candidate: int, standoff_index: int, child: int, config: Config
) -> Attempt:
    """Return an attempt by its identity in a dataset, with its conditions.

    Raises:
        DataError: If there is no such number in a family.
    """
    most = sum(config.refine.children**k for k in range(1, config.refine.generations + 1))
    if not 0 <= child <= most:
        raise DataError(f"child must be 0 to {most}, got {child}")
    first = list_attempts(prepared, range(candidate, candidate + 1), config)[standoff_index]
    model, hand = prepared.model, load_hand(config.hand_source)
    member = family_member(
        first,
        child,
        config.refine,
        name=model.name,
        seed=config.seed,
        place=lambda attempt: centred(model, hand, [attempt])[0],
    )
    return _with_conditions(member, model, config)


def _with_conditions(attempt: Attempt, model: ObjectModel, config: Config) -> Attempt:
    place = attempt.candidate, attempt.standoff_index, attempt.child
    return replace(attempt, conditions=draw_conditions(model, config, *place))


def predict_attempts(setup: TrialSetup, attempts: Sequence[Attempt]) -> list[Prediction | None]:
    """Return what geometry says of each attempt; one call for all of them is much faster."""
    config, prepared = setup.config, setup.prepared
    hand = load_hand(config.hand_source)

    # A call is about one resting pose and preshape.
    found: list[Prediction | None] = [None] * len(attempts)
    for k, X_TO in enumerate(prepared.resting_poses):
        for preshape in sorted({attempt.preshape for attempt in attempts}, key=str):
            rows = [
                row
                for row, attempt in enumerate(attempts)
                if (attempt.resting, attempt.preshape) == (k, preshape)
            ]
            own, shaped = [attempts[row] for row in rows], hand.at(preshape)
            predictions = predict(prepared.model, shaped, X_TO, own, config.screen)
            for row, prediction in zip(rows, predictions, strict=True):
                found[row] = prediction
    return found


def try_attempt(
    setup: TrialSetup, attempt: Attempt, prediction: Prediction | None = None
) -> TrialRecord:
    """Run the trial of one attempt; replace the scene if Drake failed in it."""
    X_TO = setup.prepared.resting_poses[attempt.resting]
    is_visible = partial(_is_visible, setup, attempt, X_TO)
    record = run_attempt(
        setup.scene_of(attempt), X_TO, attempt, setup.config, prediction, is_visible=is_visible
    )
    _replace_failed(setup, record)
    return record


def lift_scraped(setup: TrialSetup, attempt: Attempt, record: TrialRecord) -> TrialRecord:
    """Lift the hand of `try_attempt`, which only scraped the table; see `lift_on`."""
    is_visible = partial(_is_visible, setup, attempt, record.X_TO)
    lifted = lift_on(setup.scene_of(attempt), record, attempt, setup.config, is_visible=is_visible)
    _replace_failed(setup, lifted)
    return lifted


def _replace_failed(setup: TrialSetup, record: TrialRecord) -> None:
    """Replace the scene if Drake failed in it."""
    if record.outcome is Outcome.SOLVER_ERROR:
        forget_scenes()
        config = setup.config
        setup.scene = cached_scene(setup.prepared.model, config.physics, config.hand_source)


def _is_visible(setup: TrialSetup, attempt: Attempt, X_TO: Array) -> bool:
    """Return whether the otm depth image of an attempt is not too flat for a lift.

    Raises:
        MachineError: If the renderer fails: that is no failure of the grasp.
    """
    least = setup.config.lift.least_depth_variance
    if least == 0.0:
        return True
    try:
        view = _render_view(setup, attempt, X_TO, "otm")
    except MachineError:
        raise
    except (RuntimeError, SystemExit) as error:
        raise MachineError(f"{setup.prepared.model.name}: cannot render: {error}") from None
    return bool(view.image[3].astype(float).var() >= least)


def measure_contacts(setup: TrialSetup, record: TrialRecord) -> ContactFit | None:
    """Return how the contacts after closing lie on the object's mesh, a row per finger.

    Returns:
        Distances and angles; None if the hand lifted nothing.
    """
    if record.closed is None or record.lift is None:
        return None
    closed = record.closed.contacts
    return fit_contacts(setup.prepared.model, closed.p_OQ, closed.nhat_Q_O)


def render_views(setup: TrialSetup, attempt: Attempt, record: TrialRecord) -> dict[str, View]:
    """Return what both cameras see of a success, by the names of `CAMERAS`.

    Raises:
        BlankImageError: If an image is blank, because OpenGL failed.
    """
    return {name: _render_view(setup, attempt, record.X_TO, name) for name in CAMERAS}


def _render_view(setup: TrialSetup, attempt: Attempt, X_TO: Array, name: str) -> View:
    """Return what the camera of a name sees of the object at rest, before the attempt."""
    # The camera, and how the scene looks.
    camera, model = setup.config.camera, setup.prepared.model
    conditions = attempt.conditions or usual_conditions(model, setup.config.physics)
    pose = {"oto": camera_pose_oto, "otm": camera_pose_otm}[name]
    X_TC = pose(multiply(X_TO, attempt.X_OG), camera, conditions.X_C0C)
    paint(setup.renderer, conditions.appearance)
    seen = render(setup.renderer, X_TO, X_TC)

    # The object's frame comes from the clean image; the sensor's errors come last.
    K = intrinsics(camera)
    estimated = name == "otm" and seen.mask.any()
    X_CI = image_frame(K, seen.mask, seen.image[3]) if estimated else None
    image, number = seen.image, CAMERAS.index(name)
    image[3] = spoil_depth(image[3], K, conditions.sensor, number, camera)
    return View(image=image, mask=seen.mask, X_TC=X_TC, X_CI=X_CI)
