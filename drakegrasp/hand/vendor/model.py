"""A vendor's model as data: rigid links, and the joints between them.

In: a URDF, SDFormat or MJCF file. Out: a `VendorModel`, in which links that are welded to each
other are one, and the frame of a link is that of the joint that carries it.
"""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from pydrake.geometry import Role, SceneGraph
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import WeldJoint

from drakegrasp.errors import HandError, first_line
from drakegrasp.frames import Array, invert_pose, make_pose, rotation_about, transform_points
from drakegrasp.hand.chains import joint_axis, joint_slides, moving_joint
from drakegrasp.hand.model_text import Mimic, declared_masses, declared_mimics
from drakegrasp.hand.parsing import make_parser
from drakegrasp.hand.vendor.inertia import Inertia, combine, moved, solid_inertia
from drakegrasp.hand.vendor.meshes import MeshFolder
from drakegrasp.hand.vendor.shapes import Shape, read_shape
from drakegrasp.hand.vendor.source import FORMATS, Source, replace_meshes

#: A hand is so large [m], with its arm if it has one; else its units are others.
SIZES = (0.03, 3.0)
#: Mass [kg] and inertia [kg m^2] of a link that has neither mass nor shape but moves.
BARE_MASS, BARE_INERTIA = 1e-3, 1e-7


@dataclass(frozen=True, kw_only=True, eq=False)
class Link:
    """A rigid link: vendors' links that are welded together, under the name of the largest."""

    name: str
    inertia: Inertia
    collisions: tuple[Shape, ...]
    visuals: tuple[Shape, ...]

    def corners(self) -> Array:
        """Return the corners (n, 3) of its collision shapes [m]."""
        return np.concatenate([np.zeros((0, 3)), *[s.corners() for s in self.collisions]])


@dataclass(frozen=True, kw_only=True, eq=False)
class VendorJoint:
    """A joint that turns or slides; at position 0 the child's frame is at X_PJ in the parent.

    Attributes:
        name: Its name.
        slides: Whether it slides.
        parent, child: Names of links.
        X_PJ: (4, 4).
        axis: (3,), unit, in the child's frame.
        limits: (2,), lower and upper [rad or m].
        effort, velocity: Largest [N m or N], [rad/s or m/s]; infinite or 0 if not given.
    """

    name: str
    slides: bool
    parent: str
    child: str
    X_PJ: Array
    axis: Array
    limits: Array
    effort: float
    velocity: float

    def pose(self, position: float) -> Array:
        """Return the pose (4, 4) of the child in the parent at a position [rad or m]."""
        if self.slides:
            return self.X_PJ @ make_pose(np.eye(3), position * self.axis)
        return self.X_PJ @ make_pose(rotation_about(self.axis, position), np.zeros(3))

    def rebased(self, sign: float, zero: float) -> VendorJoint:
        """Return the joint with positions c instead of q = zero + sign * c."""
        limits = np.sort((self.limits - zero) * sign)
        return replace(self, X_PJ=self.pose(zero), axis=sign * self.axis, limits=limits)


@dataclass(frozen=True, kw_only=True, eq=False)
class VendorModel:
    """A tree of rigid links.

    Attributes:
        name: Of the model.
        root: Name of the link that no joint carries.
        links: By name.
        joints: By name, each after those that carry its parent.
        mimics: What each joint follows, by its name; leaders follow nothing.
        notes: What was left out or put in, a line each.
    """

    name: str
    root: str
    links: dict[str, Link]
    joints: dict[str, VendorJoint]
    mimics: dict[str, Mimic]
    notes: tuple[str, ...]

    def chain(self, link: str, base: str | None = None) -> list[VendorJoint]:
        """Return the joints from a base, or the root, to a link."""
        above = {joint.child: joint for joint in self.joints.values()}
        path: list[VendorJoint] = []
        while link != base and link in above:
            path.insert(0, above[link])
            link = above[link].parent
        return path

    def pose(self, link: str, positions: Mapping[str, float], base: str | None = None) -> Array:
        """Return the pose (4, 4) of a link in a base, or the root; joints are at 0 if not given."""
        X = np.eye(4)
        for joint in self.chain(link, base):
            X = X @ joint.pose(positions.get(joint.name, 0.0))
        return X


