"""The trial setup of an object in this process, the steps of a trial, and the rows of a shard.

Input: a prepared object of a dataset, and attempts. Output: what geometry decides, the records of
the trials, and the columns of a shard by the names of `drakegrasp.dataset.schema`: `/trials`, with
a row per attempt, and `/looks`, with the images of each success. Nothing is written here. For a
verdict, the filters of a dataset are applied to the columns of a single trial.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from drakegrasp.arithmetic import multiply, norm
from drakegrasp.config import Config, FilterConfig
from drakegrasp.dataset.prepared_objects import PreparedObject, load_prepared
from drakegrasp.dataset.schema import CAMERAS, MOVED_SHIFT, MOVED_TURN, NO_PRESHAPE, sizes
from drakegrasp.dataset.shards import ShardHeader, trial_columns
from drakegrasp.dataset.successes import successes_of
from drakegrasp.errors import DataError
from drakegrasp.filters import FILTERS, Removal
from drakegrasp.frames import Array, pack_pose, rotation_angle
from drakegrasp.grasp import unused_fingers
from drakegrasp.hand.description import load_hand
from drakegrasp.objects.model import ContactFit, ObjectModel, fit_contacts
from drakegrasp.objects.surroundings import Neighbourhood
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation.attempt import Attempt, Conditions, draw_conditions, usual_conditions
from drakegrasp.simulation.attempts import posture_attempts
from drakegrasp.simulation.candidates import palm_attempts
from drakegrasp.simulation.closing import centred
from drakegrasp.simulation.scene import Scene, hand_joint_names
from drakegrasp.simulation.scene_cache import cached_renderer, cached_scene, run_in
from drakegrasp.simulation.screen import Screening, screen
from drakegrasp.simulation.trial import TrialRecord
from drakegrasp.table import AnyArray, Table
from drakegrasp.vision.camera import (
    camera_pose_otm,
    camera_pose_oto,
    image_frame,
    intrinsics,
    spoil_depth,
)
from drakegrasp.vision.rendering import Renderer, paint, render

#: Number of prepared objects that a process caches; the next unit mostly has the same object.
KEPT_OBJECTS = 2
#: Functions that return the pose of the camera of each name, given the pose of the palm.
_CAMERA_POSES = {"oto": camera_pose_oto, "otm": camera_pose_otm}


@dataclass(eq=False)
class TrialSetup:
    """The objects that every trial of an object needs.

    Attributes:
        prepared: The object, its resting poses and its palm poses.
        config: Configuration of the dataset.
        scene: Simulation of object, table and hand. After an inconclusive trial it is replaced.
    """

    prepared: PreparedObject
    config: Config
    scene: Scene

    def scene_of(self, attempt: Attempt) -> Scene:
        """Return the scene of an attempt, with the hand in the attempt's preshape if it has one."""
        if attempt.preshape is None:
            return self.scene
        model, config = self.prepared.model, self.config
        return cached_scene(model, config.physics, config.hand_source, attempt.preshape)

    def renew_scene(self) -> None:
        """Replace the scene, after an inconclusive trial emptied the cache."""
        config = self.config
        self.scene = cached_scene(self.prepared.model, config.physics, config.hand_source)

    @cached_property
    def renderer(self) -> Renderer:
        """The object's renderer, built when it is first needed."""
        return cached_renderer(self.prepared.model, self.config.camera)

    @cached_property
    def sizes(self) -> dict[str, int]:
        """The array lengths that the schema does not fix: fingers, joints and pixels."""
        return sizes(
            fingers=self.scene.hand.num_fingers,
            joints=len(hand_joint_names(self.scene)),
            image=self.config.camera.size,
        )


def trial_setup(out: Path, header: ShardHeader, config: Config) -> TrialSetup:
    """Return the setup of a unit's object, whose object and scene are cached between units.

    Raises:
        DataError: If the object's files are damaged, or belong to another configuration or mesh.
    """
    key = out, header.object_name, header.mesh_sha256, config
    prepared = _load(*key)
    if len(prepared.candidates) < header.stop:  # more palm poses were drawn since
        _load.cache_clear()
        prepared = _load(*key)
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
    return prepared


# Attempts


def list_attempts(prepared: PreparedObject, indices: range, config: Config) -> list[Attempt]:
    """Return the attempts of a range of an object's candidates, with their conditions.

    Their palms are centred, see `centred`.
    """
    drawn, hand, model = prepared.candidates, load_hand(config.hand_source), prepared.model
    place: Any = {"name": model.name, "seed": config.seed}
    if drawn.postures is None:
        count = len(hand.preshapes)
        made = list(palm_attempts(drawn, indices, config.candidates, **place, preshapes=count))
    else:
        made = list(posture_attempts(drawn, indices, hand, **place))
    made = [replace(a, unused=hand.unused_in(a.preshape)) for a in made] if hand.preshapes else made
    return [
        replace(
            each, conditions=draw_conditions(model, config, each.candidate, each.standoff_index)
        )
        for each in centred(model, hand, made)
    ]


