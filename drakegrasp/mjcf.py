"""Hands as models of MuJoCo, objects as convex parts. Needs the extra `[peer]`.

Input: a hand that Drake has read. Output: bodies with inertia and collision shapes that are added
to a specification; or the hand by itself as an MJCF whose world is the palm link, for tools that
move the root themselves. In this MJCF each joint that a motor moves has a position actuator, and
coupled joints follow. The root has no joint, and the joints of the preshape do not exist.

MuJoCo collides convex shapes only: `convex_parts` divides an object into such parts.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import Any, TypeAlias

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
from pydrake.multibody.tree import Joint, RigidBody

from drakegrasp.foreign_files import read_npz
from drakegrasp.frames import Array
from drakegrasp.hand.description import SLIDE, Hand
from drakegrasp.hand.parsing import add_model, joint_axis, joint_slides, moving_joint
from drakegrasp.hand.shapes import hull_corners
from drakegrasp.mesh.surfaces import hull_text
from drakegrasp.objects.model import ObjectModel
from drakegrasp.runtime.files import write_atomic

#: Memory of MuJoCo [bytes]; only what is needed is touched. By default MuJoCo takes about 14 MB,
#: and leaves contacts out if that is too little, e.g. for a hand deep in an object of many convex
#: parts.
MEMORY = 256_000_000
#: Time step [s].
TIME_STEP = 0.002
#: Time constant [s] and damping ratio of contacts, joint limits and couplings: the stiffest that
#: MuJoCo allows is two steps. With its default of 20 ms a finger would penetrate by more than 1 mm.
STIFF = (2.0 * TIME_STEP, 1.0)
#: Impedance of joint limits and couplings, close to that of a rigid constraint: a finger's limit
#: then yields by less than 0.01 degrees under its largest load.
RIGID = (0.999, 0.9999, 0.001, 0.5, 2.0)
#: Torsion radius of a fingertip's patch in Drake [m]: the median of 336 patches of the Barrett Hand
#: on built-in objects (pipelines/measurements/torsion_radius.py of commit cbc3bb01).
TORSION_RADIUS = 0.0029


#: A joint of Drake that moves in MuJoCo, the body of its link, and the arguments of `add_joint`:
#: its name, kind and limits, and its position in the body's frame.
MovingJoint: TypeAlias = tuple[Joint, mujoco.MjsBody, dict[str, Any]]


def make_spec(time_step: float, impratio: float, noslip_iterations: int) -> mujoco.MjSpec:
    """Return an empty model with the solver's settings: elliptic cones, implicit steps [s]."""
    spec = mujoco.MjSpec()
    spec.memory = MEMORY
    spec.option.timestep = time_step
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = impratio
    spec.option.noslip_iterations = noslip_iterations
    return spec


def add_links(
    spec: mujoco.MjSpec,
    hand: Hand,
    parent: mujoco.MjsBody,
    friction: float,
    *,
    touches: tuple[int, int],
) -> Iterator[MovingJoint]:
    """Add the links of a hand; yield each moving joint, which the caller adds to its body.

    A joint of the preshape does not exist in MuJoCo; its body has the pose that the joint would
    give it.

    Args:
        spec: Specification to which shapes are added.
        hand: The hand.
        parent: Body to which the palm link is fixed.
        friction: Coefficient of friction of the hand's contacts.
        touches: `contype` and `conaffinity` of the hand's shapes, bits of MuJoCo's collision masks.
    """
    # Drake reads the model.
    plant, scene_graph = MultibodyPlant(0.0), SceneGraph()
    plant.RegisterAsSourceForSceneGraph(scene_graph)
    instance = add_model(plant, hand.model)
    inspector = scene_graph.model_inspector()

    def add(body: mujoco.MjsBody, link: RigidBody, X_PL: RigidTransform) -> mujoco.MjsBody:
        return _add_link(spec, plant, inspector, friction, touches, body, link, X_PL)

    # The palm, then link by link in the file's order, in which parents come first.
    palm = plant.GetBodyByName(hand.palm_link, instance)
    bodies = {hand.palm_link: add(parent, palm, RigidTransform())}
    for index in plant.GetJointIndices(instance):
        joint = plant.get_joint(index)
        child = joint.child_body()
        X_PF = joint.frame_on_parent().GetFixedPoseInBodyFrame()
        X_CM = joint.frame_on_child().GetFixedPoseInBodyFrame()
        X_PC = X_PF @ _fixed_motion(joint, hand) @ X_CM.inverse()
        body = bodies[child.name()] = add(bodies[joint.parent_body().name()], child, X_PC)
        if moving_joint(joint) and joint.name() not in hand.preshape:
            slide, hinge = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
            attributes = {
                "name": joint.name(),
                "type": slide if joint_slides(joint) else hinge,
                "axis": X_CM.rotation().matrix() @ joint_axis(joint),
                "pos": X_CM.translation(),
                "limited": True,
                "range": (joint.position_lower_limit(), joint.position_upper_limit()),
            }
            yield joint, body, attributes


