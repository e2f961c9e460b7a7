"""The trial of one attempt, from its start pose to its verdict.

`run_attempt` is the experiment; builds, verification and replays all call it. Input: a scene, the
object's resting pose and an attempt. Output: a `TrialRecord` with the outcome and all measurements.
A failure of the physics is an outcome, not an exception. So is an error in Drake.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import multiply
from drakegrasp.config import Config
from drakegrasp.errors import first_line
from drakegrasp.frames import X_WT, Array
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation.attempt import Attempt
from drakegrasp.simulation.conditions import Materials, usual_materials
from drakegrasp.simulation.construction import set_materials
from drakegrasp.simulation.contacts import (
    ClearanceMonitor,
    Contacts,
    open_hand_collides,
    open_hand_meets,
    read_contacts,
)
from drakegrasp.simulation.drive import drive_of
from drakegrasp.simulation.lift import Lift, lift
from drakegrasp.simulation.scene import (
    Scene,
    TrialLimits,
    TrialTimeout,
    closing_angles,
    command_joints,
    finger_speed,
    hand_joint_names,
    hand_positions,
    reset_attempt,
    start_limits,
)
from drakegrasp.simulation.screen import Prediction, predict
from drakegrasp.simulation.verdict import (
    is_precision,
    is_stable,
    judge_closed,
    judge_lifted,
    scrapes,
)

#: Far below a time step, and far above the rounding error of a sum of time steps [s].
ROUNDING = 1e-9
#: A finger has missed the object if it closed this far beyond the last angle at which it can meet
#: the object, in the unit of its closing joint.
BEYOND = np.deg2rad(2.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class Closed:
    """How the fingers closed.

    Attributes:
        contacts: Contacts at the end.
        q: Positions of the hand's joints [rad or m], in the plant's order.
        duration: Simulated time [s].
        clearance: Smallest height of the hand above the table's top from the start on [m],
            negative below it; NaN if not measured.
    """

    contacts: Contacts
    q: Array
    duration: float
    clearance: float = np.nan


@dataclass(frozen=True, kw_only=True, eq=False)
class TrialRecord:
    """The result of one attempt; a stage that was not reached is None.

    Attributes:
        outcome: The verdict.
        X_TO, X_OG: Resting pose of the object and start pose of the palm, (4, 4).
        closed: How the fingers closed.
        lift: How the lift ended.
        message: First line of the error for `solver_error`, else empty.
    """

    outcome: Outcome
    X_TO: Array
    X_OG: Array
    closed: Closed | None = None
    lift: Lift | None = None
    message: str = field(default="")

    @property
    def precision(self) -> bool:
        """Whether the object is held, and only by the fingertips."""
        lift = self.lift
        return lift is not None and bool(is_precision(self.outcome, lift.contacts.other_links))

    @property
    def stable(self) -> bool:
        """Whether it is a precision grasp that moves less than 5 mm and 5 degrees in the hand."""
        lift = self.lift
        return lift is not None and bool(
            is_stable(self.outcome, lift.contacts.other_links, lift.slip, lift.turn)
        )


def run_attempt(
    scene: Scene,
    X_TO: npt.ArrayLike,
    attempt: Attempt,
    config: Config,
    prediction: Prediction | None = None,
) -> TrialRecord:
    """Simulate one attempt to grasp and lift the object, and return its record.

    The same scene, attempt and configuration give the same bits, whatever ran before.

    Args:
        scene: Scene of the object and the hand.
        X_TO: Resting pose of the object in the table-top frame, (4, 4).
        attempt: The attempt.
        config: The rules.
        prediction: Result of `predict` for the attempt, if the caller already has it; the record is
            the same without it.

    Raises:
        ConfigError: If the hand cannot have the drive that the configuration requests.
        MemoryError: If the machine runs out of memory.
        OSError: If a file of the hand cannot be read.
    """
    drive_of(scene.hand, config.lift)
    scene = _scene_for(scene, attempt)
    X_TO = np.asarray(X_TO, dtype=float)
    start = TrialRecord(outcome=Outcome.SUCCESS, X_TO=X_TO, X_OG=attempt.X_OG)
    try:
        if prediction is None:
            (prediction,) = predict(scene.model, scene.hand, X_TO, [attempt], config.screen)
        decided = _start(scene, X_TO, attempt, prediction)
        if decided is not None:
            return replace(start, outcome=decided)
        limits = start_limits(config)
        record = _close(scene, start, attempt, config, limits, prediction)
        if record.outcome is not Outcome.SUCCESS:
            return record
        return _lift(scene, record, config, limits)
    except TrialTimeout:
        return replace(start, outcome=Outcome.TIMEOUT)
    except (MemoryError, OSError):
        raise
    # A failed assertion in Drake arrives as SystemExit, everything else as RuntimeError.
    except (Exception, SystemExit) as error:
        return replace(start, outcome=Outcome.SOLVER_ERROR, message=first_line(error))


def start_meetings(scene: Scene, X_TO: Array, attempt: Attempt) -> dict[str, list[str]]:
    """Return the links that intersect "object" or "table" at an attempt's start, by these keys.

    Args:
        scene: Scene of the object and the hand.
        X_TO: Resting pose of the object, (4, 4).
        attempt: The attempt.
    """
    scene = _scene_for(scene, attempt)
    _place(scene, X_TO, attempt, attempt.closing)
    return open_hand_meets(scene)


def _scene_for(scene: Scene, attempt: Attempt) -> Scene:
    """Return the scene with the motors of an attempt."""
    if attempt.own_motors and scene.own_motors is not None:
        return scene.own_motors()
    return scene


def _place(scene: Scene, X_TO: Array, attempt: Attempt, closing: Array | None) -> None:
    """Reset a scene to the start of an attempt, with closing positions (k,) [rad or m]."""
    X_WO, q = multiply(X_WT, X_TO), None if attempt.path is None else attempt.path[0]
    X_WG = multiply(X_WO, attempt.X_OG)
    reset_attempt(scene, X_WO, X_WG, spread=attempt.spread, closing=closing, q=q)


def _start(
    scene: Scene, X_TO: Array, attempt: Attempt, prediction: Prediction | None
) -> Outcome | None:
    """Place the open hand, and return the outcome of an attempt that its start decides."""
    # Do not simulate an attempt that geometry alone decides.
    if not attempt.ray_hits:
        return Outcome.RAY_MISS
    if multiply(X_TO, attempt.X_OG)[2, 3] <= 0.0:
        return Outcome.BELOW_TABLE
    screened = None if prediction is None else prediction.outcome
    if screened is Outcome.START_COLLISION:
        return screened
    if prediction is not None and screened is not None and prediction.clear:
        return screened

    # If the open hand is close to a collision, Drake decides whether it collides.
    set_materials(scene, _materials(scene, attempt))
    _place(scene, X_TO, attempt, attempt.closing)
    return Outcome.START_COLLISION if open_hand_collides(scene) else screened


def _materials(scene: Scene, attempt: Attempt) -> Materials:
    """Return the friction and mass of an attempt; by default those of the scene."""
    if attempt.conditions is None:
        return usual_materials(scene.model, scene.physics)
    return attempt.conditions.materials


def _close(
    scene: Scene,
    start: TrialRecord,
    attempt: Attempt,
    config: Config,
    limits: TrialLimits,
    prediction: Prediction | None,
) -> TrialRecord:
    """Close the hand on the static object, and return the record; a success may lift."""
    # Start just before the fingers meet something, if geometry has found where.
    way = ClearanceMonitor(config.close)
    way.look(scene)
    if prediction is not None:
        _place(scene, start.X_TO, attempt, prediction.closing)
        way.look(scene)
    if attempt.path is not None and attempt.own_motors:
        _follow_path(scene, limits, config, attempt.path, way)
    else:
        _close_fingers(scene, limits, config, prediction, way)
    closed = Closed(
        contacts=read_contacts(scene),
        q=hand_positions(scene),
        duration=scene.time,
        clearance=way.clearance(),
    )

    # It lifts only an object that is held by all fingertips and nothing else.
    verdict = judge_closed(
        closed.contacts.touching,
        closed.contacts.other_links,
        closed.contacts.hand_on_table,
        required=scene.hand.required,
        scraped=scrapes(closed.clearance, config.close),
    )
    return replace(start, closed=closed, outcome=Outcome(int(verdict)))


def _lift(scene: Scene, record: TrialRecord, config: Config, limits: TrialLimits) -> TrialRecord:
    """Lift the object in the closed hand, and return the record."""
    end = lift(scene, limits, config)
    record = replace(record, lift=end)

    # All fingertips must still hold the object, clear of the table. A lift that ended because the
    # object moved has no such verdict.
    if end.moved:
        return replace(record, outcome=Outcome.MOVED)
    verdict = judge_lifted(
        end.contacts.touching,
        end.contacts.other_links,
        end.contacts.object_on_table,
        required=scene.hand.required,
        scraped=scrapes(end.clearance, config.close),
    )
    return replace(record, outcome=Outcome(int(verdict)))


def _close_fingers(
    scene: Scene,
    limits: TrialLimits,
    config: Config,
    prediction: Prediction | None,
    way: ClearanceMonitor,
) -> None:
    """Close the fingers on the static object until they stop or a required finger has missed it."""
    # Closing that geometry skipped counts as time; an angle beyond the last contact is a miss.
    end, last = config.close.max_time, np.array(np.inf)
    if prediction is not None:
        hand = scene.hand
        end -= float((prediction.closing / hand.closing_speed).min())
        # A fingertip that is not required does not end the attempt if it misses the object.
        last = np.where(hand.required, prediction.last + BEYOND * hand.closing_unit, np.inf)

    # The last check may be before the end by a rounding error, but never by a step.
    while end - scene.time > ROUNDING:
        limits.advance(scene, min(config.close.check_period, end - scene.time))
        way.look(scene)
        stopped = finger_speed(scene) < config.close.stop_speed
        closing = multiply(scene.hand.closing_ratio, closing_angles(scene))
        if stopped or np.any(closing > last):
            break


def _follow_path(
    scene: Scene, limits: TrialLimits, config: Config, path: Array, way: ClearanceMonitor
) -> None:
    """Move each joint by its own motor to the grasp and on to the squeeze, until all have stopped.

    The joints move in synchrony: the joint with the longest path moves at the hand's closing speed.
    """
    # The paths of the driven joints, in the order of their motors.
    names = hand_joint_names(scene)
    moved = [names.index(joint.name()) for joint in scene.closing_joints]
    places = [q[moved] for q in path]
    speed = scene.closing_units * float((scene.hand.closing_speed / scene.hand.closing_unit).min())
    lasts = [float((np.abs(b - a) / speed).max()) for a, b in pairwise(places)]
    stages = [i for i, seconds in enumerate(lasts) if seconds > 0.0]
    times = np.cumsum([0.0, *(lasts[i] for i in stages)])
    command_joints(scene, times.tolist(), [places[0], *(places[i + 1] for i in stages)])

    # The joints stop when they press on the object or are at their targets.
    end = float(times[-1]) + config.close.max_time
    while end - scene.time > ROUNDING:
        limits.advance(scene, min(config.close.check_period, end - scene.time))
        way.look(scene)
        if scene.time > times[-1] and finger_speed(scene) < config.close.stop_speed:
            break
