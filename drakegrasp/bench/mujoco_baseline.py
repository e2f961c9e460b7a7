"""Simulates the same attempts in MuJoCo, as a baseline for Drake's speed.

In: a prepared object and attempts. Out: their outcomes. MuJoCo collides convex shapes only, so
the object is cut into convex parts (CoACD), and contacts are points. No attempt is screened and
no image is rendered. Otherwise the trial is that of `drakegrasp.simulation.trial`, with the same
hand. Needs the extra `[peer]`.
"""

from __future__ import annotations

from functools import partial

import coacd
import mujoco
import numpy as np
from pydrake.geometry import (
    Box,
    Capsule,
    Cylinder,
    GeometryId,
    SceneGraph,
    SceneGraphInspector,
    Sphere,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RevoluteJoint, RigidBody

from drakegrasp.config import Config
from drakegrasp.frames import X_WT, Array
from drakegrasp.hand.description import Hand, load_hand, make_parser
from drakegrasp.hand.shapes import hull_corners
from drakegrasp.objects.model import ObjectModel
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation.candidates import Attempt
from drakegrasp.simulation.verdict import judge_closed, judge_lifted

#: Time step [s].
TIME_STEP = 0.002
#: Largest concavity of a convex part, and the largest number of its corners.
CONCAVITY, CORNERS = 0.05, 24
#: Stiffness [N/m] and damping [N s/m] of the wrist, and gain of the fingers' speed [N m s/rad].
WRIST_STIFFNESS, WRIST_DAMPING, FINGER_DAMPING = 2e4, 400.0, 5.0
#: Mass [kg] and inertia [kg m^2] of the bodies that carry the wrist, and a small inertia of the
#: rotors [kg m^2] that keeps joints stable.
CARRIER_MASS, CARRIER_INERTIA, ARMATURE = 0.01, 1e-5, 2e-4
#: Time steps between two checks while closing, and while lifting.
CLOSING_STRIDE, LIFTING_STRIDE = 25, 50
#: Fingers start from rest, so slow fingers have stopped only after this time [s].
STARTING = 0.3
#: Mean speed of the lift [m/s], and its least duration [s].
LIFT_SPEED, LIFT_TIME = 0.3, 1.0
#: Torsional and rolling friction [m], MuJoCo's defaults.
TURNING, ROLLING = 0.005, 0.0001
#: Bits of MuJoCo's collision masks.
_HAND, _OBJECT, _TABLE = 1, 2, 4


class MujocoBaseline:
    """One object, the table and the hand in MuJoCo.

    Attributes:
        parts: Number of the object's convex parts.
    """

    def __init__(self, model: ObjectModel, X_TO: Array, config: Config) -> None:
        """Build the scene.

        Args:
            model: The object.
            X_TO: Its resting pose, (4, 4).
            config: The configuration; gives hand, friction, closing and the lift's target.
        """
        self._config, self._hand = config, load_hand(config.hand)
        self._X_WO = X_WT @ X_TO

        parts = _convex_parts(model)
        self.parts = len(parts)
        spec = _spec()
        _add_table(spec, config)
        _add_object(spec, model, parts, config)
        self._joints = _add_hand(spec, self._hand, config)
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)

        self._find_addresses()

    def _find_addresses(self) -> None:
        """Look up where bodies and joints are in MuJoCo's arrays."""
        m, hand = self._model, self._hand
        self._object, self._palm = m.body("object").id, m.body(hand.palm_link).id
        self._tips = {m.body(finger.fingertip).id for finger in hand.fingers}
        self._table = m.geom("table").id
        self._wrist_q = [m.joint(f"wrist_{axis}").qposadr[0] for axis in "xyz"]
        self._object_q, self._object_v = m.joint("object").qposadr[0], m.joint("object").dofadr[0]
        closing = [finger.closing_joint for finger in hand.fingers]
        self._closing_v = [m.joint(name).dofadr[0] for name in closing]
        self._X_GB = np.linalg.inv(hand.X_BG)

    def run(self, attempt: Attempt) -> Outcome:
        """Return the outcome of one attempt."""
        # Palm pose and start, as in a trial.
        if not attempt.ray_hits:
            return Outcome.RAY_MISS
        X_WG = self._X_WO @ attempt.X_OG
        if X_WG[2, 3] <= X_WT[2, 3]:
            return Outcome.BELOW_TABLE
        start = (X_WG @ self._X_GB)[:3, 3]
        self._reset(X_WG @ self._X_GB, attempt.spread)
        links, hand_on_table, _ = self._touching()
        if links or hand_on_table:
            return Outcome.START_COLLISION

        # Close on the clamped object and judge the contacts.
        self._close(start)
        links, hand_on_table, _ = self._touching()
        verdict = judge_closed(*self._held_by(links), hand_on_table)
        if verdict != Outcome.SUCCESS:
            return Outcome(int(verdict))

        # Lift: the wrist is commanded by B's origin, and the target is the palm's.
        X_BG = self._hand.X_BG
        target = X_WT[:3, 3] + self._config.lift.p_TG
        return self._lift(start, target - (X_WG[:3, :3] @ X_BG[:3, :3].T @ X_BG[:3, 3]))

    def _reset(self, X_WB: Array, spread: float) -> None:
        """Put the open hand at its start and the object at rest."""
        m, d = self._model, self._data
        mujoco.mj_resetData(m, d)

        # The wrist has no rotation and the spread is locked, so both turn bodies of the model.
        m.body_quat[self._palm] = _quaternion(X_WB[:3, :3])
        for body, axis, quat in self._joints:
            turn, total = np.zeros(4), np.zeros(4)
            mujoco.mju_axisAngle2Quat(turn, axis, spread)
            mujoco.mju_mulQuat(total, quat, turn)
            m.body_quat[m.body(body).id] = total

        d.qpos[self._wrist_q] = X_WB[:3, 3]
        d.qpos[self._object_q : self._object_q + 3] = self._X_WO[:3, 3]
        d.qpos[self._object_q + 3 : self._object_q + 7] = _quaternion(self._X_WO[:3, :3])
        mujoco.mj_forward(m, d)

    def _close(self, p_WB: Array) -> None:
        """Close the fingers on the object, which is held in place, until they stop."""
        m, d = self._model, self._data
        d.ctrl[:3], d.ctrl[3:] = p_WB, self._hand.closing_speed
        q, v = self._object_q, self._object_v
        resting, step = d.qpos[q : q + 7].copy(), 0
        while d.time < self._config.close.max_time:
            mujoco.mj_step(m, d)
            d.qpos[q : q + 7] = resting
            d.qvel[v : v + 6] = 0.0
            step += 1
            if step % CLOSING_STRIDE == 0 and d.time > STARTING:
                speed = np.abs(d.qvel[self._closing_v]).max()
                if speed < self._config.close.stop_speed:
                    return

    def _lift(self, start: Array, target: Array) -> Outcome:
        """Lift the wrist from start to target and return the outcome."""
        m, d = self._model, self._data
        duration = max(LIFT_TIME, float(np.linalg.norm(target - start)) / LIFT_SPEED)
        begin, step = d.time, 0

        # A cubic path, at rest at both ends. A dropped object ends the lift.
        while d.time < begin + duration:
            x = min((d.time - begin) / duration, 1.0)
            d.ctrl[:3] = start + (target - start) * (3.0 * x * x - 2.0 * x**3)
            mujoco.mj_step(m, d)
            step += 1
            if step % LIFTING_STRIDE == 0 and not self._touching()[0]:
                return Outcome.DROPPED

        links, _, object_on_table = self._touching()
        return Outcome(int(judge_lifted(*self._held_by(links), object_on_table)))

    def _held_by(self, links: set[int]) -> tuple[list[bool], int]:
        """Return whether each fingertip is among links, and the number of other links."""
        return [tip in links for tip in self._tips], len(links - self._tips)

    def _touching(self) -> tuple[set[int], bool, bool]:
        """Return the links that touch the object, and whether hand and object touch the table."""
        m, d = self._model, self._data
        links: set[int] = set()
        hand_on_table = object_on_table = False
        for contact in d.contact[: d.ncon]:
            if contact.dist > 0.0:
                continue
            bodies = {m.geom_bodyid[contact.geom1], m.geom_bodyid[contact.geom2]}
            if self._table in (contact.geom1, contact.geom2):
                object_on_table |= self._object in bodies
                hand_on_table |= self._object not in bodies
            elif self._object in bodies:
                links |= bodies - {self._object}
        return links, hand_on_table, object_on_table


