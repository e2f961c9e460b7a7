"""A vendor's model as data: a tree of rigid links, and the joints between them.

Input: a `Source`, which Drake parses. Output: a `VendorModel`. In it, links that are welded to each
other are one link, every moving link has a mass, and limits let mimic joints follow. The frame of a
link is the frame of the joint to its parent.
"""

from __future__ import annotations

import logging
import re
import tempfile
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from pydrake.geometry import Role, SceneGraph
from pydrake.math import RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import SpatialInertia, UnitInertia

from drakegrasp.commissioning.draft.mjcf import compile_parts
from drakegrasp.commissioning.draft.parts import Carrier, Link, Parts, motion
from drakegrasp.commissioning.draft.shapes import (
    Shape,
    added,
    read_shape,
    replace_meshes,
    solid_inertia,
)
from drakegrasp.commissioning.draft.source import FORMATS, Source
from drakegrasp.errors import HandError, first_line
from drakegrasp.frames import Array, invert_pose, transform_points
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
#: Drake's warnings on parts that no hand has, or that are reported elsewhere.
_ASIDE = re.compile("'(light|camera|sensor|transmission|gazebo)'|effort limits|inertia")


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
        return motion(self.axis, self.slides, positions)

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
    # MuJoCo reads MJCF, and Drake the other formats.
    parts = (compile_parts if source.root.tag == "mujoco" else _parse_parts)(source)
    impossible = {} if source.root.tag == "mujoco" else impossible_inertias(source.root)

    # Build links and joints, and find their leaders.
    carriers = _carriers(parts)
    places, links, notes = _places(parts.bodies, carriers), {}, list(parts.notes)
    for head in dict.fromkeys(head for head, _ in places.values()):
        members = [(parts.bodies[i], X_LB) for i, (at, X_LB) in places.items() if at == head]
        links[head], remarks = _weld(members, impossible)
        notes += remarks
    joints = _joints(carriers, places, links, parts.efforts)
    leaders = find_leaders(parts.mimics, joints)
    notes += make_room(joints, leaders)
    model = VendorModel(
        name=parts.name,
        root=next(link.name for key, link in links.items() if key not in carriers),
        links={link.name: link for link in links.values()},
        joints=joints,
        mimics=leaders,
        notes=tuple(notes),
    )
    _refuse_size(model)
    return model


def _parse_parts(source: Source) -> Parts:
    """Return the parts of a URDF or SDFormat model.

    Raises:
        HandError: If Drake rejects the model, or its numbers are impossible.
    """
    # Read what the text declares and Drake does not keep.
    root = source.root
    masses = declared_masses(root)
    for name, mass in masses.items():
        if not 0.0 <= mass < np.inf:
            raise HandError(f"model: link {name!r} must have a mass of 0 kg or more, got {mass:g}")
    refuse_impossible(root)
    efforts, mimics = declared_efforts(root), declared_mimics(root)

    # Parse it with Drake.
    plant, graph = MultibodyPlant(1e-3), SceneGraph()
    plant.RegisterAsSourceForSceneGraph(graph)
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / f"model.{FORMATS[root.tag]}"
        meshes, notes = replace_meshes(source, path.parent)
        ElementTree.ElementTree(root).write(path, encoding="utf-8")
        instance, warned = _parse(plant, path)
        bodies = _bodies(plant, graph, instance, masses, meshes)
    for motor in map(plant.get_joint_actuator, plant.GetJointActuatorIndices()):
        efforts.setdefault(motor.joint().name(), motor.effort_limit())
    joints = [plant.get_joint(index) for index in plant.GetJointIndices(instance)]
    world = plant.world_body().index()
    return Parts(
        name=plant.GetModelInstanceName(instance),
        bodies=bodies,
        carriers=[_carrier(joint) for joint in joints if joint.parent_body().index() != world],
        efforts=efforts,
        mimics=mimics,
        notes=[*notes, *warned],
    )


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
) -> dict[Hashable, Link]:
    """Return the bodies that Drake parsed, before welded bodies are joined."""
    found = dict[Hashable, Link]()
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
        if masses.get(name, mass) != 0.0 and mass != 0.0:
            inertia = body.default_spatial_inertia()
        solids, visuals = (tuple(s for s in own if s is not None) for own in shapes)
        found[index] = Link(name=name, inertia=inertia, collisions=solids, visuals=visuals)
    return found


