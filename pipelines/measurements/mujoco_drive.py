"""The drive of the fingers in MuJoCo, for mujoco_baseline.py.

The rules are those of `drakegrasp.simulation.drive`. MuJoCo's joint limits replace its holding;
the motor's torque stays on.
"""

from __future__ import annotations

import mujoco
import numpy as np

from drakegrasp.frames import Array
from drakegrasp.hand.description import Hand
from drakegrasp.hand.file_format import Drive


class FingerDrive:
    """Keeps the closing joints of a hand from being pushed open during a lift."""

    def __init__(self, model: mujoco.MjModel, hand: Hand, drive: Drive) -> None:
        """Find the joints and motors.

        Args:
            model: Model with the joints and motors of `mujoco_scene`; its limits are changed.
            hand: The hand.
            drive: What holds the closing joints, see `drakegrasp.simulation.drive`.
        """
        self._model, self._drive = model, drive
        fingers = [hand.fingers[i] for i in hand.motor_fingers]
        self._joints = np.array([model.joint(f.closing_joint).id for f in fingers])
        self._motors = np.array([model.actuator(f.name).id for f in fingers])
        self._q, self._v = model.jnt_qposadr[self._joints], model.jnt_dofadr[self._joints]
        # A motor moves its joints at fixed ratios, so it supports their torques by the same ratios.
        self._gain = np.zeros((len(self._joints), model.nv))
        for i, finger in enumerate(hand.motor_fingers):
            self._gain[i, self._v[i]] = 1.0
            for coupling in hand.followers(finger):
                self._gain[i, model.joint(coupling.joint).dofadr[0]] = coupling.ratio
        self._range = model.jnt_range[self._joints].copy()
        self._torque = np.array([finger.effort_limit for finger in fingers])
        self._holding = np.array([finger.holding_effort or np.inf for finger in fingers])
        self._yields = np.zeros(len(self._joints), dtype=np.bool_)

    def disengage(self) -> None:
        """Restore the limits of joints and motors to those of the hand's files."""
        self._yields[:] = False
        self._model.jnt_range[self._joints] = self._range
        self._set_torques()

    def engage(self, data: mujoco.MjData) -> None:
        """Let the drive hold the closing joints at their angles from now on."""
        if self._drive != "torque":
            self._model.jnt_range[self._joints, 0] = data.qpos[self._q]
        if self._drive == "locked":
            self._model.jnt_range[self._joints, 1] = data.qpos[self._q]

    def update(self, data: mujoco.MjData) -> None:
        """After a step, let each worm follow its finger if it closed, or yield to a large load."""
        if self._drive != "worm":
            return

        # A finger that was pushed open is held again when it stops or closes.
        angles, lower = data.qpos[self._q], self._model.jnt_range[self._joints, 0]
        held_again = self._yields & (data.qvel[self._v] >= 0.0)
        lower = np.where(
            held_again, angles, np.where(self._yields, lower, np.maximum(lower, angles))
        )
        self._yields &= ~held_again

        # A worm yields to a load beyond its strength; its finger opens against this strength.
        loads = self.loads(data)
        overloaded = ~self._yields & ~held_again & (loads > self._holding)
        self._yields |= overloaded
        lower = np.where(overloaded, self._range[:, 0], lower)
        self._model.jnt_range[self._joints, 0] = np.minimum(lower, self._range[:, 1])
        self._set_torques()

    def loads(self, data: mujoco.MjData) -> Array:
        """Return the loads (m,) by which contacts pushed motors open in the last step [N m or N].

        Torques that a caller applies to joints count as contacts. Reactions of motors and limits do
        not count, because they are larger for one step if a finger runs into its limit.
        """
        is_contact = data.efc_type >= int(mujoco.mjtConstraint.mjCNSTR_CONTACT_FRICTIONLESS)
        torques = np.zeros(self._model.nv)
        forces = np.where(is_contact, data.efc_force, 0.0)
        mujoco.mj_mulJacTVec(self._model, data, torques, forces)
        return np.asarray(-self._gain @ (torques + data.qfrc_applied))

    def _set_torques(self) -> None:
        torque = np.where(self._yields, self._holding, self._torque)
        self._model.actuator_forcerange[self._motors] = np.column_stack([-torque, torque])
