"""Object, table and hand as a model of MuJoCo.

In: a prepared object, a hand and the configuration. Out: a compiled `MujocoScene`. MuJoCo collides
convex shapes only, so the object is cut into convex parts (CoACD). Masses, inertias, joints, shapes
and friction are those that Drake simulates. Needs the extra `[peer]`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import coacd
import mujoco
import numpy as np
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.geometry import (
    Box,
    Capsule,
    Cylinder,
    GeometryId,
    SceneGraph,
    SceneGraphInspector,
    Sphere,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RigidBody

from drakegrasp.config import Config
from drakegrasp.frames import X_WT, Array
from drakegrasp.hand.chains import joint_axis, joint_slides, moving_joint
from drakegrasp.hand.description import SLIDE, Hand
from drakegrasp.hand.parsing import add_model
from drakegrasp.hand.shapes import hull_corners
from drakegrasp.objects.model import ObjectModel

#: Time step [s].
TIME_STEP = 0.002
#: Largest concavity of a convex part over the object's size, and the largest number of its corners.
CONCAVITY, CORNERS = 0.02, 64
#: Time constant [s] and damping ratio of contacts, joint limits and couplings: the stiffest that
#: MuJoCo allows is two steps. Its default of 20 ms lets a finger penetrate by more than 1 mm.
STIFF = (2.0 * TIME_STEP, 1.0)
#: Impedance of joint limits and couplings, near that of a rigid constraint: a finger's limit then
#: gives way by less than 0.01 degrees under its largest load.
RIGID = (0.999, 0.9999, 0.001, 0.5, 2.0)
#: Friction is this much stiffer than the normal direction, and is solved again until it is exact
#: (`noslip`): MuJoCo's regularized friction lets what is held creep.
FRICTION_STIFFNESS, NOSLIP_ITERATIONS = 10.0, 20
#: Gain of the fingers' speed [N m s/rad]; for those that slide it follows from
#: `description.SLIDE`.
FINGER_DAMPING = 5.0
#: Mass [kg] and inertia [kg m^2] of the bodies that carry the wrist, and a small inertia of the
#: rotors [kg m^2] that keeps joints stable.
CARRIER_MASS, CARRIER_INERTIA, ARMATURE = 0.01, 1e-5, 2e-4
#: Inertia that is added to what no contact may move [kg, kg m^2]: the wrist, which follows its path
#: exactly, and the object while the hand closes.
IMMOVABLE = 1e4
#: Torsion radius of a fingertip's patch in Drake [m]: the median of 336 patches of the Barrett Hand
#: on built-in objects (pipelines/measurements/torsion_radius.py).
TORSION_RADIUS = 0.0029
#: Bits of MuJoCo's collision masks.
_HAND, _OBJECT, _TABLE = 1, 2, 4


@dataclass(frozen=True, kw_only=True, eq=False)
class SpreadJoint:
    """A joint that an attempt sets and locks: it is no joint of the model, its body is turned.

    Attributes:
        body: Name of the body.
        axis: Of the joint, (3,), unit, in the body's frame.
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
        parts: Number of the object's convex parts.
    """

    model: mujoco.MjModel
    spreads: tuple[SpreadJoint, ...]
    parts: int


def build_mujoco_scene(model: ObjectModel, hand: Hand, config: Config) -> MujocoScene:
    """Return object, table and hand as a model of MuJoCo."""
    config = config.model_copy(update={"physics": model.own_physics(config.physics)})
    parts = _convex_parts(model)
    spec = _spec()
    _add_table(spec, config)
    _add_object(spec, model, parts, config)
    spreads = _add_hand(spec, hand, config)
    return MujocoScene(model=spec.compile(), spreads=tuple(spreads), parts=len(parts))


def quaternion(R: Array) -> Array:
    """Return the quaternion (w, x, y, z) of a rotation matrix (3, 3)."""
    found = np.zeros(4)
    mujoco.mju_mat2Quat(found, np.ascontiguousarray(R).ravel())
    return found


def pair_friction(coefficient: float) -> list[float]:
    """Return what MuJoCo calls the friction of a geom, for a pair's coefficient of friction.

    These are the coefficients of sliding and of turning about the normal, and of rolling, which
    contacts here do not have. That of turning is torque per normal force [m], so it depends on the
    coefficient of the pair.
    """
    return [coefficient, coefficient * TORSION_RADIUS, 0.0]


def _convex_parts(model: ObjectModel) -> list[Array]:
    """Return the corners of an object's convex parts, each (n, 3) in {O} [m]."""
    coacd.set_log_level("error")
    mesh = coacd.Mesh(model.collision_vertices, model.collision_faces)
    parts = coacd.run_coacd(mesh, threshold=CONCAVITY, seed=0, max_convex_hull=CORNERS)
    return [np.asarray(corners, dtype=float) for corners, _ in parts]


