"""Writes a model as URDF, with its meshes as Wavefront files beside it."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations_with_replacement
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from pydrake.geometry import Box, Capsule, Cylinder, Sphere
from pydrake.math import RotationMatrix

from drakegrasp.frames import Array
from drakegrasp.hand.draft.shapes import Shape
from drakegrasp.hand.draft.vendor import Link, VendorJoint, VendorModel
from drakegrasp.hand.parsing import Mimic
from drakegrasp.mesh.wavefront import obj_text

#: Folder of the meshes.
MESHES = "meshes"
#: Velocity limit of a joint that has none [rad/s or m/s].
FAST = 10.0


def write_urdf(model: VendorModel, path: Path, comments: Sequence[str]) -> None:
    """Write a model.

    Args:
        model: The model.
        path: The URDF file; meshes are written to a folder beside it.
        comments: Lines for the beginning of the file.
    """
    robot = Element("robot", {"name": model.name, "xmlns:drake": "https://drake.mit.edu"})
    for line in comments:
        robot.append(ElementTree.Comment(f" {line.replace('--', '- -')} "))
    (path.parent / MESHES).mkdir(parents=True, exist_ok=True)
    for number, link in enumerate(model.links.values()):
        name = "".join(c if c.isalnum() else "_" for c in link.name)
        _add_link(robot, link, f"{number:02d}_{name}", path.parent)
    for joint in model.joints.values():
        _add_joint(robot, joint, model.mimics.get(joint.name))
    ElementTree.indent(robot)
    text = ElementTree.tostring(robot, encoding="unicode")
    path.write_text(f'<?xml version="1.0"?>\n{text}\n', encoding="utf-8")


def _add(parent: Element, tag: str, **given: str | float | Array) -> Element:
    """Add an element with its attributes: texts, numbers, or arrays of numbers."""
    return SubElement(parent, tag, {
        key: value if isinstance(value, str) else " ".join(
            f"{float(number) + 0.0:.10g}" for number in np.ravel(value))
        for key, value in given.items()
    })  # fmt: skip


def _add_origin(parent: Element, X: Array) -> None:
    rpy = RotationMatrix.ProjectToRotationMatrix(X[:3, :3]).ToRollPitchYaw().vector()
    _add(parent, "origin", xyz=X[:3, 3], rpy=rpy)


def _add_link(robot: Element, link: Link, stem: str, folder: Path) -> None:
    """Add a link; its meshes become files whose names start with `stem`."""
    # Inertia about the centre of mass.
    element = _add(robot, "link", name=link.name)
    inertial, p_LLcm = _add(element, "inertial"), link.inertia.get_com()
    tensor = link.inertia.Shift(p_LLcm).CalcRotationalInertia().CopyToFullMatrix3()
    _add(inertial, "origin", xyz=p_LLcm)
    _add(inertial, "mass", value=link.inertia.get_mass())
    pairs = combinations_with_replacement(range(3), 2)
    _add(inertial, "inertia", **{f"i{'xyz'[a]}{'xyz'[b]}": tensor[a, b] for a, b in pairs})

    # Shapes, which are drawn as they collide; meshes are separate files.
    for n, shape in enumerate(link.collisions):
        name = f"{stem}_{n}"
        if shape.vertices is not None and shape.faces is not None:
            text = obj_text(shape.vertices, shape.faces, normals=True)
            (folder / MESHES / f"{name}.obj").write_text(text, encoding="utf-8")
        for tag in ("collision", "visual"):
            mesh = _add_shape(element, tag, shape, name)
            if tag == "collision" and mesh is not None:
                _add(mesh, "drake:declare_convex")


def _add_shape(parent: Element, tag: str, shape: Shape, name: str) -> Element | None:
    """Add a shape; return the element of a mesh."""
    element = _add(parent, tag, name=name)
    _add_origin(element, shape.X_LS)
    geometry, own = _add(element, "geometry"), shape.primitive
    if isinstance(own, Box):
        _add(geometry, "box", size=own.size())
    elif isinstance(own, Sphere):
        _add(geometry, "sphere", radius=own.radius())
    elif isinstance(own, Cylinder | Capsule):
        kind = "cylinder" if isinstance(own, Cylinder) else "drake:capsule"
        _add(geometry, kind, radius=own.radius(), length=own.length())
    else:
        return _add(geometry, "mesh", filename=f"{MESHES}/{name}.obj")
    return None


def _add_joint(robot: Element, joint: VendorJoint, mimic: Mimic | None) -> None:
    """Add a joint, with the joint that it follows."""
    limited = bool(np.isfinite(joint.limits).all())
    turns = "revolute" if limited else "continuous"
    element = _add(robot, "joint", name=joint.name, type="prismatic" if joint.slides else turns)
    _add(element, "parent", link=joint.parent)
    _add(element, "child", link=joint.child)
    _add_origin(element, joint.X_PJ)
    _add(element, "axis", xyz=joint.axis)

    # Limits, and the leader.
    ends = dict(zip(("lower", "upper"), joint.limits, strict=True)) if limited else {}
    speed = joint.velocity if np.isfinite(joint.velocity) else FAST
    _add(element, "limit", **ends, effort=joint.effort, velocity=speed)
    if mimic is not None:
        line = {"multiplier": mimic.ratio, "offset": mimic.offset}
        _add(element, "mimic", joint=mimic.leader, **line)
