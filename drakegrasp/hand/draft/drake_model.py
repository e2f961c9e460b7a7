"""URDF and SDFormat as Drake parses them.

Input: the path of a model. Output: its bodies and joints. Drake reads few formats of meshes, so it
gets Wavefront files in their place. Drake keeps no efforts, mimics and missing masses, and reads
some words as numbers: `hand.parsing` has what the text declares.
"""

from __future__ import annotations

import logging
import re
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element
from xml.sax.saxutils import unescape

import numpy as np
from pydrake.geometry import (
    Box,
    Capsule,
    Convex,
    Cylinder,
    Ellipsoid,
    GeometryId,
    Mesh,
    SceneGraph,
    SceneGraphInspector,
    Sphere,
)
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex, SpatialInertia

from drakegrasp.errors import HandError, one_line
from drakegrasp.foreign_files import read_content
from drakegrasp.hand.draft.vendor import (
    Link,
    Shape,
    VendorJoint,
    VendorModel,
    ellipsoid,
    read_mesh,
    with_hull,
)
from drakegrasp.hand.folder import REFERENCES
from drakegrasp.hand.parsing import (
    ModelFile,
    add_model,
    declared_efforts,
    declared_masses,
    declared_mimics,
    impossible_inertias,
    joint_axis,
    joint_slides,
    moving_joint,
    validate_joint,
    validate_joints,
)
from drakegrasp.hand.shapes import hull_corners

#: Maximum size of a model's text [bytes].
LONGEST = 20_000_000
#: What a model's text must not have, and what it must be.
_REFUSED = (
    (rb"<!DOCTYPE|<!ENTITY", "must be XML without a document type, got {}"),
    (
        rb"<xacro:\w+|\$[{(][^<>\"']*",
        "must be a model without xacro, got {}: first convert the file with `xacro`",
    ),
    (
        rb"<(?:drake:)?include\b|<submesh\b",
        "must be complete by itself, got {}: put what it names into the file",
    ),
)


def parse_model(path: Path, find: Callable[[str, Path], Path]) -> VendorModel:
    """Return the bodies and joints of a URDF or SDFormat model.

    Args:
        path: The model.
        find: Returns the file of a mesh's URI, given the folder of the model.

    Raises:
        HandError: If Drake rejects the model, its numbers are impossible, or the mesh of a
            collision shape cannot be read.
    """
    text, root = _text_of(path)
    validate_joints(root)
    masses, impossible = declared_masses(root), impossible_inertias(root)
    for name, mass in masses.items():
        if mass < 0.0:
            raise HandError(f"model: link {name!r} must have a mass of 0 kg or more, got {mass:g}")
    plant, graph = MultibodyPlant(1e-3), SceneGraph()
    plant.RegisterAsSourceForSceneGraph(graph)
    with tempfile.TemporaryDirectory() as scratch:
        copy = Path(scratch) / f"model{path.suffix.lower()}"
        rewritten, uris = _with_stand_ins(text, copy.parent)
        copy.write_bytes(rewritten)
        instance = _parse(plant, copy)

    def find_mesh(name: str) -> Shape:
        return read_mesh(find(uris[name], path.parent))

    # Bodies and joints; a joint to the world only fixes the hand.
    links, efforts = {}, declared_efforts(root)
    for body in map(plant.get_body, plant.GetBodyIndices(instance)):
        name, solid = body.name(), plant.GetCollisionGeometriesForBody(body)
        own = solid or plant.GetVisualGeometriesForBody(body)
        found = (_shape(graph.model_inspector(), shape, find_mesh) for shape in own)
        shapes = tuple(shape for shape in found if shape is not None)
        # Drake replaces a mass of zero by its own value.
        massless = body.default_mass() == 0.0 or masses.get(name) == 0.0
        links[name] = Link(
            name=name,
            inertia=SpatialInertia.Zero() if massless else body.default_spatial_inertia(),
            impossible=impossible.get(name, ""),
            collisions=shapes if solid else (),
            pictures=() if solid else shapes,
        )
    joints = [plant.get_joint(index) for index in plant.GetJointIndices(instance)]
    world = plant.world_body().index()
    return VendorModel(
        name=plant.GetModelInstanceName(instance),
        links=links,
        joints={
            joint.name(): _joint(joint, efforts.get(joint.name(), 0.0))
            for joint in joints
            if joint.parent_body().index() != world
        },
        mimics={mimic.joint: mimic for mimic in declared_mimics(root)},
    )


