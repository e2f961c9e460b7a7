"""Small models of hands as vendors write them: massless frames, mimics, meshes, other formats."""

from __future__ import annotations

from pathlib import Path

import trimesh

INERTIA = '<inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/>'


def link(name: str, mass: float, *shapes: str) -> str:
    """Return a link with shapes, each an origin and a geometry."""
    inertial = f'<inertial><mass value="{mass}"/>{INERTIA}</inertial>' if mass else ""
    solid = "".join(f"<collision>{s}</collision><visual>{s}</visual>" for s in shapes)
    return f'<link name="{name}">{inertial}{solid}</link>\n'


def box(size: str, xyz: str = "0 0 0") -> str:
    return f'<origin xyz="{xyz}"/><geometry><box size="{size}"/></geometry>'


def joint(
    name: str, kind: str, parent: str, child: str, xyz: str, axis: str, limits: str, more: str = ""
) -> str:
    lower, upper, effort = limits.split()
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}"/><axis xyz="{axis}"/>'
        f'<limit lower="{lower}" upper="{upper}" effort="{effort}" velocity="1"/>{more}</joint>\n'
    )


def fixed(name: str, parent: str, child: str, origin: str = 'xyz="0 0 0"') -> str:
    return (
        f'<joint name="{name}" type="fixed"><parent link="{parent}"/><child link="{child}"/>'
        f"<origin {origin}/></joint>\n"
    )


#: Two jaws that slide along y; a positive position opens them, as of most parallel grippers. The
#: root and the ends of the jaws are frames without mass, and the right jaw follows the left one.
JAWS = (
    '<robot name="jaws">\n<link name="mount"/>\n'
    + link("body", 0.5, box("0.06 0.14 0.04", "0 0 -0.02"))
    + link("left_jaw", 0.05, box("0.02 0.012 0.06", "0 0.006 0.03"))
    + link("right_jaw", 0.05, box("0.02 0.012 0.06", "0 -0.006 0.03"))
    + '<link name="left_end"/>\n'
    + fixed("mount_joint", "mount", "body", 'xyz="0 0 0.1" rpy="0 0 0.5"')
    + joint("left_slide", "prismatic", "body", "left_jaw", "0 0 0", "0 1 0", "0 0.05 60")
    + joint("right_slide", "prismatic", "body", "right_jaw", "0 0 0", "0 -1 0", "0 0.05 60",
            '<mimic joint="left_slide"/>')
    + fixed("left_end_joint", "left_jaw", "left_end", 'xyz="0 0 0.06"')
    + "</robot>"
)  # fmt: skip


def _finger(name: str, xyz: str, more: str = "") -> str:
    return (
        link(f"{name}_near", 0.03, box("0.016 0.016 0.05", "0 0 0.025"))
        + link(f"{name}_far", 0.02, box("0.016 0.016 0.04", "0 0 0.02"))
        + joint(f"{name}_1", "revolute", "palm", f"{name}_near", xyz, "0 1 0", "0 1.6 1.0")
        + joint(f"{name}_2", "revolute", f"{name}_near", f"{name}_far", "0 0 0.05", "0 1 0",
                "0 1.6 1.0", more)
    )  # fmt: skip


#: A hand with a palm in the plane of y and z that faces +x: two fingers along +z that bend towards
#: it, whose last joints follow, and a thumb that stands out of the palm once it is turned about z.
MITTEN = (
    '<robot name="mitten">\n'
    + link("palm", 0.4, box("0.02 0.08 0.08", "0 0 -0.04"))
    + _finger("index", "0 0.022 0", '<mimic joint="index_1" multiplier="0.8"/>')
    + _finger("middle", "0 -0.022 0", '<mimic joint="middle_1" multiplier="0.8"/>')
    + link("thumb_base", 0.01, box("0.016 0.016 0.016"))
    + link("thumb_near", 0.03, box("0.016 0.016 0.05", "0.02 0 0"))
    + link("thumb_far", 0.02, box("0.05 0.016 0.016", "0.025 0 0"))
    + joint("thumb_turn", "revolute", "palm", "thumb_base", "0.02 0 -0.07", "1 0 0",
            "-1.6 1.6 1.0")
    + joint("thumb_1", "revolute", "thumb_base", "thumb_near", "0 0 0", "0 -1 0", "-0.2 1.2 1.0")
    + joint("thumb_2", "revolute", "thumb_near", "thumb_far", "0.04 0 0", "0 -1 0", "0 1.2 1.0")
    + "</robot>"
)  # fmt: skip

#: The jaws in MJCF: boxes by half sizes, and an equality in place of the mimic.
JAWS_MJCF = """<mujoco model="jaws">
  <worldbody><body name="body">
    <geom type="box" size="0.03 0.07 0.02" pos="0 0 -0.02" mass="0.5"/>
    <body name="left_jaw"><joint name="left_slide" type="slide" axis="0 1 0" range="0 0.05"/>
      <geom type="box" size="0.01 0.006 0.03" pos="0 0.006 0.03" mass="0.05"/></body>
    <body name="right_jaw"><joint name="right_slide" type="slide" axis="0 -1 0" range="0 0.05"/>
      <geom type="box" size="0.01 0.006 0.03" pos="0 -0.006 0.03" mass="0.05"/></body>
  </body></worldbody>
  <equality><joint joint1="right_slide" joint2="left_slide" polycoef="0 1 0 0 0"/></equality>
  <actuator><motor joint="left_slide" forcerange="-60 60"/></actuator>
</mujoco>"""


def write_model(folder: Path, text: str, name: str = "hand.urdf") -> Path:
    """Write a model, and return its path."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / name
    path.write_text(text)
    return path


def write_mesh(path: Path, extents: tuple[float, float, float] = (0.02, 0.012, 0.06)) -> Path:
    """Write a box as a mesh file of any format that trimesh writes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    mesh = trimesh.creation.box(extents)
    mesh.visual = trimesh.visual.TextureVisuals(
        material=trimesh.visual.material.PBRMaterial(baseColorFactor=[255, 0, 0, 255])
    )
    mesh.export(path)
    return path