def find_attempt(
    prepared: PreparedObject, candidate: int, standoff_index: int, config: Config
) -> Attempt:
    """Return an attempt by its identity in a dataset, with its conditions."""
    return list_attempts(prepared, range(candidate, candidate + 1), config)[standoff_index]


def screen_attempts(setup: TrialSetup, attempts: Sequence[Attempt]) -> list[Screening | None]:
    """Return what geometry decides about each attempt; one call for all is much faster."""
    config, prepared = setup.config, setup.prepared
    hand = load_hand(config.hand_source)

    # `screen` takes attempts of one preshape.
    groups: dict[int | None, list[int]] = {}
    for row, attempt in enumerate(attempts):
        groups.setdefault(attempt.preshape, []).append(row)
    found: list[Screening | None] = [None] * len(attempts)
    for preshape, rows in groups.items():
        own = [attempts[row] for row in rows]
        X_TO = prepared.resting_poses[[attempt.resting for attempt in own]]
        said = screen(prepared.model, hand.at(preshape), X_TO, own, config.screen)
        for row, screening in zip(rows, said, strict=True):
            found[row] = screening
    return found


def try_attempt(
    setup: TrialSetup, attempt: Attempt, screening: Screening | None = None
) -> TrialRecord:
    """Run the trial of one attempt; replace the scene if the trial was inconclusive."""
    X_TO = setup.prepared.resting_poses[attempt.resting]
    record = run_in(setup.scene_of(attempt), X_TO, attempt, setup.config, screening)
    if record.outcome.inconclusive:
        setup.renew_scene()
    return record


# Rows of a shard


class TrialRow(NamedTuple):
    """The sources of a row of `/trials`; `Field.of` in the schema names the source of a column.

    Attributes:
        attempt: The attempt.
        conditions: Friction, mass, appearance and cameras of the attempt.
        trial: The record of the trial.
        fit: Fit of the contacts after closing to the surface; None if no lift was tried.
    """

    attempt: Attempt
    conditions: Conditions
    trial: TrialRecord
    fit: ContactFit | None


def trial_rows(
    setup: TrialSetup, attempts: Sequence[Attempt], records: Sequence[TrialRecord]
) -> dict[str, AnyArray]:
    """Return the columns of `/trials` for attempts and the records of their trials."""
    return _trial_rows(setup.prepared.model, setup.config, setup.sizes, attempts, records)


def _trial_rows(
    model: ObjectModel,
    config: Config,
    sizes: dict[str, int],
    attempts: Sequence[Attempt],
    records: Sequence[TrialRecord],
) -> dict[str, AnyArray]:
    fields = [field for field in trial_columns() if field.of]
    columns = {field.name: field.empty(len(records), sizes) for field in fields}
    # A posture has no index of a preshape.
    columns["preshape"][:] = NO_PRESHAPE if load_hand(config.hand_source).preshapes else 0
    usual = usual_conditions(model, config.physics)
    for i, (attempt, record) in enumerate(zip(attempts, records, strict=True)):
        row = TrialRow(attempt, attempt.conditions or usual, record, _fit(model, record))
        used = ~unused_fingers(attempt.unused, sizes["k"])
        for field in fields:
            # A value that the trial did not reach keeps the fill value of the column.
            value = field.value_of(row)
            if value is None:
                continue
            if field.shape.startswith("k"):
                # A finger that the preshape does not use has no contact and no force.
                columns[field.name][i] = np.nan if field.per_finger else 0
                columns[field.name][i][used] = value
            else:
                columns[field.name][i] = pack_pose(value) if field.shape == "12" else value
    return columns


def _fit(model: ObjectModel, record: TrialRecord) -> ContactFit | None:
    """Return the fit of the contacts after closing to the mesh; None if no lift was tried."""
    if record.closed is None or record.lift is None:
        return None
    closed = record.closed.contacts
    return fit_contacts(model, closed.p_OQ, closed.nhat_Q_O)


def look_at(setup: TrialSetup, attempt: Attempt, X_TO: Array) -> dict[str, AnyArray]:
    """Return the row of `/looks` of a success on an object that rests at X_TO (4, 4).

    If the camera does not see the object, the image frame is missing and a filter removes the
    sample.

    Raises:
        BlankImageError: If an image is blank because OpenGL failed.
    """
    return _seen(setup, attempt, X_TO, "oto") | _seen(setup, attempt, X_TO, "otm")