def _spec() -> mujoco.MjSpec:
    """Return an empty model with the solver's settings."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.compiler.balanceinertia = True
    spec.option.timestep = TIME_STEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = FRICTION_STIFFNESS
    spec.option.noslip_iterations = NOSLIP_ITERATIONS
    spec.option.tolerance = 1e-10
    return spec


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
        # Its friction decides, not the larger one of the pair.
        priority=1,
    )


def _add_object(
    spec: mujoco.MjSpec, model: ObjectModel, parts: list[Array], config: Config
) -> None:
    body = spec.worldbody.add_body(name="object")
    body.add_freejoint(name="object")
    _set_inertia(body, model.mass, model.p_OOcm, model.I_OOcm_O)
    for k, corners in enumerate(parts):
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
    # Drake reads the model.
    plant, scene_graph = MultibodyPlant(0.0), SceneGraph()
    plant.RegisterAsSourceForSceneGraph(scene_graph)
    instance = add_model(plant, hand.model)
    inspector = scene_graph.model_inspector()
    add = partial(_add_link, spec, plant, inspector, config.physics.friction_hand)

    # Carriers of the wrist, then the palm, then link by link in the file's order, in which
    # parents come first.
    bodies = _add_wrist(spec)
    bodies[hand.palm_link] = add(
        bodies["wrist_z"], plant.GetBodyByName(hand.palm_link, instance), RigidTransform()
    )
    spreads, kinds = [], mujoco.mjtJoint
    for index in plant.GetJointIndices(instance):
        joint = plant.get_joint(index)
        parent, child = joint.parent_body().name(), joint.child_body()
        X_PF = joint.frame_on_parent().GetFixedPoseInBodyFrame()
        X_CM = joint.frame_on_child().GetFixedPoseInBodyFrame()
        # A joint of the preshape is none in MuJoCo: its body stands where the joint would put it.
        X_PC = X_PF @ _fixed_motion(joint, hand) @ X_CM.inverse()
        body = bodies[child.name()] = add(bodies[parent], child, X_PC)
        if not moving_joint(joint) or joint.name() in hand.preshape:
            continue

        axis = X_CM.rotation().matrix() @ joint_axis(joint)
        if joint.name() in hand.spread.joints:
            zero = quaternion(X_PC.rotation().matrix())
            spreads.append(SpreadJoint(body=child.name(), axis=axis, quaternion=zero))
            continue
        body.add_joint(
            name=joint.name(),
            type=kinds.mjJNT_SLIDE if joint_slides(joint) else kinds.mjJNT_HINGE,
            axis=axis,
            pos=X_CM.translation(),
            limited=True,
            range=[joint.position_lower_limit(), joint.position_upper_limit()],
            damping=joint.default_damping(),
            armature=ARMATURE / (SLIDE**2 if joint_slides(joint) else 1.0),
            solref_limit=STIFF,
            solimp_limit=RIGID,
        )
    _add_drives(spec, hand)
    return spreads


def _fixed_motion(joint: Any, hand: Hand) -> RigidTransform:
    """Return the motion of a joint that is fixed, or keeps its position in the hand's preshape."""
    if not moving_joint(joint):
        return joint.X_FM()
    position, axis = hand.preshape.get(joint.name(), 0.0), joint_axis(joint)
    if joint_slides(joint):
        return RigidTransform(position * axis)
    return RigidTransform(RotationMatrix(AngleAxis(position, axis)), np.zeros(3))