def read_model(source: Source) -> VendorModel:
    """Return a vendor's model.

    Raises:
        HandError: If it is no tree of rigid links with meshes that can be read, in one line.
    """
    masses = {} if source.root.tag == "mujoco" else declared_masses(source.root)
    if negative := [name for name, mass in masses.items() if not 0.0 <= mass < np.inf]:
        raise HandError(
            f"model: link {negative[0]!r} must have a mass of 0 kg or more, "
            f"got {masses[negative[0]]:g}"
        )
    mimics = declared_mimics(source.root)
    with tempfile.TemporaryDirectory() as scratch:
        meshes = MeshFolder(Path(scratch))
        notes = replace_meshes(source, meshes.convert)
        path = Path(scratch) / f"model.{FORMATS[source.root.tag]}"
        ElementTree.ElementTree(source.root).write(path, encoding="utf-8")
        plant, graph = MultibodyPlant(1e-3), SceneGraph()
        plant.RegisterAsSourceForSceneGraph(graph)
        parts = _Parts(plant, graph, _parse(plant, path), meshes.colours, masses)
        model = _merge(parts, _efforts(source.root, plant), notes)
    model = _with_room(replace(model, mimics=_resolve(mimics, model.joints)))
    _refuse_size(model)
    return model


def _parse(plant: MultibodyPlant, path: Path) -> Any:
    """Let Drake parse a model file, and return its model instance."""
    parser = make_parser(plant)
    with _quiet():
        try:
            (instance,) = parser.AddModels(path)
        except (RuntimeError, ValueError, SystemExit) as error:
            text = first_line(error).replace(str(path.parent) + "/", "")
            raise HandError(f"model: must be a file of one model, got {text}") from None
    return instance


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep Drake's remarks on tags that it does not know to itself."""
    logger = logging.getLogger("drake")
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(before)


@dataclass(frozen=True)
class _Parts:
    """What Drake parsed."""

    plant: MultibodyPlant
    graph: SceneGraph
    instance: Any
    colours: dict[str, Array]
    masses: dict[str, float]

    def inertia(self, body: Any) -> Inertia | None:
        """Return the inertia of a body; None if its model gives no mass."""
        if self.masses.get(body.name(), body.default_mass()) == 0.0 or body.default_mass() == 0.0:
            return None
        M = body.default_spatial_inertia()
        centre = M.get_com()
        about = M.CalcRotationalInertia().CopyToFullMatrix3()
        mass = M.get_mass()
        shift = mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
        return Inertia(mass=mass, p_LLcm=centre, I_LLcm=about - shift)

    def shapes(self, body: Any, role: Role) -> list[Shape]:
        """Return the shapes of a body, those that collide as hulls."""
        get = (
            self.plant.GetCollisionGeometriesForBody
            if role is Role.kProximity
            else self.plant.GetVisualGeometriesForBody
        )
        inspector = self.graph.model_inspector()
        seen = Role.kIllustration if role is Role.kIllustration else role
        found = [read_shape(inspector, shape, seen, self.colours) for shape in get(body)]
        return [shape for shape in found if shape is not None]


def _merge(parts: _Parts, efforts: Mapping[str, float], notes: Sequence[str]) -> VendorModel:
    """Return the model whose welded links are one."""
    plant = parts.plant
    bodies = {index: plant.get_body(index) for index in plant.GetBodyIndices(parts.instance)}
    joints = [plant.get_joint(i) for i in plant.GetJointIndices(parts.instance)]
    above = _carriers(plant, bodies, joints)

    # Each body's carrier through welds, and its pose there.
    heads: dict[Any, tuple[Any, Array]] = {}
    for index in _sorted(bodies, above):
        joint = above.get(index)
        if joint is None or moving_joint(joint):
            X_CM = np.eye(4) if joint is None else _fixed(joint.frame_on_child())
            heads[index] = index, invert_pose(X_CM)
        else:
            head, X_HP = heads[joint.parent_body().index()]
            X_PC = _fixed(joint.frame_on_parent()) @ joint.X_FM().GetAsMatrix4()
            heads[index] = head, X_HP @ X_PC @ invert_pose(_fixed(joint.frame_on_child()))

    # Links: of several bodies the heaviest names them, and gives the root its frame.
    names, frames, links, remarks = {}, {}, {}, list(notes)
    for head in [i for i in heads if heads[i][0] == i]:
        members = [i for i in heads if heads[i][0] == head]
        main = max(members, key=lambda i: _weight(parts, bodies[i]))
        frames[head] = np.eye(4) if head in above else invert_pose(heads[main][1])
        names[head] = bodies[main].name()
        link = _link(parts, names[head], [(bodies[i], frames[head] @ heads[i][1]) for i in members])
        links[link[0].name] = link[0]
        remarks += link[1]

    # Joints between them.
    made: dict[str, VendorJoint] = {}
    for index in heads:
        joint = above.get(index)
        if joint is None or not moving_joint(joint):
            continue
        head, X_HP = heads[joint.parent_body().index()]
        made[joint.name()] = VendorJoint(
            name=joint.name(),
            slides=joint_slides(joint),
            parent=names[head],
            child=names[index],
            X_PJ=frames[head] @ X_HP @ _fixed(joint.frame_on_parent()),
            axis=joint_axis(joint),
            limits=np.array([joint.position_lower_limit(), joint.position_upper_limit()]),
            effort=efforts.get(joint.name(), 0.0),
            velocity=float(joint.velocity_upper_limit()),
        )
    (root,) = [names[i] for i in heads if i not in above]
    return VendorModel(
        name=plant.GetModelInstanceName(parts.instance),
        root=root,
        links=links,
        joints=made,
        mimics={},
        notes=tuple(remarks),
    )


