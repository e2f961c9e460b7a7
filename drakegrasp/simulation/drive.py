"""The drive of the fingers: what keeps a closing joint from being pushed open during a lift.

Input: a scene whose closed hand is about to lift, and the kind of drive. With each kind, the
motor's torque stays on:

* `torque`: only the motor holds the joint; a load larger than its torque pushes the joint open.
* `worm`: the joint never opens. After each step its angle becomes the joint's lower limit. If the
  contacts load a finger by more than its `holding_effort`, the worm yields: the joint opens against
  that torque until it stops or closes again.
* `locked`: the joint keeps its angle, whatever the load.

For a sliding closing joint, angles are lengths [m] and torques are forces [N]. A joint with its own
motor closes towards its commanded position.

Limits of joints and actuators belong to the plant and not to its context. So `disengage` restores
them after a lift, and `hand_over` moves them to the scene that continues a lift.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from pydrake.systems.framework import Context, EventStatus

from drakegrasp.config import LiftConfig
from drakegrasp.errors import ConfigError
from drakegrasp.frames import Array
from drakegrasp.hand.description import Hand
from drakegrasp.hand.file_format import Drive
from drakegrasp.simulation.scene import (
    ClosingJoint,
    Scene,
    closing_angles,
    closing_rates,
    commanded_joints,
    joint_limits,
)

#: A finger that opens more slowly than this is at rest, in the unit of its closing joint [1/s].
STANDING = 1e-4
#: Efforts that differ by less than this fraction are equal.
ROUNDING = 1e-9


def drive_of(hand: Hand, config: LiftConfig) -> Drive:
    """Return the drive of a hand's fingers under a configuration.

    Raises:
        ConfigError: If `lift.drive` is `worm`, and a finger of the hand has no
            `holding_effort`.
    """
    drive = hand.drive if config.drive is None else config.drive
    without = [finger for finger in hand.fingers if finger.holding_effort is None]
    if drive == "worm" and without:
        raise ConfigError(
            "lift.drive: must be torque or locked for a hand whose fingers have no holding_torque "
            f"or holding_force ({', '.join(finger.name for finger in without)}), got 'worm'"
        )
    return drive


def engage(scene: Scene, drive: Drive) -> None:
    """Let the drive hold the closing joints at their angles from now on.

    Args:
        scene: The scene, with its motors on.
        drive: The kind of drive, see the module.
    """
    if drive == "torque":
        return
    signs, angles = _closing_signs(scene), closing_angles(scene)
    for joint, sign, angle, limits in zip(
        scene.closing_joints, signs, signs * angles, scene.closing_limits, strict=True
    ):
        # A joint that closed up to its limit may be slightly beyond it.
        _, upper = _signed(limits, sign)
        least = angle if drive == "locked" else min(angle, upper)
        _set_limits(joint, *_signed((least, angle if drive == "locked" else upper), sign))
    if drive == "worm":
        _start_worms(scene)


def disengage(scene: Scene) -> None:
    """Restore the limits of the closing joints and their motors to those of the hand's files."""
    scene.simulator.clear_monitor()
    for i, joint in enumerate(scene.closing_joints):
        _set_limits(joint, *scene.closing_limits[i])
        scene.motors[i].set_effort_limit(scene.effort_limits[i])


def hand_over(scene: Scene, before: Scene) -> None:
    """Move the drive's state to the scene that continues the lift.

    Args:
        scene: The scene that continues, with the state of the other one.
        before: The scene that simulated the lift until now.
    """
    for i, joint in enumerate(before.closing_joints):
        _set_limits(scene.closing_joints[i], *joint_limits(joint))
        scene.motors[i].set_effort_limit(before.motors[i].effort_limit())

    worms_turn = before.simulator.get_monitor() is not None
    disengage(before)
    if worms_turn:
        _start_worms(scene)