def _fixed_motion(joint: Joint, hand: Hand) -> RigidTransform:
    """Return the motion X_FM of a joint that is fixed, or that the hand's preshape sets."""
    if not moving_joint(joint):
        return joint.X_FM()
    position, axis = hand.preshape.get(joint.name(), 0.0), joint_axis(joint)
    if joint_slides(joint):
        return RigidTransform(position * axis)
    return RigidTransform(RotationMatrix(AngleAxis(position, axis)), np.zeros(3))


def add_couplings(spec: mujoco.MjSpec, hand: Hand) -> None:
    """Couple each coupled joint to the closing joint of the finger whose motor moves it."""
    for i in hand.motor_fingers:
        for coupling in hand.followers(i):
            spec.add_equality(
                type=mujoco.mjtEq.mjEQ_JOINT,
                objtype=mujoco.mjtObj.mjOBJ_JOINT,
                name1=coupling.joint,
                name2=hand.fingers[i].closing_joint,
                data=[coupling.offset, coupling.ratio, *np.zeros(mujoco.mjNEQDATA - 2)],
                solref=STIFF,
                solimp=RIGID,
            )


def quaternion(R: Array) -> Array:
    """Return the quaternion (w, x, y, z) of a rotation matrix (3, 3)."""
    found = np.zeros(4)
    mujoco.mju_mat2Quat(found, np.ascontiguousarray(R).ravel())
    return found


def pair_friction(coefficient: float) -> list[float]:
    """Return MuJoCo's friction values of a geom for a coefficient of friction of a pair.

    These are coefficients of sliding, of torsion about the normal, and of rolling, which contacts
    here do not have. The torsional one is torque per normal force [m], so it depends on the
    coefficient of the pair.
    """
    return [coefficient, coefficient * TORSION_RADIUS, 0.0]


def _add_link(
    spec: mujoco.MjSpec,
    plant: MultibodyPlant,
    inspector: SceneGraphInspector,
    friction: float,
    touches: tuple[int, int],
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
    set_inertia(body, inertia.get_mass(), p_LLcm, central)
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
            contype=touches[0],
            conaffinity=touches[1],
            friction=pair_friction(friction),
            solref=STIFF,
            condim=4,
        )
    return body


def _shape(
    spec: mujoco.MjSpec, inspector: SceneGraphInspector, geometry: GeometryId, link: str
) -> tuple[mujoco.mjtGeom, list[float], str]:
    """Return MuJoCo's kind, size and mesh of a shape of the hand; meshes are added to the model.

    MuJoCo has the same primitives, which the corners of `hand.shapes` would only approximate.
    """
    shape, kinds = inspector.GetShape(geometry), mujoco.mjtGeom
    if isinstance(shape, Box):
        return kinds.mjGEOM_BOX, list(shape.size() / 2.0), ""
    if isinstance(shape, Sphere):
        return kinds.mjGEOM_SPHERE, [shape.radius(), 0.0, 0.0], ""
    if isinstance(shape, Cylinder | Capsule):
        kind = kinds.mjGEOM_CAPSULE if isinstance(shape, Capsule) else kinds.mjGEOM_CYLINDER
        return kind, [shape.radius(), shape.length() / 2.0, 0.0], ""
    corners = hull_corners(inspector, geometry)
    assert corners is not None
    name = f"{link}.{inspector.GetName(geometry)}"
    spec.add_mesh(name=name, uservert=corners.ravel())
    return kinds.mjGEOM_MESH, [0.0, 0.0, 0.0], name


def set_inertia(body: mujoco.MjsBody, mass: float, com: Array, central: Array) -> None:
    """Set a body's mass [kg], centre of mass (3,) [m] and central inertia (3, 3) [kg m^2]."""
    body.explicitinertial = True
    body.mass, body.ipos = mass, com
    body.fullinertia = central[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]


#: Gain [N m/rad] and maximum torque [N m] of each motor, damping [N m s/rad], and inertia of rotors
#: [kg m^2]: those of the Shadow Hand of DexGraspBench (assets/hand/shadow/right_hand.xml). For
#: prismatic joints they are converted with `description.SLIDE`.
GAIN, TORQUE, DAMPING, ARMATURE = 5.0, 3.0, 0.05, 2e-4
#: Links touch everything with MuJoCo's default masks, but not each other.
_TOUCHES = (1, 0)
#: Default friction of a model.
_FRICTION = 1.0
#: Folder of the meshes, beside the MJCF.
MESHES = "meshes"


