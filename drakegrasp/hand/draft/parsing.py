"""Reads a vendor's model with Drake.

In: a `Source`. Out: a `VendorModel`, in which links that are welded to each other are one, every
link that moves has a mass, and limits let mimics follow.
"""

from __future__ import annotations

import logging
import re
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from pydrake.geometry import Role, SceneGraph, SceneGraphInspector
from pydrake.math import RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import SpatialInertia, WeldJoint

from drakegrasp.errors import HandError, first_line
from drakegrasp.frames import Array, invert_pose, transform_points
from drakegrasp.hand.chains import joint_axis, joint_slides, moving_joint
from drakegrasp.hand.draft.compiled import Compiled, compile_model
from drakegrasp.hand.draft.couplings import find_leaders, make_room
from drakegrasp.hand.draft.meshes import MeshFile, MeshFolder, replace_meshes
from drakegrasp.hand.draft.mjcf import spell_out, trim
from drakegrasp.hand.draft.model import Link, VendorJoint, VendorModel
from drakegrasp.hand.draft.shapes import (
    Shape,
    added,
    point_inertia,
    read_shape,
    solid_inertia,
    with_mass,
)
from drakegrasp.hand.draft.source import FORMATS, Source
from drakegrasp.hand.model_text import (
    declared_efforts,
    declared_masses,
    declared_mimics,
    impossible_inertias,
)
from drakegrasp.hand.parsing import make_parser

#: A hand is so large [m], with its arm if it has one; else its units are others.
SIZES = (0.03, 3.0)
#: A hull that reaches farther beyond its mesh [m] is told of: own choice, half of a fingertip.
HOLLOW = 0.01
#: Mass [kg] and radius [m] of a link that has neither mass nor shape but moves.
BARE_MASS, BARE_RADIUS = 1e-3, 0.016


#: What Drake says of parts that MuJoCo reads or that are no part of a hand, or that is said again.
_ASIDE = re.compile(
    "child of '(equality|actuator|tendon|contact|sensor|asset|option|default)'|'(light|camera|site|"
    "compiler|option|tendon|equality|sensor|contact|exclude|transmission|gazebo|general)'|"
    "effort limits|inertia|'actuatorfrc|The motor"
)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Body:
    """A body that Drake parsed, before it is joined with those that are welded to it.

    Attributes:
        name: Its name.
        inertia: M_BBo_B; None if its model gives no mass.
        collisions, visuals: Its shapes.
        impossible: What is wrong with the inertia that its model gives; None if nothing.
    """

    name: str
    inertia: SpatialInertia | None
    collisions: list[Shape]
    visuals: list[Shape]
    impossible: str | None = None

    @property
    def weight(self) -> tuple[float, int, int]:
        """How much it counts among those that are welded to it: the first names them all."""
        mass = 0.0 if self.inertia is None else self.inertia.get_mass()
        return mass, len(self.collisions), len(self.visuals)


def read_model(source: Source) -> VendorModel:
    """Return a vendor's model.

    Raises:
        HandError: If it is no tree of rigid links with meshes that can be read, in one line.
    """
    # What the text says and Drake does not keep.
    mjcf = source.root.tag == "mujoco"
    masses = {} if mjcf else declared_masses(source.root)
    if negative := [name for name, mass in masses.items() if not 0.0 <= mass < np.inf]:
        raise HandError(
            f"model: link {negative[0]!r} must have a mass of 0 kg or more, "
            f"got {masses[negative[0]]:g}"
        )
    impossible = {} if mjcf else impossible_inertias(source.root)

    # What Drake makes of it, and of MJCF MuJoCo.
    compiled = None
    with tempfile.TemporaryDirectory() as scratch:
        meshes = MeshFolder(Path(scratch))
        if mjcf:
            trim(source.root)
        notes = replace_meshes(source, meshes)
        path = Path(scratch) / f"model.{FORMATS[source.root.tag]}"
        if mjcf:
            ElementTree.ElementTree(source.root).write(path, encoding="utf-8")
            compiled = compile_model(path)
            spell_out(source.root)
        ElementTree.ElementTree(source.root).write(path, encoding="utf-8")
        plant, graph = MultibodyPlant(1e-3), SceneGraph()
        plant.RegisterAsSourceForSceneGraph(graph)
        instance, said = _parse(plant, path)
        inspector = graph.model_inspector()
        bodies = {
            index: _read_body(plant, plant.get_body(index), inspector, masses, meshes.files)
            for index in plant.GetBodyIndices(instance)
        }
    if compiled is None:
        efforts, mimics = declared_efforts(source.root), declared_mimics(source.root)
        for index in plant.GetJointActuatorIndices():
            motor = plant.get_joint_actuator(index)
            efforts.setdefault(motor.joint().name(), motor.effort_limit())
    else:
        efforts, mimics = compiled.efforts, compiled.mimics
        _refuse_losses(plant, instance, compiled)
        bodies = {
            index: replace(body, inertia=compiled.inertias.get(body.name))
            for index, body in bodies.items()
        }
        said = [*compiled.notes, *said]
    bodies = {
        index: replace(body, impossible=impossible.get(body.name)) for index, body in bodies.items()
    }
    notes += said

    # Links and joints, and what follows what.
    carriers = _carriers(plant, instance, bodies)
    places = _places(bodies, carriers)
    links, remarks = _links(bodies, carriers, places)
    names = {index: link.name for index, link in links.items()}
    limits = {} if compiled is None else compiled.limits
    joints = _joints(carriers, places, names, efforts, limits)
    leaders = find_leaders(mimics, joints)
    joints, widened = make_room(joints, leaders)
    (root,) = (name for index, name in names.items() if index not in carriers)
    model = VendorModel(
        name=plant.GetModelInstanceName(instance),
        root=root,
        links={link.name: link for link in links.values()},
        joints=joints,
        mimics=leaders,
        notes=(*notes, *remarks, *widened),
    )
    _refuse_size(model)
    return model