def _carrier(joint: Any) -> Carrier:
    """Return what a joint of Drake is."""
    refuse_other_joint(joint)
    X_PJ, X_CJ = (
        np.asarray(frame.GetFixedPoseInBodyFrame().GetAsMatrix4())
        for frame in (joint.frame_on_parent(), joint.frame_on_child())
    )
    ends = {
        "name": joint.name(),
        "parent": joint.parent_body().index(),
        "child": joint.child_body().index(),
    }

    # A weld may hold its child away from its frame.
    if not moving_joint(joint):
        return Carrier(**ends, X_PJ=X_PJ @ joint.X_FM().GetAsMatrix4(), X_CJ=X_CJ)
    return Carrier(
        **ends,
        X_PJ=X_PJ,
        X_CJ=X_CJ,
        axis=joint_axis(joint),
        slides=joint_slides(joint),
        limits=np.array([joint.position_lower_limit(), joint.position_upper_limit()]),
        velocity=float(joint.velocity_upper_limit()),
    )


def _carriers(parts: Parts) -> dict[Hashable, Carrier]:
    """Return what carries each body except for the root."""
    found: dict[Hashable, Carrier] = {}
    for carrier in parts.carriers:
        if carrier.child in found:
            raise HandError(
                f"model: link {parts.bodies[carrier.child].name!r} must be carried by one joint, "
                f"got {found[carrier.child].name!r} and {carrier.name!r}: cut the closed loop"
            )
        found[carrier.child] = carrier

    # One body must be left that has no parent.
    roots = [body.name for key, body in parts.bodies.items() if key not in found]
    if len(roots) != 1:
        got = f"{len(roots)} ({', '.join(roots)})" if roots else "none: its joints form a loop"
        raise HandError(f"model: must be one tree of links, with one root, got {got}")
    return found


def _places(
    bodies: Mapping[Hashable, Link], carriers: Mapping[Hashable, Carrier]
) -> dict[Hashable, tuple[Hashable, Array]]:
    """Return for each body the first body of its link, and its pose (4, 4) in the link.

    Bodies come after their parents.
    """
    # Go from the root outwards. The frame of a link is that of its joint.
    order = [key for key in bodies if key not in carriers]
    places: dict[Hashable, tuple[Hashable, Array]] = {}
    for key in order:
        carrier = carriers.get(key)
        if carrier is None:
            places[key] = key, np.eye(4)
        elif carrier.axis is not None:
            places[key] = key, invert_pose(carrier.X_CJ)
        else:
            head, X_LP = places[carrier.parent]
            places[key] = head, X_LP @ carrier.X_PJ @ invert_pose(carrier.X_CJ)
        order += [child for child, above in carriers.items() if above.parent == key]
    if len(order) < len(bodies):
        lost = next(body.name for key, body in bodies.items() if key not in places)
        raise HandError(f"model: must be one tree of links, got a loop at link {lost!r}")

    # The frame of the root is that of its heaviest body.
    members = [key for key, (head, _) in places.items() if head == order[0]]
    X_LR = invert_pose(places[max(members, key=lambda key: bodies[key].weight)][1])
    return places | {key: (order[0], X_LR @ places[key][1]) for key in members}


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
    drawn = tuple(shape.simplified() for shape in visuals)
    return Link(name=name, inertia=total, collisions=tuple(collisions), visuals=drawn), notes


def _joints(
    carriers: Mapping[Hashable, Carrier],
    places: Mapping[Hashable, tuple[Hashable, Array]],
    links: Mapping[Hashable, Link],
    efforts: Mapping[str, float],
) -> dict[str, VendorJoint]:
    """Return the joints that move, by name, each after those above its parent."""
    found = {}
    for key in links:
        carrier = carriers.get(key)
        if carrier is None or carrier.axis is None:
            continue
        name, (head, X_LP) = carrier.name, places[carrier.parent]
        refuse_limits(name, *carrier.limits)

        # Infinite efforts give no information.
        effort = efforts.get(name, 0.0)
        found[name] = VendorJoint(
            name=name,
            slides=carrier.slides,
            parent=links[head].name,
            child=links[key].name,
            X_PJ=X_LP @ carrier.X_PJ,
            axis=carrier.axis,
            limits=carrier.limits,
            effort=effort if np.isfinite(effort) else 0.0,
            velocity=carrier.velocity,
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
