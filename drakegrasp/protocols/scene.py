"""Hand and object in MuJoCo, with the numbers of a protocol.

Input: the MJCF of a hand, a folder with an object's convex parts, and a protocol. Output: a
`ProtocolScene`, which can be reset, moved, pushed and measured. The hand's root is welded to a body
that moves on command, as in DexGraspBench (`src/util/hand_util.py`). Needs the extra `[peer]`.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from drakegrasp.errors import DataError, HandError, MeshError, one_line
from drakegrasp.foreign_files import read_json
from drakegrasp.frames import Array
from drakegrasp.mjcf import make_spec
from drakegrasp.protocols.protocol import MujocoProtocol

#: Prefix of the names that come from the hand's MJCF.
HAND = "hand-"
#: Impedance of the weld that moves the hand, and index of the scale of its torques in its data.
_WELD, _TORQUE_SCALE = (0.9, 0.95, 0.001, 0.5, 2.0), 10
#: Settings of the solver that the protocol determines.
_SETTINGS = (*("timestep", "integrator", "disableflags", "cone", "noslip_iterations", "impratio"),)
#: Half extents of the table's plane, which has no edge, and the spacing of its grid.
_PLANE = (0.0, 0.0, 1.0)
#: Warnings with which MuJoCo restarts from its rest state, or leaves contacts out.
_DIVERGED = (
    mujoco.mjtWarning.mjWARN_CONTACTFULL,
    mujoco.mjtWarning.mjWARN_CNSTRFULL,
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
)
#: Paths of the parts and of the volume within the folder of an object.
PARTS, INFO = "urdf/meshes", "info/simplified.json"


@dataclass(frozen=True, kw_only=True)
class ObjectFolder:
    """Convex parts in the object's frame {O}.

    Attributes:
        parts: Wavefront files, sorted by name.
        scale: Factor by which their coordinates are multiplied.
        volume: Volume of the scaled object [m^3].
        digest: 16 digits of the SHA-256 of the parts and the volume.
    """

    parts: tuple[Path, ...]
    scale: float
    volume: float
    digest: str


def read_object_folder(folder: Path, scale: float) -> ObjectFolder:
    """Return the object of a folder.

    Args:
        folder: Folder in DexGraspBench's layout.
        scale: Scale of the object.

    Raises:
        DataError: If the folder has no parts, or its volume cannot be read.
    """
    parts = tuple(sorted((folder / PARTS).glob("*.obj")))
    if not parts:
        raise DataError(f"{folder / PARTS}: must hold the object's convex parts (.obj), got none")
    if not (math.isfinite(scale) and scale > 0.0):
        raise DataError(f"{folder}: scale must be a positive number, got {scale}")
    try:
        info = read_json(folder / INFO)
        unit = info["mass"] / (info["density"] * info["scale"] ** 3)
    except (KeyError, TypeError, ArithmeticError, OSError, ValueError) as error:
        raise DataError(
            f"{folder / INFO}: must have mass, density and scale, got {one_line(error)}"
        ) from None
    if not (math.isfinite(unit) and unit > 0.0):
        raise DataError(f"{folder / INFO}: the volume must be positive, got {unit}")

    # The digest identifies the object, whatever the name of its folder.
    text = hashlib.sha256()
    for part in parts:
        text.update(part.read_bytes())
    text.update(repr((unit, scale)).encode())
    return ObjectFolder(
        parts=parts, scale=scale, volume=unit * scale**3, digest=text.hexdigest()[:16]
    )


class ProtocolScene:
    """A hand of n joints and an object, under a protocol's rules.

    Attributes:
        joints: Number n of the hand's joint positions.
        mass: Mass of the object [kg], as the protocol specifies it.
        modelled_mass: Mass of the object in the model [kg]; it differs if parts overlap.
    """

    def __init__(self, protocol: MujocoProtocol, hand: Path, thing: ObjectFolder) -> None:
        """Build the scene.

        Args:
            protocol: The protocol, with its numbers.
            hand: MJCF of the hand; its world body is the hand's root.
            thing: The object.

        Raises:
            HandError: If the MJCF cannot be used.
            MeshError: If a part of the object cannot be used.
        """
        self.mass = protocol.object_mass(thing.volume)
        spec = make_spec(protocol.time_step, protocol.impratio, protocol.noslip_iterations)
        spec.option.disableflags = mujoco.mjtDisableBit.mjDSBL_GRAVITY
        _add_hand(spec, protocol, hand)
        if protocol.lift is not None:
            spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=_PLANE)
        _add_object(spec, thing, self.mass / thing.volume)
        for geom in spec.geoms:
            geom.friction[:2] = protocol.friction
            geom.condim = 4
        spec.add_key()

        # The object's files were checked, so an error here is due to the hand.
        try:
            self._model = spec.compile()
        except ValueError as error:
            raise HandError(f"{hand}: must be an MJCF of a hand, got {one_line(error)}") from None
        self._data = mujoco.MjData(self._model)
        self._object = self._model.body("object").id
        self.modelled_mass = float(self._model.body_subtreemass[self._object])
        self.joints = self._model.nq - 14
        self._commands = self._command_matrix()

    def _command_matrix(self) -> Array:
        """Return the matrix (actuators, n) from joint positions to commands."""
        m, d = self._model, self._data
        mujoco.mj_resetDataKeyframe(m, d, 0)
        mujoco.mj_forward(m, d)
        matrix = np.zeros((m.nu, m.nv))
        mujoco.mju_sparse2dense(
            matrix, d.actuator_moment, d.moment_rownnz, d.moment_rowadr, d.moment_colind
        )
        return matrix[:, 6:-6]

    def reset(self, posture: Array, object_pose: Array) -> None:
        """Place hand (7 + n,) and object (7,) at rest in their poses, without a push."""
        m, d = self._model, self._data
        m.key_qpos[0] = np.concatenate([posture, object_pose])
        m.key_ctrl[0] = self._commands @ posture[7:]
        m.key_mpos[0], m.key_mquat[0] = posture[:3], posture[3:7]
        mujoco.mj_resetDataKeyframe(m, d, 0)
        mujoco.mj_forward(m, d)

    def move(self, start: Array, end: Array, changes: int, steps: int) -> None:
        """Command the hand from one posture (7 + n,) to another.

        Args:
            start: Posture at which the command begins.
            end: Posture at which the command ends.
            changes: Number of changes of the command, by equal amounts.
            steps: Number of time steps after each change.
        """
        shares = np.linspace(0.0, 1.0, changes + 1)
        p = np.linspace(start[:3], end[:3], changes + 1)
        ends = Rotation.from_quat(np.stack([start[3:7], end[3:7]]), scalar_first=True)
        q = Slerp([0.0, 1.0], ends)(shares).as_quat(scalar_first=True)
        commands = np.linspace(self._commands @ start[7:], self._commands @ end[7:], changes + 1)
        for i in range(1, changes + 1):
            self._data.mocap_pos[0], self._data.mocap_quat[0] = p[i], q[i]
            self._data.ctrl[:] = commands[i]
            mujoco.mj_forward(self._model, self._data)
            self.step(steps)

    def step(self, steps: int) -> None:
        """Simulate a number of time steps."""
        mujoco.mj_step(self._model, self._data, steps)

    @property
    def diverged(self) -> bool:
        """Whether the simulation failed since the last reset."""
        return any(self._data.warning[kind].number > 0 for kind in _DIVERGED)

    def push(self, force: Array) -> None:
        """Apply a force (3,) [N] at the object's centre of mass until the next reset."""
        self._data.xfrc_applied[self._object, :3] = force

    def push_where_it_is(self, force: Array) -> None:
        """Apply a force (3,) [N] at the present position of the centre of mass.

        Its torque about the object's origin does not change when the object moves.
        """
        m, d = self._model, self._data
        d.qfrc_applied[:] = 0.0
        mujoco.mj_applyFT(
            m, d, force, np.zeros(3), d.subtree_com[self._object], self._object, d.qfrc_applied
        )

    def object_pose(self) -> Array:
        """Return position [m] and quaternion (w, x, y, z) of the object in {W}, (7,)."""
        return self._data.qpos[-7:].copy()

    def penetrations(self) -> tuple[float, float]:
        """Return the deepest contacts of the object, and of the hand with itself or the table [m].

        A value is zero if nothing touches.
        """
        bodies, d = self._model.geom_bodyid, self._data
        with_object, others = [0.0], [0.0]
        for contact in d.contact[: d.ncon]:
            pair = bodies[contact.geom1], bodies[contact.geom2]
            (with_object if self._object in pair else others).append(-contact.dist)
        return max(with_object), max(others)


