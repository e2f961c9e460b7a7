"""Simulates the same attempts in MuJoCo, to compare with Drake's speed and labels.

Input: a prepared object and attempts. Output: their outcomes. MuJoCo uses convex parts of the
object for collisions, and contacts are points. No attempt is screened and no image is rendered.
Otherwise the trial is that of `drakegrasp.simulation.trial`: the same hand, drive, pads, path and
verdict. Needs the extra `[peer]`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco_drive import FingerDrive
from mujoco_scene import IMMOVABLE, build_mujoco_scene

from drakegrasp.config import Config
from drakegrasp.frames import X_WT, Array, invert_pose, make_pose, rotation_angle
from drakegrasp.hand.description import load_plain_hand
from drakegrasp.hand.kinematics import within_load
from drakegrasp.mjcf import TIME_STEP, pair_friction, quaternion
from drakegrasp.objects.model import ObjectModel
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation.attempt import Attempt, Materials, usual_materials
from drakegrasp.simulation.contacts import MAX_BESIDE
from drakegrasp.simulation.drive import drive_of
from drakegrasp.simulation.lift import lift_duration
from drakegrasp.simulation.trial import judge_closed, judge_lifted

#: Time steps between two checks while closing, and while lifting.
CLOSING_STRIDE, LIFTING_STRIDE = 25, 50
#: Fingers start from rest, so slow fingers have stopped only after this time [s].
STARTING = 0.3


@dataclass(frozen=True, kw_only=True)
class PeerTrial:
    """The result of one attempt in MuJoCo.

    Attributes:
        outcome: The verdict.
        tried: Whether the closed hand was allowed to lift.
        slip: Distance by which {O} moved in {G} during the lift [m]; NaN if no lift was tried.
        turn: Angle by which {O} rotated in {G} during the lift [rad]; NaN if no lift was tried.
    """

    outcome: Outcome
    tried: bool = False
    slip: float = np.nan
    turn: float = np.nan


@dataclass(frozen=True, kw_only=True, eq=False)
class PeerContacts:
    """The contacts at one instant, for a hand of k fingers.

    Attributes:
        touching: (k,), whether each fingertip presses on the object with its pad.
        other_links: Number of links that touch the object, other than fingertips with their pads.
        hand_on_table, object_on_table: Whether hand and object touch the table.
    """

    touching: np.ndarray
    other_links: int
    hand_on_table: bool
    object_on_table: bool


class MujocoBaseline:
    """One object, the table and the hand in MuJoCo."""

    def __init__(self, model: ObjectModel, X_TO: Array, config: Config) -> None:
        """Build the scene.

        Args:
            model: The object.
            X_TO: Resting pose of the object, (4, 4).
            config: The configuration: hand, friction, closing and lift.

        Raises:
            ConfigError: See `drive_of`.
            HandError: If the hand has preshapes.
        """
        self._config = config
        plain = load_plain_hand(config.hand_source, "attempts in MuJoCo")
        self._hand = within_load(plain, config.physics.finger_load)
        self._usual = usual_materials(model, config.physics)
        self.place(X_TO)
        scene = build_mujoco_scene(model, self._hand, config)
        self._spreads = scene.spreads
        self._model, self._data = scene.model, mujoco.MjData(scene.model)
        self._drive = FingerDrive(self._model, self._hand, drive_of(self._hand, config.lift))
        self._find_addresses()

    def _find_addresses(self) -> None:
        """Look up the places of bodies and joints in MuJoCo's arrays."""
        m, hand = self._model, self._hand
        self._object, self._palm = m.body("object").id, m.body(hand.palm_link).id
        self._tips = [m.body(finger.fingertip).id for finger in hand.fingers]
        self._table = m.geom("table").id
        self._wrist_q = [m.joint(f"wrist_{axis}").qposadr[0] for axis in "xyz"]
        self._wrist_v = [m.joint(f"wrist_{axis}").dofadr[0] for axis in "xyz"]
        q, v = m.joint("object").qposadr[0], m.joint("object").dofadr[0]
        self._object_q, self._object_v = slice(q, q + 7), slice(v, v + 6)
        self._object_inertia = m.dof_M0[self._object_v].copy()
        self._weights = {name: getattr(m, name)[at].copy() for name, at in self._weighed()}
        closing = [hand.fingers[i].closing_joint for i in hand.motor_fingers]
        self._closing_v = [m.joint(name).dofadr[0] for name in closing]
        coupled = [coupling for i in hand.motor_fingers for coupling in hand.followers(i)]
        self._followers = {m.joint(c.joint).qposadr[0]: c.offset for c in coupled}

    def _weighed(self) -> Iterator[tuple[str, int | slice]]:
        """Yield MuJoCo's arrays that scale with the object's mass, and the object's place in them.

        Arrays named `invweight0` scale with the inverse of the mass.
        """
        body, velocity = self._object, self._object_v
        for name in ("body_mass", "body_subtreemass", "body_inertia", "body_invweight0"):
            yield name, body
        for name in ("dof_M0", "dof_invweight0"):
            yield name, velocity

    def _set_materials(self, materials: Materials) -> None:
        """Set the object's mass, and the coefficient of friction of each side."""
        m, factor = self._model, materials.mass / self._usual.mass
        for name, at in self._weighed():
            scale = 1.0 / factor if name.endswith("invweight0") else factor
            getattr(m, name)[at] = scale * self._weights[name]
        self._object_inertia = m.dof_M0[self._object_v].copy()
        m.geom_friction[:] = pair_friction(materials.friction_hand)
        m.geom_friction[self._table] = pair_friction(materials.friction_table)

    def place(self, X_TO: Array) -> None:
        """Set the object's resting pose (4, 4) for the following attempts."""
        self._X_WO = X_WT @ X_TO

    def run(self, attempt: Attempt) -> PeerTrial:
        """Return the result of one attempt; its fingers close from the open hand."""
        # Check palm pose and start, as in a trial.
        if not attempt.ray_hits:
            return PeerTrial(outcome=Outcome.RAY_MISS)
        X_WG = self._X_WO @ attempt.X_OG
        if X_WG[2, 3] <= X_WT[2, 3]:
            return PeerTrial(outcome=Outcome.BELOW_TABLE)
        conditions = attempt.conditions
        self._set_materials(self._usual if conditions is None else conditions.materials)
        self._reset(X_WG, attempt.spread)
        if self._open_hand_collides():
            return PeerTrial(outcome=Outcome.START_COLLISION)

        # Close on the clamped object and judge the contacts.
        self._close()
        closed = self._contacts()
        verdict = judge_closed(
            closed.touching, closed.other_links, closed.hand_on_table, required=self._hand.required
        )
        if verdict is not Outcome.SUCCESS:
            return PeerTrial(outcome=verdict)

        # Lift, and judge what the hand then holds.
        X_GO = self._object_in_hand()
        self._lift(X_WG)
        lifted = self._contacts()
        verdict = judge_lifted(
            lifted.touching,
            lifted.other_links,
            lifted.object_on_table,
            required=self._hand.required,
        )
        motion = invert_pose(X_GO) @ self._object_in_hand()
        return PeerTrial(
            outcome=verdict,
            tried=True,
            slip=float(np.linalg.norm(motion[:3, 3])),
            turn=rotation_angle(motion[:3, :3]),
        )

    def _reset(self, X_WG: Array, spread: float) -> None:
        """Put the open hand at its start, and the object at rest so that no contact moves it."""
        m, d = self._model, self._data
        mujoco.mj_resetData(m, d)
        self._drive.disengage()
        self._clamp_object(True)

        # The wrist has no rotation and the spread is locked, so both are rotations of bodies.
        X_WB = X_WG @ invert_pose(self._hand.X_BG)
        m.body_quat[self._palm] = quaternion(X_WB[:3, :3])
        for spread_joint in self._spreads:
            m.body_quat[m.body(spread_joint.body).id] = spread_joint.orientation(spread)

        for joint, position in self._followers.items():
            d.qpos[joint] = position
        d.qpos[self._wrist_q] = X_WB[:3, 3]
        d.qpos[self._object_q] = [*self._X_WO[:3, 3], *quaternion(self._X_WO[:3, :3])]
        mujoco.mj_forward(m, d)

    def _clamp_object(self, clamp: bool) -> None:
        """Give the object an inertia so large that no contact moves it, or its own inertia."""
        # MuJoCo uses dof_M0 for the inertia of a body whose centre of mass is its origin.
        added = IMMOVABLE if clamp else 0.0
        self._model.dof_armature[self._object_v] = added
        self._model.dof_M0[self._object_v] = self._object_inertia + added

    def _close(self) -> None:
        """Close the fingers on the object, which is held in place, until they stop."""
        d = self._data
        motors = self._hand.motor_fingers
        d.ctrl[:], unit = self._hand.closing_speed[motors], self._hand.closing_unit[motors]
        resting, palm, step = d.qpos[self._object_q].copy(), d.qpos[self._wrist_q].copy(), 0
        while d.time < self._config.close.max_time:
            self._step(palm)
            d.qpos[self._object_q], d.qvel[self._object_v] = resting, 0.0
            step += 1
            if step % CLOSING_STRIDE == 0 and d.time > STARTING:
                speed = np.abs(d.qvel[self._closing_v] / unit).max()
                if speed < self._config.close.stop_speed:
                    return

    def _lift(self, X_WG: Array) -> None:
        """Free the object, move the wrist to its target and hold it; end early if all is lost."""
        d, rules = self._data, self._config.lift
        self._clamp_object(False)
        self._drive.engage(d)

        # The wrist does not move while the object is released; then it moves as in Drake.
        path = lift_path(invert_pose(X_WT) @ X_WG, self._config)
        p_WB = d.qpos[self._wrist_q].copy()
        steps = round((rules.release_time + path.duration + rules.hold_time) / TIME_STEP)
        for step in range(1, steps + 1):
            time = max(step * TIME_STEP - rules.release_time, 0.0)
            self._step(p_WB + path.at(time)[0] - X_WG[:3, 3])
            self._drive.update(d)
            if step % LIFTING_STRIDE == 0:
                contacts = self._contacts()
                if not contacts.touching.any() and not contacts.other_links:
                    return

    def _step(self, p_WB: Array) -> None:
        """Simulate one step in which the wrist moves to a position (3,) [m]."""
        d = self._data
        d.qvel[self._wrist_v] = (p_WB - d.qpos[self._wrist_q]) / TIME_STEP
        mujoco.mj_step(self._model, d)

    def _object_in_hand(self) -> Array:
        """Return the pose X_GO (4, 4) of the object in the palm frame."""
        d = self._data
        X_WB = make_pose(d.xmat[self._palm].reshape(3, 3), d.xpos[self._palm])
        X_WO = make_pose(d.xmat[self._object].reshape(3, 3), d.xpos[self._object])
        return invert_pose(X_WB @ self._hand.X_BG) @ X_WO

    def _open_hand_collides(self) -> bool:
        """Return whether the hand intersects object or table."""
        bodies, d = self._model.geom_bodyid, self._data
        return any(
            contact.dist <= 0.0
            and {bodies[contact.geom1], bodies[contact.geom2]} - {self._object, bodies[self._table]}
            for contact in d.contact[: d.ncon]
        )

    def _contacts(self) -> PeerContacts:
        """Return the contacts of the last step; contacts weaker than the limit do not count."""
        m, d, limit = self._model, self._data, self._config.physics.contact_force
        # For each fingertip, on its pad and beside it: the force, and the sum of normal forces.
        tips, pressure = np.zeros((len(self._tips), 2, 3)), np.zeros((len(self._tips), 2))
        others, hand_on_table, object_on_table = dict[int, float](), 0.0, np.zeros(3)
        for i, contact in enumerate(d.contact[: d.ncon]):
            # The force of the second body on the first, in the world's frame.
            wrench = np.zeros(6)
            mujoco.mj_contactForce(m, d, i, wrench)
            force = contact.frame.reshape(3, 3).T @ wrench[:3]
            one, two = m.geom_bodyid[contact.geom1], m.geom_bodyid[contact.geom2]
            link = int(two if one == self._object else one)
            signed = force if one == self._object else -force

            # Sum by the kind of pair: with the table, or of the object with a link of the hand.
            if self._table in (contact.geom1, contact.geom2):
                if self._object in (one, two):
                    object_on_table += signed
                else:
                    hand_on_table += float(np.linalg.norm(force))
            elif self._object not in (one, two):
                continue
            elif link in self._tips:
                beside = int(not self._on_pad(link, contact.pos))
                tips[self._tips.index(link), beside] += signed
                pressure[self._tips.index(link), beside] += wrench[0]
            else:
                others[link] = others.get(link, 0.0) + float(np.linalg.norm(force))

        # As in Drake, contact that is mostly on the pad is the fingertip's; other contact is split.
        whole = pressure[:, 1] <= MAX_BESIDE * pressure.sum(axis=1)
        tips[whole] = np.stack([tips[whole].sum(axis=1), np.zeros((whole.sum(), 3))], axis=1)
        on_pad, beside = np.moveaxis(np.linalg.norm(tips, axis=2) > limit, 1, 0)
        return PeerContacts(
            touching=on_pad,
            other_links=int(beside.sum()) + sum(force > limit for force in others.values()),
            hand_on_table=hand_on_table > limit,
            object_on_table=bool(np.linalg.norm(object_on_table) > limit),
        )

    def _on_pad(self, link: int, p_WQ: Array) -> bool:
        """Return whether a point (3,) of a fingertip link [m] lies on its pad."""
        R_WF = self._data.xmat[link].reshape(3, 3)
        finger = self._hand.fingers[self._tips.index(link)]
        return bool(finger.on_pad((p_WQ - self._data.xpos[link]) @ R_WF))