def _text_of(path: Path) -> tuple[bytes, Element]:
    """Return the text of a model without its comments, and the root of its XML."""
    try:
        text = re.sub(rb"<!--.*?-->", b"", read_content(path, LONGEST), flags=re.DOTALL)
    except OSError as error:
        raise HandError(f"{path}: must be a readable file, got: {error.strerror}") from None
    for pattern, must in _REFUSED:
        if found := re.search(pattern, text):
            raise HandError(f"{path}: {must.format(repr(found[0].decode(errors='replace')))}")
    try:
        return text, ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise HandError(f"{path}: must be XML, got text that is not ({one_line(error)})") from None


#: A tetrahedron, as a Wavefront file.
_STAND_IN = "v 0 0 0\nv .01 0 0\nv 0 .01 0\nv 0 0 .01\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def _with_stand_ins(model: bytes, folder: Path) -> tuple[bytes, dict[str, str]]:
    """Return the text of a model that names other meshes, and their URIs by the new names.

    Drake must find a Wavefront file; its triangles are not used.
    """
    uris = dict[str, str]()

    def replaced(match: re.Match[bytes]) -> bytes:
        kind = str(match.lastgroup)
        if kind not in ("uri", "mesh"):
            return match[0]
        name = f"mesh{len(uris)}.obj"
        uris[name] = unescape(match[kind].decode(errors="surrogateescape"))
        (folder / name).write_text(_STAND_IN, encoding="utf-8")
        start, stop = (position - match.start() for position in match.span(kind))
        return match[0][:start] + name.encode() + match[0][stop:]

    return REFERENCES.sub(replaced, model), uris


def _parse(plant: MultibodyPlant, path: Path) -> ModelInstanceIndex:
    """Let Drake parse a model file without its warnings; faults that count are found elsewhere."""
    logger, level = logging.getLogger("drake"), logging.getLogger("drake").level
    logger.setLevel(logging.ERROR)
    try:
        return add_model(plant, ModelFile(path))
    except HandError as error:
        raise HandError(str(error).replace(f"{path.parent}/", "")) from None
    finally:
        logger.setLevel(level)


def _shape(
    inspector: SceneGraphInspector, geometry: GeometryId, find_mesh: Callable[[str], Shape]
) -> Shape | None:
    """Return a shape that Drake parsed, on its body; None if it has no bounds.

    Args:
        inspector: The inspector of the scene graph.
        geometry: The shape.
        find_mesh: Returns the content of the mesh file that Drake knows by a name.

    Raises:
        HandError: If its mesh cannot be read.
    """
    shape = inspector.GetShape(geometry)
    found = Shape(X_LS=inspector.GetPoseInFrame(geometry).GetAsMatrix4())
    if isinstance(shape, Box | Cylinder | Capsule | Sphere):
        return replace(found, primitive=shape)

    # Other shapes become triangles: those of the file, or of the hull.
    if isinstance(shape, Mesh | Convex) and shape.source().is_path():
        mesh = find_mesh(shape.source().path().name)
        assert mesh.vertices is not None
        vertices = mesh.vertices * np.asarray(shape.scale3())
        return replace(found, vertices=vertices, faces=mesh.faces)
    if isinstance(shape, Ellipsoid):
        return replace(found, **ellipsoid([shape.a(), shape.b(), shape.c()]))
    corners = hull_corners(inspector, geometry)
    return None if corners is None else with_hull(found, corners)


def _joint(joint: Any, effort: float) -> VendorJoint:
    """Return what a joint of Drake is."""
    validate_joint(joint)
    X_PJ, X_CJ = (
        np.asarray(frame.GetFixedPoseInBodyFrame().GetAsMatrix4())
        for frame in (joint.frame_on_parent(), joint.frame_on_child())
    )
    ends = {"parent": joint.parent_body().name(), "child": joint.child_body().name()}

    # A fixed joint may hold its child away from its frame.
    if not moving_joint(joint):
        X_PJ = X_PJ @ joint.X_FM().GetAsMatrix4()
        return VendorJoint(name=joint.name(), **ends, X_PJ=X_PJ, X_CJ=X_CJ)
    return VendorJoint(
        name=joint.name(),
        **ends,
        X_PJ=X_PJ,
        X_CJ=X_CJ,
        axis=joint_axis(joint),
        slides=joint_slides(joint),
        limits=np.array([joint.position_lower_limit(), joint.position_upper_limit()]),
        effort=effort if np.isfinite(effort) else 0.0,
        velocity=float(joint.velocity_upper_limit()),
    )
