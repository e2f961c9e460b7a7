"""What MuJoCo makes of an MJCF file.

In: the file, with meshes beside it. Out: joints, couplings, efforts and inertias as MuJoCo compiles
them, which Drake reads in part: classes, gears, references and equalities have rules of their own.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.math import RotationMatrix
from pydrake.multibody.tree import RotationalInertia, SpatialInertia

from drakegrasp.errors import HandError, one_line
from drakegrasp.frames import Array
from drakegrasp.hand.model_text import Mimic


@dataclass(frozen=True, kw_only=True, eq=False)
class Compiled:
    """What MuJoCo makes of an MJCF file.

    Attributes:
        limits: (2,) of each joint that turns or slides [rad or m].
        efforts: Largest effort of each joint that has one [N m or N].
        mimics: Joints that follow others.
        inertias: M_BBo_B of each body with a mass.
        notes: What was left out, a line each.
    """

    limits: dict[str, Array]
    efforts: dict[str, float]
    mimics: list[Mimic]
    inertias: dict[str, SpatialInertia]
    notes: list[str]


def compile_model(path: Path) -> Compiled:
    """Return what MuJoCo makes of an MJCF file in which every body and joint has a name.

    Raises:
        HandError: If MuJoCo is missing, or refuses it, or an equality is no line.
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

    kinds = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
    limits = {
        model.joint(j).name: model.jnt_range[j].copy()
        if model.jnt_limited[j]
        else np.array([-np.inf, np.inf])
        for j in range(model.njnt)
        if int(model.jnt_type[j]) in kinds
    }
    mimics, notes = _mimics(mujoco, model)
    return Compiled(
        limits=limits,
        efforts=_efforts(mujoco, model),
        mimics=mimics,
        inertias=_inertias(model),
        notes=notes,
    )


def _mimics(mujoco: Any, model: Any) -> tuple[list[Mimic], list[str]]:
    """Return the equalities of joints that are active, and a note of each other one that is."""
    mimics, notes = [], []
    for e in np.flatnonzero(model.eq_active0):
        if int(model.eq_type[e]) != int(mujoco.mjtEq.mjEQ_JOINT):
            kind = mujoco.mjtEq(int(model.eq_type[e])).name.removeprefix("mjEQ_").lower()
            notes.append(f"equality <{kind}>: is not kept")
            continue
        name = model.joint(model.eq_obj1id[e]).name
        offset, ratio, *rest = (float(x) for x in model.eq_data[e, :5])
        if model.eq_obj2id[e] < 0:
            raise HandError(
                f"model: joint {name!r} must follow a joint, got an equality with a constant: "
                "leave the joint out"
            )
        if any(rest):
            raise HandError(f"model: polycoef of joint {name!r} must be a line, got a curve")

        # Equalities hold between the ways from the posture that the file draws.
        leader = model.joint(model.eq_obj2id[e]).name
        ends = model.jnt_qposadr[[model.eq_obj1id[e], model.eq_obj2id[e]]]
        zero, start = (float(q) for q in model.qpos0[ends])
        offset += zero - ratio * start
        mimics.append(Mimic(joint=name, leader=leader, ratio=ratio, offset=offset))
    return mimics, notes


def _efforts(mujoco: Any, model: Any) -> dict[str, float]:
    """Return what the actuators of each joint give together at rest, at most what it may take."""
    total: dict[int, Array] = {}
    for a in range(len(model.actuator_trntype)):
        force = _force(mujoco, model, a)
        for joint, arm in _arms(mujoco, model, a):
            total[joint] = total.get(joint, np.zeros(2)) + np.sort(arm * force)

    # The limit of the joint itself holds for the sum, and alone where no actuator is.
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
    kind, target = int(model.actuator_trntype[a]), int(model.actuator_trnid[a, 0])
    gear = float(model.actuator_gear[a, 0])
    if kind in (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)):
        return [(target, gear)]
    if kind != int(mujoco.mjtTrn.mjTRN_TENDON):
        return []

    # A tendon that is a sum of joints; one through space has other levers in each posture.
    first, number = model.tendon_adr[target], model.tendon_num[target]
    wraps = [
        w
        for w in range(first, first + number)
        if int(model.wrap_type[w]) == int(mujoco.mjtWrap.mjWRAP_JOINT)
    ]
    return [(int(model.wrap_objid[w]), gear * float(model.wrap_prm[w])) for w in wraps]


def _force(mujoco: Any, model: Any, a: int) -> Array:
    """Return the least and largest force (2,) of an actuator at rest; infinite if unknown."""
    force = np.array([-np.inf, np.inf])
    gain, bias = model.actuator_gainprm[a], model.actuator_biasprm[a]
    direct = int(model.actuator_dyntype[a]) in (
        int(mujoco.mjtDyn.mjDYN_NONE),
        int(mujoco.mjtDyn.mjDYN_FILTER),
        int(mujoco.mjtDyn.mjDYN_FILTEREXACT),
    )
    biased = int(model.actuator_biastype[a]) != int(mujoco.mjtBias.mjBIAS_NONE)
    affine = int(model.actuator_biastype[a]) == int(mujoco.mjtBias.mjBIAS_AFFINE)
    fixed = int(model.actuator_gaintype[a]) == int(mujoco.mjtGain.mjGAIN_FIXED)

    # A servo's force depends on where it is: only its range of force limits it.
    plain = fixed and (not biased or (affine and bias[1] == 0.0))
    if direct and plain and model.actuator_ctrllimited[a]:
        constant = bias[0] if biased else 0.0
        force = np.sort(constant + gain[0] * model.actuator_ctrlrange[a])
    if model.actuator_forcelimited[a]:
        force = np.clip(force, *model.actuator_forcerange[a])
    return force


def _inertias(model: Any) -> dict[str, SpatialInertia]:
    """Return M_BBo_B of each body but the world that has a mass."""
    found = {}
    for b in range(1, model.nbody):
        name, mass = model.body(b).name, float(model.body_mass[b])
        if not np.isfinite([mass, *model.body_inertia[b], *model.body_ipos[b]]).all():
            raise HandError(f"model: mass and inertia of body {name!r} must be finite numbers")
        if mass > 0.0:
            w, x, y, z = model.body_iquat[b]
            R_BI = RotationMatrix(_matrix(w, x, y, z))
            central = RotationalInertia(*model.body_inertia[b]).ReExpress(R_BI)
            found[name] = SpatialInertia.MakeFromCentralInertia(mass, model.body_ipos[b], central)
    return found


def _matrix(w: float, x: float, y: float, z: float) -> Array:
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
