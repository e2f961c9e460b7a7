"""Posed scenes for MuJoCo: one MJCF file per grasp, with the object, the table and the hand.

Input: a dataset. Output: `<object>/<trial_id>.xml`, which `mujoco.MjModel.from_xml_path` loads, and
`meshes/`. All poses are in {T}. The keyframe `grasp` has the joint positions after closing, the
object in its resting pose, and the same joint positions as commands of the motors. The mass is that
of the object, without randomisation; the friction is that of the configuration or of the object.
The palm is fixed to the world.
"""

from __future__ import annotations

from pathlib import Path
from xml.sax.saxutils import escape

import mujoco

from drakegrasp.arithmetic import multiply
from drakegrasp.config import Config
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.exchange.dexgraspbench import pose_vector
from drakegrasp.exchange.export import ClosedGrasp, samples_by_object
from drakegrasp.frames import invert_pose
from drakegrasp.hand.description import Hand, load_plain_hand
from drakegrasp.mesh.surfaces import hull_text
from drakegrasp.mjcf import (
    MEMORY,
    convex_parts,
    make_hand_model,
    pair_friction,
    set_inertia,
)
from drakegrasp.objects.model import ObjectModel
from drakegrasp.runtime.progress import Report
from drakegrasp.vision.camera import object_colour

#: Description of the format in `drakegrasp export --help`.
HELP = "a MuJoCo scene per grasp: the closed hand, the object, the table; needs drakegrasp[peer]"

#: Half extents of the table [m]; its top is at z = 0.
TABLE = (0.8, 0.8, 0.05)
#: Folder of all meshes, and the folder of the hand's meshes in it.
MESHES, HAND = "meshes", "hand"


def write_mjcf(out: Path, folder: Path, progress: Report) -> int:
    """Write one scene per sample and return the number of scenes; see `export.export_dataset`."""
    from drakegrasp.pictures.still_scene import StillScene

    config = read_manifest(out).config
    hand = load_plain_hand(config.hand_source, "scenes of MuJoCo")
    posed, count = StillScene(hand), 0
    for thing, samples in samples_by_object(out, progress):
        scene = ObjectScenes(hand, thing, config, folder)
        (folder / thing.name).mkdir()
        for grasp in samples:
            text = scene.posed(grasp, posed.joints)
            (folder / thing.name / f"{grasp.trial_id}.xml").write_text(text, encoding="utf-8")
        count += len(samples)
    return count


class ObjectScenes:
    """Builds the scenes of one object, one grasp after the other."""

    def __init__(self, hand: Hand, thing: ObjectModel, config: Config, folder: Path) -> None:
        """Write the meshes, and build the scene.

        Args:
            hand: The hand.
            thing: The object.
            config: Configuration, from which the friction of hand and table is used.
            folder: Folder in which `meshes/` is created.
        """
        # The table.
        physics = thing.own_physics(config.physics)
        self._hand, self._meshes = hand, folder / MESHES
        self._spec = mujoco.MjSpec()
        self._spec.memory = MEMORY
        self._spec.modelname = thing.name
        self._spec.worldbody.add_light(pos=[0.3, -0.3, 1.5], dir=[-0.2, 0.2, -1.0])
        self._spec.worldbody.add_geom(
            name="table",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=[0.0, 0.0, -TABLE[2]],
            size=TABLE,
            rgba=[0.74, 0.70, 0.64, 1.0],
            friction=pair_friction(physics.friction_table),
            condim=4,
            priority=1,
        )

        # The hand, whose palm `posed` moves for each grasp, and the object.
        model = make_hand_model(hand, physics.friction_hand)
        self._joints = [joint.name for joint in model.joints]
        self._frame = self._attach(model)
        self._add_object(thing, physics.friction_hand)
        self._key = self._spec.add_key(name="grasp")

    def posed(self, grasp: ClosedGrasp, joints: tuple[str, ...]) -> str:
        """Return the MJCF of a grasp.

        Args:
            grasp: The sample.
            joints: Names of the joints, in the order of `grasp.q`.
        """
        palm = pose_vector(multiply(grasp.X_TG, invert_pose(self._hand.X_BG)))
        self._frame.pos, self._frame.quat = palm[:3], palm[3:]
        q = dict(zip(joints, grasp.q.tolist(), strict=True))
        self._key.qpos = [*(q[name] for name in self._joints), *pose_vector(grasp.X_TO)]
        self._key.ctrl = [q[joint] for joint in self._motor_joints()]

        # The compiler needs absolute paths of meshes; the file needs paths relative to its folder.
        self._spec.compile()
        return self._spec.to_xml().replace(escape(str(self._meshes)), f"../{MESHES}")

    def _motor_joints(self) -> list[str]:
        """Return the names of the joints that the motors drive."""
        return [motor.target.removeprefix(f"{HAND}/") for motor in self._spec.actuators]

    def _attach(self, model: mujoco.MjSpec) -> mujoco.MjsFrame:
        """Add the hand; return the frame to which its palm is attached."""
        for mesh in model.meshes:
            mesh.file = self._write(HAND, mesh.file, model.assets[mesh.file].decode())
        frame = self._spec.worldbody.add_frame()
        frame.attach_body(model.body(self._hand.palm_link), f"{HAND}/", "")
        return frame

    def _add_object(self, thing: ObjectModel, friction: float) -> None:
        body = self._spec.worldbody.add_body(name="object")
        body.add_freejoint(name="object")
        set_inertia(body, thing.mass, thing.p_OOcm, thing.I_OOcm_O)
        for number, corners in enumerate(convex_parts(thing)):
            name = f"part_{number:03d}"
            self._spec.add_mesh(
                name=name, file=self._write(thing.name, f"{name}.obj", hull_text(corners))
            )
            body.add_geom(
                type=mujoco.mjtGeom.mjGEOM_MESH,
                meshname=name,
                rgba=[*object_colour(thing.name), 1.0],
                friction=pair_friction(friction),
                condim=4,
            )

    def _write(self, folder: str, name: str, text: str) -> str:
        """Write the text of a mesh file and return the path of the file."""
        path = self._meshes / folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
        return str(path)