def _carriers(
    plant: MultibodyPlant, bodies: Mapping[Any, Any], joints: Sequence[Any]
) -> dict[Any, Any]:
    """Return the joint that carries each body but the root."""
    above: dict[Any, Any] = {}
    for joint in joints:
        child = joint.child_body().index()
        if joint.parent_body().index() == plant.world_body().index():
            continue  # The hand hangs free, however the file holds it.
        if not (moving_joint(joint) or isinstance(joint, WeldJoint)):
            raise HandError(
                f"model: joint {joint.name()!r} must be revolute, prismatic or fixed, "
                f"got {type(joint).__name__}"
            )
        if child in above:
            raise HandError(
                f"model: link {joint.child_body().name()!r} must be carried by one joint, got "
                f"{above[child].name()!r} and {joint.name()!r}: cut the closed loop"
            )
        above[child] = joint
    roots = [body.name() for index, body in bodies.items() if index not in above]
    if len(roots) != 1:
        got = f"{len(roots)} ({', '.join(roots)})" if roots else "none: its joints form a loop"
        raise HandError(f"model: must be one tree of links, with one root, got {got}")
    return above


def _sorted(bodies: Mapping[Any, Any], above: Mapping[Any, Any]) -> list[Any]:
    """Return the bodies, each after the one that carries it."""
    order = [index for index in bodies if index not in above]
    for index in order:
        order += [i for i in bodies if i in above and above[i].parent_body().index() == index]
    if len(order) < len(bodies):
        lost = next(body.name() for index, body in bodies.items() if index not in order)
        raise HandError(f"model: must be one tree of links, got a loop at link {lost!r}")
    return order


def _fixed(frame: Any) -> Array:
    return np.asarray(frame.GetFixedPoseInBodyFrame().GetAsMatrix4())


def _weight(parts: _Parts, body: Any) -> tuple[float, int, int]:
    """Return how much a body counts among those that are welded to it."""
    inertia = parts.inertia(body)
    plant = parts.plant
    shapes = len(plant.GetCollisionGeometriesForBody(body))
    pictures = len(plant.GetVisualGeometriesForBody(body))
    return (0.0 if inertia is None else inertia.mass), shapes, pictures


def _link(parts: _Parts, name: str, members: Sequence[tuple[Any, Array]]) -> tuple[Link, list[str]]:
    """Return the link of welded bodies with their poses in its frame, and notes."""
    notes, found = [], {Role.kProximity: [], Role.kIllustration: []}  # type: ignore[var-annotated]
    inertias = []
    for body, X_LB in members:
        inertia = parts.inertia(body)
        inertias += [] if inertia is None else [moved(inertia, X_LB)]
        for role, shapes in found.items():
            shapes += [replace(s, X_LS=X_LB @ s.X_LS) for s in parts.shapes(body, role)]
    collisions = [shape.hull() for shape in found[Role.kProximity]]
    if not collisions and found[Role.kIllustration]:
        collisions = [shape.hull() for shape in found[Role.kIllustration]]
        notes.append(f"link {name}: the model has no collision shapes; hulls of its pictures")

    # Mass and inertia, or what its size makes likely.
    total = combine(inertias)
    hulls = [shape.corners() for shape in collisions]
    if total is None and hulls:
        total = solid_inertia(hulls, None)
        notes.append(f"link {name}: the model gives no mass; {1e3 * total.mass:.0f} g by its size")
    elif total is None:
        total = Inertia(mass=BARE_MASS, p_LLcm=np.zeros(3), I_LLcm=BARE_INERTIA * np.eye(3))
    elif not total.is_possible():
        notes.append(f"link {name}: no body has the model's inertia; that of its shapes")
        total = (
            solid_inertia(hulls, total.mass)
            if hulls
            else replace(total, I_LLcm=total.mass * 1e-4 * np.eye(3))
        )
    link = Link(
        name=name,
        inertia=total,
        collisions=tuple(collisions),
        visuals=tuple(found[Role.kIllustration]),
    )
    return link, notes


