"""The lift of an attempt: the object is freed, and the wrist moves it to its target.

Input: a scene whose closed hand may lift, and the rules. Output: the contacts at the end, and the
pose of the object then. First the wrist does not move for `lift.release_time`. So the motion of the
object when it becomes free can be distinguished from the motion that the lift adds. Two things save
time without changing the verdict:

* While nothing moves in the hand, a step is `physics.coarse_steps` times as long, because a grasp
  at rest needs no fine steps. A second diagram takes the coarse steps; it takes over the state.
* The lift ends early when the verdict is certain: nothing of the hand touches the object any more,
  or object and fingers do not move and a fingertip has clearly lost the object.

With `lift.stop_when: lost_sample`, a lift also ends, without a verdict, at the first check at which
the object has moved more in the hand than a sample may. If the verdict is certain at that check, or
at the end, the verdict takes precedence.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from drakegrasp.arithmetic import multiply, norm
from drakegrasp.config import Config, LiftConfig
from drakegrasp.frames import X_WT, Array, invert_pose, rotation_angle, transform_points
from drakegrasp.hand.finger_sweep import pad_points
from drakegrasp.simulation.attempt import Materials
from drakegrasp.simulation.construction import set_materials
from drakegrasp.simulation.contacts import (
    ClearanceMonitor,
    Contacts,
    bodies_on_object,
    hand_bodies,
    read_contacts,
)
from drakegrasp.simulation.drive import disengage, drive_of, engage, hand_over
from drakegrasp.simulation.scene import (
    Scene,
    TrialLimits,
    WristMotion,
    closing_angles,
    hand_positions,
    move_wrist,
    neighbour_poses,
    object_pose,
    palm_pose,
    release,
    transfer_state,
)
from drakegrasp.simulation.screen import extra_margin

#: An object that moved less than this in the hand since the last check is still held [m], [rad].
HELD_SHIFT, HELD_ANGLE = 5e-4, np.deg2rad(0.5)
#: Coarse steps are taken while the object moves less than this between checks [m], [rad].
COARSE_SHIFT, COARSE_ANGLE = 1e-4, np.deg2rad(0.1)
#: A fingertip farther than this from the object has lost it for good [m]: a fingertip that counts
#: as not moving creeps back by less than half of this before the lift ends.
LOST = 3e-3
#: A fraction of a step, far above the rounding errors of times.
ROUNDING = 1e-6


@dataclass(frozen=True, kw_only=True, eq=False)
class Lift:
    """How a lift ended.

    Attributes:
        contacts: Contacts at the end.
        q: Positions of the hand's joints [rad or m], in the plant's order.
        duration: Simulated time [s].
        X_TO: Pose of the object, (4, 4).
        X_OG: Pose of the palm, (4, 4).
        slip: Distance that {O} has moved in {G} since the object is free [m].
        turn: Angle that {O} has turned in {G} since then [rad].
        slip_released, turn_released: The same values before the wrist moved.
        moved: Whether the lift ended early because the object moved too far in the hand.
        clearance: Smallest height of the hand above the table's top [m], negative below it; NaN if
            not measured.
        X_TN: Poses of the n neighbours at the end, (n, 4, 4).
    """

    contacts: Contacts
    q: Array
    duration: float
    X_TO: Array
    X_OG: Array
    slip: float
    turn: float
    slip_released: float
    turn_released: float
    moved: bool
    clearance: float = np.nan
    X_TN: Array = field(default_factory=lambda: np.zeros((0, 4, 4)))


def lift(scene: Scene, limits: TrialLimits, config: Config, materials: Materials) -> Lift:
    """Free the object, move the wrist to `lift.p_TG`, hold it there, and return the result.

    Args:
        scene: Scene with the object in the closed hand.
        limits: The attempt's limits.
        config: The rules.
        materials: Friction and mass of the attempt.

    Raises:
        TrialTimeout: See `TrialLimits.advance`.
        StateError: See `TrialLimits.advance`.
    """
    X_GO_start, start = _object_in_hand(scene), scene.time

    # `scene` takes fine steps; `current` is the scene that takes the steps that are needed now.
    now, current, monitor, used = start, scene, _Monitor(scene), [scene]
    slip_released, turn_released, certain, moved = 0.0, 0.0, False, False
    clearance = ClearanceMonitor(config.close)
    clearance.look(scene)
    try:
        # Free the object in the hand; later the wrist moves to its target.
        release(scene)
        engage(scene, drive_of(scene.hand, config.lift))
        motion = _plan_motion(scene, config)
        end = motion.begin + motion.duration + config.lift.hold_time

        # Simulate from check to check until the hold at the target ends, the verdict is certain, or
        # the object has moved too far.
        while now < end and not certain and not moved:
            check = min(_next_check(now, config), motion.begin if now < motion.begin else end)
            # Stop just before a step, so that rounding errors do not move a step across a check.
            margin = ROUNDING * current.physics.time_step if check < end else 0.0
            limits.advance(current, check - margin - current.time)
            certain = monitor.update(current, check - now, config.close.stop_speed)
            now = check
            clearance.look(current)

            # Measure how far the object moved in the hand, in total and before the wrist moves.
            X_GO = _object_in_hand(current)
            slip, turn = _motion(X_GO_start, X_GO)
            if now <= motion.begin:
                slip_released, turn_released = slip, turn
            if now < end and not certain:
                moved = is_lost_sample(slip, turn, config.lift)

            # Choose the next step size, and move the state to the diagram that has it.
            if now < end and not certain and not moved:
                chosen = _scene_with_step(scene, monitor.at_rest)
                if chosen is not current:
                    used.append(chosen)
                    set_materials(chosen, materials)
                    transfer_state(chosen, current, now, motion)
                    hand_over(chosen, current)
                current = chosen

        # Read the contacts at the end.
        contacts = read_contacts(current)
    finally:
        for stage in used:
            disengage(stage)
    return Lift(
        contacts=contacts,
        q=hand_positions(current),
        duration=now - start,
        X_TO=object_pose(current),
        X_OG=invert_pose(X_GO),
        slip=slip,
        turn=turn,
        slip_released=slip_released,
        turn_released=turn_released,
        moved=moved,
        clearance=clearance.least(),
        X_TN=neighbour_poses(current),
    )


def _plan_motion(scene: Scene, config: Config) -> WristMotion:
    """Command the wrist to its target, as fast as the limits allow, after the release time."""
    target = X_WT[:3, 3] + config.lift.p_TG
    duration = lift_duration(float(norm(target - palm_pose(scene)[:3, 3])), config)
    # A coarse step may begin together with the motion.
    begin = _on_grid(scene.time + config.lift.release_time, config)
    # The palm may start at its target.
    return move_wrist(scene, target, max(duration, config.physics.time_step), begin=begin)


def _next_check(now: float, config: Config) -> float:
    """Return the time of the next check [s]: after the period, when a coarse step begins."""
    return _on_grid(now + config.lift.check_period, config)


def _on_grid(time: float, config: Config) -> float:
    """Return the first time [s] from a time on at which a coarse step begins."""
    step = config.physics.coarse_steps * config.physics.time_step
    return float(np.ceil(time / step - ROUNDING) * step)


def _scene_with_step(scene: Scene, at_rest: bool) -> Scene:
    """Return the scene with long time steps if everything is at rest and it has them."""
    return scene.coarse_scene() if at_rest and scene.coarse_scene is not None else scene


class _Monitor:
    """Compares a lift with its last check.

    Attributes:
        at_rest: Whether object and fingers have not moved in the hand since the last check.
    """

    def __init__(self, scene: Scene) -> None:
        tips = zip(scene.fingertips, scene.hand.required, strict=True)
        self._tips = {body.index() for body, required in tips if required}
        self._X_GO, self._angles = _object_in_hand(scene), closing_angles(scene)
        self._unit = scene.closing_units
        # Whether all fingertips touched the object at a check after which nothing moved; then the
        # contacts need not be computed again.
        self._held = False
        self.at_rest = False

    def update(self, scene: Scene, elapsed: float, stop_speed: float) -> bool:
        """Check the lift again and return whether its verdict is certain.

        Args:
            scene: The scene that was simulated since the last check.
            elapsed: Simulated time since the last check [s].
            stop_speed: Speed below which a closing joint is at rest, in its unit [1/s].
        """
        # Measure what moved since the last check.
        X_GO, angles = _object_in_hand(scene), closing_angles(scene)
        shift, angle = _motion(self._X_GO, X_GO)
        closed = np.abs(angles - self._angles) / self._unit
        standing = float(closed.max()) / elapsed <= stop_speed
        self.at_rest = standing and not (shift > COARSE_SHIFT or angle > COARSE_ANGLE)
        self._X_GO, self._angles = X_GO, angles

        # An object that moves in the hand is lost once nothing of the hand touches it.
        if shift > HELD_SHIFT or angle > HELD_ANGLE:
            self._held = False
            return not bodies_on_object(scene) & hand_bodies(scene)
        if not standing:
            self._held = False
            return False

        # If nothing moves and a fingertip is clear of the object, the grasp has slipped for good,
        # unless the table still supports the object.
        if self._held:
            return False
        touching = bodies_on_object(scene)
        self._held = self._tips <= touching
        return scene.table.index() not in touching and _has_lost_tip(scene)


def _has_lost_tip(scene: Scene) -> bool:
    """Return whether the pad of a required fingertip has lost the object for good."""
    field, X_OW = scene.model.field, invert_pose(scene.pose(scene.object))
    pads = pad_points(scene.hand)
    tips = zip(scene.fingertips, pads, scene.hand.required, strict=True)
    for tip, p_FiQ in [(tip, points) for tip, points, required in tips if required]:
        p_OQ = transform_points(multiply(X_OW, scene.pose(tip)), p_FiQ)
        distance = field.interpolate(*p_OQ.astype(np.float32).T)
        if distance.min() > LOST + extra_margin(field):
            return True
    return False


def _object_in_hand(scene: Scene) -> Array:
    """Return the pose X_GO (4, 4) of the object in the palm frame."""
    return multiply(invert_pose(palm_pose(scene)), scene.pose(scene.object))


def _motion(X_GO_before: Array, X_GO: Array) -> tuple[float, float]:
    """Return by how much the object moved [m] and turned [rad] in the hand."""
    shift = float(norm(X_GO[:3, 3] - X_GO_before[:3, 3]))
    return shift, rotation_angle(multiply(invert_pose(X_GO_before), X_GO)[:3, :3])


def is_lost_sample(slip: float, turn: float, rules: LiftConfig) -> bool:
    """Return whether a lift ends at a check because the grasp can no longer be a sample.

    Args:
        slip: Distance that the object has moved in the hand since it is free [m].
        turn: Angle that the object has turned in the hand [rad].
        rules: When lifts end.
    """
    too_far = slip > rules.stop_slip or np.degrees(turn) > rules.stop_turn_deg
    return rules.stop_when == "lost_sample" and bool(too_far)


#: Peak speed of a minimum-jerk motion divided by its mean speed (Flash and Hogan, 1985).
PEAK_SPEED = 15.0 / 8.0
#: Peak acceleration of a minimum-jerk motion, times duration squared, divided by distance.
PEAK_ACCELERATION = 10.0 / np.sqrt(3.0)


def lift_duration(distance: float, config: Config) -> float:
    """Return the shortest duration [s] of a minimum-jerk motion over a distance [m].

    Its peaks are 15/8 d/T and 10/√3 d/T², so within the limits of speed and acceleration

        T = max(15/8 d / v_max, √(10/√3 d / a_max)).
    """
    at_speed_limit = PEAK_SPEED * distance / config.lift.max_speed
    at_acceleration_limit = np.sqrt(PEAK_ACCELERATION * distance / config.lift.max_acceleration)
    return float(max(at_speed_limit, at_acceleration_limit))
