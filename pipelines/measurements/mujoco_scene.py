"""Object, table and hand as a model of MuJoCo, for mujoco_baseline.py.

Input: a prepared object, a hand and the configuration. Output: a compiled `MujocoScene`. MuJoCo
only collides convex shapes, so the object is divided into convex parts. Masses, inertias, joints,
shapes and friction are those that Drake simulates.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from drakegrasp.config import Config
from drakegrasp.frames import X_WT, Array
from drakegrasp.hand.description import SLIDE, Hand
from drakegrasp.hand.parsing import joint_slides
from drakegrasp.mjcf import (
    RIGID,
    STIFF,
    TIME_STEP,
    add_couplings,
    add_links,
    convex_parts,
    make_spec,
    pair_friction,
    set_inertia,
)
from drakegrasp.objects.model import ObjectModel

#: Friction is stiffer than the normal direction by this factor, and is solved again until it is
#: exact (`noslip`): with MuJoCo's regularized friction a held object creeps.
FRICTION_STIFFNESS, NOSLIP_ITERATIONS = 10.0, 20
#: Gain of the fingers' speed [N m s/rad]; for sliding fingers it follows from `description.SLIDE`.
FINGER_DAMPING = 5.0
#: Mass [kg] and inertia [kg m^2] of the bodies that support the wrist, and a small inertia of the
#: rotors [kg m^2] that keeps joints stable.
CARRIER_MASS, CARRIER_INERTIA, ARMATURE = 0.01, 1e-5, 2e-4
#: Inertia [kg, kg m^2] that is added to bodies that no contact may move: the wrist, which follows
#: its path exactly, and the object while the hand closes.
IMMOVABLE = 1e4
#: Bits of MuJoCo's collision masks.
_HAND, _OBJECT, _TABLE = 1, 2, 4
_ON_HAND = (_HAND, _OBJECT | _TABLE)


@dataclass(frozen=True, kw_only=True, eq=False)
class SpreadJoint:
    """A joint that an attempt sets and locks: the model has no such joint, but its body is turned.

    Attributes:
        body: Name of the body.
        axis: Axis of the joint, (3,), unit, in the body's frame.
        quaternion: Orientation of the body at angle zero, (4,), in its parent's frame.
    """

    body: str
    axis: Array
    quaternion: Array

    def orientation(self, angle: float) -> Array:
        """Return the body's quaternion (4,) at an angle [rad]."""
        turn, total = np.zeros(4), np.zeros(4)
        mujoco.mju_axisAngle2Quat(turn, self.axis, angle)
        mujoco.mju_mulQuat(total, self.quaternion, turn)
        return total


@dataclass(frozen=True, kw_only=True, eq=False)
class MujocoScene:
    """A compiled model; bodies and joints have the names of the hand's files.

    Attributes:
        model: The model, with the bodies `object` and `wrist_x` to `wrist_z` and the geom `table`.
        spreads: The spread joints.
    """

    model: mujoco.MjModel
    spreads: tuple[SpreadJoint, ...]


def build_mujoco_scene(model: ObjectModel, hand: Hand, config: Config) -> MujocoScene:
    """Return object, table and hand as a model of MuJoCo."""
    config = config.model_copy(update={"physics": model.own_physics(config.physics)})
    spec = make_spec(TIME_STEP, FRICTION_STIFFNESS, NOSLIP_ITERATIONS)
    spec.compiler.degree, spec.compiler.balanceinertia = False, True
    spec.option.tolerance = 1e-10
    _add_table(spec, config)
    _add_object(spec, model, config)
    spreads = _add_hand(spec, hand, config)
    return MujocoScene(model=spec.compile(), spreads=tuple(spreads))


def _add_table(spec: mujoco.MjSpec, config: Config) -> None:
    thickness = 0.05
    spec.worldbody.add_geom(
        name="table",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=X_WT[:3, 3] - [0.0, 0.0, thickness],
        size=[0.8, 0.8, thickness],
        contype=_TABLE,
        conaffinity=_HAND | _OBJECT,
        friction=pair_friction(config.physics.friction_table),
        solref=STIFF,
        condim=4,
        # The table's friction is used, not the larger one of the pair.
        priority=1,
    )


def _add_object(spec: mujoco.MjSpec, model: ObjectModel, config: Config) -> None:
    body = spec.worldbody.add_body(name="object")
    body.add_freejoint(name="object")
    set_inertia(body, model.mass, model.p_OOcm, model.I_OOcm_O)
    for k, corners in enumerate(convex_parts(model)):
        spec.add_mesh(name=f"part_{k}", uservert=corners.ravel())
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=f"part_{k}",
            contype=_OBJECT,
            conaffinity=_HAND | _TABLE,
            friction=pair_friction(config.physics.friction_hand),
            solref=STIFF,
            condim=4,
        )


def _add_hand(spec: mujoco.MjSpec, hand: Hand, config: Config) -> list[SpreadJoint]:
    """Add the hand on its wrist; return its spread joints."""
    wrist, spreads = _add_wrist(spec), []
    links = add_links(spec, hand, wrist, config.physics.friction_hand, touches=_ON_HAND)
    for joint, body, attributes in links:
        if joint.name() in hand.spread.joints:
            start = body.quat.copy()
            spreads.append(SpreadJoint(body=body.name, axis=attributes["axis"], quaternion=start))
            continue
        unit = SLIDE if joint_slides(joint) else 1.0
        body.add_joint(
            **attributes,
            damping=joint.default_damping(),
            armature=ARMATURE / unit**2,
            solref_limit=STIFF,
            solimp_limit=RIGID,
        )
    _add_drives(spec, hand)
    return spreads


def _add_wrist(spec: mujoco.MjSpec) -> mujoco.MjsBody:
    """Add three light bodies on prismatic joints, which follow a path; return the last."""
    parent = spec.worldbody
    for name, axis in zip("xyz", np.eye(3), strict=True):
        parent = parent.add_body(name=f"wrist_{name}")
        set_inertia(parent, CARRIER_MASS, np.zeros(3), CARRIER_INERTIA * np.eye(3))
        parent.gravcomp = 1.0
        parent.add_joint(
            name=f"wrist_{name}", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis, armature=IMMOVABLE
        )
    return parent


def _add_drives(spec: mujoco.MjSpec, hand: Hand) -> None:
    """Add each motor with its limited torque, and the joints that follow the motor."""
    for i in hand.motor_fingers:
        finger, unit = hand.fingers[i], float(hand.closing_unit[i])
        spec.joint(finger.closing_joint).armature = finger.rotor_inertia * finger.gear_ratio**2
        limit = finger.effort_limit
        motor = spec.add_actuator(
            name=finger.name,
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            target=finger.closing_joint,
            forcelimited=True,
            forcerange=[-limit, limit],
        )
        motor.set_to_velocity(kv=FINGER_DAMPING / unit**2)

    add_couplings(spec, hand)