def _efforts(root: Element, plant: MultibodyPlant) -> dict[str, float]:
    """Return the largest effort [N m or N] of each joint that the model gives one."""
    efforts = {}
    for joint in root.iter("joint"):
        for limit in joint.iter("limit"):
            text = limit.get("effort") or limit.findtext("effort")
            try:
                efforts[joint.get("name", "")] = abs(float(text or 0.0))
            except ValueError:
                raise HandError(f"model: effort must be a number, got {text!r}") from None
    for index in plant.GetJointActuatorIndices():
        motor = plant.get_joint_actuator(index)
        efforts.setdefault(motor.joint().name(), motor.effort_limit())
    return {name: effort for name, effort in efforts.items() if 0.0 < effort < np.inf}


def _resolve(mimics: Sequence[Mimic], joints: Mapping[str, VendorJoint]) -> dict[str, Mimic]:
    """Return what each joint follows, through all that its leader follows."""
    given = {mimic.joint: mimic for mimic in mimics}
    resolved: dict[str, Mimic] = {}
    for name, mimic in given.items():
        if name not in joints:
            raise HandError(f"model: joint {name!r} follows another, so it must turn or slide")
        ratio, offset, leader, seen = mimic.ratio, mimic.offset, mimic.leader, {name}
        while leader in given:
            if leader in seen:
                raise HandError(
                    f"model: joint {name!r} must follow a joint that leads, got a circle of mimics"
                )
            seen.add(leader)
            nxt = given[leader]
            ratio, offset, leader = ratio * nxt.ratio, offset + ratio * nxt.offset, nxt.leader
        if leader not in joints or leader in seen:
            raise HandError(f"model: joint {name!r} must follow a joint that moves, got {leader!r}")
        if ratio == 0.0:
            raise HandError(f"model: joint {name!r} must follow {leader!r} by a ratio, got 0")
        resolved[name] = Mimic(joint=name, leader=leader, ratio=ratio, offset=offset)
    return resolved


def _with_room(model: VendorModel) -> VendorModel:
    """Return the model in which joints that follow may go where their leaders take them.

    Limits of some vendors' mimics have the wrong sign.
    """
    joints, notes = dict(model.joints), list(model.notes)
    for name, mimic in model.mimics.items():
        joint = joints[name]
        led = np.sort(mimic.ratio * joints[mimic.leader].limits + mimic.offset)
        shared = min(led[1], joint.limits[1]) - max(led[0], joint.limits[0])
        if np.isfinite(led).all() and shared < 0.5 * (led[1] - led[0]):
            lower, upper = joint.limits
            joints[name] = replace(joint, limits=led)
            notes.append(
                f"joint {name}: its limits {lower:g}..{upper:g} bar the way of its mimic; now "
                f"{led[0]:g}..{led[1]:g}"
            )
    return replace(model, joints=joints, notes=tuple(notes))


def _refuse_size(model: VendorModel) -> None:
    """Refuse a model without shapes, or one whose units are not metres."""
    points = [
        transform_points(model.pose(n, {}), link.corners()) for n, link in model.links.items()
    ]
    cloud = np.concatenate(points)
    if not len(cloud):
        raise HandError("model: must have shapes, got links without any")
    size = float(np.ptp(cloud, axis=0).max())
    if not SIZES[0] <= size <= SIZES[1]:
        raise HandError(
            f"model: must be a hand in metres, got one of {size:.3g} m: check units and scales of "
            "its meshes"
        )
    for joint in model.joints.values():
        if not joint.limits[0] <= joint.limits[1]:
            raise HandError(
                f"model: joint {joint.name!r} must have a lower limit below its upper one, got "
                f"{joint.limits[0]:g}..{joint.limits[1]:g}"
            )