def _read_hand(path: Path) -> mujoco.MjSpec:
    """Return the MJCF of a hand, with absolute paths of its meshes.

    Raises:
        HandError: If the MJCF cannot be read.
    """
    try:
        hand = mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise HandError(f"{path}: must be an MJCF of a hand, got {one_line(error)}") from None
    for mesh in hand.meshes:
        if mesh.file:
            mesh.file = str((path.parent / hand.meshdir / mesh.file).resolve())
    hand.meshdir = ""
    return hand


def _add_hand(spec: mujoco.MjSpec, protocol: MujocoProtocol, path: Path) -> None:
    """Add the hand, free in space, and the body that moves the hand."""
    hand = _read_hand(path)
    # The protocol's settings replace those of the file; MuJoCo warns if the two differ.
    for name in _SETTINGS:
        setattr(hand.option, name, getattr(spec.option, name))

    # Settings of the protocol for contacts, joints and motors.
    for geom in hand.geoms:
        geom.solimp[:3], geom.solref[:2] = protocol.solimp, protocol.solref
    for joint in hand.joints if protocol.joint_margin else ():
        joint.margin = protocol.joint_margin
    for actuator in hand.actuators:
        if protocol.position_gain is not None:
            actuator.gainprm[0], actuator.biasprm[1] = (
                protocol.position_gain,
                -protocol.position_gain,
            )
        if protocol.velocity_gain is not None:
            actuator.biasprm[2] = -protocol.velocity_gain

    root = spec.worldbody.add_frame().attach_body(hand.worldbody, HAND, "")
    root.add_freejoint(name="hand_freejoint")
    spec.worldbody.add_body(name="mocap_body", mocap=True)
    weld = np.zeros(mujoco.mjNEQDATA)
    weld[_TORQUE_SCALE] = 1.0
    spec.add_equality(
        type=mujoco.mjtEq.mjEQ_WELD,
        objtype=mujoco.mjtObj.mjOBJ_BODY,
        name1="mocap_body",
        name2=f"{HAND}world",
        solimp=_WELD,
        data=weld,
    )


