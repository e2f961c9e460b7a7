"""MJCF as MuJoCo compiles it.

Input: an MJCF file. Output: bodies with their shapes and inertias, joints, couplings and efforts,
all of them from the compiled model. MuJoCo gets the triangles of mesh files as `mesh.loading` reads
them.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.geometry import Box, Capsule, Cylinder, Sphere
from pydrake.math import RotationMatrix
from pydrake.multibody.tree import RotationalInertia, SpatialInertia

from drakegrasp.arithmetic import norm
from drakegrasp.errors import HandError, one_line
from drakegrasp.foreign_files import read_content
from drakegrasp.frames import Array, make_pose
from drakegrasp.hand.draft.vendor import (
    ENDLESS,
    Link,
    Shape,
    VendorJoint,
    VendorModel,
    ellipsoid,
    read_mesh,
)
from drakegrasp.hand.kinematics import joint_motion
from drakegrasp.hand.parsing import Mimic

#: Maximum size of a model's text [bytes].
LONGEST = 20_000_000


def compile_model(path: Path, find: Callable[[str, Path], Path]) -> VendorModel:
    """Return the bodies and joints of an MJCF model.

    Args:
        path: The model.
        find: Returns the file of a mesh, given the folder in which the model looks for it.

    Raises:
        HandError: If MuJoCo rejects the file, a mesh cannot be read, or the model has something
            that no hand of rigid links has.
    """
    try:  # MuJoCo replaces NaN by its defaults
        if found := re.search(rb"[\s\"']nan[\s\"']", read_content(path, LONGEST), re.I):
            raise ValueError(f"{found[0].decode()!r}, which is no number")
        spec = mujoco.MjSpec.from_file(str(path))
        _read_meshes(spec, path.parent, find)
        if spec.flexes:
            raise HandError("model: must be of rigid bodies, got <flex>")
        model = spec.compile()
    except OSError as error:
        raise HandError(f"{path}: must be a readable file, got: {error.strerror}") from None
    except ValueError as error:
        raise HandError(f"model: must be MJCF that MuJoCo reads, got {one_line(error)}") from None

    # Bodies and joints without a name get one. Body 0 is the world, which has no part in the hand.
    bodies = [model.body(b).name or f"body{b}" for b in range(model.nbody)]
    names = [model.joint(j).name or _joint_name(model, bodies, j) for j in range(model.njnt)]
    links, notes = dict[str, Link](), list[str]()
    for b in range(1, model.nbody):
        links[bodies[b]] = _link(model, b, bodies[b], notes)
    efforts, joints = _efforts(model, names), dict[str, VendorJoint]()
    for joint in _joints(model, bodies, names):
        joints[joint.name] = replace(joint, effort=efforts.get(joint.name, 0.0))
        links.setdefault(joint.child, Link(name=joint.child, inertia=SpatialInertia.Zero()))
    for named in (bodies, names):
        if twins := sorted({name for name in named if named.count(name) > 1}):
            raise HandError(f"model: names must be unique, got {twins[0]!r} twice")
    mimics = {mimic.joint: mimic for mimic in _mimics(model, names, notes)}
    name = model.names.partition(b"\0")[0].decode()
    return VendorModel(name=name, links=links, joints=joints, mimics=mimics, notes=tuple(notes))


def _read_meshes(spec: Any, folder: Path, find: Callable[[str, Path], Path]) -> None:
    """Give MuJoCo the triangles of mesh files, and nothing that is only drawn.

    Raises:
        HandError: If a mesh cannot be read.
    """
    for mesh in spec.meshes:
        if mesh.file:
            shape = read_mesh(find(mesh.file, folder / spec.meshdir))
            assert shape.vertices is not None and shape.faces is not None
            mesh.uservert, mesh.userface = shape.vertices.ravel(), shape.faces.ravel()
            mesh.file = mesh.content_type = ""
    for material in spec.materials:
        material.textures = [""] * len(material.textures)
    for drawn in (*spec.textures, *spec.skins):
        spec.delete(drawn)


def _joint_name(model: Any, bodies: Sequence[str], j: int) -> str:
    """Return a name for a joint: those of the bodies that it joins."""
    body = int(model.jnt_bodyid[j])
    n = j - int(model.body_jntadr[body])
    return f"{bodies[model.body_parentid[body]]}-{bodies[body]}" + (f"-{n + 1}" if n else "")


def _pose(p: Array, quaternion: Array) -> Array:
    """Return a pose (4, 4) of a position (3,) and a quaternion w, x, y, z."""
    R = RotationMatrix(Quaternion(quaternion / norm(quaternion)))
    return make_pose(R.matrix(), p)


def _joints(model: Any, bodies: Sequence[str], names: Sequence[str]) -> Iterator[VendorJoint]:
    """Yield what carries each body. The hand is free, however the file fixes it to the world.

    A body with several joints has a body without mass between each two of them.
    """
    kinds = mujoco.mjtJoint
    for b in range(1, model.nbody):
        parent = bodies[model.body_parentid[b]]
        if model.body_parentid[b] == 0:
            continue
        X_PB, first = _pose(model.body_pos[b], model.body_quat[b]), int(model.body_jntadr[b])
        last = first + int(model.body_jntnum[b]) - 1
        if last < first:
            yield VendorJoint(name=bodies[b], parent=parent, child=bodies[b], X_PJ=X_PB)
        for j in range(first, last + 1):
            kind = kinds(int(model.jnt_type[j]))
            if kind not in (kinds.mjJNT_HINGE, kinds.mjJNT_SLIDE):
                raise HandError(
                    f"model: joint {names[j]!r} must be revolute, prismatic or fixed, got "
                    f"{kind.name.removeprefix('mjJNT_').lower()}"
                )

            # The body is at X_PB where the joint has the position of the model's reference.
            child = bodies[b] if j == last else f"{names[j]}_end"
            axis, slides = model.jnt_axis[j].copy(), kind == kinds.mjJNT_SLIDE
            reference = float(model.qpos0[model.jnt_qposadr[j]])
            X_BJ = make_pose(np.eye(3), model.jnt_pos[j])
            yield VendorJoint(
                name=names[j],
                parent=parent,
                child=child,
                X_PJ=X_PB @ X_BJ @ joint_motion(axis, -reference, slides=slides),
                X_CJ=X_BJ,
                axis=axis,
                slides=slides,
                limits=model.jnt_range[j].copy() if model.jnt_limited[j] else ENDLESS,
            )
            parent, X_PB = child, np.eye(4)


def _link(model: Any, b: int, name: str, notes: list[str]) -> Link:
    """Return a body with its shapes; `notes` receives a line for each shape that is left out."""
    mass, inertia = float(model.body_mass[b]), SpatialInertia.Zero()
    if not np.isfinite([mass, *model.body_inertia[b], *model.body_ipos[b]]).all():
        raise HandError(f"model: mass and inertia of body {name!r} must be finite numbers")
    if mass > 0.0:
        R_BI = RotationMatrix(Quaternion(model.body_iquat[b] / norm(model.body_iquat[b])))
        central = RotationalInertia(*model.body_inertia[b]).ReExpress(R_BI)
        inertia = SpatialInertia.MakeFromCentralInertia(mass, model.body_ipos[b], central)

    # Shapes that collide, or else those that are drawn.
    collisions, pictures = list[Shape](), list[Shape]()
    for g in np.flatnonzero(model.geom_bodyid == b).tolist():
        shape = _shape(model, g)
        if shape is None:
            kind = mujoco.mjtGeom(int(model.geom_type[g])).name.removeprefix("mjGEOM_").lower()
            notes.append(f"link {name}: a shape of type {kind} is not kept")
        elif model.geom_contype[g] or model.geom_conaffinity[g]:
            collisions.append(shape)
        else:
            pictures.append(shape)
    drawn = () if collisions else tuple(pictures)
    return Link(name=name, inertia=inertia, collisions=tuple(collisions), pictures=drawn)


def _shape(model: Any, g: int) -> Shape | None:
    """Return a shape on its body; None for a kind that no hand has."""
    kinds, kind, size = mujoco.mjtGeom, int(model.geom_type[g]), model.geom_size[g]
    X_BS = _pose(model.geom_pos[g], model.geom_quat[g])
    primitives = {
        kinds.mjGEOM_BOX: lambda: Box(2.0 * size),
        kinds.mjGEOM_SPHERE: lambda: Sphere(size[0]),
        kinds.mjGEOM_CAPSULE: lambda: Capsule(size[0], 2.0 * size[1]),
        kinds.mjGEOM_CYLINDER: lambda: Cylinder(size[0], 2.0 * size[1]),
    }
    if kind in primitives:
        return Shape(X_LS=X_BS, primitive=primitives[kind]())
    if kind == kinds.mjGEOM_ELLIPSOID:
        return Shape(X_LS=X_BS, **ellipsoid(size))
    if kind != kinds.mjGEOM_MESH:
        return None

    # A mesh, in the frame that MuJoCo gives it.
    m = int(model.geom_dataid[g])
    start, face = int(model.mesh_vertadr[m]), int(model.mesh_faceadr[m])
    vertices = model.mesh_vert[start : start + model.mesh_vertnum[m]].astype(float)
    faces = model.mesh_face[face : face + model.mesh_facenum[m]].astype(np.int64)
    return Shape(X_LS=X_BS, vertices=vertices, faces=faces)


def _mimics(model: Any, joints: Sequence[str], notes: list[str]) -> Iterator[Mimic]:
    """Yield the active equalities of joints; `notes` receives a line for each other one."""
    for e in np.flatnonzero(model.eq_active0):
        kind = mujoco.mjtEq(int(model.eq_type[e]))
        if kind != mujoco.mjtEq.mjEQ_JOINT:
            notes.append(f"equality <{kind.name.removeprefix('mjEQ_').lower()}>: is not kept")
            continue
        follower, led_by = model.eq_obj1id[e], model.eq_obj2id[e]
        name = joints[follower]
        offset, ratio, *rest = (float(x) for x in model.eq_data[e, :5])
        if led_by < 0:
            raise HandError(
                f"model: joint {name!r} must follow a joint, got an equality with a constant: "
                "leave the joint out"
            )
        if any(rest):
            raise HandError(f"model: polycoef of joint {name!r} must be a line, got a curve")

        # Equalities hold between displacements from the posture that the file draws.
        zero, start = (float(q) for q in model.qpos0[model.jnt_qposadr[[follower, led_by]]])
        offset += zero - ratio * start
        yield Mimic(joint=name, leader=joints[led_by], ratio=ratio, offset=offset)


def _efforts(model: Any, joints: Sequence[str]) -> dict[str, float]:
    """Return the effort of each joint whose actuators, or which itself, have force ranges.

    Forces that follow from gains and controls, or from tendons, differ between postures.
    """
    total: dict[int, float] = {}
    kinds = mujoco.mjtTrn
    for a in range(model.nu):
        if kinds(int(model.actuator_trntype[a])) in (kinds.mjTRN_JOINT, kinds.mjTRN_JOINTINPARENT):
            most = float(np.abs(model.actuator_forcerange[a]).max())
            force = most if model.actuator_forcelimited[a] else np.inf
            joint = int(model.actuator_trnid[a, 0])
            total[joint] = total.get(joint, 0.0) + force * abs(float(model.actuator_gear[a, 0]))
    for j in np.flatnonzero(model.jnt_actfrclimited).tolist():
        total[j] = min(total.get(j, np.inf), float(np.abs(model.jnt_actfrcrange[j]).max()))
    return {joints[j]: float(effort) for j, effort in total.items() if np.isfinite(effort)}