def _parse(plant: MultibodyPlant, path: Path) -> tuple[Any, list[str]]:
    """Let Drake parse a model file; return its model instance, and notes of what it left out."""
    parser = make_parser(plant)
    with _heard() as messages:
        try:
            (instance,) = parser.AddModels(path)
        except (RuntimeError, ValueError, SystemExit) as error:
            text = first_line(error).replace(str(path.parent) + "/", "")
            raise HandError(f"model: must be a file of one model, got {text}") from None
    lines = (" ".join(m.split()).partition(" warning: ")[2] for m in messages)
    return instance, [f"Drake: {t}" for t in dict.fromkeys(lines) if t and not _ASIDE.search(t)]


@contextmanager
def _heard() -> Iterator[list[str]]:
    """Collect Drake's warnings in place of printing them."""
    logger, messages = logging.getLogger("drake"), []

    def hear(record: logging.LogRecord) -> bool:
        if record.levelno == logging.WARNING:
            messages.append(record.getMessage())
        return record.levelno > logging.WARNING

    logger.addFilter(hear)
    try:
        yield messages
    finally:
        logger.removeFilter(hear)


def _refuse_losses(plant: MultibodyPlant, instance: Any, compiled: Compiled) -> None:
    """Refuse a model of which Drake read other joints or bodies than MuJoCo."""
    joints = {plant.get_joint(i).name() for i in plant.GetJointIndices(instance)}
    bodies = {plant.get_body(i).name() for i in plant.GetBodyIndices(instance)}
    for kind, known, own in (
        ("joint", compiled.limits, joints),
        ("body", compiled.inertias, bodies),
    ):
        if lost := [name for name in known if name not in own]:
            raise HandError(f"model: {kind} {lost[0]!r} of MuJoCo must be one of Drake, got none")


def _read_body(
    plant: MultibodyPlant,
    body: Any,
    inspector: SceneGraphInspector,
    masses: Mapping[str, float],
    meshes: Mapping[str, MeshFile],
) -> _Body:
    """Return a body; Drake replaces a mass of zero by one of its own."""
    massless = masses.get(body.name(), body.default_mass()) == 0.0 or body.default_mass() == 0.0
    collisions, visuals = (
        [read_shape(inspector, geometry, role, meshes) for geometry in geometries]
        for role, geometries in (
            (Role.kProximity, plant.GetCollisionGeometriesForBody(body)),
            (Role.kIllustration, plant.GetVisualGeometriesForBody(body)),
        )
    )

    # Shapes without bounds are no part of a hand.
    return _Body(
        name=body.name(),
        inertia=None if massless else body.default_spatial_inertia(),
        collisions=[shape for shape in collisions if shape is not None],
        visuals=[shape for shape in visuals if shape is not None],
    )


def _carriers(plant: MultibodyPlant, instance: Any, bodies: Mapping[Any, _Body]) -> dict[Any, Any]:
    """Return the joint that carries each body but the root."""
    # The hand hangs free, however the file holds it.
    found: dict[Any, Any] = {}
    for joint in (plant.get_joint(index) for index in plant.GetJointIndices(instance)):
        if joint.parent_body().index() == plant.world_body().index():
            continue
        child = joint.child_body()
        if not (moving_joint(joint) or isinstance(joint, WeldJoint)):
            raise HandError(
                f"model: joint {joint.name()!r} must be revolute, prismatic or fixed, "
                f"got {type(joint).__name__}"
            )
        if child.index() in found:
            raise HandError(
                f"model: link {child.name()!r} must be carried by one joint, got "
                f"{found[child.index()].name()!r} and {joint.name()!r}: cut the closed loop"
            )
        found[child.index()] = joint

    # One body is left that nothing carries.
    roots = [body.name for index, body in bodies.items() if index not in found]
    if len(roots) != 1:
        got = f"{len(roots)} ({', '.join(roots)})" if roots else "none: its joints form a loop"
        raise HandError(f"model: must be one tree of links, with one root, got {got}")
    return found


