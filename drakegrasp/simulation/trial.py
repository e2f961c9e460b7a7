"""One attempt, from its start pose to its verdict.

This is the one function that build, verify and replay all call. In: a scene, the object's
resting pose and an attempt. Out: a `TrialRecord` with the outcome and everything that was
measured on the way. Failures of the physics are values; the one place where an error of
Drake becomes an outcome is `run_attempt`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import multiply
from drakegrasp.config import Config
from drakegrasp.errors import first_line
from drakegrasp.frames import X_WT, Array
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation.candidates import Attempt
from drakegrasp.simulation.contacts import Contacts, open_hand_collides, read_contacts
from drakegrasp.simulation.lift import lift
from drakegrasp.simulation.scene import (
    Scene,
    closing_angles,
    finger_speed,
    hand_positions,
    reset_attempt,
)
from drakegrasp.simulation.screen import Prediction, predict
from drakegrasp.simulation.stepping import Clock, LateError, start_clock

#: Far below a time step, far above the rounding of a sum of them [s].
ROUNDING = 1e-9
#: A finger that is farther than this beyond where it can meet the object has missed it [rad].
BEYOND = np.deg2rad(2.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class TrialRecord:
    """The result of one attempt. What a stage did not reach is None.

    Attributes:
        outcome: The verdict.
        X_TO, X_OG: Resting pose of the object and start pose of the palm, (4, 4).
        closed, lifted: Contacts after closing and after the lift.
        q_closed, q_lifted: Positions of the hand's joints then [rad], in the plant's order.
        time_close, time_lift: Simulated seconds of the two stages.
        X_TO_lifted: Pose of the object after the lift, (4, 4).
        slip: Distance that {O} moved in {G} during the lift [m].
        slip_angle: Angle that it turned in {G} [rad].
        message: Text of the error for `solver_error`, else empty.
    """

    outcome: Outcome
    X_TO: Array
    X_OG: Array
    closed: Contacts | None = None
    lifted: Contacts | None = None
    q_closed: Array | None = None
    q_lifted: Array | None = None
    time_close: float = 0.0
    time_lift: float = 0.0
    X_TO_lifted: Array | None = None
    slip: float = np.nan
    slip_angle: float = np.nan
    message: str = field(default="")


def run_attempt(
    scene: Scene,
    X_TO: npt.ArrayLike,
    attempt: Attempt,
    config: Config,
    prediction: Prediction | None = None,
) -> TrialRecord:
    """Return what happens when the hand tries one attempt.

    The palm is placed, the fingers close on the static object, the contacts are judged,
    the object is freed and lifted to `lift.p_TG`, and the contacts are judged again. What
    geometry has decided is not simulated (`screen`), and the fingers begin to close where
    they are about to meet something. The same scene, attempt and configuration give the same
    bits, whatever ran before.

    Args:
        scene: Of the object, with the hand.
        X_TO: Resting pose of the object in the table-top frame, (4, 4).
        attempt: What to try.
        config: The rules.
        prediction: What `predict` says of the attempt, where it was asked before; the result
            is the same without.
    """
    X_TO = np.asarray(X_TO, dtype=float)
    record = TrialRecord(outcome=Outcome.RAY_MISS, X_TO=X_TO, X_OG=attempt.X_OG)
    if not attempt.ray_hits:
        return record
    if multiply(X_TO, attempt.X_OG)[2, 3] <= 0.0:
        return replace(record, outcome=Outcome.BELOW_TABLE)
    try:
        if prediction is None:
            prediction = _predict(scene, X_TO, attempt, config)
        return _simulate(scene, record, attempt, config, prediction)
    except LateError:
        return TrialRecord(outcome=Outcome.TIMEOUT, X_TO=X_TO, X_OG=attempt.X_OG)
    except (MemoryError, OSError):
        raise  # the machine's, not the attempt's
    # A failed assertion within Drake arrives as SystemExit, everything else as RuntimeError.
    except (Exception, SystemExit) as error:
        failed = TrialRecord(outcome=Outcome.SOLVER_ERROR, X_TO=X_TO, X_OG=attempt.X_OG)
        return replace(failed, message=first_line(error))


def _predict(scene: Scene, X_TO: Array, attempt: Attempt, config: Config) -> Prediction | None:
    if scene.handles is None:
        return None
    (found,) = predict(scene.model, scene.handles.hand, X_TO, [attempt], config.screen)
    return found


def _simulate(
    scene: Scene,
    record: TrialRecord,
    attempt: Attempt,
    config: Config,
    prediction: Prediction | None,
) -> TrialRecord:
    lost = None if prediction is None else prediction.outcome
    # Near a collision Drake has the last word on whether it is one.
    if lost is Outcome.START_COLLISION or (lost is not None and prediction and prediction.clear):
        return replace(record, outcome=lost)
    X_WO = multiply(X_WT, record.X_TO)
    clock = start_clock(config)
    X_WG = multiply(X_WO, attempt.X_OG)
    reset_attempt(scene, X_WO, X_WG, spread=attempt.spread, closing=attempt.closing)
    if open_hand_collides(scene):
        return replace(record, outcome=Outcome.START_COLLISION)
    if lost is not None:
        return replace(record, outcome=lost)
    if prediction is not None:
        reset_attempt(scene, X_WO, X_WG, spread=attempt.spread, closing=prediction.closing)
    record = _close(scene, clock, record, config, prediction)
    assert record.closed is not None
    verdict = judge_closed(record.closed)
    if verdict is not None:
        return replace(record, outcome=verdict)
    end = lift(scene, clock, config)
    return replace(
        record,
        outcome=judge_lifted(end.contacts),
        lifted=end.contacts,
        q_lifted=end.q,
        time_lift=end.duration,
        X_TO_lifted=end.X_TO,
        slip=end.slip,
        slip_angle=end.slip_angle,
    )


def judge_closed(contacts: Contacts) -> Outcome | None:
    """Return why a closed hand may not lift the object, or None if it may."""
    if not contacts.touching.all():
        return Outcome.MISSING_FINGERTIP
    if contacts.other_links:
        return Outcome.HAND_CONTACT
    if contacts.hand_on_table:
        return Outcome.TABLE_CONTACT
    return None


def judge_lifted(contacts: Contacts) -> Outcome:
    """Return the verdict after the lift."""
    if not contacts.touching.any() and not contacts.other_links:
        return Outcome.DROPPED
    if not contacts.touching.all():
        return Outcome.SLIPPED
    if contacts.object_on_table:
        return Outcome.TABLE_CONTACT
    return Outcome.SUCCESS


def _close(
    scene: Scene,
    clock: Clock,
    record: TrialRecord,
    config: Config,
    prediction: Prediction | None,
) -> TrialRecord:
    rules = config.close
    end, limit = rules.max_time, np.inf
    if prediction is not None:
        assert scene.handles is not None
        end -= float(prediction.closing.min()) / scene.handles.hand.closing_speed
        limit = prediction.last + BEYOND
    # The last look may fall short of the end by rounding, never by a step.
    while end - scene.time > ROUNDING:
        clock.advance(scene, min(rules.check_period, end - scene.time))
        if finger_speed(scene) < rules.stop_speed or np.any(closing_angles(scene) > limit):
            break
    return replace(
        record,
        closed=read_contacts(scene),
        q_closed=hand_positions(scene),
        time_close=scene.time,
    )