def opening_torques(scene: Scene) -> Array:
    """Return the torque (m,) [N m or N] by which contacts now push each closing joint open.

    Contacts act on joint j of the hand with the torque τ_j = Σ J_jᵀ f. The sum is over all contact
    forces f, and J_j dq_j/dt is the velocity that the joint gives to a force's point. If motor i
    moves joint j at the ratio r_ij, virtual work gives the load of its closing joint

        τ_i = − Σ_j r_ij τ_j,   with r = 1 for the closing joint itself.
    """
    # Contact forces in the coordinates of all joints of the hand.
    plant = scene.plant
    port = plant.get_generalized_contact_forces_output_port(scene.instance)
    torques = np.zeros(plant.num_velocities())
    plant.SetVelocitiesInArray(scene.instance, port.Eval(scene.context), torques)

    # A motor moves its joints at fixed ratios, so it supports their torques by the same ratios.
    return _closing_signs(scene) * np.array(
        [
            -sum(ratio * torques[joint.velocity_start()] for joint, ratio in driven.items())
            for driven in scene.driven
        ]
    )


def _closing_signs(scene: Scene) -> Array:
    """Return (m,), 1 for a joint that closes towards larger positions, else -1.

    A joint's own motor pushes towards its commanded position. A joint that passes this position is
    held from both sides.
    """
    if scene.joint_trajectory is None:
        return np.ones(len(scene.closing_joints))
    return np.where(commanded_joints(scene) >= closing_angles(scene), 1.0, -1.0)


def _signed(limits: tuple[float, float], sign: float) -> tuple[float, float]:
    """Return limits unchanged for sign 1, or those of the negative position for sign -1."""
    lower, upper = limits
    return (lower, upper) if sign > 0.0 else (-upper, -lower)


def _start_worms(scene: Scene) -> None:
    turn = partial(_turn_worms, scene)
    turn(scene.simulator.get_context())
    scene.simulator.set_monitor(turn)


def _turn_worms(scene: Scene, _: Context) -> EventStatus:
    """Between two steps, let each worm follow its finger if it closed, or yield to a large load.

    With the position q, the lower limit l and the load τ (`opening_torques`) of a closing joint:

        it holds:   l ← max(l, q);   it yields from the step on at which τ > τ_hold
        it yields:  l ← the limit in the hand's files, and the motor applies up to τ_hold;
                    it holds again, with l ← q, once dq/dt ≥ −`STANDING` u

    where τ_hold is the finger's `holding_effort` and u its `Hand.closing_unit`. For a joint whose
    position decreases as it closes, the signs of q, l and dq/dt are reversed in these formulas.
    """
    signs = _closing_signs(scene)
    angles, rates = signs * closing_angles(scene), signs * closing_rates(scene)

    # Set the limits before the loads are read: Drake solves this state once, for the loads and for
    # the following step.
    for i, effort_limit in enumerate(scene.effort_limits.tolist()):
        joint, motor = scene.closing_joints[i], scene.motors[i]
        lower, upper = _signed(joint_limits(joint), signs[i])
        yields = motor.effort_limit() > effort_limit * (1.0 + ROUNDING)
        if yields and rates[i] >= -STANDING:
            # A finger that yielded is at rest again: from now on the worm holds it here.
            motor.set_effort_limit(effort_limit)
            _set_limits(joint, *_signed((min(angles[i], upper), upper), signs[i]))
        elif not yields and angles[i] > lower:
            _set_limits(joint, *_signed((min(angles[i], upper), upper), signs[i]))

    # A finger whose load exceeds the strength of its worm opens against exactly that torque.
    loads, overloaded = opening_torques(scene), False
    for i, holding_effort in enumerate(scene.holding_efforts):
        assert holding_effort is not None
        motor = scene.motors[i]
        yields = motor.effort_limit() > scene.effort_limits[i] * (1.0 + ROUNDING)
        if loads[i] > holding_effort and not yields:
            _set_limits(scene.closing_joints[i], *scene.closing_limits[i])
            motor.set_effort_limit(holding_effort)
            overloaded = True

    # Drake's solution for this state is then invalid: set the state again so that it is recomputed.
    if overloaded:
        scene.plant.SetPositions(scene.context, scene.plant.GetPositions(scene.context))
    return EventStatus.DidNothing()


def _set_limits(joint: ClosingJoint, lower: float, upper: float) -> None:
    joint.set_position_limits(np.array([lower]), np.array([upper]))