def _seen(setup: TrialSetup, attempt: Attempt, X_TO: Array, name: str) -> dict[str, AnyArray]:
    """Return the image and mask that a camera takes of the object at rest, before the attempt."""
    # The camera, and the appearance of the scene.
    camera, model = setup.config.camera, setup.prepared.model
    conditions = attempt.conditions or usual_conditions(model, setup.config.physics)
    X_TC = _CAMERA_POSES[name](multiply(X_TO, attempt.X_OG), camera, conditions.X_C0C)
    paint(setup.renderer, conditions.appearance)
    seen = render(setup.renderer, X_TO, X_TC)

    # Compute the image frame from the clean image, before the errors of the sensor are added.
    K, image = intrinsics(camera), seen.image
    found: dict[str, AnyArray] = {"mask": seen.mask, "X_TC": pack_pose(X_TC)}
    if name == "otm" and seen.mask.any():
        found["X_CI"] = pack_pose(image_frame(K, seen.mask, image[3]))
    image[3] = spoil_depth(image[3], K, conditions.sensor, CAMERAS.index(name), camera)
    found["image"] = image
    return {f"{key}_{name}": value for key, value in found.items()}


# Filters


def judge_sample(
    model: ObjectModel, trial: TrialRecord, config: Config, *, views: bool = True
) -> Removal | None:
    """Return the first filter that removes a lifted grasp, or `KEPT` if none does.

    The cameras have the poses of a build without randomisation.

    Args:
        model: The object.
        trial: Trial of the grasp.
        config: Configuration, from which the filters and the camera are used.
        views: Whether to apply the filters of camera poses and of the contacts that a camera sees.
            They do not apply to a palm with an error, because the image was taken before it, and to
            an object among others, which may be hidden.

    Returns:
        The filter; None for a trial that is not a success.
    """
    if trial.outcome is not Outcome.SUCCESS:
        return None

    # Create its row of /trials, as a build would write it.
    assert trial.closed is not None
    fingers, joints = len(trial.closed.contacts.touching), len(trial.closed.q)
    lengths = sizes(fingers=fingers, joints=joints, image=0)
    attempt = Attempt(X_OG=trial.X_OG, spread=0.0)
    columns = _trial_rows(model, config, lengths, [attempt], [trial])

    # Add the poses of the cameras.
    if views:
        X_TG = multiply(trial.X_TO, trial.X_OG)
        for name, pose in _CAMERA_POSES.items():
            columns[f"X_TC_{name}"] = pack_pose(pose(X_TG, config.camera))[None]
    return Removal(int(successes_of(Table(columns), config)["by_filter"][0]))


@dataclass(frozen=True, kw_only=True)
class Disturbance:
    """What a trial did to the neighbours of the grasped object, from its start to its end.

    Attributes:
        neighbour: Index of the neighbour that was shifted most.
        shift: Largest shift of a neighbour's origin [m].
        turn: Largest turn of a neighbour [rad].
    """

    neighbour: int
    shift: float
    turn: float

    @property
    def is_small(self) -> bool:
        """Whether the neighbours count as left in place."""
        return self.shift <= MOVED_SHIFT and self.turn <= MOVED_TURN


def disturbance_of(trial: TrialRecord, around: Neighbourhood | None) -> Disturbance | None:
    """Return what a trial did to the neighbours, None without any or if the hand did not close."""
    end = trial.lift or trial.closed
    if end is None or around is None or not around.models:
        return None
    shift = norm(end.X_TN[:, :3, 3] - around.X_TN[:, :3, 3])
    turned = multiply(np.swapaxes(around.X_TN[:, :3, :3], 1, 2), end.X_TN[:, :3, :3])
    return Disturbance(
        neighbour=int(np.argmax(shift)),
        shift=float(shift.max()),
        turn=max(rotation_angle(R) for R in turned),
    )


#: Columns of the filters that need the images of a success.
_OF_PICTURES = {"seen", "depth_variance"}


def unjudged(config: FilterConfig) -> tuple[Removal, ...]:
    """Return the enabled filters that a verdict cannot apply."""
    of_pictures = (each for each in FILTERS if each.is_on(config) and {*each.needs} & _OF_PICTURES)
    others = {Removal.OUTLIER: config.outlier_sigma > 0.0, Removal.OWN: bool(config.own)}
    return (
        *(each.removal for each in of_pictures),
        *(reason for reason, on in others.items() if on),
    )
