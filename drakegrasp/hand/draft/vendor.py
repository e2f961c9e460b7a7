"""A vendor's model as data: a tree of rigid links with shapes, and the joints between them.

`drake_model` and `mujoco_model` read such models, `source` welds their links, and `write_urdf`
writes them, with their meshes as Wavefront files beside the URDF. After welding the frame of a link
is the frame of the joint that carries it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations_with_replacement
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np
import numpy.typing as npt
import trimesh
from pydrake.geometry import Box, Capsule, Cylinder, Sphere
from pydrake.math import RotationMatrix
from pydrake.multibody.tree import SpatialInertia

from drakegrasp.arithmetic import dot
from drakegrasp.errors import HandError, MeshError
from drakegrasp.frames import Array, transform_points
from drakegrasp.hand.kinematics import joint_motion
from drakegrasp.hand.parsing import Mimic
from drakegrasp.hand.shapes import ball_corners, primitive_corners
from drakegrasp.mesh.loading import load_surface
from drakegrasp.mesh.surfaces import Faces, obj_text

#: Number of corners of the hull of a collision mesh; on a ball of 10 mm radius they miss less than
#: 0.4 mm.
CORNERS = 64
#: Minimum thickness of a hull [m]: a plane has no hull.
THIN = 4e-4
#: Limits of a joint that has none.
ENDLESS = np.array([-np.inf, np.inf])
#: Folder of the meshes.
MESHES = "meshes"
#: Velocity limit of a joint that has none [rad/s or m/s].
FAST = 10.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Shape:
    """A shape on a link: a primitive, or else a mesh.

    Attributes:
        X_LS: Pose of the shape on the link, (4, 4).
        primitive: A box, cylinder, capsule or sphere.
        vertices: (n, 3), vertices of a mesh, in its own frame [m].
        faces: (m, 3), faces of a mesh.
    """

    X_LS: Array = field(default_factory=lambda: np.eye(4))
    primitive: Box | Cylinder | Capsule | Sphere | None = None
    vertices: Array | None = None
    faces: Faces | None = None

    def corners(self) -> Array:
        """Return points (n, 3) with the same hull as the shape, in the link's frame [m]."""
        own = self.vertices if self.primitive is None else primitive_corners(self.primitive)
        assert own is not None
        return transform_points(self.X_LS, own)

    def hull(self) -> Shape:
        """Return the convex hull of a mesh, with few corners; other shapes unchanged."""
        if self.vertices is None:
            return self
        points = self.vertices
        if np.ptp(points, axis=0).min() < THIN / 4.0:
            points = np.concatenate([points - THIN / 2.0, points + THIN / 2.0])

        # The farthest points along the link's axes, and along even directions.
        axes = self.X_LS[:3, :3]
        directions = np.concatenate([axes, -axes, ball_corners(1.0, CORNERS)])
        farthest = np.unique([int(np.argmax(dot(points, d))) for d in directions])
        return with_hull(self, points[farthest])


def with_hull(shape: Shape, points: Array) -> Shape:
    """Return a shape whose mesh is the convex hull of points (n, 3)."""
    solid = trimesh.convex.convex_hull(points)
    return replace(shape, vertices=np.array(solid.vertices), faces=np.array(solid.faces))


def ellipsoid(axes: npt.ArrayLike) -> dict[str, Any]:
    """Return vertices and faces of an ellipsoid with half axes (3,) [m]."""
    ball = trimesh.creation.icosphere(2)
    return {"vertices": np.array(ball.vertices) * np.asarray(axes), "faces": np.array(ball.faces)}


def read_mesh(path: Path) -> Shape:
    """Return the content of a mesh file.

    Raises:
        HandError: If the file is missing or not a mesh, see `drakegrasp.mesh.loading`.
    """
    try:
        vertices, faces = load_surface(path)
    except MeshError as error:
        raise HandError(f"model: mesh {error}") from None
    return Shape(vertices=vertices, faces=faces)


@dataclass(frozen=True, kw_only=True, eq=False)
class Link:
    """A rigid link.

    Attributes:
        name: Name of the link.
        inertia: M_LLo_L; zero for a body whose model gives none, before it is welded.
        collisions: Collision shapes; convex after welding.
        pictures: Shapes that are drawn, of a body that has no others; empty after welding.
        impossible: What is wrong with the inertia of its model; empty if nothing is.
    """

    name: str
    inertia: SpatialInertia
    collisions: tuple[Shape, ...] = ()
    pictures: tuple[Shape, ...] = ()
    impossible: str = ""

    def corners(self) -> Array:
        """Return the corners (n, 3) of the collision shapes [m]."""
        return np.concatenate([np.zeros((0, 3)), *[s.corners() for s in self.collisions]])

    @property
    def weight(self) -> tuple[float, int]:
        """Rank of the link among those welded to it: the highest gives its name to all."""
        return self.inertia.get_mass(), len(self.collisions)


