"""MJCF as MuJoCo compiles it and as Drake reads it.

Input: the XML of an MJCF file, and its meshes. Output: the same hand without the parts of
the language that Drake drops (bodies and joints without names, frames, classes within classes), and
the joints, couplings, efforts and inertias as MuJoCo compiles them; Drake reads only a part of
these.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeAlias
from xml.etree.ElementTree import Element

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RotationMatrix
from pydrake.multibody.tree import RotationalInertia, SpatialInertia

from drakegrasp.arithmetic import norm
from drakegrasp.errors import HandError, one_line
from drakegrasp.frames import Array
from drakegrasp.hand.parsing import Mimic

#: Attributes that a class of MJCF gives to the elements of each tag.
_Defaults = dict[str, dict[str, str]]
#: Sections that are not about a hand.
_ASIDE = ("size", "keyframe", "sensor", "visual", "statistic", "custom", "deformable")
#: Elements that create bodies that the file does not write out.
_MADE = ("replicate", "composite", "flexcomp", "attach", "model")


def trim(root: Element) -> None:
    """Remove sections that are not about a hand, and name each body and joint.

    Raises:
        HandError: If bodies are not written out.
    """
    for element in root.iter():
        if element.tag in _MADE:
            raise HandError(
                f"model: must have its bodies written out, got <{element.tag}>: load and save it "
                "with MuJoCo"
            )
    for section in [child for child in root if child.tag in _ASIDE]:
        root.remove(section)
    for material in root.iter("material"):
        for layer in material.findall("layer"):
            material.remove(layer)
    for world in root.findall("worldbody"):
        _name(world, "world", [0])


def _name(parent: Element, name: str, count: list[int]) -> None:
    """Give names to the unnamed bodies and joints below an element.

    Args:
        parent: The element, which is the body `name` or a frame in this body.
        name: Name of the body.
        count: Number of bodies visited so far, in a list of one; it is increased.
    """
    for child in parent:
        if child.tag == "frame":
            _name(child, name, count)
        elif child.tag == "body":
            count[0] += 1
            own = child.attrib.setdefault("name", f"body{count[0]}")
            joints = [joint for joint in child.iterfind("joint") if not joint.get("name")]
            for n, joint in enumerate(joints):
                joint.set("name", f"{name}-{own}" + (f"-{n + 1}" if n else ""))
            _name(child, own, count)


def spell_out(root: Element) -> None:
    """Replace frames by welded bodies, and write into each class the values that it inherits.

    Raises:
        HandError: If a frame contains a joint or an inertia of the body around it.
    """
    for world in root.findall("worldbody"):
        _lift_frames(world)
    for frame in root.iter("frame"):
        if spoilt := [c.tag for c in frame if c.tag in ("joint", "freejoint", "inertial")]:
            raise HandError(f"model: <{spoilt[0]}> must lie in a body, got it in a <frame>")
    for n, frame in enumerate(list(root.iter("frame"))):
        frame.tag = "body"
        frame.set("name", f"drakegrasp_frame_{n}")
    main: _Defaults = {}
    for default in root.findall("default"):
        main = _inherit(default, main)


def _lift_frames(world: Element) -> None:
    """Move the content of the world's frames into the world: the pose of the hand is not used."""
    while (frame := world.find("frame")) is not None:
        place = list(world).index(frame)
        for child in frame:
            if "childclass" in frame.attrib and child.tag in ("body", "frame"):
                child.attrib.setdefault("childclass", frame.attrib["childclass"])
        world.remove(frame)
        world[place:place] = list(frame)


def _inherit(default: Element, above: _Defaults) -> _Defaults:
    """Write the values that a class of MJCF inherits into the class; return all its values.

    Drake looks only at the next class, so values that this class does not name would be lost.
    """
    given = {tag: dict(attributes) for tag, attributes in above.items()}
    own = [element for element in default if element.tag != "default"]
    for element in own:
        given.setdefault(element.tag, {}).update(element.attrib)
        element.attrib.update(given[element.tag])
    present = {element.tag for element in own}
    default.extend(Element(tag, given[tag]) for tag in given if tag not in present)
    for nested in default.findall("default"):
        _inherit(nested, given)
    return given


#: Results of MuJoCo's compiler: M_BBo_B of each body with a mass; limits (2,) of each moving joint
#: [rad or m]; the largest effort of each joint that has one [N m or N]; joints that follow others;
#: and notes on what was left out, one line each.
Compiled: TypeAlias = tuple[
    dict[str, SpatialInertia], dict[str, Array], dict[str, float], list[Mimic], list[str]
]


def compile_model(path: Path) -> Compiled:
    """Return MuJoCo's compilation of an MJCF file in which every body and joint has a name.

    Raises:
        HandError: If MuJoCo is missing or rejects the file, or an equality is not linear.
    """
    try:
        import mujoco
    except ImportError:
        raise HandError(
            "model: MJCF is read with MuJoCo, got none: pip install 'drakegrasp[peer]'"
        ) from None
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        text = one_line(error).replace(str(path.parent) + "/", "")
        raise HandError(f"model: must be MJCF that MuJoCo reads, got {text}") from None

    kinds = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE
    endless = np.array([-np.inf, np.inf])
    limits = {
        model.joint(j).name: model.jnt_range[j].copy() if model.jnt_limited[j] else endless
        for j, kind in enumerate(model.jnt_type.tolist())
        if kind in kinds
    }
    mimics, notes = _mimics(mujoco, model)
    return _inertias(model), limits, _efforts(mujoco, model), mimics, notes


def _mimics(mujoco: Any, model: Any) -> tuple[list[Mimic], list[str]]:
    """Return the active equalities of joints, and a note for each other active equality."""
    mimics, notes = [], []
    for e in np.flatnonzero(model.eq_active0):
        kind = mujoco.mjtEq(int(model.eq_type[e]))
        if kind != mujoco.mjtEq.mjEQ_JOINT:
            notes.append(f"equality <{kind.name.removeprefix('mjEQ_').lower()}>: is not kept")
            continue
        follower, led_by = model.eq_obj1id[e], model.eq_obj2id[e]
        name = model.joint(follower).name
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
        leader = model.joint(led_by).name
        mimics.append(Mimic(joint=name, leader=leader, ratio=ratio, offset=offset))
    return mimics, notes


def _efforts(mujoco: Any, model: Any) -> dict[str, float]:
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
            efforts[model.joint(j).name] = float(np.abs(span).max())
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


def _inertias(model: Any) -> dict[str, SpatialInertia]:
    """Return M_BBo_B of each body with a mass, except for the world."""
    found = {}
    for b in range(1, model.nbody):
        name, mass = model.body(b).name, float(model.body_mass[b])
        if not np.isfinite([mass, *model.body_inertia[b], *model.body_ipos[b]]).all():
            raise HandError(f"model: mass and inertia of body {name!r} must be finite numbers")
        if mass > 0.0:
            R_BI = RotationMatrix(Quaternion(model.body_iquat[b] / norm(model.body_iquat[b])))
            central = RotationalInertia(*model.body_inertia[b]).ReExpress(R_BI)
            found[name] = SpatialInertia.MakeFromCentralInertia(mass, model.body_ipos[b], central)
    return found
