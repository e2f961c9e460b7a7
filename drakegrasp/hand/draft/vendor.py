"""A vendor's model as data: a tree of rigid links, and the joints between them.

Input: bodies and joints as `drake_model` or `mujoco_model` reads them. Output of `weld`: a
`VendorModel` in which bodies that are fixed to each other are one link, every link has a mass and
an inertia that a body can have, and each follower names the joint that leads it. The frame of a
link is the frame of the joint that carries it. `write_urdf` writes such a model, with its meshes as
Wavefront files beside it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations_with_replacement
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from pydrake.geometry import Box, Capsule, Cylinder, Sphere
from pydrake.math import RotationMatrix
from pydrake.multibody.tree import SpatialInertia, UnitInertia

from drakegrasp.errors import HandError
from drakegrasp.frames import Array, invert_pose, rotation_about, transform_points
from drakegrasp.hand.draft.shapes import Shape, added, solid_inertia
from drakegrasp.hand.parsing import Mimic, validate_limits
from drakegrasp.mesh.surfaces import obj_text

#: Limits of a joint that has none.
ENDLESS = np.array([-np.inf, np.inf])
#: Smallest fraction of a leader's range that the limits of a follower must leave to it.
ROOM = 0.5
#: Smallest and largest size of a hand, including an arm [m]; other sizes mean other units.
SIZES = (0.03, 3.0)
#: Mass [kg] and radius [m] of a moving link that has neither mass nor shape.
BARE_MASS, BARE_RADIUS = 1e-3, 0.016
#: Folder of the meshes.
MESHES = "meshes"
#: Velocity limit of a joint that has none [rad/s or m/s].
FAST = 10.0


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
        return motion(self.axis, self.slides, positions)

    def pose(self, position: float) -> Array:
        """Return the pose (4, 4) of the joint's moving frame in the parent."""
        return np.asarray(self.X_PJ @ self.motion(position))

    def rebased(self, sign: float, zero: float) -> VendorJoint:
        """Return the joint with positions c instead of q, where q = zero + sign * c."""
        limits = np.sort((self.limits - zero) * sign)
        return replace(self, X_PJ=self.pose(zero), axis=sign * self.axis, limits=limits)


def motion(axis: Array, slides: bool, positions: Array | float) -> Array:
    """Return the poses (..., 4, 4) of a joint's child at positions (...), relative to position 0.

    Args:
        axis: (3,), unit.
        slides: Whether the joint slides along the axis; else it turns about it.
        positions: Positions [rad or m].
    """
    positions = np.asarray(positions, dtype=float)
    X = np.zeros((*positions.shape, 4, 4)) + np.eye(4)
    if slides:
        X[..., :3, 3] = positions[..., None] * axis
    else:
        X[..., :3, :3] = rotation_about(axis, positions)
    return X


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
        X = np.eye(4)
        for joint in self.chain(link, base):
            X = X @ joint.pose(positions.get(joint.name, 0.0))
        return X

    def mimic(self, joint: str) -> Mimic:
        """Return the leader of a joint, with ratio and offset; by default the joint itself."""
        return self.mimics.get(joint, Mimic(joint=joint, leader=joint, ratio=1.0, offset=0.0))

    def relation(self, joint: str, to: str) -> tuple[float, float] | None:
        """Return ratio and offset of a joint's position to another's; None if unrelated."""
        own, other = self.mimic(joint), self.mimic(to)
        ratio = own.ratio / other.ratio
        return (ratio, own.offset - ratio * other.offset) if own.leader == other.leader else None


def weld(model: VendorModel) -> VendorModel:
    """Return a model in which bodies that are fixed to each other are one link.

    Raises:
        HandError: If it is not one tree of links of a hand's size, or joints cannot follow their
            leaders. The message has one line.
    """
    carriers = _carriers(model)
    places, links, notes = _places(model, carriers), dict[str, Link](), list(model.notes)
    for head in dict.fromkeys(head for head, _ in places.values()):
        members = [(model.links[b], X_LB) for b, (at, X_LB) in places.items() if at == head]
        links[head], remarks = _weld(members)
        notes += remarks

    # The joints that move, each between two links.
    joints = {}
    for head, link in links.items():
        if head in carriers:
            joint = carriers[head]
            validate_limits(joint.name, *joint.limits)
            above, X_LP = places[joint.parent]
            joints[joint.name] = replace(
                joint,
                parent=links[above].name,
                child=link.name,
                X_PJ=X_LP @ joint.X_PJ,
                X_CJ=np.eye(4),
            )
    mimics = _leaders(model.mimics, joints)
    named = {link.name: link for link in links.values()}
    welded = replace(model, links=named, joints=joints, mimics=mimics, notes=tuple(notes))
    _validate_size(welded)
    return welded


def _carriers(model: VendorModel) -> dict[str, VendorJoint]:
    """Return the joint that carries each body except for the root."""
    found: dict[str, VendorJoint] = {}
    for joint in model.joints.values():
        if joint.child in found:
            raise HandError(
                f"model: link {joint.child!r} must be carried by one joint, got "
                f"{found[joint.child].name!r} and {joint.name!r}: cut the closed loop"
            )
        found[joint.child] = joint
    roots = [name for name in model.links if name not in found]
    if len(roots) != 1:
        got = f"{len(roots)} ({', '.join(roots)})" if roots else "none: its joints form a loop"
        raise HandError(f"model: must be one tree of links, with one root, got {got}")
    return found


