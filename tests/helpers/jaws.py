"""A made-up hand of two sliding jaws, and grasps of a box between them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import trimesh

from drakegrasp.exchange.dexgraspbench import write_object
from drakegrasp.protocols.protocol import DexGraspBench, GraspMotion, MujocoProtocol

if TYPE_CHECKING:
    from drakegrasp.protocols.scene import ObjectFolder

#: Edge of the box [m].
EDGE = 0.04
#: Each jaw presses with 1.2 N: 60 N/m over the last 20 mm. So a friction of 0.6 carries 1.44 N.
HAND = """
<mujoco model="jaws">
  <worldbody>
    <body name="palm">
      <geom type="box" size="0.05 0.02 0.01" pos="0 0 0.1" mass="0.5" contype="0" conaffinity="0"/>
    </body>
    <body name="left">
      <joint name="left" type="slide" axis="1 0 0" range="-0.1 0.1" damping="1" limited="true"/>
      <geom type="box" size="0.005 0.02 0.02" pos="-0.025 0 0" mass="0.05"/>
    </body>
    <body name="right">
      <joint name="right" type="slide" axis="-1 0 0" range="-0.1 0.1" damping="1" limited="true"/>
      <geom type="box" size="0.005 0.02 0.02" pos="0.025 0 0" mass="0.05"/>
    </body>
  </worldbody>
  <contact><exclude body1="left" body2="right"/></contact>
  <actuator>
    <position name="left" joint="left" kp="60"/>
    <position name="right" joint="right" kp="60"/>
  </actuator>
</mujoco>
"""
HERE = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]


def box_folder(folder: Path, *edges: float) -> ObjectFolder:
    from drakegrasp.protocols.scene import read_object_folder

    write_object(folder, [np.asarray(trimesh.creation.box(edges).vertices)])
    return read_object_folder(folder, 1.0)


def jaws(opening: float, **changes: Any) -> GraspMotion:
    """Return a grasp whose jaws start so far from the box [m], meet it, and press by 20 mm."""

    def posture(closed: float) -> np.ndarray:
        return np.array([*HERE, closed, closed])

    motion = GraspMotion(
        pregrasp=posture(-opening),
        grasp=posture(0.0),
        squeeze=posture(0.02),
        object_pose=np.array(HERE),
    )
    return replace(motion, **changes)


def changed(protocol: type[MujocoProtocol] = DexGraspBench, **numbers: Any) -> MujocoProtocol:
    """Return a protocol with other numbers."""
    return type("Changed", (protocol,), numbers)()
