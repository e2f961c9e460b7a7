"""A made-up arm with six joints, as a URDF with boxes, cylinders and a mesh."""

from __future__ import annotations

from pathlib import Path

import trimesh

#: Joints: name, parent, child, kind, origin, axis, limits. Three axes are parallel,
#: as of many arms, so a pose far from singularities has up to eight branches.
JOINTS = (
    ("pan", "base", "shoulder", "revolute", "0 0 0.15", "0 0 1", (-6.2, 6.2)),
    ("lift", "shoulder", "upper", "revolute", "0 0.12 0", "0 1 0", (-6.2, 6.2)),
    ("elbow", "upper", "fore", "revolute", "0 -0.1 0.5", "0 1 0", (-3.1, 3.1)),
    ("wrist_1", "fore", "one", "revolute", "0 0 0.45", "0 1 0", (-6.2, 6.2)),
    ("wrist_2", "one", "two", "revolute", "0 0.1 0", "0 0 1", (-6.2, 6.2)),
    ("wrist_3", "two", "three", "continuous", "0 0 0.1", "0 1 0", None),
    ("plate", "three", "flange", "fixed", "0 0.08 0", None, None),
)
SHAPES = {
    "base": '<cylinder length="0.1" radius="0.07"/>',
    "shoulder": '<sphere radius="0.06"/>',
    "upper": '<mesh filename="upper.stl" scale="0.001 0.001 0.001"/>',
    "fore": '<box size="0.08 0.08 0.4"/>',
    "one": '<sphere radius="0.04"/>',
    "two": '<cylinder length="0.06" radius="0.04"/>',
    "three": '<box size="0.05 0.05 0.05"/>',
}
CENTRES = {"base": "0 0 0.05", "upper": "0 0 0.25", "fore": "0 0 0.22"}


def write_arm(folder: Path, *, name: str = "six.urdf", replace: tuple[str, str] = ("", "")) -> Path:
    """Write the arm and its mesh, with a part of its text replaced."""
    text = "".join(_link(link) for link in (*SHAPES, "flange")) + "".join(map(_joint, JOINTS))
    text = f'<robot name="six">{text}<gazebo/></robot>'
    assert replace[0] in text
    path = folder / name
    path.write_text(text.replace(*replace) if replace[0] else text)
    trimesh.creation.box([80.0, 80.0, 480.0]).export(folder / "upper.stl")
    return path


def _link(name: str) -> str:
    if name not in SHAPES:
        return f'<link name="{name}"/>'
    shape = f"<geometry>{SHAPES[name]}</geometry>"
    origin = f'<origin xyz="{CENTRES.get(name, "0 0 0")}"/>'
    visual = '<visual><geometry><mesh filename="nowhere.dae"/></geometry></visual>'
    return f'<link name="{name}">{visual}\n<collision>{origin}{shape}</collision>\n</link>\n'


def _joint(joint: tuple[str, str, str, str, str, str | None, tuple[float, float] | None]) -> str:
    name, parent, child, kind, origin, axis, limits = joint
    parts = f'<parent link="{parent}"/><child link="{child}"/><origin xyz="{origin}"/>'
    if name == "plate":  # +z of the flange points out of the arm
        parts = parts.replace("<origin ", '<origin rpy="-1.570796 0 0" ')
    parts += f'<axis xyz="{axis}"/>' if axis else ""
    if limits:
        parts += f'<limit lower="{limits[0]}" upper="{limits[1]}" effort="1" velocity="1"/>'
    return f'<joint name="{name}" type="{kind}">{parts}</joint>'