def _places(
    model: VendorModel, carriers: Mapping[str, VendorJoint]
) -> dict[str, tuple[str, Array]]:
    """Return for each body the first body of its link, and its pose (4, 4) in the link.

    Bodies come after their parents.
    """
    # Go from the root outwards. The frame of a link is that of its joint.
    order = [model.root]
    places: dict[str, tuple[str, Array]] = {}
    for body in order:
        joint = carriers.get(body)
        if joint is None:
            places[body] = body, np.eye(4)
        elif joint.moves:
            places[body] = body, invert_pose(joint.X_CJ)
        else:
            head, X_LP = places[joint.parent]
            places[body] = head, X_LP @ joint.X_PJ @ invert_pose(joint.X_CJ)
        order += model.below(body)
    if len(order) < len(model.links):
        lost = next(name for name in model.links if name not in places)
        raise HandError(f"model: must be one tree of links, got a loop at link {lost!r}")

    # The frame of the root is that of its heaviest body.
    members = [body for body, (head, _) in places.items() if head == model.root]
    heaviest = max(members, key=lambda body: model.links[body].weight)
    X_LR = invert_pose(places[heaviest][1])
    return places | {body: (model.root, X_LR @ places[body][1]) for body in members}


def _weld(members: Sequence[tuple[Link, Array]]) -> tuple[Link, list[str]]:
    """Return the link of bodies with poses (4, 4) in its frame, and notes of what was added."""
    # Join the shapes; without collision shapes, the visual shapes also collide.
    name, notes = max((body for body, _ in members), key=lambda body: body.weight).name, []
    solids, pictures = (
        [replace(s, X_LS=X_LB @ s.X_LS) for body, X_LB in members for s in getattr(body, kind)]
        for kind in ("collisions", "pictures")
    )
    if pictures and not solids:
        notes.append(f"link {name}: the model has no collision shapes; hulls of its pictures")
    collisions = [shape.hull() for shape in solids or pictures]

    # Add the inertias about the link's origin.
    total = SpatialInertia.Zero()
    for body, X_LB in members:
        if body.inertia.get_mass() > 0.0:
            own = body.inertia.ReExpress(RotationMatrix(X_LB[:3, :3])).Shift(-X_LB[:3, 3])
            total = added(total, own)

    # Vendors leave out masses of small links, and give inertias that no body has.
    ball = SpatialInertia(BARE_MASS, np.zeros(3), UnitInertia.SolidSphere(BARE_RADIUS))
    if total.get_mass() == 0.0:
        total = solid_inertia(collisions) if collisions else ball
        if collisions:
            mass = f"{1e3 * total.get_mass():.0f} g by its size"
            notes.append(f"link {name}: the model gives no mass; {mass}")
    elif wrong := next((body.impossible for body, _ in members if body.impossible), ""):
        notes.append(
            f"link {name}: the model's inertia is impossible ({wrong}); that of its shapes is used"
        )
        likely = solid_inertia(collisions) if collisions else ball
        total = SpatialInertia(total.get_mass(), likely.get_com(), likely.get_unit_inertia())
    return Link(name=name, inertia=total, collisions=tuple(collisions)), notes


def _leaders(given: Mapping[str, Mimic], joints: Mapping[str, VendorJoint]) -> dict[str, Mimic]:
    """Return the leader of each following joint, through chains of mimics.

    Raises:
        HandError: If mimics form a circle, name something that is not a moving joint, or limits
            keep a joint from following.
    """
    found: dict[str, Mimic] = {}
    for name, mimic in given.items():
        must = f"model: joint {name!r} must"
        if name not in joints:
            raise HandError(f"{must} turn or slide, as it follows {mimic.leader!r}")

        # Follow the leaders up to a joint that follows none.
        ratio, offset, leader, seen = mimic.ratio, mimic.offset, mimic.leader, {name}
        while leader in given and leader not in seen:
            seen.add(leader)
            above = given[leader]
            ratio, offset, leader = ratio * above.ratio, offset + ratio * above.offset, above.leader
        if leader in seen:
            raise HandError(f"{must} follow a joint that leads, got a circle of mimics")
        if leader not in joints:
            raise HandError(f"{must} follow a joint that moves, got {leader!r}")
        if ratio == 0.0:
            raise HandError(f"{must} follow {leader!r} by a ratio, got 0")
        found[name] = Mimic(joint=name, leader=leader, ratio=ratio, offset=offset)

        # Limits of some vendors' followers have the wrong sign.
        lower, upper = joints[name].limits
        led = np.sort(ratio * joints[leader].limits + offset)
        shared = min(led[1], upper) - max(led[0], lower)
        if np.isfinite(led).all() and shared < ROOM * (led[1] - led[0]):
            raise HandError(
                f"{must} have limits that let it follow {leader!r}, {led[0]:g}..{led[1]:g}, got "
                f"{lower:g}..{upper:g}"
            )
    return found


def _validate_size(model: VendorModel) -> None:
    """Reject a model without shapes, or a model whose units are not metres."""
    points = [transform_points(model.pose(n, {}), own.corners()) for n, own in model.links.items()]
    cloud = np.concatenate(points)
    if not len(cloud):
        raise HandError("model: must have shapes, got links without any")
    size = float(np.ptp(cloud, axis=0).max())
    if not SIZES[0] <= size <= SIZES[1]:
        raise HandError(
            f"model: must be a hand in metres, got one of {size:.3g} m: check units and scales of "
            "its meshes"
        )


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