def _add_wrist(spec: mujoco.MjSpec) -> dict[str, mujoco.MjsBody]:
    """Add three light bodies on sliding joints, which follow a path; return them."""
    bodies, parent = {}, spec.worldbody
    for name, axis in zip("xyz", np.eye(3), strict=True):
        parent = parent.add_body(name=f"wrist_{name}")
        _set_inertia(parent, CARRIER_MASS, np.zeros(3), CARRIER_INERTIA * np.eye(3))
        parent.gravcomp = 1.0
        parent.add_joint(
            name=f"wrist_{name}",
            type=mujoco.mjtJoint.mjJNT_SLIDE,
            axis=axis,
            armature=IMMOVABLE,
        )
        bodies[f"wrist_{name}"] = parent
    return bodies


def _add_drives(spec: mujoco.MjSpec, hand: Hand) -> None:
    """Give each finger its motor, with a limited torque, and its coupled joints."""
    for finger, unit in zip(hand.fingers, hand.closing_unit.tolist(), strict=True):
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

        for coupling in finger.coupled:
            spec.add_equality(
                type=mujoco.mjtEq.mjEQ_JOINT,
                objtype=mujoco.mjtObj.mjOBJ_JOINT,
                name1=coupling.joint,
                name2=finger.closing_joint,
                data=[coupling.offset, coupling.ratio, *np.zeros(mujoco.mjNEQDATA - 2)],
                solref=STIFF,
                solimp=RIGID,
            )


def _add_link(
    spec: mujoco.MjSpec,
    plant: MultibodyPlant,
    inspector: SceneGraphInspector,
    friction: float,
    parent: mujoco.MjsBody,
    link: RigidBody,
    X_PL: RigidTransform,
) -> mujoco.MjsBody:
    """Add a link L with its inertia and shapes S to its parent P."""
    body = parent.add_body(
        name=link.name(), pos=X_PL.translation(), quat=quaternion(X_PL.rotation().matrix())
    )
    inertia = link.default_spatial_inertia()
    p_LLcm = inertia.get_com()
    central = inertia.Shift(p_LLcm).CalcRotationalInertia().CopyToFullMatrix3()
    _set_inertia(body, inertia.get_mass(), p_LLcm, central)
    body.gravcomp = 1.0

    for geometry in plant.GetCollisionGeometriesForBody(link):
        kind, size, mesh = _shape(spec, inspector, geometry, link.name())
        X_LS = inspector.GetPoseInFrame(geometry)
        body.add_geom(
            type=kind,
            size=size,
            meshname=mesh,
            pos=X_LS.translation(),
            quat=quaternion(X_LS.rotation().matrix()),
            contype=_HAND,
            conaffinity=_OBJECT | _TABLE,
            friction=pair_friction(friction),
            solref=STIFF,
            condim=4,
        )
    return body


def _shape(
    spec: mujoco.MjSpec, inspector: SceneGraphInspector, geometry: GeometryId, link: str
) -> tuple[mujoco.mjtGeom, list[float], str]:
    """Return MuJoCo's kind, size and mesh of a shape of the hand; meshes are added to the model.

    MuJoCo has these primitives, too; the corners of `hand.shapes` only approximate them.
    """
    shape, kinds = inspector.GetShape(geometry), mujoco.mjtGeom
    if isinstance(shape, Box):
        return kinds.mjGEOM_BOX, list(shape.size() / 2.0), ""
    if isinstance(shape, Cylinder):
        return kinds.mjGEOM_CYLINDER, [shape.radius(), shape.length() / 2.0, 0.0], ""
    if isinstance(shape, Capsule):
        return kinds.mjGEOM_CAPSULE, [shape.radius(), shape.length() / 2.0, 0.0], ""
    if isinstance(shape, Sphere):
        return kinds.mjGEOM_SPHERE, [shape.radius(), 0.0, 0.0], ""
    corners = hull_corners(inspector, geometry)
    assert corners is not None
    name = f"{link}.{inspector.GetName(geometry)}"
    spec.add_mesh(name=name, uservert=corners.ravel())
    return kinds.mjGEOM_MESH, [0.0, 0.0, 0.0], name


def _set_inertia(body: mujoco.MjsBody, mass: float, com: Array, central: Array) -> None:
    """Give a body its mass [kg], centre of mass (3,) [m] and central inertia (3, 3) [kg m^2]."""
    body.explicitinertial = True
    body.mass, body.ipos = mass, com
    body.fullinertia = central[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
