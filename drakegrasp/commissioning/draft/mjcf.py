"""MJCF as MuJoCo compiles it.

Input: the XML of an MJCF file, and its meshes. Output: bodies with their shapes and inertias,
joints, couplings and efforts, all of them from the compiled model.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.geometry import Box, Capsule, Cylinder, Sphere
from pydrake.math import RotationMatrix
from pydrake.multibody.tree import RotationalInertia, SpatialInertia

from drakegrasp.arithmetic import norm
from drakegrasp.commissioning.draft.parts import ENDLESS, Carrier, Link, Parts, motion
from drakegrasp.commissioning.draft.shapes import Shape, ellipsoid, read_mesh
from drakegrasp.commissioning.draft.source import Source
from drakegrasp.errors import HandError, one_line
from drakegrasp.frames import Array, make_pose
from drakegrasp.hand.parsing import Mimic
from drakegrasp.mesh.wavefront import obj_text

#: Elements that are drawn only, and whose files are not read.
_LOOKS = ("texture", "layer", "skin")
#: Elements that make any number of bodies.
_MADE = ("replicate", "flexcomp")
#: First group of shapes that MuJoCo does not draw unless it is asked to.
HIDDEN = 3
#: Colour of a shape whose model gives none: that of its material is drawn.
_PLAIN = np.array([0.5, 0.5, 0.5, 1.0])


def compile_parts(source: Source) -> Parts:
    """Return the parts of an MJCF model.

    Raises:
        HandError: If MuJoCo is missing or rejects the file, or if the model has something that no
            hand of rigid links has.
    """
    try:
        import mujoco
    except ImportError:
        raise HandError(
            "model: MJCF is read with MuJoCo, got none: pip install 'drakegrasp[peer]'"
        ) from None
    with tempfile.TemporaryDirectory() as scratch:
        path = _write(source, Path(scratch))
        try:
            model = mujoco.MjModel.from_xml_path(str(path))
        except ValueError as error:
            text = one_line(error).replace(f"{scratch}/", "")
            raise HandError(f"model: must be MJCF that MuJoCo reads, got {text}") from None
    if model.nflex:
        raise HandError("model: must be of rigid bodies, got <flex>")

    # Bodies and joints without a name get one.
    bodies = [model.body(b).name or f"body{b}" for b in range(model.nbody)]
    joints = [model.joint(j).name or _joint_name(model, bodies, j) for j in range(model.njnt)]
    for names in (bodies, joints):
        if twins := sorted({name for name in names if names.count(name) > 1}):
            raise HandError(f"model: names must be unique, got {twins[0]!r} twice")
    carriers = list(_carriers(mujoco, model, bodies, joints))
    mimics, notes = _mimics(mujoco, model, joints)
    links: dict[Any, Link] = {}
    for b in range(1, model.nbody):
        links[b], left_out = _link(mujoco, model, b, bodies[b])
        notes += left_out
    for carrier in carriers:
        bare = Link(name=f"{carrier.name}_end", inertia=SpatialInertia.Zero())
        links.setdefault(carrier.child, bare)
    return Parts(
        name=model.names.partition(b"\0")[0].decode(),
        bodies=links,
        carriers=carriers,
        efforts=_efforts(mujoco, model, joints),
        mimics=mimics,
        notes=notes,
    )


def _write(source: Source, folder: Path) -> Path:
    """Write a model, whose meshes become Wavefront files beside it; return its path.

    Raises:
        HandError: If a mesh cannot be read.
    """
    # The compiler element specifies the folder of the meshes.
    root, base = source.root, source.folder
    for compiler in root.iter("compiler"):
        place = compiler.attrib.pop("meshdir", None) or compiler.attrib.pop("assetdir", None)
        base = source.folder / place if place else base
        for key in ("assetdir", "texturedir", "strippath"):
            compiler.attrib.pop(key, None)
    for element in list(root.iter()):
        if element.tag in _MADE:
            raise HandError(
                f"model: must have its bodies written out, got <{element.tag}>: load and save it "
                "with MuJoCo"
            )
        element.attrib.pop("texture", None)
        for child in [child for child in element if child.tag in _LOOKS]:
            element.remove(child)

    # If a mesh has no name, its name is that of the file.
    for n, mesh in enumerate(root.iterfind("asset/mesh")):
        if file := mesh.get("file"):
            shape = read_mesh(source.find(file, base))
            assert shape.vertices is not None and shape.faces is not None
            text = obj_text(shape.vertices, shape.faces, normals=False)
            (folder / f"{n}.obj").write_text(text, encoding="utf-8")
            mesh.attrib.pop("content_type", None)
            mesh.attrib.setdefault("name", Path(file).stem)
            mesh.set("file", f"{n}.obj")
    path = folder / "model.xml"
    ElementTree.ElementTree(root).write(path, encoding="utf-8")
    return path


def _joint_name(model: Any, bodies: Sequence[str], j: int) -> str:
    """Return a name for a joint: those of the bodies that it joins."""
    body = int(model.jnt_bodyid[j])
    n = j - int(model.body_jntadr[body])
    return f"{bodies[model.body_parentid[body]]}-{bodies[body]}" + (f"-{n + 1}" if n else "")


def _pose(p: Array, quaternion: Array) -> Array:
    """Return a pose (4, 4) of a position (3,) and a quaternion w, x, y, z."""
    R = RotationMatrix(Quaternion(quaternion / norm(quaternion)))
    return make_pose(R.matrix(), p)


def _carriers(
    mujoco: Any, model: Any, bodies: Sequence[str], joints: Sequence[str]
) -> Iterator[Carrier]:
    """Yield what carries each body. The hand is free, however the file fixes it to the world.

    A body with several joints has a body without mass between each two of them.
    """
    kinds = mujoco.mjtJoint
    for b in range(1, model.nbody):
        parent: Any = int(model.body_parentid[b])
        if parent == 0:
            continue
        X_PB, first = _pose(model.body_pos[b], model.body_quat[b]), int(model.body_jntadr[b])
        last = first + int(model.body_jntnum[b]) - 1
        if last < first:
            yield Carrier(name=bodies[b], parent=parent, child=b, X_PJ=X_PB, X_CJ=np.eye(4))
        for j in range(first, last + 1):
            kind = kinds(int(model.jnt_type[j]))
            if kind not in (kinds.mjJNT_HINGE, kinds.mjJNT_SLIDE):
                raise HandError(
                    f"model: joint {joints[j]!r} must be revolute, prismatic or fixed, got "
                    f"{kind.name.removeprefix('mjJNT_').lower()}"
                )

            # The body is at X_PB where the joint has the position of the model's reference.
            child = b if j == last else (b, j)
            axis, slides = model.jnt_axis[j].copy(), kind == kinds.mjJNT_SLIDE
            reference = float(model.qpos0[model.jnt_qposadr[j]])
            X_BJ = make_pose(np.eye(3), model.jnt_pos[j])
            yield Carrier(
                name=joints[j],
                parent=parent,
                child=child,
                X_PJ=X_PB @ X_BJ @ motion(axis, slides, -reference),
                X_CJ=X_BJ,
                axis=axis,
                slides=slides,
                limits=model.jnt_range[j].copy() if model.jnt_limited[j] else ENDLESS,
            )
            parent, X_PB = child, np.eye(4)


def _link(mujoco: Any, model: Any, b: int, name: str) -> tuple[Link, list[str]]:
    """Return a body with its shapes, and notes on the shapes that are left out."""
    mass, inertia = float(model.body_mass[b]), SpatialInertia.Zero()
    if not np.isfinite([mass, *model.body_inertia[b], *model.body_ipos[b]]).all():
        raise HandError(f"model: mass and inertia of body {name!r} must be finite numbers")
    if mass > 0.0:
        R_BI = RotationMatrix(Quaternion(model.body_iquat[b] / norm(model.body_iquat[b])))
        central = RotationalInertia(*model.body_inertia[b]).ReExpress(R_BI)
        inertia = SpatialInertia.MakeFromCentralInertia(mass, model.body_ipos[b], central)

    # Shapes collide, are drawn, or both.
    collisions, visuals, notes = [], [], list[str]()
    for g in np.flatnonzero(model.geom_bodyid == b).tolist():
        shape, rgba = _shape(mujoco, model, g), _colour(model, g)
        if shape is None:
            kind = mujoco.mjtGeom(int(model.geom_type[g])).name.removeprefix("mjGEOM_").lower()
            notes.append(f"link {name}: a shape of type {kind} is not kept")
            continue
        if model.geom_contype[g] or model.geom_conaffinity[g]:
            collisions.append(shape)
        if model.geom_group[g] < HIDDEN and rgba[3] > 0.0:
            visuals.append(replace(shape, colour=rgba[:3]))
    shapes = {"collisions": tuple(collisions), "visuals": tuple(visuals)}
    return Link(name=name, inertia=inertia, **shapes), notes


def _shape(mujoco: Any, model: Any, g: int) -> Shape | None:
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


def _colour(model: Any, g: int) -> Array:
    """Return the colour (4,) with which MuJoCo draws a shape."""
    own, material = np.asarray(model.geom_rgba[g], dtype=float), int(model.geom_matid[g])
    if material >= 0 and np.array_equal(own, _PLAIN):
        return np.asarray(model.mat_rgba[material], dtype=float)
    return own


def _mimics(mujoco: Any, model: Any, joints: Sequence[str]) -> tuple[list[Mimic], list[str]]:
    """Return the active equalities of joints, and a note for each other active equality."""
    mimics, notes = [], []
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
        mimics.append(Mimic(joint=name, leader=joints[led_by], ratio=ratio, offset=offset))
    return mimics, notes


def _efforts(mujoco: Any, model: Any, joints: Sequence[str]) -> dict[str, float]:
    """Return the total effort of each joint's actuators at rest, within the joint's own limit."""
    total: dict[int, Array] = {}
    for a in range(len(model.actuator_trntype)):
        force = _force(mujoco, model, a)
        for joint, arm in _arms(mujoco, model, a):
            total[joint] = total.get(joint, np.zeros(2)) + np.sort(arm * force)

    # The joint's own limit applies to the sum, and on its own if there is no actuator.
    efforts = {}
    for j in range(model.njnt):
        span = total.get(j)
        if model.jnt_actfrclimited[j]:
            most = model.jnt_actfrcrange[j]
            span = most if span is None else np.clip(span, *most)
        if span is not None:
            efforts[joints[j]] = float(np.abs(span).max())
    return efforts


def _arms(mujoco: Any, model: Any, a: int) -> list[tuple[int, float]]:
    """Return each joint that an actuator moves, with its effort per force of the actuator."""
    kinds, kind = mujoco.mjtTrn, model.actuator_trntype[a]
    target, gear = int(model.actuator_trnid[a, 0]), float(model.actuator_gear[a, 0])
    if kind == kinds.mjTRN_JOINT or kind == kinds.mjTRN_JOINTINPARENT:
        return [(target, gear)]
    if kind != kinds.mjTRN_TENDON:
        return []

    # A tendon that is a sum of joints; the lever arms of a spatial tendon differ between postures.
    first = model.tendon_adr[target]
    wraps = slice(first, first + model.tendon_num[target])
    rows = zip(model.wrap_type[wraps], model.wrap_objid[wraps], model.wrap_prm[wraps], strict=True)
    return [(int(joint), gear * float(coefficient)) for wrap, joint, coefficient in rows
            if wrap == mujoco.mjtWrap.mjWRAP_JOINT]  # fmt: skip


def _force(mujoco: Any, model: Any, a: int) -> Array:
    """Return the smallest and largest force (2,) of an actuator at rest; infinite if unknown."""
    force, biases, dynamics = np.array([-np.inf, np.inf]), mujoco.mjtBias, mujoco.mjtDyn
    gain, bias = model.actuator_gainprm[a], model.actuator_biasprm[a]
    kind = model.actuator_biastype[a]
    instant = dynamics.mjDYN_NONE, dynamics.mjDYN_FILTER, dynamics.mjDYN_FILTEREXACT
    direct = int(model.actuator_dyntype[a]) in instant
    fixed = model.actuator_gaintype[a] == mujoco.mjtGain.mjGAIN_FIXED

    # A servo's force depends on its position, so only its force range limits it.
    constant = kind == biases.mjBIAS_NONE or (kind == biases.mjBIAS_AFFINE and bias[1] == 0.0)
    if direct and fixed and constant and model.actuator_ctrllimited[a]:
        start = 0.0 if kind == biases.mjBIAS_NONE else bias[0]
        force = np.sort(start + gain[0] * model.actuator_ctrlrange[a])
    if model.actuator_forcelimited[a]:
        force = np.clip(force, *model.actuator_forcerange[a])
    return force