def _add_object(spec: mujoco.MjSpec, thing: ObjectFolder, density: float) -> None:
    """Add the object, free in space, as the last body.

    Raises:
        MeshError: If a part is not a mesh.
    """
    body = spec.worldbody.add_body(name="object")
    body.add_freejoint(name="obj_freejoint")
    for number, path in enumerate(thing.parts):
        name = f"object_part_{number}"
        _validate_mesh(path)
        spec.add_mesh(name=name, file=str(path.resolve()), scale=[thing.scale] * 3)
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, density=density)


def _validate_mesh(path: Path) -> None:
    """Raise an error if MuJoCo cannot read a file as a mesh."""
    alone = mujoco.MjSpec()
    alone.add_mesh(name="part", file=str(path.resolve()))
    alone.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="part")
    try:
        alone.compile()
    except ValueError as error:
        raise MeshError(f"{path}: must be a convex part, got {one_line(error)}") from None


def hand_digest(path: Path) -> str:
    """Return 16 digits of the SHA-256 of an MJCF and its meshes.

    Raises:
        HandError: If the MJCF or a mesh cannot be read.
    """
    hand = _read_hand(path)
    try:
        text = hashlib.sha256(path.read_bytes())
        for mesh in hand.meshes:
            if mesh.file:
                text.update(Path(mesh.file).read_bytes())
    except OSError as error:
        raise HandError(f"{path}: its meshes must be readable, got {one_line(error)}") from None
    return text.hexdigest()[:16]
