"""Lifting an object by forces at contact points alone, without a hand.

In: a scene of object and table, the object's resting pose, contact points and normals. Out: a
`ForceLift` with the verdict. The smallest forces for the lift are computed first: if there are
none, or one is larger than its fingertip's limit, the grasp fails. Otherwise the lift is
simulated. At every control step the forces that keep the object on its path are computed again
and applied to the body ("applying forces directly", Veres et al., appendix), with the torsional
moments of the contacts of a hand with two fingertips. They never leave the friction cones or exceed
the limits; if they are not enough, the object leaves its path.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
import numpy.typing as npt
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import ExternallyAppliedSpatialForce
from scipy.spatial.transform import Rotation

from drakegrasp.config import Config
from drakegrasp.errors import first_line
from drakegrasp.frames import X_WT, Array, invert_pose, rotation_angle
from drakegrasp.simulation.scene import ObjectScene, advance, reset_object
from drakegrasp.simulation.stepping import StateError
from drakegrasp.simulation.trajectory import LiftPath, carrying_force, lift_path
from drakegrasp.verification.forces.contact_forces import (
    ForceProgram,
    GraspContacts,
    hardest_forces,
)

#: Time steps of the simulation per solution of the contact forces. Between two solutions the
#: forces keep their direction while the object turns, which turns it further, as in a column that
#: buckles. With 5 steps this overcame the damping of slim objects in 4 of 120 lifts.
STEPS_PER_CONTROL = 1
#: Natural frequency omega of the feedback times the control period h. Critically damped feedback
#: that is held constant over h is stable up to omega h = 1; at a fifth of that an error decays
#: without overshoot, as under continuous feedback.
FREQUENCY_TIMES_PERIOD = 0.2
#: The simulation stops when the object is this many times as far from its path as allowed at the
#: end.
LOST = 10.0


class LiftEnd(StrEnum):
    """How a lift by forces ended."""

    HELD = "held"  # the object arrived, in position and orientation
    INFEASIBLE = "infeasible"  # no forces within friction carry the object
    OVER_LIMIT = "over_limit"  # they exist, but are larger than a fingertip's
    STRAYED = "strayed"  # simulated, and the object left its path or missed its target
    ERROR = "error"  # Drake or the solver failed; says nothing about the grasp
    TIMEOUT = "timeout"  # the wall-clock limit passed; says nothing about the grasp


@dataclass(frozen=True, kw_only=True, eq=False)
class ForceLift:
    """The result of one lift by forces. Values of stages that were not reached are NaN or None.

    Attributes:
        end: How it ended.
        planned_force: Normal force of the finger that takes the largest share of its limit, where
            that share is as small as the lift allows [N]; inf if no forces carry the object.
        planned_share: That share; above 1 the fingers are too weak.
        applied_force: Largest normal force that was applied [N].
        position_error: Distance of the object's origin from its path when the simulation ended
            [m].
        angle_error: Angle between its orientation and that of the path then [rad].
        X_TO_lifted: Its pose then, (4, 4).
        steps: Number of simulated control steps.
        message: Text of the error if `end` is `error`, else empty.
    """

    end: LiftEnd
    planned_force: float
    planned_share: float
    applied_force: float = np.nan
    position_error: float = np.nan
    angle_error: float = np.nan
    X_TO_lifted: Array | None = None
    steps: int = 0
    message: str = ""

    @property
    def held(self) -> bool:
        """Whether the forces lifted the object to the target."""
        return self.end is LiftEnd.HELD


def lift_by_forces(
    scene: ObjectScene, X_TO: npt.ArrayLike, contacts: GraspContacts, config: Config
) -> ForceLift:
    """Return what happens when forces at contact points lift the object.

    The object moves along `trajectory.lift_path` and then rests for `lift.hold_time`. Friction is
    the object's own, or `physics.friction_hand`. The same arguments give the same bits, whatever
    ran before.

    Args:
        scene: Of the object; a hand would be in the way.
        X_TO: Resting pose of the object, (4, 4).
        contacts: Where the forces act, and how large they may be.
        config: Physics, lift and limits.
    """
    # Are there forces within the limit at all?
    path = lift_path(X_TO, config)
    friction = scene.model.own_physics(config.physics).friction_hand
    program = ForceProgram(contacts, friction)
    needed = hardest_forces(program, path.wrenches(scene.model))
    force = float(needed.normal[np.argmax(needed.shares)])
    planned = ForceLift(end=LiftEnd.INFEASIBLE, planned_force=force, planned_share=needed.share)
    if not np.isfinite(force):
        return planned
    if needed.share > 1.0:
        return replace(planned, end=LiftEnd.OVER_LIMIT)

    # Simulate the lift.
    fingers = _Fingers(scene, np.asarray(contacts.p_OQ, dtype=float), program)
    try:
        return _simulate(fingers, planned, path, config)
    except (MemoryError, OSError):
        raise  # the machine failed, not the grasp
    # A failed assertion within Drake arrives as SystemExit.
    except (Exception, SystemExit) as error:
        return replace(planned, end=LiftEnd.ERROR, message=first_line(error))
    finally:
        fingers.release()


@dataclass(frozen=True, eq=False)
class _Fingers:
    """Applies contact forces to the object at points that are fixed to it."""

    scene: ObjectScene
    p_OQ: Array  # (k, 3) [m]
    program: ForceProgram

    def push(self, wrench_O: Array) -> float:
        """Apply the forces that give the object a wrench (6,), or come closest to it.

        Returns:
            The largest normal force [N].
        """
        forces = self.program.smallest(wrench_O)
        if forces.share > 1.0:
            forces = self.program.closest(wrench_O)
        if not np.isfinite(forces.largest_normal):
            raise StateError("the solver found no contact forces")
        R_WO = self.scene.pose(self.scene.object)[:3, :3]
        self._apply(forces.f_Q_O @ R_WO.T, forces.tau_Q_O @ R_WO.T)
        return forces.largest_normal

    def release(self) -> None:
        """Remove all forces from the scene."""
        self._apply(np.zeros_like(self.p_OQ), np.zeros_like(self.p_OQ))

    def _apply(self, f_Q_W: Array, tau_Q_W: Array) -> None:
        """Apply forces [N] and moments [N m], (k, 3) each in {W}, until the next call."""
        applied = []
        for p, f, tau in zip(self.p_OQ, f_Q_W, tau_Q_W, strict=True):
            force = ExternallyAppliedSpatialForce()
            force.body_index = self.scene.object.index()
            force.p_BoBq_B = p
            force.F_Bq_W = SpatialForce(tau, f)
            applied.append(force)
        port = self.scene.plant.get_applied_spatial_force_input_port()
        port.FixValue(self.scene.context, applied)


def _simulate(fingers: _Fingers, planned: ForceLift, path: LiftPath, config: Config) -> ForceLift:
    """Simulate the lift along a path, and return what was planned with what happened."""
    # The object rests at the start of its path.
    scene = fingers.scene
    period = STEPS_PER_CONTROL * config.physics.time_step
    steps = int(np.ceil((path.duration + config.lift.hold_time) / period))
    fingers.release()
    reset_object(scene, path.X_WO)
    scene.simulator.Initialize()

    # Carry it along, until it has arrived or is lost.
    largest, done = 0.0, 0
    deviation = (0.0, 0.0)
    end = time.thread_time() + config.attempt_seconds
    while done < steps and _within(deviation, config, LOST):
        if time.thread_time() > end:
            return replace(planned, end=LiftEnd.TIMEOUT)
        wrench_O = _wanted_wrench(scene, path, FREQUENCY_TIMES_PERIOD / period)
        largest = max(largest, fingers.push(wrench_O))
        advance(scene, period)
        deviation = _deviation(scene, path)
        done += 1
    if not np.isfinite(deviation).all():
        raise StateError("the object's pose is not finite")

    # Has it arrived?
    arrived = done == steps and _within(deviation, config, 1.0)
    return replace(
        planned,
        end=LiftEnd.HELD if arrived else LiftEnd.STRAYED,
        applied_force=largest,
        position_error=deviation[0],
        angle_error=deviation[1],
        X_TO_lifted=invert_pose(X_WT) @ scene.pose(scene.object),
        steps=done,
    )


def _deviation(scene: ObjectScene, path: LiftPath) -> tuple[float, float]:
    """Return the object's distance from its path [m], and its angle to it [rad]."""
    X_WO = scene.pose(scene.object)
    p, _, _ = path.at(scene.time)
    return float(np.linalg.norm(X_WO[:3, 3] - p)), rotation_angle(X_WO[:3, :3] @ path.R_WO.T)


