"""Writes a vendor's model as URDF, with its meshes beside it.

In: a `VendorModel`. Out: `<name>.urdf` and `meshes/` in a folder: all that the hand needs.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from pydrake.geometry import Box, Capsule, Cylinder, Sphere
from pydrake.math import RotationMatrix

from drakegrasp.frames import Array
from drakegrasp.hand.draft.model import Link, VendorJoint, VendorModel
from drakegrasp.hand.draft.shapes import Shape
from drakegrasp.hand.model_text import Mimic
from drakegrasp.mesh.wavefront import obj_text

#: Folder of the meshes.
MESHES = "meshes"
#: Velocity limit of a joint that has none [rad/s or m/s].
FAST = 10.0
_DRAKE = "drake:"


def write_urdf(model: VendorModel, path: Path, comments: Sequence[str]) -> None:
    """Write a model.

    Args:
        model: The model.
        path: The URDF file; meshes come into a folder beside it.
        comments: Lines for its head.
    """
    robot = Element("robot", {"name": model.name, "xmlns:drake": "https://drake.mit.edu"})
    for line in comments:
        robot.append(ElementTree.Comment(f" {line.replace('--', '- -')} "))
    (path.parent / MESHES).mkdir(parents=True, exist_ok=True)
    for number, link in enumerate(model.links.values()):
        robot.append(_link(link, f"{number:02d}_{_file_name(link.name)}", path.parent))
    for joint in model.joints.values():
        robot.append(_joint(joint, model.mimics.get(joint.name)))
    ElementTree.indent(robot)
    text = ElementTree.tostring(robot, encoding="unicode")
    path.write_text(f'<?xml version="1.0"?>\n{text}\n', encoding="utf-8")


def _link(link: Link, stem: str, folder: Path) -> Element:
    """Return a link; its meshes become files whose names start with a stem."""
    # Inertia about the centre of mass.
    element = Element("link", {"name": link.name})
    inertial = SubElement(element, "inertial")
    p_LLcm = link.inertia.get_com()
    tensor = link.inertia.Shift(p_LLcm).CalcRotationalInertia().CopyToFullMatrix3()
    SubElement(inertial, "origin", {"xyz": _numbers(p_LLcm)})
    SubElement(inertial, "mass", {"value": _number(link.inertia.get_mass())})
    entries = {
        f"i{'xyz'[a]}{'xyz'[b]}": _number(tensor[a, b]) for a in range(3) for b in range(a, 3)
    }
    SubElement(inertial, "inertia", entries)

    # Shapes; meshes are files of their own.
    for tag, shapes in (("collision", link.collisions), ("visual", link.visuals)):
        for n, shape in enumerate(shapes):
            element.append(_shape(tag, shape, f"{stem}_{tag}_{n}", folder))
    return element


def _shape(tag: str, shape: Shape, name: str, folder: Path) -> Element:
    """Return a shape; a mesh becomes a file."""
    element = Element(tag, {"name": name})
    element.append(_origin(shape.X_LS))
    geometry, own = SubElement(element, "geometry"), shape.primitive
    if isinstance(own, Box):
        SubElement(geometry, "box", {"size": _numbers(own.size())})
    elif isinstance(own, Sphere):
        SubElement(geometry, "sphere", {"radius": _number(own.radius())})
    elif isinstance(own, Cylinder | Capsule):
        kind = "cylinder" if isinstance(own, Cylinder) else f"{_DRAKE}capsule"
        size = {"radius": _number(own.radius()), "length": _number(own.length())}
        SubElement(geometry, kind, size)
    else:
        assert shape.vertices is not None and shape.faces is not None
        file = folder / MESHES / f"{name}.obj"
        text = obj_text(shape.vertices, shape.faces, normals=tag == "visual")
        file.write_text(text, encoding="utf-8")
        mesh = SubElement(geometry, "mesh", {"filename": f"{MESHES}/{file.name}"})
        if tag == "collision":
            SubElement(mesh, f"{_DRAKE}declare_convex")

    # Only what is drawn has a colour.
    if tag == "visual" and shape.colour is not None:
        material = SubElement(element, "material", {"name": f"{name}_colour"})
        SubElement(material, "color", {"rgba": f"{_numbers(shape.colour)} 1"})
    return element


def _joint(joint: VendorJoint, mimic: Mimic | None) -> Element:
    """Return a joint, with what it follows."""
    limited = bool(np.isfinite(joint.limits).all())
    turns = "revolute" if limited else "continuous"
    kind = "prismatic" if joint.slides else turns
    element = Element("joint", {"name": joint.name, "type": kind})
    SubElement(element, "parent", {"link": joint.parent})
    SubElement(element, "child", {"link": joint.child})
    element.append(_origin(joint.X_PJ))
    SubElement(element, "axis", {"xyz": _numbers(joint.axis)})

    # Limits, and the joint that leads it.
    lower, upper = (_number(limit) for limit in joint.limits)
    speed = joint.velocity if np.isfinite(joint.velocity) else FAST
    most = {"effort": _number(joint.effort), "velocity": _number(speed)}
    SubElement(element, "limit", {"lower": lower, "upper": upper, **most} if limited else most)
    if mimic is not None:
        line = {"multiplier": _number(mimic.ratio), "offset": _number(mimic.offset)}
        SubElement(element, "mimic", {"joint": mimic.leader, **line})
    return element


def _origin(X: Array) -> Element:
    rpy = RotationMatrix.ProjectToRotationMatrix(X[:3, :3]).ToRollPitchYaw().vector()
    return Element("origin", {"xyz": _numbers(X[:3, 3]), "rpy": _numbers(rpy)})


def _numbers(values: Sequence[float] | Array) -> str:
    return " ".join(map(_number, values))


def _number(value: float) -> str:
    return f"{float(value) + 0.0:.10g}"


def _file_name(name: str) -> str:
    return "".join(c if c.isalnum() else "_" for c in name)
