"""The trial of one attempt, from its start pose to its verdict.

`run_attempt` is the experiment; builds, verification and replays all call it. Input: a scene, the
object's resting pose and an attempt. Output: a `TrialRecord` with the outcome and all measurements.
A failure of the physics is an outcome, not an exception. So is an error in Drake.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import multiply
from drakegrasp.config import CloseConfig, Config
from drakegrasp.errors import first_line
from drakegrasp.frames import X_WT, Array
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation.attempt import Attempt, Materials, usual_materials
from drakegrasp.simulation.construction import set_materials
from drakegrasp.simulation.contacts import (
    ClearanceMonitor,
    Contacts,
    open_hand_meets,
    presses_on_neighbour,
    read_contacts,
    scrapes,
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
    neighbour_poses,
    reset_attempt,
    start_limits,
)
from drakegrasp.simulation.screen import Screening, screen

#: Far below a time step, and far above the rounding error of a sum of time steps [s].
ROUNDING = 1e-9
#: A finger has missed the object if it closed this far beyond the last angle at which it can meet
#: the object, in the unit of its closing joint.
BEYOND = np.deg2rad(2.0)
#: In a stable grasp, the object moves and turns in the hand by less than this [m], [rad]; own
#: choice.
STABLE_SLIP, STABLE_TURN = 5e-3, float(np.deg2rad(5.0))


@dataclass(frozen=True, kw_only=True, eq=False)
class Closed:
    """How the fingers closed.

    Attributes:
        contacts: Contacts at the end.
        q: Positions of the hand's joints [rad or m], in the plant's order.
        duration: Simulated time [s].
        clearance: Smallest height of the hand above the table's top from the start on [m],
            negative below it; NaN if not measured.
        X_TN: Poses of the n neighbours then, (n, 4, 4).
    """

    contacts: Contacts
    q: Array
    duration: float
    clearance: float = np.nan
    X_TN: Array = field(default_factory=lambda: np.zeros((0, 4, 4)))


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
    message: str = ""

    @property
    def precision(self) -> bool:
        """Whether the object is lifted, and only by the fingertips."""
        lifted, lift = self.outcome is Outcome.SUCCESS, self.lift
        return lifted and lift is not None and not lift.contacts.other_links

    @property
    def stable(self) -> bool:
        """Whether it is a precision grasp that moves less than 5 mm and 5 degrees in the hand."""
        lift = self.lift
        still = lift is not None and lift.slip < STABLE_SLIP and lift.turn < STABLE_TURN
        return self.precision and still


def judge_closed(
    touching: npt.ArrayLike,
    other_links: int,
    hand_on_table: bool,
    *,
    required: npt.ArrayLike = True,
    scraped: bool = False,
) -> Outcome:
    """Return the outcome of a closed hand: `SUCCESS` if it may lift.

    The first rule that applies decides.

    Args:
        touching: (k,), whether each fingertip touches the object.
        other_links: Number of other links of the hand that touch the object.
        hand_on_table: Whether the hand touches the table.
        required: (k,), whether each fingertip must touch the object; one value applies to all.
        scraped: Whether the hand was too far below the table's top, see `scrapes`.
    """
    if np.any(required & ~np.asarray(touching)):
        return Outcome.MISSING_FINGERTIP
    if other_links:
        return Outcome.HAND_CONTACT
    return Outcome.TABLE_CONTACT if hand_on_table or scraped else Outcome.SUCCESS


def judge_lifted(
    touching: npt.ArrayLike,
    other_links: int,
    object_on_table: bool,
    *,
    required: npt.ArrayLike = True,
    scraped: bool = False,
) -> Outcome:
    """Return the outcome of an attempt after the lift: `SUCCESS` if the hand holds the object.

    The first rule that applies decides; the arguments are those of `judge_closed`.
    """
    if not np.any(touching) and not other_links:
        return Outcome.DROPPED
    if np.any(required & ~np.asarray(touching)):
        partly = np.any(touching) and not object_on_table
        return Outcome.PARTLY_HELD if partly else Outcome.SLIPPED
    return Outcome.TABLE_CONTACT if object_on_table or scraped else Outcome.SUCCESS


def run_attempt(
    scene: Scene,
    X_TO: npt.ArrayLike,
    attempt: Attempt,
    config: Config,
    screening: Screening | None = None,
) -> TrialRecord:
    """Simulate one attempt to grasp and lift the object, and return its record.

    The same scene, attempt and configuration give the same bits, whatever ran before.

    Args:
        scene: Scene of the object and the hand.
        X_TO: Resting pose of the object in the table-top frame, (4, 4).
        attempt: The attempt.
        config: The rules.
        screening: Result of `screen` for the attempt, if the caller already has it; the record is
            the same without it.

    Raises:
        ConfigError: If the hand cannot have the drive that the configuration requests.
        MemoryError: If the machine runs out of memory.
        OSError: If a file of the hand cannot be read.
    """
    drive_of(scene.hand, config.lift)
    scene = _scene_with_motors(scene, attempt)
    X_TO = np.asarray(X_TO, dtype=float)
    start = TrialRecord(outcome=Outcome.SUCCESS, X_TO=X_TO, X_OG=attempt.X_OG)
    try:
        if screening is None:
            (screening,) = screen(scene.model, scene.hand, X_TO, [attempt], config.screen)
        decided = _start(scene, X_TO, attempt, screening)
        if decided is not None:
            return replace(start, outcome=decided)
        limits = start_limits(config)
        # Geometry knows where the fingers meet the object, not where they meet something else.
        known = screening if scene.is_alone else None
        record = _close(scene, start, attempt, config, limits, known)
        if record.outcome is not Outcome.SUCCESS:
            return record
        return _lift(scene, record, config, limits, _materials_of(scene, attempt))
    except TrialTimeout:
        return replace(start, outcome=Outcome.TIMEOUT)
    except (MemoryError, OSError):
        raise
    # A failed assertion in Drake arrives as SystemExit, everything else as RuntimeError.
    except (Exception, SystemExit) as error:
        return replace(start, outcome=Outcome.SOLVER_ERROR, message=first_line(error))


def start_meetings(scene: Scene, X_TO: Array, attempt: Attempt) -> dict[str, list[str]]:
    """Return the links that intersect other bodies at an attempt's start, see `open_hand_meets`.

    Args:
        scene: Scene of the object and the hand.
        X_TO: Resting pose of the object, (4, 4).
        attempt: The attempt.
    """
    scene = _scene_with_motors(scene, attempt)
    _place(scene, X_TO, attempt, attempt.closing)
    return open_hand_meets(scene)


def _scene_with_motors(scene: Scene, attempt: Attempt) -> Scene:
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
    scene: Scene, X_TO: Array, attempt: Attempt, screening: Screening | None
) -> Outcome | None:
    """Place the open hand, and return the outcome of an attempt that its start decides."""
    # Do not simulate an attempt that geometry alone decides.
    if not attempt.ray_hits:
        return Outcome.RAY_MISS
    if multiply(X_TO, attempt.X_OG)[2, 3] <= 0.0:
        return Outcome.BELOW_TABLE
    screened = None if screening is None else screening.outcome
    if screened is Outcome.START_COLLISION:
        return screened
    if screening is not None and screened is not None and screening.clear:
        return screened

    # If the open hand is close to a collision, Drake decides whether it collides.
    set_materials(scene, _materials_of(scene, attempt))
    _place(scene, X_TO, attempt, attempt.closing)
    return Outcome.START_COLLISION if open_hand_meets(scene) else screened


def _materials_of(scene: Scene, attempt: Attempt) -> Materials:
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
    screening: Screening | None,
) -> TrialRecord:
    """Close the hand on the static object, and return the record; a success may lift."""
    # Start just before the fingers meet something, if geometry has found where.
    clearance = ClearanceMonitor(config.close)
    clearance.look(scene)
    if screening is not None:
        _place(scene, start.X_TO, attempt, screening.closing)
        clearance.look(scene)
    if attempt.path is not None and attempt.own_motors:
        _follow_path(scene, limits, config.close, attempt.path, clearance)
    else:
        _close_fingers(scene, limits, config.close, screening, clearance)
    closed = Closed(
        contacts=read_contacts(scene),
        q=hand_positions(scene),
        duration=scene.time,
        clearance=clearance.least(),
        X_TN=neighbour_poses(scene),
    )
    if presses_on_neighbour(scene):
        return replace(start, closed=closed, outcome=Outcome.NEIGHBOUR_HIT)

    # It lifts only an object that is held by all required fingertips and nothing else.
    verdict = judge_closed(
        closed.contacts.touching,
        closed.contacts.other_links,
        closed.contacts.hand_on_table,
        required=scene.hand.required,
        scraped=scrapes(closed.clearance, config.close),
    )
    return replace(start, closed=closed, outcome=verdict)


def _lift(
    scene: Scene, record: TrialRecord, config: Config, limits: TrialLimits, materials: Materials
) -> TrialRecord:
    """Lift the object in the closed hand, and return the record."""
    end = lift(scene, limits, config, materials)
    # A lift that ended because the object moved has no verdict on what the hand holds.
    if end.moved:
        return replace(record, lift=end, outcome=Outcome.MOVED)
    verdict = judge_lifted(
        end.contacts.touching,
        end.contacts.other_links,
        end.contacts.object_on_table,
        required=scene.hand.required,
        scraped=scrapes(end.clearance, config.close),
    )
    return replace(record, lift=end, outcome=verdict)


def _close_fingers(
    scene: Scene,
    limits: TrialLimits,
    rules: CloseConfig,
    screening: Screening | None,
    clearance: ClearanceMonitor,
) -> None:
    """Close the fingers on the static object until they stop or a required finger has missed it."""
    # Closing that geometry skipped counts as time; an angle beyond the last contact is a miss.
    end, last, hand = rules.max_time, np.array(np.inf), scene.hand
    if screening is not None:
        end -= float((screening.closing / hand.closing_speed).min())
        # A fingertip that is not required does not end the attempt if it misses the object.
        last = np.where(hand.required, screening.last + BEYOND * hand.closing_unit, np.inf)

    for _ in _checks(scene, limits, rules, end, clearance):
        stopped = finger_speed(scene) < rules.stop_speed
        if stopped or np.any(multiply(hand.closing_ratio, closing_angles(scene)) > last):
            break


def _follow_path(
    scene: Scene, limits: TrialLimits, rules: CloseConfig, path: Array, clearance: ClearanceMonitor
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
    for _ in _checks(scene, limits, rules, float(times[-1]) + rules.max_time, clearance):
        if scene.time > times[-1] and finger_speed(scene) < rules.stop_speed:
            break


def _checks(
    scene: Scene, limits: TrialLimits, rules: CloseConfig, end: float, clearance: ClearanceMonitor
) -> Iterator[None]:
    """Simulate from check to check of closing fingers until a time [s], or a neighbour is hit."""
    # The last check may be before the end by a rounding error, but never by a step.
    while end - scene.time > ROUNDING:
        limits.advance(scene, min(rules.check_period, end - scene.time))
        clearance.look(scene)
        if presses_on_neighbour(scene):
            return
        yield