def _convex_parts(model: ObjectModel) -> list[Array]:
    """Return the corners of an object's convex parts, each (n, 3) in {O} [m]."""
    coacd.set_log_level("error")
    mesh = coacd.Mesh(model.visual_vertices, model.visual_faces)
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
    spec.option.impratio = 10.0
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
        friction=[config.physics.friction_table, TURNING, ROLLING],
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
            friction=[config.physics.friction_hand, TURNING, ROLLING],
            condim=4,
        )


def _add_hand(spec: mujoco.MjSpec, hand: Hand, config: Config) -> list[tuple[str, Array, Array]]:
    """Add the hand on its wrist; return body, axis and zero orientation of each spread joint.

    The spread is set before an attempt and locked, so the model has no such joints: an attempt
    turns their bodies.
    """
    # Drake reads the SDFormat file.
    plant, scene_graph = MultibodyPlant(0.0), SceneGraph()
    plant.RegisterAsSourceForSceneGraph(scene_graph)
    (instance,) = make_parser(plant).AddModels(hand.sdf_path)
    inspector = scene_graph.model_inspector()
    add = partial(_add_link, spec, plant, inspector, config.physics.friction_hand)

    # Carriers of the wrist, then the palm, then link by link in the file's order, in which
    # parents come first.
    bodies = _add_wrist(spec)
    bodies[hand.palm_link] = add(
        bodies["wrist_z"], plant.GetBodyByName(hand.palm_link, instance), RigidTransform()
    )
    spreads = []
    for index in plant.GetJointIndices(instance):
        joint = plant.get_joint(index)
        parent, child = joint.parent_body().name(), joint.child_body()
        X_PF = joint.frame_on_parent().GetFixedPoseInBodyFrame()
        X_CM = joint.frame_on_child().GetFixedPoseInBodyFrame()
        X_PC = X_PF @ X_CM.inverse()
        body = bodies[child.name()] = add(bodies[parent], child, X_PC)
        if not isinstance(joint, RevoluteJoint):
            continue

        axis = X_CM.rotation().matrix() @ joint.revolute_axis()
        if joint.name() in hand.spread.joints:
            spreads.append((child.name(), axis, _quaternion(X_PC.rotation().matrix())))
            continue
        body.add_joint(
            name=joint.name(),
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=axis,
            pos=X_CM.translation(),
            limited=True,
            range=[joint.position_lower_limit(), joint.position_upper_limit()],
            damping=joint.default_damping(),
            armature=ARMATURE,
        )
    _add_drives(spec, hand)
    return spreads