def _places(bodies: Mapping[Any, _Body], carriers: Mapping[Any, Any]) -> dict[Any, Any]:
    """Return the link of each body, by the body that a joint carries, and its pose (4, 4) there.

    Bodies come after those that carry them.
    """
    # From the root on. The frame of a link is that of its joint.
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


def _links(
    bodies: Mapping[Any, _Body], carriers: Mapping[Any, Any], places: Mapping[Any, Any]
) -> tuple[dict[Any, Link], list[str]]:
    """Return the links, by the body that a joint carries, and notes of what was put in."""
    links, notes = {}, []
    for head in dict.fromkeys(head for head, _ in places.values()):
        members = [(bodies[i], X_LB) for i, (at, X_LB) in places.items() if at == head]
        links[head], remarks = _weld(members)
        notes += remarks
    return links, notes


def _weld(members: Sequence[tuple[_Body, Array]]) -> tuple[Link, list[str]]:
    """Return the link of bodies with their poses in its frame, and notes of what was put in."""
    # Shapes; what only is drawn collides, too, if nothing else does.
    name, notes = max((body for body, _ in members), key=lambda body: body.weight).name, []
    solids = [s.carried(X) for body, X in members for s in body.collisions]
    visuals = [s.carried(X) for body, X in members for s in body.visuals]
    if not solids and visuals:
        solids = visuals
        notes.append(f"link {name}: the model has no collision shapes; hulls of its pictures")
    collisions = [shape.hull() for shape in solids]
    notes += _hollows(name, solids, collisions)

    # Inertias add up about the link's origin.
    total: SpatialInertia | None = None
    for body, X_LB in members:
        if body.inertia is not None:
            own = body.inertia.ReExpress(RotationMatrix(X_LB[:3, :3])).Shift(-X_LB[:3, 3])
            total = own if total is None else added(total, own)

    # What has no mass gets one by its size, and what no body has is replaced.
    wrong = [body.impossible for body, _ in members if body.impossible]
    got = f" ({wrong[0]})" if wrong else ""
    if total is None and not collisions:
        total = point_inertia(BARE_MASS, BARE_RADIUS)
    elif total is None:
        total = solid_inertia(collisions)
        notes.append(
            f"link {name}: the model gives no mass; {1e3 * total.get_mass():.0f} g by its size"
        )
    elif wrong or not total.IsPhysicallyValid():
        notes.append(f"link {name}: no body has the model's inertia{got}; that of its shapes")
        likely = solid_inertia(collisions) if collisions else point_inertia(1.0, BARE_RADIUS)
        total = with_mass(likely, total.get_mass())
    link = Link(name=name, inertia=total, collisions=tuple(collisions), visuals=tuple(visuals))
    return link, notes


def _hollows(name: str, shapes: Sequence[Shape], hulls: Sequence[Shape]) -> Iterator[str]:
    """Yield a note of each mesh of a link whose hull fills what is hollow."""
    for shape, hull in zip(shapes, hulls, strict=True):
        beyond = 0.0 if shape.vertices is None else hull.reach_beyond(shape)
        if beyond > HOLLOW:
            yield (
                f"link {name}: the hull that collides reaches up to {1e3 * beyond:.0f} mm beyond "
                "its mesh, and what is hollow there is solid: cut the mesh into convex parts"
            )


def _joints(
    carriers: Mapping[Any, Any],
    places: Mapping[Any, Any],
    names: Mapping[Any, str],
    efforts: Mapping[str, float],
    ranges: Mapping[str, Array],
) -> dict[str, VendorJoint]:
    """Return the joints that move, by name, each after those that carry its parent."""
    found = {}
    for index in places:
        joint = carriers.get(index)
        if joint is None or not moving_joint(joint):
            continue
        head, X_LP = places[joint.parent_body().index()]
        drakes = np.array([joint.position_lower_limit(), joint.position_upper_limit()])
        limits = ranges.get(joint.name(), drakes)
        if not limits[0] <= limits[1]:
            raise HandError(
                f"model: joint {joint.name()!r} must have a lower limit below its upper one, got "
                f"{limits[0]:g}..{limits[1]:g}"
            )

        # Efforts without end say nothing.
        effort = efforts.get(joint.name(), 0.0)
        found[joint.name()] = VendorJoint(
            name=joint.name(),
            slides=joint_slides(joint),
            parent=names[head],
            child=names[index],
            X_PJ=X_LP @ _fixed(joint.frame_on_parent()),
            axis=joint_axis(joint),
            limits=limits,
            effort=effort if np.isfinite(effort) else 0.0,
            velocity=float(joint.velocity_upper_limit()),
        )
    return found


def _refuse_size(model: VendorModel) -> None:
    """Refuse a model without shapes, or one whose units are not metres."""
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