@dataclass(frozen=True, kw_only=True, eq=False)
class VendorJoint:
    """A joint that turns or slides, or before welding a fixed one.

    Attributes:
        name: Name of the joint.
        parent, child: Names of links.
        X_PJ: (4, 4), pose of the joint's frame in the parent at position 0.
        X_CJ: (4, 4), pose of the joint's frame in the child; after welding they are the same.
        axis: (3,), unit, in the joint's frame; zero for a fixed joint.
        slides: Whether the joint slides.
        limits: (2,), lower and upper [rad or m].
        effort: Largest effort [N m or N]; 0 if the model gives none.
        velocity: Largest velocity [rad/s or m/s]; infinite if the model gives none.
    """

    name: str
    parent: str
    child: str
    X_PJ: Array
    X_CJ: Array = field(default_factory=lambda: np.eye(4))
    axis: Array = field(default_factory=lambda: np.zeros(3))
    slides: bool = False
    limits: Array = field(default_factory=lambda: ENDLESS)
    effort: float = 0.0
    velocity: float = np.inf

    @property
    def moves(self) -> bool:
        """Whether the joint turns or slides."""
        return bool(self.axis.any())

    def motion(self, positions: Array | float) -> Array:
        """Return the poses (..., 4, 4) of the child at positions (...), relative to position 0."""
        return joint_motion(self.axis, positions, slides=self.slides)

    def rebased(self, sign: float, zero: float) -> VendorJoint:
        """Return the joint with positions c instead of q, where q = zero + sign * c."""
        limits = np.sort((self.limits - zero) * sign)
        return replace(
            self, X_PJ=self.X_PJ @ self.motion(zero), axis=sign * self.axis, limits=limits
        )


def chain_poses(joints: Sequence[VendorJoint], q: Array) -> tuple[list[Array], Array]:
    """Return the poses of joints at positions (..., m) [rad or m], in the parent of the first one.

    They are (..., 4, 4) each: those of the joints' frames, and that of the last joint's child.
    """
    X, frames = np.broadcast_to(np.eye(4), (*q.shape[:-1], 4, 4)), []
    for j, joint in enumerate(joints):
        frames.append(X @ joint.X_PJ)
        X = frames[-1] @ joint.motion(q[..., j])
    return frames, X


@dataclass(frozen=True, kw_only=True, eq=False)
class VendorModel:
    """A tree of rigid links.

    Attributes:
        name: Name of the model.
        links: Links by name.
        joints: Joints by name; after welding each comes after those above its parent.
        mimics: The joint that each joint follows, by the follower's name; after welding leaders
            follow no joint.
        notes: What was left out or added, one line each.
    """

    name: str
    links: dict[str, Link]
    joints: dict[str, VendorJoint]
    mimics: dict[str, Mimic]
    notes: tuple[str, ...] = ()

    @property
    def root(self) -> str:
        """Name of the link without a parent."""
        children = {joint.child for joint in self.joints.values()}
        return next(name for name in self.links if name not in children)

    def chain(self, link: str, base: str | None = None) -> list[VendorJoint]:
        """Return the joints from a base, or from the root, to a link."""
        above = {joint.child: joint for joint in self.joints.values()}
        path: list[VendorJoint] = []
        while link != base and link in above:
            path.insert(0, above[link])
            link = above[link].parent
        return path

    def below(self, link: str) -> list[str]:
        """Return the child links of a link."""
        return [joint.child for joint in self.joints.values() if joint.parent == link]

    def carries(self, base: str, link: str) -> bool:
        """Return whether a base is an ancestor of a link."""
        return [joint.parent for joint in self.chain(link, base)][:1] == [base]

    def has_shapes(self, link: str) -> bool:
        """Return whether a link or one of its descendants has a collision shape."""
        return bool(self.links[link].collisions) or any(map(self.has_shapes, self.below(link)))

    def pose(self, link: str, positions: Mapping[str, float], base: str | None = None) -> Array:
        """Return the pose (4, 4) of a link in a base or the root; joints not given are at 0."""
        joints = self.chain(link, base)
        q = np.array([positions.get(joint.name, 0.0) for joint in joints])
        return chain_poses(joints, q)[1]

    def mimic(self, joint: str) -> Mimic:
        """Return the leader of a joint, with ratio and offset; by default the joint itself."""
        return self.mimics.get(joint, Mimic(joint=joint, leader=joint, ratio=1.0, offset=0.0))

    def relation(self, joint: str, to: str) -> tuple[float, float] | None:
        """Return ratio and offset of a joint's position to another's; None if unrelated."""
        own, other = self.mimic(joint), self.mimic(to)
        ratio = own.ratio / other.ratio
        return (ratio, own.offset - ratio * other.offset) if own.leader == other.leader else None


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