def make_hand_model(hand: Hand, friction: float = _FRICTION) -> mujoco.MjSpec:
    """Return a hand as a specification of MuJoCo; its assets are the meshes that it names.

    The joints are in the order of the hand's positions.

    Args:
        hand: The hand.
        friction: Coefficient of friction of the hand's contacts.
    """
    spec = mujoco.MjSpec()
    spec.modelname = hand.name
    spec.compiler.degree = False
    spec.compiler.balanceinertia = True
    coupled = {c.joint for i in hand.motor_fingers for c in hand.followers(i)}
    for joint, body, attributes in add_links(
        spec, hand, spec.worldbody, friction, touches=_TOUCHES
    ):
        unit, name = SLIDE if joint_slides(joint) else 1.0, joint.name()
        body.add_joint(**attributes, damping=DAMPING / unit**2, armature=ARMATURE / unit**2)
        if name not in coupled:
            motor = spec.add_actuator(
                name=name,
                trntype=mujoco.mjtTrn.mjTRN_JOINT,
                target=name,
                forcelimited=True,
                forcerange=[-TORQUE / unit, TORQUE / unit],
            )
            # As numbers, since the benchmark's MuJoCo does not know the word `position` of newer
            # ones.
            gain = GAIN / unit**2
            motor.biastype = mujoco.mjtBias.mjBIAS_AFFINE
            motor.gainprm[0], motor.biasprm[1] = gain, -gain
    add_couplings(spec, hand)

    # Corners are converted to mesh files, which other tools can read.
    texts = {}
    for number, mesh in enumerate(spec.meshes):
        mesh.file = f"link_{number}.obj"
        texts[mesh.file] = hull_text(np.array(mesh.uservert).reshape(-1, 3)).encode()
        mesh.uservert = []
    spec.assets = texts
    spec.compile()
    return spec


def write_hand_model(spec: mujoco.MjSpec, path: Path) -> None:
    """Write the MJCF of a hand, and its meshes in a folder beside it."""
    (path.parent / MESHES).mkdir(parents=True, exist_ok=True)
    for name, text in spec.assets.items():
        (path.parent / MESHES / name).write_bytes(text)
    spec.meshdir = MESHES
    path.write_text(spec.to_xml(), encoding="utf-8")
    spec.meshdir = ""


#: Largest concavity of a convex part over the object's size, the seed, and the largest number of
#: corners of a part.
SETTINGS = {"threshold": 0.02, "seed": 0, "max_convex_hull": 64}


def convex_parts(model: ObjectModel) -> list[Array]:
    """Return the corners of an object's convex parts, each (n, 3) in {O} [m]."""
    import coacd

    coacd.set_log_level("error")
    mesh = coacd.Mesh(model.collision_vertices, model.collision_faces)
    parts = coacd.run_coacd(mesh, **SETTINGS)
    return [np.asarray(corners, dtype=float) for corners, _ in parts]


def kept_convex_parts(model: ObjectModel, keep: Path) -> list[Array]:
    """Return the convex parts of an object, cached in a folder, since dividing takes many seconds.

    Args:
        model: The object.
        keep: The folder, created with the first object. A file without valid parts is rewritten.

    Raises:
        OSError: If the folder cannot be written.
    """
    path = keep / f"{_digest(model)}.npz"
    try:
        return _read_parts(path)
    except Exception:  # missing, or damaged in any way: it can be computed again
        parts = convex_parts(model)

    # The parts are read in the order in which they are written.
    buffer = io.BytesIO()
    np.savez(buffer, *parts)
    write_atomic(path, buffer.getvalue())
    return parts


def _read_parts(path: Path) -> list[Array]:
    """Return the parts in a file.

    Raises:
        Exception: Of any kind, if the file is missing or holds something else.
    """
    content = read_npz(path)
    parts = [content[f"arr_{k}"] for k in range(len(content))]
    if not parts:
        raise ValueError(f"{path}: must hold the corners of convex parts, got none")
    return parts


def _digest(model: ObjectModel) -> str:
    """Return 32 hex digits that identify everything that determines an object's parts."""
    digest = hashlib.sha256(repr((SETTINGS, metadata.version("coacd"))).encode())
    for array in (model.collision_vertices, model.collision_faces):
        digest.update(repr((array.shape, array.dtype.str)).encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:32]
