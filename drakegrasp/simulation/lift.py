"""The lift of an attempt: the object is freed, and the wrist brings it to its target.

In: a scene whose closed hand may lift, and the rules. Out: what touches what at the end, and where
the object is. Two things keep a lift from costing more than it tells:

* While nothing moves in the hand, steps are `physics.calm_steps` times as long: a grasp at rest
  needs no short ones. They are taken by a second diagram with the same state.
* It ends where its end is known: nothing of the hand touches the object any more, or object and
  fingers stand still with a fingertip well off the object.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydrake.multibody.tree import BodyIndex

from drakegrasp.arithmetic import multiply, norm
from drakegrasp.config import Config
from drakegrasp.frames import X_WT, Array, invert_pose, rotation_angle, transform_points
from drakegrasp.hand.finger_sweep import link_points
from drakegrasp.simulation.contacts import Contacts, bodies_on_object, hand_bodies, read_contacts
from drakegrasp.simulation.scene import (
    Scene,
    closing_angles,
    go_on_in,
    hand_positions,
    move_wrist,
    palm_pose,
    release,
)
from drakegrasp.simulation.screen import extra_margin
from drakegrasp.simulation.stepping import Clock
from drakegrasp.simulation.trajectory import lift_duration

#: An object that moved less than this in the hand since the last look is still held [m], [rad].
STILL, STILL_ANGLE = 5e-4, np.deg2rad(0.5)
#: A lift in which it moved less than this is calm [m], [rad].
CALM, CALM_ANGLE = 1e-4, np.deg2rad(0.1)
#: A fingertip this far from the object has lost it: one that still counts as standing creeps
#: towards it by less than half of that until the end of a lift [m].
LOST = 3e-3
#: A part of a step, far above the rounding of times.
ROUNDING = 1e-6


@dataclass(frozen=True, kw_only=True, eq=False)
class Lift:
    """How a lift ended.

    Attributes:
        contacts: What touched what.
        q: Positions of the hand's joints [rad], in the plant's order.
        duration: Simulated time [s].
        X_TO: Pose of the object, (4, 4).
        slip: Distance that {O} moved in {G} during the lift [m].
        slip_angle: Angle that it turned in {G} [rad].
    """

    contacts: Contacts
    q: Array
    duration: float
    X_TO: Array
    slip: float
    slip_angle: float


def lift(scene: Scene, clock: Clock, config: Config) -> Lift:
    """Free the object, bring the wrist to `lift.p_TG` and hold it there, and return what is left.

    Args:
        scene: With the object in the closed hand.
        clock: The attempt's limits.
        config: The rules.

    Raises:
        LateError: See `Clock`.
        StateError: See `Clock`.
    """
    X_GO_before = X_GO = _object_in_hand(scene)
    start = scene.time
    target = X_WT[:3, 3] + config.lift.p_TG
    duration = lift_duration(float(norm(target - palm_pose(scene)[:3, 3])), config)
    duration = max(duration, config.physics.time_step)  # the palm may start at its target
    release(scene)
    motion = move_wrist(scene, target, duration)
    now, end = start, start + duration + config.lift.hold_time
    tips, angles = _fingertips(scene), closing_angles(scene)
    # `scene` takes short steps, `current` those that it needs now. `held`: all fingertips have been
    # seen on the object since anything moved, and need not be looked for again.
    current, held, over = scene, False, False
    while not over:
        look = min(_next_look(now, config), end)
        # Just before a step, so that rounding moves none from one look to another.
        margin = ROUNDING * current.physics.time_step if look < end else 0.0
        clock.advance(current, look - margin - current.time)
        X_GO_seen, X_GO = X_GO, _object_in_hand(current)
        angles_seen, angles = angles, closing_angles(current)
        speed = float(np.abs(angles - angles_seen).max()) / (look - now)
        now, standing = look, speed <= config.close.stop_speed
        if _moved(X_GO_seen, X_GO, STILL, STILL_ANGLE):
            held, over = False, not bodies_on_object(current) & hand_bodies(current)
        elif not standing:
            held = False
        elif not held:
            touching = bodies_on_object(current)
            held = tips <= touching
            over = current.table.index() not in touching and _has_lost_tip(current)
        over = over or now >= end
        calm = standing and not _moved(X_GO_seen, X_GO, CALM, CALM_ANGLE)
        if not over and current is not (fitting := _scene_for(scene, calm)):
            go_on_in(fitting, current, now, motion)
            current = fitting
    shift, angle = _motion(X_GO_before, X_GO)
    return Lift(
        contacts=read_contacts(current),
        q=hand_positions(current),
        duration=now - start,
        X_TO=multiply(invert_pose(X_WT), current.pose(current.object)),
        slip=shift,
        slip_angle=angle,
    )


def _next_look(now: float, config: Config) -> float:
    """Return when to look again [s]: after the period, where a long step begins."""
    step = config.physics.calm_steps * config.physics.time_step
    return float(np.ceil((now + config.lift.check_period) / step - ROUNDING) * step)


def _scene_for(scene: Scene, calm: bool) -> Scene:
    return scene.make_calm() if calm and scene.make_calm is not None else scene


def _fingertips(scene: Scene) -> set[BodyIndex]:
    assert scene.handles is not None
    return {body.index() for body in scene.handles.fingertips}


def _has_lost_tip(scene: Scene) -> bool:
    """Return whether some fingertip is well off the object."""
    assert scene.handles is not None
    points, X_OW = link_points(scene.handles.hand), invert_pose(scene.pose(scene.object))
    field = scene.model.field
    margin = LOST + extra_margin(field)
    for tip in scene.handles.fingertips:
        p_OQ = transform_points(multiply(X_OW, scene.pose(tip)), points[tip.name()]).astype(
            np.float32
        )
        if field.interpolate(*p_OQ.T).min() > margin:
            return True
    return False


def _object_in_hand(scene: Scene) -> Array:
    return multiply(invert_pose(palm_pose(scene)), scene.pose(scene.object))


def _motion(X_GO_before: Array, X_GO: Array) -> tuple[float, float]:
    """Return by how much the object moved [m] and turned [rad] in the hand."""
    shift = float(norm(X_GO[:3, 3] - X_GO_before[:3, 3]))
    return shift, rotation_angle(multiply(invert_pose(X_GO_before), X_GO)[:3, :3])


def _moved(X_GO_before: Array, X_GO: Array, limit: float, angle_limit: float) -> bool:
    shift, angle = _motion(X_GO_before, X_GO)
    return shift > limit or angle > angle_limit