def _add_wrist(spec: mujoco.MjSpec) -> dict[str, mujoco.MjsBody]:
    """Add three light bodies on sliding joints, each with a position drive; return them."""
    bodies, parent = {}, spec.worldbody
    for name, axis in zip("xyz", np.eye(3), strict=True):
        parent = parent.add_body(name=f"wrist_{name}")
        _set_inertia(parent, CARRIER_MASS, np.zeros(3), CARRIER_INERTIA * np.eye(3))
        parent.gravcomp = 1.0
        parent.add_joint(name=f"wrist_{name}", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
        bodies[f"wrist_{name}"] = parent
        motor = spec.add_actuator(
            name=f"wrist_{name}", trntype=mujoco.mjtTrn.mjTRN_JOINT, target=f"wrist_{name}"
        )
        motor.set_to_position(kp=WRIST_STIFFNESS, kv=WRIST_DAMPING)
    return bodies


def _add_drives(spec: mujoco.MjSpec, hand: Hand) -> None:
    """Give each finger its motor, with a limited torque, and its coupled joints."""
    for finger in hand.fingers:
        spec.joint(finger.closing_joint).armature = finger.rotor_inertia * finger.gear_ratio**2
        limit = finger.torque_limit
        motor = spec.add_actuator(
            name=finger.name,
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            target=finger.closing_joint,
            forcelimited=True,
            forcerange=[-limit, limit],
        )
        motor.set_to_velocity(kv=FINGER_DAMPING)

        for coupling in finger.coupled:
            spec.add_equality(
                type=mujoco.mjtEq.mjEQ_JOINT,
                objtype=mujoco.mjtObj.mjOBJ_JOINT,
                name1=coupling.joint,
                name2=finger.closing_joint,
                data=np.eye(1, mujoco.mjNEQDATA, 1)[0] * coupling.ratio,
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
        name=link.name(), pos=X_PL.translation(), quat=_quaternion(X_PL.rotation().matrix())
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
            quat=_quaternion(X_LS.rotation().matrix()),
            contype=_HAND,
            conaffinity=_OBJECT | _TABLE,
            friction=[friction, TURNING, ROLLING],
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


def _quaternion(R: Array) -> Array:
    """Return the quaternion (w, x, y, z) of a rotation matrix (3, 3)."""
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(R).ravel())
    return quaternion