def _within(deviation: tuple[float, float], config: Config, times: float) -> bool:
    """Return whether a deviation is at most `times` the one that is allowed at the end."""
    rules = config.verify
    allowed = rules.max_position_error, np.deg2rad(rules.max_angle_error_deg)
    return all(d <= times * limit for d, limit in zip(deviation, allowed, strict=True))


def _wanted_wrench(scene: ObjectScene, path: LiftPath, frequency: float) -> Array:
    """Return the wrench (6,) about Ocm in {O} that keeps the object on its path [N m, N].

    It balances gravity and inertia, and corrects errors of position and orientation by critically
    damped feedback of the natural frequency ω [rad/s]. With the path's acceleration a*, the errors
    e of position and θ of orientation (a rotation vector), the object's angular velocity Ω, its
    mass m and its inertia I about the centre of mass:

        F = m (a* + ω² e + 2 ω de/dt + g ẑ)
        τ = I (ω² θ − 2 ω Ω) + Ω × I Ω   (Euler; the path does not turn)
    """
    # The object's motion, and that of the path.
    model = scene.model
    X_WO = scene.pose(scene.object)
    R_WO = X_WO[:3, :3]
    velocity = scene.plant.EvalBodySpatialVelocityInWorld(scene.context, scene.object)
    turning = np.array(velocity.rotational())
    p, v, a = path.at(scene.time)

    # Force on the centre of mass; the path is that of the origin.
    arm = R_WO @ model.p_OOcm
    position_error = p + path.R_WO @ model.p_OOcm - (X_WO[:3, 3] + arm)
    velocity_error = v - (velocity.translational() + np.cross(turning, arm))
    acceleration = a + frequency**2 * position_error + 2.0 * frequency * velocity_error
    force_W = carrying_force(model, acceleration)

    # Torque about it, by Euler's equation.
    angle_error = Rotation.from_matrix(path.R_WO @ R_WO.T).as_rotvec()
    I_W = R_WO @ model.I_OOcm_O @ R_WO.T
    spin = I_W @ (frequency**2 * angle_error - 2.0 * frequency * turning)
    torque_W = spin + np.cross(turning, I_W @ turning)
    return np.concatenate([R_WO.T @ torque_W, R_WO.T @ force_W])
