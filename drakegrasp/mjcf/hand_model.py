"""A hand alone as an MJCF, whose world is the palm link: for tools that move the root themselves.

In: a hand. Out: `HandModel`: the specification, and the order of its joints. Each joint that a
motor moves has a position actuator, coupled joints follow. The root has no joint; joints that a
preshape keeps are none.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from drakegrasp.hand.description import SLIDE, Hand
from drakegrasp.mesh.wavefront import hull_text
from drakegrasp.mjcf.links import Collides, add_couplings, add_links

#: Gain [N m/rad] and largest torque [N m] of each motor, damping [N m s/rad] and inertia of rotors
#: [kg m^2]: those of the Shadow Hand of DexGraspBench (assets/hand/shadow/right_hand.xml). Joints
#: that slide have them by `description.SLIDE`.
GAIN, TORQUE, DAMPING, ARMATURE = 5.0, 3.0, 0.05, 2e-4
#: Links touch all that has MuJoCo's usual masks, and not each other.
_TOUCHES = Collides(contype=1, conaffinity=0)
#: Friction of a model that is not told another.
_FRICTION = 1.0
#: Folder of the meshes, beside the MJCF.
MESHES = "meshes"


@dataclass(frozen=True, kw_only=True, eq=False)
class HandModel:
    """A hand as a specification of MuJoCo.

    Attributes:
        spec: With a mesh file for each shape that is no primitive.
        joints: Names of the joints in the order of its positions.
        meshes: Text of each mesh file, by its name.
    """

    spec: mujoco.MjSpec
    joints: tuple[str, ...]
    meshes: dict[str, str]


def make_hand_model(hand: Hand, friction: float = _FRICTION) -> HandModel:
    """Return a hand as a specification of MuJoCo.

    Args:
        hand: The hand.
        friction: Coefficient of its contacts.
    """
    spec = mujoco.MjSpec()
    spec.modelname = hand.name
    spec.compiler.degree = False
    spec.compiler.balanceinertia = True
    coupled = {c.joint for i in hand.motor_fingers for c in hand.followers(i)}
    for joint in add_links(spec, hand, spec.worldbody, friction, touches=_TOUCHES):
        unit = SLIDE if joint.slides else 1.0
        joint.add(damping=DAMPING / unit**2, armature=ARMATURE / unit**2)
        if joint.name not in coupled:
            motor = spec.add_actuator(
                name=joint.name,
                trntype=mujoco.mjtTrn.mjTRN_JOINT,
                target=joint.name,
                forcelimited=True,
                forcerange=[-TORQUE / unit, TORQUE / unit],
            )
            # As numbers: the word `position` of a newer MuJoCo is none to the benchmark's.
            gain = GAIN / unit**2
            motor.biastype = mujoco.mjtBias.mjBIAS_AFFINE
            motor.gainprm[0], motor.biasprm[1] = gain, -gain
    add_couplings(spec, hand)

    # Corners become mesh files, which other tools can read.
    meshes = {}
    for number, mesh in enumerate(spec.meshes):
        name = f"link_{number}.obj"
        meshes[name] = hull_text(np.array(mesh.uservert).reshape(-1, 3))
        mesh.uservert, mesh.file = [], name
    model = _compile(spec, meshes)
    joints = tuple(model.joint(i).name for i in range(model.njnt))
    return HandModel(spec=spec, joints=joints, meshes=meshes)


def write_hand_model(hand: HandModel, path: Path) -> None:
    """Write the MJCF of a hand, and its meshes in a folder beside it."""
    (path.parent / MESHES).mkdir(parents=True, exist_ok=True)
    for name, text in hand.meshes.items():
        (path.parent / MESHES / name).write_text(text, encoding="utf-8")
    _compile(hand.spec, hand.meshes)
    hand.spec.meshdir = MESHES
    path.write_text(hand.spec.to_xml(), encoding="utf-8")
    hand.spec.meshdir = ""


def _compile(spec: mujoco.MjSpec, meshes: dict[str, str]) -> mujoco.MjModel:
    """Compile a specification whose mesh files are texts in memory."""
    spec.assets = {name: text.encode() for name, text in meshes.items()}
    return spec.compile()
