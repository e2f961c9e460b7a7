"""The drive of the fingers: what keeps a closing joint from being pushed open during a lift.

In: a scene whose closed hand is about to lift, and the kind of drive. The motor's torque stays on
with each of them:

* `torque`: nothing else holds the joint; what pushes harder than the motor pushes it open.
* `worm`: the joint never opens. After each step its angle becomes the joint's lower limit. Where
  the contacts load a finger by more than its `holding_torque`, the worm yields: the joint opens
  against that torque, until it stands or closes again.
* `locked`: the joint keeps its angle, whatever the load.

Limits of joints and actuators belong to the plant, not to its context: `disengage` restores them
before the next attempt, and `hand_over` carries them to the scene that continues a lift.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from pydrake.systems.framework import Context, EventStatus

from drakegrasp.config import LiftConfig
from drakegrasp.errors import ConfigError
from drakegrasp.frames import Array
from drakegrasp.hand.description import Drive, Hand
from drakegrasp.simulation.scene import Scene, closing_angles, closing_rates, hand_handles


def drive_of(hand: Hand, config: LiftConfig) -> Drive:
    """Return the drive of a hand's fingers under a configuration.

    Raises:
        ConfigError: If `lift.drive` is `worm`, and a finger of the hand has no `holding_torque`.
    """
    drive = hand.drive if config.drive is None else config.drive
    without = [finger.name for finger in hand.fingers if finger.holding_torque is None]
    if drive == "worm" and without:
        raise ConfigError(
            "lift.drive: must be torque or locked for a hand whose fingers have no "
            f"holding_torque ({', '.join(without)}), got 'worm'"
        )
    return drive


def engage(scene: Scene, drive: Drive) -> None:
    """Let the drive hold the closing joints at their angles from now on.

    Args:
        scene: A scene with a hand, whose motors are on.
        drive: See the module.
    """
    if drive == "torque":
        return
    joints = hand_handles(scene).closing_joints
    for joint, angle in zip(joints, closing_angles(scene), strict=True):
        upper = angle if drive == "locked" else float(joint.position_upper_limits()[0])
        _set_limits(joint, angle, upper)
    if drive == "worm":
        scene.simulator.set_monitor(partial(_turn_worms, scene))


def disengage(scene: Scene) -> None:
    """Give the closing joints and their motors the limits of the hand's files again."""
    handles = hand_handles(scene)
    scene.simulator.clear_monitor()
    for i, joint in enumerate(handles.closing_joints):
        _set_limits(joint, *handles.closing_limits[i])
        _set_torque(scene, i, handles.hand.fingers[i].torque_limit)


def hand_over(scene: Scene, before: Scene) -> None:
    """Let the drive go on in the scene that continues a lift.

    Args:
        scene: The scene that continues.
        before: The scene that simulated the lift until now.
    """
    disengage(scene)
    source, target = hand_handles(before), hand_handles(scene)
    for i, (joint, other) in enumerate(
        zip(target.closing_joints, source.closing_joints, strict=True)
    ):
        _set_limits(
            joint, float(other.position_lower_limits()[0]), float(other.position_upper_limits()[0])
        )
        _set_torque(scene, i, source.motors[i].effort_limit())
    if before.simulator.get_monitor() is not None:
        scene.simulator.set_monitor(partial(_turn_worms, scene))


def holding_torques(scene: Scene) -> Array:
    """Return the torque (k,) [N m] by which the contacts push each closing joint open now."""
    handles = hand_handles(scene)
    port = scene.plant.get_generalized_contact_forces_output_port(handles.instance)
    return -np.asarray(handles.closing_gain @ port.Eval(scene.context))


def _turn_worms(scene: Scene, context: Context) -> EventStatus:
    """After a step: take up what the fingers have closed, and yield where a load is too large."""
    handles = hand_handles(scene)

    # Limits first: Drake solves this state once, for the load here and for the step that follows.
    rates = closing_rates(scene)
    yields = [
        motor.effort_limit() > finger.torque_limit
        for motor, finger in zip(handles.motors, handles.hand.fingers, strict=True)
    ]
    for i, (joint, angle) in enumerate(
        zip(handles.closing_joints, closing_angles(scene), strict=True)
    ):
        lower, upper = (float(limit[0]) for limit in _limits(joint))
        if yields[i] and rates[i] >= 0.0:
            # The finger that was pushed open stands again: the worm holds it here.
            _set_torque(scene, i, handles.hand.fingers[i].torque_limit)
            _set_limits(joint, min(angle, upper), upper)
        elif not yields[i] and angle > lower:
            _set_limits(joint, min(angle, upper), upper)

    # A finger whose load is beyond its strength opens against that strength.
    loads = holding_torques(scene)
    overloaded = [
        i
        for i, finger in enumerate(handles.hand.fingers)
        if not yields[i] and finger.holding_torque is not None and loads[i] > finger.holding_torque
    ]
    for i in overloaded:
        _set_limits(handles.closing_joints[i], *handles.closing_limits[i])
        _set_torque(scene, i, handles.hand.fingers[i].holding_torque)
    if overloaded:
        # What Drake has solved for this state holds no more.
        scene.plant.SetPositions(scene.context, scene.plant.GetPositions(scene.context))
    return EventStatus.DidNothing()
