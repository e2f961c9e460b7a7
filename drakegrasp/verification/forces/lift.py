"""Lifting an object by forces at contact points alone, without a hand.

In: a scene of object and table, the object's resting pose, contact points and normals. Out:
a `ForceLift` with the verdict. First the forces that the lift takes at least are computed:
without any, or with ones beyond what a fingertip can give, the grasp has failed. Then the
lift is simulated. At every control step the forces that carry the object along its path, and
back to it, are computed anew and applied to the body ("applying forces directly",
Veres et al., appendix). They never leave the friction cones nor the limit: what a grasp
cannot give the object does not get, and it strays.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import numpy.typing as npt
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import ExternallyAppliedSpatialForce
from scipy.spatial.transform import Rotation

from drakegrasp.config import Config
from drakegrasp.frames import X_WT, Array, invert_pose, rotation_angle
from drakegrasp.simulation.scene import Scene, advance, reset_object
from drakegrasp.simulation.stepping import StateError
from drakegrasp.simulation.trajectory import LiftPath, carrying_force, lift_path
from drakegrasp.verification.forces.contact_forces import ForceProgram, largest_normal_force

#: Time steps of the simulation between two solutions of the contact forces. In between, the
#: forces keep their direction while the object turns, which drives it on as a squeezed column
#: buckles: at 5 steps this overcame the damping of slim objects (4 of 120 lifts).
STEPS_PER_CONTROL = 1
#: Natural frequency omega of the object about its path, times the control period h. A mass
#: under critically damped feedback that is held over h is stable up to omega h = 1; at a fifth
#: of that an error dies without overshoot, as under feedback that is not sampled.
FREQUENCY_TIMES_PERIOD = 0.2
#: An object that is this many times as far from its path as it may be in the end is lost.
LOST = 10.0


class LiftEnd(StrEnum):
    """How a lift by forces ended."""

    HELD = "held"  # the object arrived, in position and orientation
    INFEASIBLE = "infeasible"  # no forces within friction carry the object
    OVER_LIMIT = "over_limit"  # they exist, but are larger than a fingertip's
    STRAYED = "strayed"  # simulated, and the object left its path or was elsewhere in the end
    ERROR = "error"  # Drake or the solver failed; says nothing about the grasp
    TIMEOUT = "timeout"  # the attempt's wall-clock limit passed; neither does this


@dataclass(frozen=True, kw_only=True, eq=False)
class ForceLift:
    """The result of one lift by forces. What was not reached is NaN or None.

    Attributes:
        end: How it ended.
        planned_force: Largest normal force that the lift takes at least [N]; inf if no
            forces carry the object.
        applied_force: Largest normal force that was applied [N].
        position_error: Distance of the object's origin from its path at the end, or when it
            was lost [m].
        angle_error: Of its orientation then [rad].
        X_TO_lifted: Its pose then, (4, 4).
        steps: Control steps that were simulated.
        message: Text of the error for `error`, else empty.
    """

    end: LiftEnd
    planned_force: float
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
    scene: Scene,
    X_TO: npt.ArrayLike,
    p_OQ: npt.ArrayLike,
    nhat_Q_O: npt.ArrayLike,
    *,
    force_limit: float,
    config: Config,
) -> ForceLift:
    """Return what happens when forces at contact points lift the object.

    The object moves along `trajectory.lift_path`, and then stays for `lift.hold_time`. Friction
    is `physics.friction_hand`. The same arguments give the same bits, whatever ran before.

    Args:
        scene: Of the object, without a hand.
        X_TO: Resting pose of the object, (4, 4).
        p_OQ: (k, 3), contact points in {O} [m].
        nhat_Q_O: (k, 3), unit normals out of the object in {O}; a finger pushes against one.
        force_limit: Of each normal force [N].
        config: The rules.

    Raises:
        ValueError: If the scene has a hand.
    """
    if scene.handles is not None:
        raise ValueError("the scene must have no hand, got one with a hand")
    path = lift_path(X_TO, config)
    program = ForceProgram(p_OQ, nhat_Q_O, scene.model.p_OOcm, config.physics.friction_hand)
    force = largest_normal_force(program, path.wrenches(scene.model))
    if not np.isfinite(force):
        return ForceLift(end=LiftEnd.INFEASIBLE, planned_force=force)
    if force > force_limit:
        return ForceLift(end=LiftEnd.OVER_LIMIT, planned_force=force)
    fingers = _Fingers(scene, np.asarray(p_OQ, dtype=float), program, force_limit)
    try:
        return _simulate(fingers, force, path, config)
    except (MemoryError, OSError):
        raise  # the machine's, not the grasp's
    # A failed assertion within Drake arrives as SystemExit.
    except (Exception, SystemExit) as error:
        lines = str(error).strip().splitlines() or [type(error).__name__]
        return ForceLift(end=LiftEnd.ERROR, planned_force=force, message=lines[0])
    finally:
        fingers.let_go()


@dataclass(frozen=True, eq=False)
class _Fingers:
    """Applies contact forces to the object; the points are fixed to it."""

    scene: Scene
    p_OQ: Array  # (k, 3) [m]
    program: ForceProgram
    force_limit: float  # [N]

    def push(self, wrench_O: Array) -> float:
        """Apply the forces that give a wrench, or come closest; return the largest normal one."""
        forces = self.program.smallest(wrench_O)
        if forces.largest_normal > self.force_limit:
            forces = self.program.closest(wrench_O, self.force_limit)
        if not np.isfinite(forces.largest_normal):
            raise StateError("contact forces must be found at every step, got none")
        R_WO = self.scene.pose(self.scene.object)[:3, :3]
        self._apply(forces.f_Q_O @ R_WO.T)
        return forces.largest_normal

    def let_go(self) -> None:
        """Leave no force behind in the scene."""
        self._apply(np.zeros_like(self.p_OQ))

    def _apply(self, f_Q_W: Array) -> None:
        applied = []
        for p, f in zip(self.p_OQ, f_Q_W, strict=True):
            force = ExternallyAppliedSpatialForce()
            force.body_index = self.scene.object.index()
            force.p_BoBq_B = p
            force.F_Bq_W = SpatialForce(np.zeros(3), f)
            applied.append(force)
        port = self.scene.plant.get_applied_spatial_force_input_port()
        port.FixValue(self.scene.context, applied)


def _simulate(fingers: _Fingers, planned: float, path: LiftPath, config: Config) -> ForceLift:
    scene = fingers.scene
    period = STEPS_PER_CONTROL * config.physics.time_step
    steps = int(np.ceil((path.duration + config.lift.hold_time) / period))
    fingers.let_go()
    reset_object(scene, path.X_WO)
    scene.simulator.Initialize()
    largest, done = 0.0, 0
    deviation = (0.0, 0.0)
    end = time.monotonic() + config.attempt_seconds
    while done < steps and _within(deviation, config, LOST):
        if time.monotonic() > end:
            return ForceLift(end=LiftEnd.TIMEOUT, planned_force=planned)
        wrench_O = _wanted_wrench(scene, path, FREQUENCY_TIMES_PERIOD / period)
        largest = max(largest, fingers.push(wrench_O))
        advance(scene, period)
        deviation = _deviation(scene, path)
        done += 1
    if not np.isfinite(deviation).all():
        raise StateError("the object's pose must stay finite, got one that is not")
    arrived = done == steps and _within(deviation, config, 1.0)
    return ForceLift(
        planned_force=planned,
        end=LiftEnd.HELD if arrived else LiftEnd.STRAYED,
        applied_force=largest,
        position_error=deviation[0],
        angle_error=deviation[1],
        X_TO_lifted=invert_pose(X_WT) @ scene.pose(scene.object),
        steps=done,
    )


def _deviation(scene: Scene, path: LiftPath) -> tuple[float, float]:
    """Return how far the object is from its path now [m], and by how much it is turned [rad]."""
    X_WO = scene.pose(scene.object)
    p, _, _ = path.at(scene.time)
    return float(np.linalg.norm(X_WO[:3, 3] - p)), rotation_angle(X_WO[:3, :3] @ path.R_WO.T)


def _within(deviation: tuple[float, float], config: Config, times: float) -> bool:
    """Return whether a deviation is within so many times the one that is allowed in the end."""
    rules = config.verify
    allowed = rules.max_position_error, np.deg2rad(rules.max_angle_error_deg)
    return all(d <= times * limit for d, limit in zip(deviation, allowed, strict=True))


def _wanted_wrench(scene: Scene, path: LiftPath, frequency: float) -> Array:
    """Return the wrench (6,) about Ocm in {O} that carries the object along its path.

    Against gravity and inertia, plus critically damped feedback of both errors: with a
    natural frequency omega [rad/s] an error e is accelerated by omega^2 e + 2 omega de/dt.
    """
    model = scene.model
    X_WO = scene.pose(scene.object)
    R_WO = X_WO[:3, :3]
    velocity = scene.plant.EvalBodySpatialVelocityInWorld(scene.context, scene.object)
    turning = np.array(velocity.rotational())
    p, v, a = path.at(scene.time)

    # The path is that of the origin; forces act on the centre of mass.
    arm = R_WO @ model.p_OOcm
    position_error = p + path.R_WO @ model.p_OOcm - (X_WO[:3, 3] + arm)
    velocity_error = v - (velocity.translational() + np.cross(turning, arm))
    acceleration = a + frequency**2 * position_error + 2.0 * frequency * velocity_error
    force_W = carrying_force(model, acceleration)

    angle_error = Rotation.from_matrix(path.R_WO @ R_WO.T).as_rotvec()
    I_W = R_WO @ model.I_OOcm_O @ R_WO.T
    spin = I_W @ (frequency**2 * angle_error - 2.0 * frequency * turning)
    torque_W = spin + np.cross(turning, I_W @ turning)  # Euler's equation
    return np.concatenate([R_WO.T @ torque_W, R_WO.T @ force_W])
