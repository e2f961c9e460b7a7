"""A vendor's model as data: a tree of rigid links, and the joints between them.

Input: a `Source`, which Drake parses. Output: a `VendorModel`. In it, links that are welded to each
other are one link, every moving link has a mass, and limits let mimic joints follow. The frame of a
link is the frame of the joint to its parent.
"""

from __future__ import annotations

import logging
import re
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from pydrake.geometry import Role, SceneGraph
from pydrake.math import RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import SpatialInertia, UnitInertia

from drakegrasp.commissioning.draft.mjcf import compile_model, spell_out, trim
from drakegrasp.commissioning.draft.shapes import (
    Shape,
    added,
    read_shape,
    replace_meshes,
    solid_inertia,
)
from drakegrasp.commissioning.draft.source import FORMATS, Source
from drakegrasp.errors import HandError, first_line
from drakegrasp.frames import Array, invert_pose, rotation_about, transform_points
from drakegrasp.hand.parsing import (
    Mimic,
    declared_efforts,
    declared_masses,
    declared_mimics,
    impossible_inertias,
    joint_axis,
    joint_slides,
    make_parser,
    moving_joint,
    refuse_impossible,
    refuse_limits,
    refuse_other_joint,
)

#: Smallest fraction of a leader's range that the limits of a following joint must leave to it.
ROOM = 0.5
#: Smallest and largest size of a hand, including an arm [m]; other sizes mean other units.
SIZES = (0.03, 3.0)
#: Smallest and largest limit of revolute joints [rad], and range of masses of a hand, including an
#: arm [kg]; other values mean other units.
SMALLEST_TURN, LARGEST_TURN, MASSES = 0.1, 2.0 * np.pi, (0.01, 60.0)
#: Reach of a hull beyond its mesh from which there is a note [m]; own choice, half of a fingertip.
HOLLOW = 0.01
#: Mass [kg] and radius [m] of a moving link that has neither mass nor shape.
BARE_MASS, BARE_RADIUS = 1e-3, 0.016
#: Drake's warnings on parts that MuJoCo reads or that no hand has, or that are reported elsewhere.
_ASIDE = re.compile(
    "child of '(equality|actuator|tendon|contact|sensor|asset|option|default)'|'(light|camera|site|"
    "compiler|option|tendon|equality|sensor|contact|exclude|transmission|gazebo|general)'|"
    "effort limits|inertia|'actuatorfrc|The motor"
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Link:
    """A rigid link: a vendor's links that are welded together, under the name of the heaviest.

    Attributes:
        name: Name of the link.
        inertia: M_LLo_L; zero for a body whose model gives none, before it is welded.
        collisions: Convex collision shapes.
        visuals: Shapes that are drawn.
    """

    name: str
    inertia: SpatialInertia
    collisions: tuple[Shape, ...]
    visuals: tuple[Shape, ...]

    def corners(self) -> Array:
        """Return the corners (n, 3) of the collision shapes [m]."""
        return np.concatenate([np.zeros((0, 3)), *[s.corners() for s in self.collisions]])

    @property
    def weight(self) -> tuple[float, int, int]:
        """Rank of the link among the links welded to it: the highest gives its name to all."""
        return self.inertia.get_mass(), len(self.collisions), len(self.visuals)


@dataclass(frozen=True, kw_only=True, eq=False)
class VendorJoint:
    """A revolute or prismatic joint; at position 0 the child's frame is at X_PJ in the parent.

    Attributes:
        name: Name of the joint.
        slides: Whether it slides.
        parent, child: Names of links.
        X_PJ: (4, 4), pose of the child in the parent at position 0.
        axis: (3,), unit, in the child's frame.
        limits: (2,), lower and upper [rad or m].
        effort, velocity: Largest effort [N m or N] and velocity [rad/s or m/s]; infinite or 0 if
            not given.
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

    def motion(self, positions: Array | float) -> Array:
        """Return the poses (..., 4, 4) of the child at positions (...), relative to position 0."""
        positions = np.asarray(positions, dtype=float)
        X = np.zeros((*positions.shape, 4, 4)) + np.eye(4)
        if self.slides:
            X[..., :3, 3] = positions[..., None] * self.axis
        else:
            X[..., :3, :3] = rotation_about(self.axis, positions)
        return X

    def pose(self, position: float) -> Array:
        """Return the pose (4, 4) of the child in the parent at a position [rad or m]."""
        return np.asarray(self.X_PJ @ self.motion(position))

    def rebased(self, sign: float, zero: float) -> VendorJoint:
        """Return the joint with positions c instead of q, where q = zero + sign * c."""
        limits = np.sort((self.limits - zero) * sign)
        return replace(self, X_PJ=self.pose(zero), axis=sign * self.axis, limits=limits)


@dataclass(frozen=True, kw_only=True, eq=False)
class VendorModel:
    """A tree of rigid links.

    Attributes:
        name: Name of the model.
        root: Name of the link without a parent.
        links: Links by name.
        joints: Joints by name, each after those above its parent.
        mimics: The joint that each joint follows, by the follower's name; leaders follow no joint.
        notes: What was left out or added, one line each.
    """

    name: str
    root: str
    links: dict[str, Link]
    joints: dict[str, VendorJoint]
    mimics: dict[str, Mimic]
    notes: tuple[str, ...]

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


def read_model(source: Source) -> VendorModel:
    """Return a vendor's model.

    Raises:
        HandError: If it is not a tree of rigid links with readable meshes, in one line.
    """
    # Read what the text declares and Drake does not keep.
    root = source.root
    is_mjcf = root.tag == "mujoco"
    masses = {} if is_mjcf else declared_masses(root)
    for name, mass in masses.items():
        if not 0.0 <= mass < np.inf:
            raise HandError(f"model: link {name!r} must have a mass of 0 kg or more, got {mass:g}")
    impossible = {} if is_mjcf else impossible_inertias(root)
    if not is_mjcf:
        refuse_impossible(root)

    # Parse it with Drake, and MJCF also with MuJoCo.
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / f"model.{FORMATS[root.tag]}"
        if is_mjcf:
            trim(root)
        meshes, notes = replace_meshes(source, path.parent)
        inertias, limits, said = None, dict[str, Array](), list[str]()
        if is_mjcf:
            ElementTree.ElementTree(root).write(path, encoding="utf-8")
            inertias, limits, efforts, mimics, said = compile_model(path)
            spell_out(root)
        else:
            efforts, mimics = declared_efforts(root), declared_mimics(root)
        ElementTree.ElementTree(root).write(path, encoding="utf-8")
        plant, graph = MultibodyPlant(1e-3), SceneGraph()
        plant.RegisterAsSourceForSceneGraph(graph)
        instance, warned = _parse(plant, path)
        bodies = _bodies(plant, graph, instance, masses, meshes, inertias)
    moved = [plant.get_joint(index) for index in plant.GetJointIndices(instance)]
    if is_mjcf:
        _refuse_lost("joint", limits, {joint.name() for joint in moved})
        _refuse_lost("body", inertias or (), {body.name for body in bodies.values()})
    else:
        for motor in map(plant.get_joint_actuator, plant.GetJointActuatorIndices()):
            efforts.setdefault(motor.joint().name(), motor.effort_limit())

    # Build links and joints, and find their leaders.
    carriers = _carriers(plant, moved, bodies)
    places, links = _places(bodies, carriers), {}
    for head in dict.fromkeys(head for head, _ in places.values()):
        members = [(bodies[i], X_LB) for i, (at, X_LB) in places.items() if at == head]
        links[head], remarks = _weld(members, impossible)
        warned += remarks
    joints = _joints(carriers, places, links, efforts, limits)
    leaders = find_leaders(mimics, joints)
    widened = list(make_room(joints, leaders))
    model = VendorModel(
        name=plant.GetModelInstanceName(instance),
        root=next(link.name for index, link in links.items() if index not in carriers),
        links={link.name: link for link in links.values()},
        joints=joints,
        mimics=leaders,
        notes=(*notes, *said, *warned, *widened),
    )
    _refuse_size(model)
    return model


def _parse(plant: MultibodyPlant, path: Path) -> tuple[Any, list[str]]:
    """Let Drake parse a model file; return its model instance, and notes of what it left out."""
    parser, logger, messages = make_parser(plant), logging.getLogger("drake"), list[str]()

    def hear(record: logging.LogRecord) -> bool:
        if record.levelno == logging.WARNING:
            messages.append(record.getMessage())
        return record.levelno > logging.WARNING

    logger.addFilter(hear)
    try:
        (instance,) = parser.AddModels(path)
    except (RuntimeError, ValueError, SystemExit) as error:
        text = first_line(error).replace(str(path.parent) + "/", "")
        raise HandError(f"model: must be a file of one model, got {text}") from None
    finally:
        logger.removeFilter(hear)
    lines = (" ".join(m.split()).partition(" warning: ")[2] for m in messages)
    return instance, [f"Drake: {t}" for t in dict.fromkeys(lines) if t and not _ASIDE.search(t)]


def _bodies(
    plant: MultibodyPlant,
    graph: SceneGraph,
    instance: Any,
    masses: Mapping[str, float],
    meshes: Mapping[str, Shape],
    inertias: Mapping[str, SpatialInertia] | None,
) -> dict[Any, Link]:
    """Return the bodies that Drake parsed, before welded bodies are joined."""
    found = {}
    for index in plant.GetBodyIndices(instance):
        body = plant.get_body(index)
        name, mass = body.name(), body.default_mass()
        shapes = (
            [read_shape(graph.model_inspector(), geometry, role, meshes) for geometry in geometries]
            for role, geometries in (
                (Role.kProximity, plant.GetCollisionGeometriesForBody(body)),
                (Role.kIllustration, plant.GetVisualGeometriesForBody(body)),
            )
        )

        # Drake replaces a mass of zero by its own value. Shapes without bounds are left out.
        inertia = SpatialInertia.Zero()
        if inertias is not None:
            inertia = inertias.get(name, inertia)
        elif masses.get(name, mass) != 0.0 and mass != 0.0:
            inertia = body.default_spatial_inertia()
        solids, visuals = (tuple(s for s in own if s is not None) for own in shapes)
        found[index] = Link(name=name, inertia=inertia, collisions=solids, visuals=visuals)
    return found


def _refuse_lost(kind: str, of_mujoco: Iterable[str], of_drake: Set[str]) -> None:
    """Reject joints or bodies that MuJoCo reads and Drake does not."""
    for name in of_mujoco:
        if name not in of_drake:
            raise HandError(f"model: {kind} {name!r} of MuJoCo must be one of Drake, got none")


def _carriers(
    plant: MultibodyPlant, joints: Sequence[Any], bodies: Mapping[Any, Link]
) -> dict[Any, Any]:
    """Return the joint to the parent of each body except for the root."""
    # The hand is free, however the file fixes it to the world.
    found: dict[Any, Any] = {}
    for joint in joints:
        if joint.parent_body().index() == plant.world_body().index():
            continue
        refuse_other_joint(joint)
        child = joint.child_body()
        if child.index() in found:
            raise HandError(
                f"model: link {child.name()!r} must be carried by one joint, got "
                f"{found[child.index()].name()!r} and {joint.name()!r}: cut the closed loop"
            )
        found[child.index()] = joint

    # One body must be left that has no parent.
    roots = [body.name for index, body in bodies.items() if index not in found]
    if len(roots) != 1:
        got = f"{len(roots)} ({', '.join(roots)})" if roots else "none: its joints form a loop"
        raise HandError(f"model: must be one tree of links, with one root, got {got}")
    return found


def _places(
    bodies: Mapping[Any, Link], carriers: Mapping[Any, Any]
) -> dict[Any, tuple[Any, Array]]:
    """Return for each body the first body of its link, and its pose (4, 4) in the link.

    Bodies come after their parents.
    """
    # Go from the root outwards. The frame of a link is that of its joint.
    order = [index for index in bodies if index not in carriers]
    places: dict[Any, tuple[Any, Array]] = {}
    for index in order:
        joint = carriers.get(index)
        if joint is None:
            places[index] = index, np.eye(4)
        elif moving_joint(joint):
            places[index] = index, invert_pose(_fixed(joint.frame_on_child()))
        else:
            head, X_LP = places[joint.parent_body().index()]
            X_PC = _fixed(joint.frame_on_parent()) @ joint.X_FM().GetAsMatrix4()
            places[index] = head, X_LP @ X_PC @ invert_pose(_fixed(joint.frame_on_child()))
        order += [i for i, above in carriers.items() if above.parent_body().index() == index]
    if len(order) < len(bodies):
        lost = next(body.name for index, body in bodies.items() if index not in places)
        raise HandError(f"model: must be one tree of links, got a loop at link {lost!r}")

    # The frame of the root is that of its heaviest body.
    members = [index for index, (head, _) in places.items() if head == order[0]]
    X_LR = invert_pose(places[max(members, key=lambda i: bodies[i].weight)][1])
    return places | {index: (order[0], X_LR @ places[index][1]) for index in members}


def _fixed(frame: Any) -> Array:
    return np.asarray(frame.GetFixedPoseInBodyFrame().GetAsMatrix4())


def _weld(
    members: Sequence[tuple[Link, Array]], impossible: Mapping[str, str]
) -> tuple[Link, list[str]]:
    """Return the link of bodies with their poses in its frame, and notes of what was added.

    Args:
        members: The bodies, with their poses (4, 4).
        impossible: Faults of impossible inertias in the model, by the names of bodies.
    """
    # Join the shapes; without collision shapes, the visual shapes also collide.
    name, notes = max((body for body, _ in members), key=lambda body: body.weight).name, []
    solids, visuals = (
        [replace(s, X_LS=X_LB @ s.X_LS) for body, X_LB in members for s in getattr(body, kind)]
        for kind in ("collisions", "visuals")
    )
    if not solids and visuals:
        solids = visuals
        notes.append(f"link {name}: the model has no collision shapes; hulls of its pictures")
    collisions = [shape.hull() for shape in solids]
    for shape, hull in zip(solids, collisions, strict=True):
        beyond = 0.0 if shape.vertices is None else hull.reach_beyond(shape)
        if beyond > HOLLOW:
            notes.append(
                f"link {name}: the hull that collides reaches up to {1e3 * beyond:.0f} mm beyond "
                "its mesh, and what is hollow there is solid: cut the mesh into convex parts"
            )

    # Add the inertias about the link's origin.
    total = SpatialInertia.Zero()
    for body, X_LB in members:
        if body.inertia.get_mass() > 0.0:
            own = body.inertia.ReExpress(RotationMatrix(X_LB[:3, :3])).Shift(-X_LB[:3, 3])
            total = added(total, own)

    # A link without mass gets a mass by its size, and an impossible inertia is replaced.
    wrong = [impossible[body.name] for body, _ in members if body.name in impossible]
    ball = SpatialInertia(BARE_MASS, np.zeros(3), UnitInertia.SolidSphere(BARE_RADIUS))
    if total.get_mass() == 0.0:
        total = solid_inertia(collisions) if collisions else ball
        if collisions:
            mass = f"{1e3 * total.get_mass():.0f} g by its size"
            notes.append(f"link {name}: the model gives no mass; {mass}")
    elif wrong or not total.IsPhysicallyValid():
        got = f" ({wrong[0]})" if wrong else ""
        notes.append(
            f"link {name}: the model's inertia is impossible{got}; that of its shapes is used"
        )
        likely = solid_inertia(collisions) if collisions else ball
        total = SpatialInertia(total.get_mass(), likely.get_com(), likely.get_unit_inertia())
    shapes = {"collisions": tuple(collisions), "visuals": tuple(visuals)}
    return Link(name=name, inertia=total, **shapes), notes


def _joints(
    carriers: Mapping[Any, Any],
    places: Mapping[Any, tuple[Any, Array]],
    links: Mapping[Any, Link],
    efforts: Mapping[str, float],
    ranges: Mapping[str, Array],
) -> dict[str, VendorJoint]:
    """Return the joints that move, by name, each after those above its parent."""
    found = {}
    for index in links:
        joint = carriers.get(index)
        if joint is None:
            continue
        name, (head, X_LP) = joint.name(), places[joint.parent_body().index()]
        drakes = np.array([joint.position_lower_limit(), joint.position_upper_limit()])
        limits = ranges.get(name, drakes)
        refuse_limits(name, *limits)

        # Infinite efforts give no information.
        effort = efforts.get(name, 0.0)
        found[name] = VendorJoint(
            name=name,
            slides=joint_slides(joint),
            parent=links[head].name,
            child=links[index].name,
            X_PJ=X_LP @ _fixed(joint.frame_on_parent()),
            axis=joint_axis(joint),
            limits=limits,
            effort=effort if np.isfinite(effort) else 0.0,
            velocity=float(joint.velocity_upper_limit()),
        )
    return found


def find_leaders(mimics: Sequence[Mimic], joints: Mapping[str, VendorJoint]) -> dict[str, Mimic]:
    """Return the leader of each following joint, through chains of mimics.

    Raises:
        HandError: If mimics form a circle, or name something that is not a moving joint.
    """
    given = {mimic.joint: mimic for mimic in mimics}
    found: dict[str, Mimic] = {}
    for name, mimic in given.items():
        if name not in joints:
            raise HandError(f"model: joint {name!r} follows another, so it must turn or slide")

        # Follow the leaders up to a joint that follows none.
        ratio, offset, leader, seen = mimic.ratio, mimic.offset, mimic.leader, {name}
        while leader in given and leader not in seen:
            seen.add(leader)
            above = given[leader]
            ratio, offset, leader = ratio * above.ratio, offset + ratio * above.offset, above.leader
        must = f"model: joint {name!r} must follow"
        if leader in seen:
            raise HandError(f"{must} a joint that leads, got a circle of mimics")
        if leader not in joints:
            raise HandError(f"{must} a joint that moves, got {leader!r}")
        if ratio == 0.0:
            raise HandError(f"{must} {leader!r} by a ratio, got 0")
        found[name] = Mimic(joint=name, leader=leader, ratio=ratio, offset=offset)
    return found


def make_room(joints: dict[str, VendorJoint], mimics: Mapping[str, Mimic]) -> Iterator[str]:
    """Give joints limits that let them follow, and yield a note for each that was changed.

    Limits of some vendors' mimics have the wrong sign.
    """
    for name, mimic in mimics.items():
        lower, upper = joints[name].limits
        led = np.sort(mimic.ratio * joints[mimic.leader].limits + mimic.offset)
        shared = min(led[1], upper) - max(led[0], lower)
        if np.isfinite(led).all() and shared < ROOM * (led[1] - led[0]):
            joints[name] = replace(joints[name], limits=led)
            yield (
                f"joint {name}: its limits {lower:g}..{upper:g} bar the way of its mimic; now "
                f"{led[0]:g}..{led[1]:g}"
            )


def doubtful_units(model: VendorModel) -> Iterator[str]:
    """Yield doubts about a model whose angles or masses no hand has: its units may be others."""
    turning = [joint.limits for joint in model.joints.values() if not joint.slides]
    angles = np.abs([limits for limits in turning if np.isfinite(limits).all()])
    if angles.size and np.median(angles.max(axis=1)) > LARGEST_TURN:
        yield (
            f"its joints turn up to {angles.max():.4g} rad: are its limits in degrees? They must "
            "be in radians"
        )
    if angles.size and angles.max() < SMALLEST_TURN:
        yield (
            f"its joints turn up to {np.rad2deg(angles.max()):.2g} degrees: are its angles in "
            'radians? MJCF says so by <compiler angle="radian"/>'
        )
    mass = sum(link.inertia.get_mass() for link in model.links.values())
    if not MASSES[0] <= mass <= MASSES[1]:
        yield f"its masses are {mass:.3g} kg in all: are they in another unit? They must be in kg"


def _refuse_size(model: VendorModel) -> None:
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