@dataclass(frozen=True, kw_only=True, eq=False)
class LiftPath:
    """A straight motion of an object at constant orientation.

    Attributes:
        X_WO: Pose at the start, (4, 4).
        p_WO_end: Position of {O} at the end, (3,) [m].
        duration: Duration of the motion [s], positive; the object stays at the end afterwards.
    """

    X_WO: Array
    p_WO_end: Array
    duration: float

    def at(self, time: float) -> tuple[Array, Array, Array]:
        """Return position [m], velocity [m/s] and acceleration [m/s^2] of {O} at a time [s].

        With s = t / T from 0 to 1 over the duration T, and the whole path d (Flash and Hogan,
        1985):

            p = p₀ + d (10 s³ − 15 s⁴ + 6 s⁵)
            v = d 30 s² (1 − s)² / T
            a = d 60 s (1 − s) (1 − 2 s) / T²
        """
        s = min(time / self.duration, 1.0)
        start = self.X_WO[:3, 3]
        shift = self.p_WO_end - start
        return (
            start + shift * s**3 * (10.0 - 15.0 * s + 6.0 * s**2),
            shift * 30.0 * s**2 * (1.0 - s) ** 2 / self.duration,
            shift * 60.0 * s * (1.0 - s) * (1.0 - 2.0 * s) / self.duration**2,
        )


def lift_path(X_TO: npt.ArrayLike, config: Config) -> LiftPath:
    """Return the path from a resting pose (4, 4) to p_TO = `lift.p_TG`.

    Without a hand, the object's origin moves to the target of the palm.
    """
    X_WO = X_WT @ np.asarray(X_TO, dtype=float)
    p_WO_end = X_WT[:3, 3] + config.lift.p_TG
    duration = lift_duration(float(np.linalg.norm(p_WO_end - X_WO[:3, 3])), config)
    # The object may start at its target.
    duration = max(duration, config.physics.time_step)
    return LiftPath(X_WO=X_WO, p_WO_end=p_WO_end, duration=duration)
